"""How much less a trajectory could cost, judged by what still pulls at it.

A subproblem's quadratic terms keep its solution z near the reference r. Without them z would not be
optimal: the other terms still pull with the gradient p = Q (z - r). Where the subproblem is a fair
model, no trajectory z' costs less than z by more than p'(z' - z), so that p times a distance bounds
what is to be gained (the duality gap of Frank and Wolfe, 1956, with the range of the plan in place
of the feasible set). It takes no further subproblem, and is not small where heavy weights alone
make the steps, and with them the predicted changes, small.
"""

from __future__ import annotations

import numpy as np

from dscp_core.scp.scp import Scp
from dscp_core.scp.trace import Iteration

_UNRESOLVED = 100.0
"""Tolerances of the cone solver, relative to the cost, below which no gain can be told: runs that
hardly moved any more have gained up to 34 (docs/method.md)."""


def cost_to_gain(scp: Scp, iteration: Iteration) -> float | None:
    """Estimate, from above, of what an iteration's trajectory costs more than a local optimum.

    How far each state, control and the terminal time may still go is not known: its largest
    magnitude in the plan is taken, or the span of its values there, if that is more. What the cost
    owes to defects of the dynamics is added, by their multipliers. How often the sum is too small
    has been measured: docs/method.md, ``python -m benchmarks cost_to_gain``.

    Args:
        scp: The loop that made the iteration.
        iteration: Any.

    Returns:
        In the unit of the problem's cost, > 0; None where virtual control is left, as the
        trajectory has no feasible one to be compared with.
    """
    layout, pattern = scp.transcription.layout, scp.transcription.pattern
    if layout.relative(iteration.virtual_control) > scp.virtual_control_tolerance:
        return None
    size = layout.reference_size
    kept = int(pattern.q.indptr[size])  # the virtual control's part comes last
    rows, columns = pattern.q.indices[:kept], pattern.q.columns[:kept]
    values = iteration.values.q[:kept]
    reached = iteration.solution.z[:size]
    step = reached - iteration.reference
    pull = np.bincount(rows, values * step[columns], size)
    off = rows != columns  # Q is stored as its upper triangle
    pull += np.bincount(columns[off], (values * step[rows])[off], size)
    nodes = reached[layout.offset :].reshape(layout.intervals + 1, -1)
    distance = np.maximum(np.abs(nodes).max(axis=0), np.ptp(nodes, axis=0))
    distances = np.append(np.abs(reached[: layout.offset]), np.tile(distance, len(nodes)))
    defects = (iteration.defects / layout.state_scale).ravel()
    multipliers = iteration.solution.equality_dual[: defects.size]  # the dynamics come first
    bound = np.abs(pull) @ distances + np.abs(multipliers) @ np.abs(defects)
    problem = scp.transcription.problem
    magnitude = max(problem.cost_magnitude or problem.cost_scale, abs(iteration.cost))
    unresolved = _UNRESOLVED * scp.options.solver_settings.tolerance * magnitude
    return float(bound) * problem.cost_scale + unresolved
