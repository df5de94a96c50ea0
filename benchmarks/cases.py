"""Initial states that several benchmarks use."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Centre and half width of the sampling box of the paper's section 4.1.3; x is up.
_CENTRE = np.array([5200.0, 0.0, 0.0, -135.0, 0.0, 0.0, 38000.0])
_HALF_WIDTH = np.array([200.0, 600.0, 600.0, 15.0, 30.0, 30.0, 0.0])


def box_states(count: int, seed: int) -> Array:
    """(count, 7) states drawn uniformly from the paper's box: m, m/s, kg."""
    random = np.random.default_rng(seed)
    return _CENTRE + _HALF_WIDTH * random.uniform(-1.0, 1.0, (count, _CENTRE.size))
