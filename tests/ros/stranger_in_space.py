"""A stranger's drone over a landing pad: it brings its names, axes, odometry, limits and a scene.

Its states are (up, east, north); messages have x east, y north, z up.
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
from dscp_core.problem.extras import Extras
from dscp_core.problem.messages import Messages, Odometry, StateLimit, StateLimitError
from dscp_core.problem.parameters import Parameter
from dscp_core.problem.scene import Arrows, Line, Scene, Sphere, Triangles

AXES = (1, 2, 0)


def admit(named, parameters, settings):
    if named["z"] < 0.0:
        raise StateLimitError(StateLimit.BELOW_GROUND, "position.z", named["z"], ">= 0 m")
    if named["z"] > 1e3:
        raise InvalidInputError("z", named["z"], "<= 1000 m")
    return named


def scene(plan, parameters, settings):
    if not settings["site_radius_m"]:
        raise RuntimeError("no site to draw")
    places, pushes = plan.states[:, :3][:, AXES], plan.controls[:, AXES]
    corners = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 9.0, 0.0]])
    grey = (0.5, 0.5, 0.5, 0.5)
    return Scene(
        places,
        shapes=(
            Line("path", places, 0.2),
            Arrows("push", places, pushes, 0.1),
            Triangles("ground", corners, grey),
            Sphere("site", np.zeros(3), settings["site_radius_m"], grey),
        ),
    )


def guess(p, intervals):
    share = ca.DM(np.linspace(0.0, 1.0, intervals + 1)).T
    states = ca.mtimes(p["start"], 1 - share)
    return InitialGuess(states, ca.MX(ca.DM.zeros(3, intervals + 1)))


def effort(at, reference, p):
    slower = (at.step - reference.step) * ca.sumsqr(reference.u) / 2
    return reference.step * ca.sumsqr(at.u) / 2 + slower


NAMES = ("up", "east", "north")

drone = OptimalControlProblem(
    name="drone",
    states=(
        *(Variable(n, "m", 10.0, "place") for n in NAMES),
        *(Variable(f"{n}_speed", "m/s", 3.0, "velocity") for n in NAMES),
    ),
    controls=tuple(Variable(f"{n}_push", "m/s^2", 1.0, "acceleration") for n in NAMES),
    parameters=(
        Parameter("terminal_time", 20.0, "s", "Duration.", lower=0.1, upper=60.0),
        Parameter("start", (50.0, 0.0, 0.0, 0.0, 0.0, 0.0), "1", "State at the start."),
        Parameter("wind", (0.0, 0.1, 0.0), "m/s^2", "Acceleration by the wind."),
        Parameter("push_max", 5.0, "m/s^2", "Greatest push upwards.", lower=0.1, upper=50.0),
    ),
    dynamics=lambda x, u, p: ca.vertcat(x[3:6], u + p["wind"]),
    initial_state=lambda p: p["start"],
    final_state={
        name: (lambda p: 0.0 * p["push_max"]) for name in (*NAMES, *(f"{n}_speed" for n in NAMES))
    },
    terminal_cost=lambda x, time, p: 0.0 * time,
    running_cost=lambda x, u, p: ca.sumsqr(u) / 2,
    cost_scale=1.0,
    cost_terms=(CostTerm("effort", effort, Where.NODE),),
    path_constraints=(
        PathConstraint(
            "push_max", lambda at, p: at.u[0] - p["push_max"], 1.0, "m/s^2", tolerance=1e-3
        ),
    ),
    initial_guess=guess,
    initial_state_parameters=("start",),
    control_states=(3, 4, 5),
    misses=(Miss("miss_place", lambda x, p: ca.norm_2(x[:3]), "m", 0.05),),
    extras=Extras(
        messages=Messages(
            states=(
                *zip("xyz", (NAMES[i] for i in AXES), strict=True),
                *((f"v{c}", f"{NAMES[i]}_speed") for c, i in zip("xyz", AXES, strict=True)),
            ),
            axes=AXES,
            frame="site",
            frame_parameter="site_frame",
            odometry=Odometry(),
            settings=(Parameter("site_radius_m", 3.0, "m", "Radius of the site.", 0.0, 100.0),),
            admit=admit,
        ),
        scene=scene,
    ),
)
