"""The nearest trajectory that the dynamics lead along, from the iteration's to the pinned end.

The penalty of an iteration leaves some virtual control, and the defects only vanish in the limit:
a millimetre below the ground at the end is a contact at 0.15 m/s for a vehicle that brakes with
12 m/s^2. One Newton step of least length in scaled units takes them away.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray

from dscp_core.problem.flight import Discretisation
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

_DEFECT = 1e-12
"""Scaled defect that is rounding."""
_MOST_STEPS = 3


def flyable(transcription: Transcription, reference: Array, parameters: Array) -> Array:
    """What is flown of a trajectory: its restoration, where its dynamics are those of the flight.

    Args:
        transcription: See `restored`.
        reference: Scaled reference vector that nearly satisfies the dynamics.
        parameters: Packed parameters, SI.
    """
    if transcription.discretisation is Discretisation.PROPAGATED:
        return restored(transcription, reference, parameters)
    return reference


def restored(transcription: Transcription, reference: Array, parameters: Array) -> Array:
    """A trajectory near this one that starts, moves and ends as the problem says.

    Args:
        transcription: Whose dynamics count.
        reference: Scaled reference vector that nearly satisfies them.
        parameters: Packed parameters, SI.

    Returns:
        Scaled reference vector; the given one where no step makes it better.
    """
    best, least = reference, math.inf
    for _ in range(_MOST_STEPS + 1):
        values = transcription.values(reference, parameters)
        rows = transcription.pattern.a.matrix(values.a)[:, : reference.size]
        # Linearised about the reference itself, the equations' residual is the true one.
        residual = values.b - rows @ reference
        error = float(np.max(np.abs(residual)))
        if not error < least:
            break
        best, least = reference, error
        if error <= _DEFECT:
            break
        try:
            factor = scipy.sparse.linalg.splu(sp.csc_array(rows @ rows.T))
        except RuntimeError:  # dependent rows
            break
        reference = reference + rows.T @ factor.solve(residual)
        if not np.all(np.isfinite(reference)):
            break
    return best
