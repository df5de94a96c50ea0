"""Gradient of an optimal cost from the multipliers of the converged run, without its iterations.

By the envelope theorem it is the partial derivative of the Lagrangian at the optimum: of the cost
itself, and of the constraints weighted with their multipliers. As accurate as the iterations have
converged; it does not see weights that only matter on the way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.program import ConeValues
from dscp_core.problem.declaration import TERMINAL_TIME
from dscp_core.scp.scp import Scp, ScpResult

Array = NDArray[np.float64]


def envelope_gradient(scp: Scp, trace: ScpResult) -> Array:
    """Derivative (P,) of the optimal cost by the packed parameters, per SI unit.

    Args:
        scp: The loop that made the trace.
        trace: A converged result.
    """
    transcription = scp.transcription
    reference, parameters = trace.final_reference, trace.parameters
    cotangent = _constraint_cotangent(scp, trace)
    constraints = transcription.values_pullback(reference, parameters, cotangent)[1]
    cost = transcription.cost_gradient(reference, parameters)[1]
    return np.asarray(cost + transcription.problem.cost_scale * constraints)


def envelope_slope(scp: Scp, trace: ScpResult) -> float:
    """Derivative of the optimal penalised cost by the terminal time, in the cost's unit per s.

    Args:
        scp: The loop that made the trace, with a fixed terminal time.
        trace: A converged result.
    """
    transcription = scp.transcription
    pattern, z = transcription.pattern, trace.iterations[-1].solution.z
    rows, columns = pattern.q.indices, pattern.q.columns
    cotangent = _constraint_cotangent(scp, trace)
    cotangent.q[:] = np.where(rows == columns, 0.5, 1.0) * z[rows] * z[columns]
    cotangent.c[:] = z
    pulled = transcription.values_pullback(trace.final_reference, trace.parameters, cotangent)[1]
    slope = pulled[transcription.table.slice(TERMINAL_TIME)][0]
    return float(slope * transcription.problem.cost_scale)


def _constraint_cotangent(scp: Scp, trace: ScpResult) -> ConeValues:
    """Derivative of the Lagrangian by the values of the last subproblem's constraints."""
    transcription, solution = scp.transcription, trace.iterations[-1].solution
    pattern, z, dual = transcription.pattern, solution.z, solution.cone_dual
    cotangent = transcription.values(trace.final_reference, trace.parameters).copy()
    cotangent.q[:] = 0.0
    cotangent.c[:] = 0.0
    cotangent.a[:] = solution.equality_dual[pattern.a.indices] * z[pattern.a.columns]
    cotangent.b[:] = -solution.equality_dual
    cotangent.g[:] = dual[pattern.g.indices] * z[pattern.g.columns]
    cotangent.h[:] = -dual
    return cotangent
