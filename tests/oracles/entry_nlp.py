"""The discretised entry problem as one nonlinear program, solved by IPOPT: nothing linearised."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problems.entry.definition import STATES
from dscp_core.problems.entry.physics import dynamic_pressure, heat_rate, load_factor

Array = NDArray[np.float64]

_OPTIONS: dict[str, Any] = {
    "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-10, "bound_relax_factor": 0.0},
    "print_time": False,
}
_PINNED_AT_THE_END = (0, 1, 2, 4, 5)


@dataclass(frozen=True)
class EntryOptimum:
    """IPOPT's answer.

    Attributes:
        message: IPOPT's return status.
        cost: T sum of C_1 gamma^2 + C_2 |u|^2 over the nodes.
        terminal_time_s: Terminal time.
        states: (N+1, 8), SI.
        controls: (N+1, 2), SI.
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
) -> EntryOptimum:
    """Optimum near a start.

    Args:
        problem: For its dynamics and scales.
        values: Parameters by name.
        states: (N+1, 8) to start from.
        controls: (N+1, 2) to start from.
        terminal_time_s: To start from.
    """
    p = {name: ca.SX(ca.DM(value)) for name, value in values.items()}
    count = len(states)
    x_scale = np.array([s.scale for s in problem.states])
    u_scale = np.array([c.scale for c in problem.controls])
    x, u = ca.SX.sym("x", 8), ca.SX.sym("u", 2)
    flow = ca.Function("flow", [x, u], [problem.dynamics(x, u, p)])
    limits = ca.Function(
        "limits",
        [x],
        [
            ca.vertcat(
                dynamic_pressure(x, p) / p["dynamic_pressure_max"],
                heat_rate(x, p) / p["heat_rate_max"],
                load_factor(x, p) / p["load_factor_max"],
            )
        ],
    )
    scaled_x, scaled_u = ca.MX.sym("X", 8, count), ca.MX.sym("U", 2, count)
    scaled_time = ca.MX.sym("T")
    at_nodes = scaled_x * ca.DM(x_scale)
    rates = scaled_u * ca.DM(u_scale)
    step = scaled_time * 1e3 / (count - 1)
    means = [(rows[:, 1:] + rows[:, :-1]) / 2 for rows in (at_nodes, rates)]
    defects = at_nodes[:, 1:] - at_nodes[:, :-1] - step * flow.map(count - 1)(*means)
    ratios = limits.map(count - 1)(at_nodes[:, 1:])
    weights = values["flight_path_angle_weight"], values["rate_weight"]
    cost = step * (weights[0] * ca.sumsqr(at_nodes[4, :]) + weights[1] * ca.sumsqr(rates))
    unknowns = ca.vertcat(scaled_time, ca.vec(scaled_x), ca.vec(scaled_u))
    rows = ca.vertcat(ca.vec(defects / ca.DM(x_scale)), ca.vec(ratios))
    solver = ca.nlpsol("entry", "ipopt", {"x": unknowns, "f": cost, "g": rows}, _OPTIONS)
    low, high = _bounds(values, count, x_scale, u_scale)
    equalities = 8 * (count - 1)
    answer = solver(
        x0=np.concatenate(
            [[terminal_time_s / 1e3], (states / x_scale).ravel(), (controls / u_scale).ravel()]
        ),
        lbx=low,
        ubx=high,
        lbg=np.concatenate([np.zeros(equalities), np.full(3 * (count - 1), -np.inf)]),
        ubg=np.concatenate([np.zeros(equalities), np.ones(3 * (count - 1))]),
    )
    found = np.asarray(answer["x"]).ravel()
    return EntryOptimum(
        message=solver.stats()["return_status"],
        cost=float(answer["f"]),
        terminal_time_s=float(found[0] * 1e3),
        states=found[1 : 1 + 8 * count].reshape(count, 8) * x_scale,
        controls=found[1 + 8 * count :].reshape(count, 2) * u_scale,
    )


def _bounds(
    values: Mapping[str, Any], count: int, x_scale: Array, u_scale: Array
) -> tuple[Array, Array]:
    """Bounds of the unknowns; pinned states are bounds too."""
    sides = []
    for side, sign in (("min", -1.0), ("max", 1.0)):
        x = np.full((count, 8), sign * np.inf)
        for column, name in ((6, "angle_of_attack"), (7, "bank_angle")):
            x[:, column] = values[f"{name}_{side}"]
        if side == "min":
            x[:, 3] = values["speed_min"]
        names = [state.name for state in STATES]
        x[0] = [values[f"initial_{name}"] for name in names]
        for column in _PINNED_AT_THE_END:
            x[-1, column] = values[f"final_{names[column]}"]
        u = np.tile([values[f"{n}_{side}"] for n in ("angle_of_attack_rate", "bank_rate")], count)
        u = u.reshape(count, 2)
        time = [values[f"terminal_time_{side}"] / 1e3]
        sides.append(np.concatenate([time, (x / x_scale).ravel(), (u / u_scale).ravel()]))
    return sides[0], sides[1]
