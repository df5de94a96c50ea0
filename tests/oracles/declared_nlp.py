"""Any declared problem, discretised, as one nonlinear program for IPOPT.

Nothing is linearised or convexified, and neither transcription nor SCP has a part in it.
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
    "ipopt": {
        "print_level": 0,
        "sb": "yes",
        "tol": 1e-10,
        "max_iter": 1000,
        "mu_init": 1e-7,
        "bound_push": 1e-8,
        "bound_frac": 1e-8,
    },
    "print_time": False,
}


@dataclass(frozen=True)
class Optimum:
    """IPOPT's answer.

    Attributes:
        message: IPOPT's return status.
        cost: Terminal cost, and the trapezoidal sum of the running cost.
        terminal_time_s: Terminal time.
        states: (N+1, nx), SI.
        controls: (N+1, nu), SI.
    """

    message: str
    cost: float
    terminal_time_s: float
    states: Array
    controls: Array


def solve(
    problem: OptimalControlProblem,
    values: Mapping[str, Any],
    states: Array,
    controls: Array,
    terminal_time_s: float,
    *,
    free: bool,
    propagated: bool = False,
) -> Optimum:
    """Optimum near a start, of a problem whose path constraints stand at nodes.

    Args:
        problem: The declaration.
        values: Parameters by name, SI.
        states: (N+1, nx) to start from.
        controls: (N+1, nu) to start from.
        terminal_time_s: To start from where it is free, else to keep.
        free: Whether it is free, within the declared bounds or else 1/100 to 100 times the start.
        propagated: Whether intervals are integrated under the mean of their controls, instead of by
            the midpoint rule.
    """
    assert not problem.cone_constraints
    p = {name: ca.SX(ca.DM(value)) for name, value in values.items()}
    count, nx, nu = len(states), len(problem.states), len(problem.controls)
    x_scale = np.array([v.scale for v in problem.states])
    u_scale = np.array([v.scale for v in problem.controls])
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    flow = ca.Function("flow", [x, u], [problem.dynamics(x, u, p)])
    running = problem.running_cost or (lambda _x, _u, _p: ca.SX(0))
    along = ca.Function("running", [x, u], [running(x, u, p)])
    at = StagePoint(x, u, ca.SX(0.0))

    scaled_x, scaled_u = ca.MX.sym("X", nx, count), ca.MX.sym("U", nu, count)
    time_s = ca.MX.sym("time")
    at_nodes, acting = scaled_x * ca.DM(x_scale), scaled_u * ca.DM(u_scale)
    step = time_s / (count - 1)
    means = [(v[:, 1:] + v[:, :-1]) / 2 for v in (at_nodes, acting)]
    if propagated:
        fly = _flight(flow, nx, nu).map(count - 1)
        defects = at_nodes[:, 1:] - fly(at_nodes[:, :-1], means[1], step)
    else:
        defects = at_nodes[:, 1:] - at_nodes[:, :-1] - step * flow.map(count - 1)(*means)
    weights = np.ones(count)
    weights[[0, -1]] = 0.5
    cost = step * ca.dot(along.map(count)(at_nodes, acting), ca.DM(weights).T)
    if problem.terminal_cost is not None:
        time = ca.SX.sym("time")
        end = ca.Function("end", [x, time], [problem.terminal_cost(x, time, p)])
        cost += end(at_nodes[:, -1], time_s)
    pinned = [at_nodes[:, 0] - ca.DM(ca.evalf(problem.initial_state(p)))]
    names = [v.name for v in problem.states]
    pinned += [
        at_nodes[names.index(name), -1] - ca.DM(ca.evalf(ca.SX(value(p))))
        for name, value in problem.final_state.items()
    ]
    equalities = ca.vertcat(ca.vec(defects / ca.DM(x_scale)), *pinned)
    limits = []
    for c in problem.path_constraints:
        limit = ca.Function("limit", [x, u], [c.expression(at, p) / c.scale])
        nodes = slice(count - 1 if c.only_last else int(c.skip_first), count - int(c.skip_last))
        limits.append(limit.map(nodes.stop - nodes.start)(at_nodes[:, nodes], acting[:, nodes]).T)
    inequalities = ca.vertcat(*limits, ca.MX(0, 1))
    unknowns = ca.vertcat(time_s, ca.vec(scaled_x), ca.vec(scaled_u))
    solver = ca.nlpsol(
        "declared",
        "ipopt",
        {"x": unknowns, "f": cost / problem.cost_scale, "g": ca.vertcat(equalities, inequalities)},
        _OPTIONS,
    )
    low, high = np.full(unknowns.numel(), -np.inf), np.full(unknowns.numel(), np.inf)
    low[0] = high[0] = terminal_time_s
    if free:
        low[0], high[0] = terminal_time_s / 100.0, terminal_time_s * 100.0
        if problem.terminal_time_bounds is not None:
            low[0], high[0] = (float(bound) for bound in problem.terminal_time_bounds(p))
    answer = solver(
        x0=np.concatenate(
            [[terminal_time_s], (states / x_scale).ravel(), (controls / u_scale).ravel()]
        ),
        lbx=low,
        ubx=high,
        lbg=np.concatenate([np.zeros(equalities.numel()), np.full(inequalities.numel(), -np.inf)]),
        ubg=np.zeros(equalities.numel() + inequalities.numel()),
    )
    found = np.asarray(answer["x"]).ravel()
    return Optimum(
        message=solver.stats()["return_status"],
        cost=float(answer["f"]) * problem.cost_scale,
        terminal_time_s=float(found[0]),
        states=found[1 : 1 + nx * count].reshape(count, nx) * x_scale,
        controls=found[1 + nx * count :].reshape(count, nu) * u_scale,
    )


def _flight(flow: ca.Function, nx: int, nu: int, steps: int = 6) -> ca.Function:
    """State after an interval of constant controls, by Kutta's three-eighths rule."""
    x, u, length = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("T")
    state, step = x, length / steps
    for _ in range(steps):
        k1 = flow(state, u)
        k2 = flow(state + step * k1 / 3, u)
        k3 = flow(state + step * (k2 - k1 / 3), u)
        k4 = flow(state + step * (k1 - k2 + k3), u)
        state = state + step * (k1 + 3 * k2 + 3 * k3 + k4) / 8
    return ca.Function("flight", [x, u, length], [state])
