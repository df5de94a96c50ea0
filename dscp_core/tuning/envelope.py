"""Gradient of an optimal cost from the multipliers of the converged run, without its iterations."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.ocp import OptimalControlProblem
from dscp_core.scp import Scp, ScpResult
from dscp_core.stages import named

Array = NDArray[np.float64]

_MASS = "mass"


def envelope_gradient(scp: Scp, trace: ScpResult) -> Array:
    """Derivative (P,) of the optimal cost by the packed parameters, per SI unit.

    By the envelope theorem it is the partial derivative of the Lagrangian at the optimum: of the
    cost itself, and of the constraints weighted with their multipliers. As accurate as the
    iterations have converged; it does not see weights that only matter on the way.

    Args:
        scp: The loop that made the trace.
        trace: A converged result.
    """
    transcription, solution = scp.transcription, trace.iterations[-1].solution
    reference, parameters = trace.final_reference, trace.parameters
    pattern, z, dual = transcription.pattern, solution.z, solution.cone_dual
    cotangent = transcription.values(reference, parameters)
    cotangent.q[:] = 0.0
    cotangent.c[:] = 0.0
    cotangent.a[:] = solution.equality_dual[pattern.a.indices] * z[pattern.a.columns]
    cotangent.b[:] = -solution.equality_dual
    cotangent.g[:] = dual[pattern.g.indices] * z[pattern.g.columns]
    cotangent.h[:] = -dual
    constraints = transcription.values_pullback(reference, parameters, cotangent)[1]
    cost = transcription.cost_gradient(reference, parameters)[1]
    return np.asarray(cost + transcription.problem.cost_scale * constraints)


def cost_is_minus_mass(
    problem: OptimalControlProblem, parameters: Array, tuned: Sequence[int]
) -> bool:
    """Whether the cost is minus the final mass, whatever the tuned parameters are.

    Args:
        problem: The declaration.
        parameters: (P,) packed, SI.
        tuned: Indices of those that may change.
    """
    names = [s.name for s in problem.states]
    if _MASS not in names or problem.running_cost is not None:
        return False
    x, time = ca.SX.sym("x", len(names)), ca.SX.sym("t")
    packed = ca.SX.sym("p", problem.table.size)
    cost = problem.terminal_cost(x, time, named(problem, packed))
    rest = cost + x[names.index(_MASS)]
    changing = ca.vertcat(x, time, *(packed[index] for index in tuned))
    slopes = ca.Function("slopes", [x, time, packed], [ca.jacobian(rest, changing)])
    random = np.random.default_rng(0)
    scale = np.array([s.scale for s in problem.states])
    return all(
        np.all(np.array(slopes(scale * random.normal(size=scale.size), 10.0, parameters)) == 0.0)
        for _ in range(3)
    )
