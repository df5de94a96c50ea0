"""Runs whose gradients are tested, and differences of whole runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dscp_core import problems
from dscp_core.gradients.losses import FinalStateLoss, Loss
from dscp_core.gradients.run import Method, tangent, unrolled
from dscp_core.scp.scp import Scp, ScpOptions
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

MINUS_FINAL_MASS = FinalStateLoss("mass", -1.0)


def descent(intervals: int, formulation: str = "convergent", *, free: bool = False) -> Scp:
    transcription = Transcription(
        problems.get("powered_descent", formulation), intervals, free_terminal_time=free
    )
    return Scp(transcription, ScpOptions.for_gradients(solver="clarabel"))


def packed(scp: Scp, **values: Any) -> Array:
    return scp.transcription.table.pack(values)


def difference(function: Callable[[float], float], step: float) -> float:
    """Derivative at zero by central differences, extrapolated once to fourth order."""
    near, far = ((function(size) - function(-size)) / (2.0 * size) for size in (step, 2.0 * step))
    return (4.0 * near - far) / 3.0


def unit(scp: Scp, name: str, component: int) -> Array:
    direction = np.zeros(scp.transcription.table.size)
    direction[scp.transcription.table.slice(name).start + component] = 1.0
    return direction


def compare(
    scp: Scp, parameters: Array, direction: Array, step: float, loss: Loss = MINUS_FINAL_MASS
) -> tuple[float, float]:
    """Gradient along a direction, and difference of whole runs with the same K.

    The step is cut to where the first active set changes: no difference across a kink.
    """
    trace = scp.run(parameters)
    gradient = unrolled(scp, trace, loss)
    assert gradient.trusted, gradient.reasons
    assert gradient.method is Method.UNROLLED
    assert gradient.value == pytest.approx(loss.value(scp.transcription, trace), rel=1e-14)
    forward = tangent(scp, trace, direction)
    backward = tangent(scp, trace, -direction)
    # Twice the step is used, and the radius is of first order.
    safe = min(step, 0.3 * forward.active_set_radius, 0.3 * backward.active_set_radius)

    def value(size: float) -> float:
        return loss.value(scp.transcription, scp.run(parameters + size * direction))

    return float(gradient.parameters @ direction), difference(value, safe)
