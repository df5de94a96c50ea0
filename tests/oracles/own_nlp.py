"""A discretised problem of any declaration as one nonlinear program, solved by IPOPT.

Midpoint rule, and the running cost by the trapezoidal rule, written down once more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.declaration import OptimalControlProblem, StagePoint

Array = NDArray[np.float64]

_OPTIONS: dict[str, Any] = {
    "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-10, "bound_relax_factor": 0.0},
    "print_time": False,
}


@dataclass(frozen=True)
class Optimum:
    """IPOPT's answer.

    Attributes:
        message: IPOPT's return status.
        cost: Terminal cost plus the running cost's integral.
        states: (N+1, nx), SI.
        controls: (N+1, nu), SI.
        terminal_time_s: Terminal time.
    """

    message: str
    cost: float
    states: Array
    controls: Array
    terminal_time_s: float


def solve(
    problem: OptimalControlProblem,
    values: Mapping[str, Any],
    states: Array,
    controls: Array,
    *,
    free: bool = False,
) -> Optimum:
    """Optimum near a start, for a problem whose constraints stand at nodes.

    Args:
        problem: The declaration.
        values: Every parameter by name.
        states: (N+1, nx) to start from.
        controls: (N+1, nu) to start from.
        free: Whether the terminal time is free, from 1/100 to 100 times that of the values.
    """
    p = {name: ca.SX(ca.DM(value)) for name, value in values.items()}
    count, nx = states.shape
    time = ca.SX.sym("time")
    x, u = ca.SX.sym("x", nx, count), ca.SX.sym("u", controls.shape[1], count)
    step = time / (count - 1)
    rows = [x[:, 0] - problem.initial_state(p)]
    names = [state.name for state in problem.states]
    rows += [x[names.index(n), -1] - value(p) for n, value in problem.final_state.items()]
    for n in range(count - 1):
        rates = problem.dynamics((x[:, n] + x[:, n + 1]) / 2, (u[:, n] + u[:, n + 1]) / 2, p)
        rows.append(x[:, n + 1] - x[:, n] - step * rates)
    cost = ca.SX(0)
    if problem.terminal_cost is not None:
        cost += problem.terminal_cost(x[:, -1], time, p)
    if problem.running_cost is not None:
        along = [problem.running_cost(x[:, n], u[:, n], p) for n in range(count)]
        cost += step * (sum(along) - (along[0] + along[-1]) / 2)
    limits = [
        c.expression(StagePoint(x[:, n], u[:, n], step), p)
        for c in problem.path_constraints
        for n in range(int(c.skip_first), count - int(c.skip_last))
    ]
    equal, unequal = ca.vertcat(*rows), ca.vertcat(*limits, ca.SX(0, 1))
    unknowns = ca.vertcat(time, ca.vec(x), ca.vec(u))
    program = {"x": unknowns, "f": cost, "g": ca.vertcat(equal, unequal)}
    solver = ca.nlpsol("own", "ipopt", program, _OPTIONS)
    given = float(values["terminal_time"])
    size = unknowns.numel() - 1
    span = 100.0 if free else 1.0
    answer = solver(
        x0=np.concatenate([[given], states.ravel(), controls.ravel()]),
        lbx=np.concatenate([[given / span], np.full(size, -np.inf)]),
        ubx=np.concatenate([[given * span], np.full(size, np.inf)]),
        lbg=np.concatenate([np.zeros(equal.numel()), np.full(unequal.numel(), -np.inf)]),
        ubg=np.zeros(equal.numel() + unequal.numel()),
    )
    found = np.asarray(answer["x"]).ravel()
    end = 1 + nx * count
    return Optimum(
        message=solver.stats()["return_status"],
        cost=float(answer["f"]),
        states=found[1:end].reshape(count, nx),
        controls=found[end:].reshape(count, -1),
        terminal_time_s=float(found[0]),
    )
