"""Small optimal control problems whose answers are known, or cheap to find."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.declaration import (
    InitialGuess,
    OptimalControlProblem,
    Parameters,
    PathConstraint,
    StagePoint,
    Variable,
)
from dscp_core.problem.parameters import Parameter
from dscp_core.scp.scp import Scp
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

_PARAMETERS = (
    Parameter("terminal_time", 2.0, "s", "Duration.", lower=0.1, upper=10.0),
    Parameter("start", (0.0, 0.0), "1", "Position and speed at the start."),
    Parameter("target", (1.0, 0.0), "1", "Position and speed at the end."),
    Parameter("mass", 1.5, "kg", "Mass.", lower=0.1, upper=10.0),
    Parameter("drag", 0.2, "kg/m", "Drag over squared speed.", lower=0.0, upper=10.0),
    Parameter("force_max", 2.0, "N", "Greatest force.", lower=0.0, upper=100.0),
)


def _straight(p: Mapping[str, ca.MX], intervals: int) -> InitialGuess:
    share = ca.DM(np.linspace(0.0, 1.0, intervals + 1)).T
    states = ca.mtimes(p["start"], 1 - share) + ca.mtimes(p["target"], share)
    return InitialGuess(states, ca.MX(ca.DM.zeros(1, intervals + 1)))


def effort(at: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
    """T u^2 / 2, convex: the product of both changes is left out."""
    slower = (at.step - reference.step) * reference.u[0] ** 2 / 2
    return reference.step * at.u[0] ** 2 / 2 + slower


def cart() -> OptimalControlProblem:
    """Cart with quadratic drag, moved by a bounded force with the least integral of u^2 / 2."""
    return OptimalControlProblem(
        name="cart",
        states=(Variable("position", "m", 2.0, ""), Variable("speed", "m/s", 0.5, "")),
        controls=(Variable("force", "N", 3.0, ""),),
        parameters=_PARAMETERS,
        dynamics=lambda x, u, p: ca.vertcat(x[1], (u[0] - p["drag"] * x[1] ** 2) / p["mass"]),
        initial_state=lambda p: p["start"],
        final_state={"position": lambda p: p["target"][0], "speed": lambda p: p["target"][1]},
        running_cost=lambda x, u, p: u[0] ** 2 / 2,
        cost_scale=2.0,
        path_constraints=(
            PathConstraint("force_max", lambda at, p: at.u[0] - p["force_max"], 3.0, "N"),
            PathConstraint("force_min", lambda at, p: -at.u[0] - p["force_max"], 3.0, "N"),
        ),
        initial_guess=_straight,
    )


def free_cart() -> OptimalControlProblem:
    """The cart without drag and bounds: a linear-quadratic problem without any inequality."""
    free = tuple(replace(p, default=0.0) if p.name == "drag" else p for p in _PARAMETERS)
    return replace(cart(), parameters=free, path_constraints=())


def trapezoid_weights(intervals: int) -> Array:
    """Weights (N+1,) of the nodes in an integral over N intervals of length 1."""
    weights = np.ones(intervals + 1)
    weights[[0, -1]] = 0.5
    return weights


def least_effort(intervals: int, time_s: float, mass_kg: float) -> Array:
    """Optimal forces (N+1,) of the free cart from rest to 1 m, by the normal equations."""
    step = time_s / intervals
    means = (np.eye(intervals, intervals + 1) + np.eye(intervals, intervals + 1, 1)) / 2
    gained = step / mass_kg * means  # speed gained per interval
    speed_end = gained.sum(axis=0)
    # The mean speed of interval n is the speed at its start plus half of what it gains.
    position_end = step * ((np.arange(intervals)[::-1] + 0.5) @ gained)
    ends = np.vstack([position_end, speed_end])
    weighted = ends / trapezoid_weights(intervals)
    forces: Array = weighted.T @ np.linalg.solve(ends @ weighted.T, np.array([1.0, 0.0]))
    return forces


def effort_of(forces: Array, time_s: float) -> float:
    """Integral of u^2 / 2 over N intervals, by the trapezoidal rule."""
    intervals = forces.size - 1
    return float(time_s / intervals * trapezoid_weights(intervals) @ forces**2 / 2)


@dataclass(frozen=True)
class Costs:
    """Setup of a worker: least cost of a problem by its drag.

    Attributes:
        problem: With a parameter of that name.
    """

    problem: OptimalControlProblem

    def __call__(self) -> Callable[[float], float]:
        """Compile it."""
        scp = Scp(Transcription(self.problem, 6))

        def cost(drag: float) -> float:
            return scp.run(self.problem.pack({"drag": drag})).iterations[-1].cost

        return cost
