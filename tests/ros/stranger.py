"""A stranger's problem: a puck with drag in a plane, moved with the least effort.

It says nothing of messages, figures or networks. Tests copy this file to where no package is.
"""

import casadi as ca
import numpy as np

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import (
    CostTerm,
    InitialGuess,
    Miss,
    OptimalControlProblem,
    PathConstraint,
    Variable,
    Where,
)
from dscp_core.problem.parameters import Parameter

PARAMETERS = (
    Parameter("terminal_time", 4.0, "s", "Duration.", lower=0.1, upper=60.0),
    Parameter("start", (0.0, 0.0), "m", "Place at the start.", lower=-50.0, upper=50.0),
    Parameter("start_velocity", (0.0, 0.0), "m/s", "Velocity there.", lower=-9.0, upper=9.0),
    Parameter("target", (3.0, -2.0), "m", "Place at the end, where it rests."),
    Parameter("drag", 0.3, "1/m", "Deceleration over squared speed.", lower=0.0, upper=5.0),
    Parameter("push_max", 1.5, "m/s^2", "Greatest push along each axis.", lower=0.1, upper=9.0),
)


def dynamics(x, u, p):
    speed = ca.sqrt(ca.sumsqr(x[2:4]) + 1e-6)
    return ca.vertcat(x[2:4], u - p["drag"] * speed * x[2:4])


def guess(p, intervals):
    share = ca.DM(np.linspace(0.0, 1.0, intervals + 1)).T
    places = ca.mtimes(p["start"], 1 - share) + ca.mtimes(p["target"], share)
    velocities = ca.mtimes(p["start_velocity"], 1 - share)
    return InitialGuess(ca.vertcat(places, velocities), ca.MX(ca.DM.zeros(2, intervals + 1)))


def effort(at, reference, p):
    slower = (at.step - reference.step) * ca.sumsqr(reference.u) / 2
    return reference.step * ca.sumsqr(at.u) / 2 + slower


def check_state(state, values):
    if np.hypot(*(state[:2] - values["target"])) > 40.0:
        raise InvalidInputError("place", state[:2].tolist(), "within 40 m of the target")


def limit(axis, sign):
    return PathConstraint(
        f"push_{axis}_{'max' if sign > 0 else 'min'}",
        lambda at, p: sign * at.u["xy".index(axis)] - p["push_max"],
        1.0,
        "m/s^2",
        tolerance=1e-3,
    )


def component(name, index):
    return lambda p: p[name][index] if name else 0.0 * p["target"][index]


puck = OptimalControlProblem(
    name="puck",
    states=(
        Variable("east", "m", 3.0, "place"),
        Variable("north", "m", 3.0, "place"),
        Variable("speed_east", "m/s", 1.0, "velocity"),
        Variable("code", "m/s", 1.0, "velocity along north; its name is a key of reports too"),
    ),
    controls=(
        Variable("push_east", "m/s^2", 1.0, "push"),
        Variable("push_north", "m/s^2", 1.0, "push"),
    ),
    parameters=PARAMETERS,
    dynamics=dynamics,
    initial_state=lambda p: ca.vertcat(p["start"], p["start_velocity"]),
    final_state={
        "east": component("target", 0),
        "north": component("target", 1),
        "speed_east": component("", 0),
        "code": component("", 1),
    },
    terminal_cost=lambda x, time, p: 0.0 * time,
    running_cost=lambda x, u, p: ca.sumsqr(u) / 2,
    cost_unit="m^2/s^3",
    cost_scale=1.0,
    cost_terms=(CostTerm("effort", effort, Where.NODE),),
    path_constraints=tuple(limit(axis, sign) for axis in "xy" for sign in (1, -1)),
    initial_guess=guess,
    default_intervals=30,
    initial_state_parameters=("start", "start_velocity"),
    check_state=check_state,
    misses=(Miss("miss_place", lambda x, p: ca.norm_2(x[:2] - p["target"]), "m", 0.05),),
)


def made():
    return puck


anything = 42


def failing():
    raise ValueError("no puck today")
