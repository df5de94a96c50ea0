"""Powered descent guidance as an optimal control problem (section 4.1, appendix A).

The core's landing frame has x up; position and velocity are relative to the ground point that
``final_position`` refers to.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import (
    ConeConstraint,
    CostTerm,
    Miss,
    OptimalControlProblem,
    Parameters,
    PathConstraint,
    StagePoint,
    Variable,
    Where,
)
from dscp_core.problem.extras import Extras
from dscp_core.problem.flight import ControlHold
from dscp_core.problems.loading import ProblemFamily
from dscp_core.problems.powered_descent.figure import descent_figure
from dscp_core.problems.powered_descent.guess import norm, projected_guess, raw_guess
from dscp_core.problems.powered_descent.messages import MESSAGES
from dscp_core.problems.powered_descent.parameters import PARAMETERS, THRUST_PROX
from dscp_core.problems.powered_descent.scene import scene_of_settings

NAME = "powered_descent"

_LENGTH_M = 5000.0
_SPEED_M_S = 150.0
_MASS_KG = 38000.0
_THRUST_N = _MASS_KG * _SPEED_M_S**2 / _LENGTH_M
# Small against the mass: multipliers of the thrust floor are 1e-8 of the final mass and have to
# stand clear of the solver's tolerance.
_COST_KG = 10.0


class Formulation(Enum):
    """Which subproblem is solved.

    PRINTED: the paper's appendix, with an isotropic trust region on the thrust, without which it
    does not converge. CONVERGENT: the same optimum with the curvature of the mass flow kept and
    the thrust bound as a cone.
    """

    PRINTED = "printed"
    CONVERGENT = "convergent"


STATES = (
    *(Variable(n, "m", _LENGTH_M, f"position along {n}, x up") for n in ("x", "y", "z")),
    *(Variable(f"v{n}", "m/s", _SPEED_M_S, f"velocity along {n}") for n in ("x", "y", "z")),
    Variable("mass", "kg", _MASS_KG, "vehicle mass"),
)
CONTROLS = tuple(
    Variable(f"thrust_{n}", "N", _THRUST_N, f"thrust along {n}") for n in ("x", "y", "z")
)


def _mass_flow_per_thrust(p: Mapping[str, ca.SX]) -> ca.SX:
    return 1.0 / (p["specific_impulse"] * p["standard_gravity"])


def dynamics(x: ca.SX, u: ca.SX, p: Parameters) -> ca.SX:
    """Point mass under thrust and constant gravity, (7, 1), SI."""
    mass = x[6]
    gravity = ca.vertcat(-p["gravity"], 0, 0)
    return ca.vertcat(x[3:6], u / mass + gravity, -_mass_flow_per_thrust(p) * norm(u))


def _thrust_tolerance_n(values: Mapping[str, Any]) -> float:
    return _THRUST_TOLERANCE * float(values["thrust_max"])


def _thrust_floor(point: StagePoint, p: Parameters) -> ca.SX:
    return p["thrust_min"] - norm(point.u)


def _mean_thrust_floor(point: StagePoint, p: Parameters) -> ca.SX:
    return p["mean_thrust_fraction"] * p["thrust_min"] - norm(point.u)


def _thrust_ceiling(point: StagePoint, p: Parameters) -> ca.SX:
    return norm(point.u) - p["thrust_max"]


def _thrust_cone(point: StagePoint, p: Parameters) -> ca.SX:
    return ca.vertcat(p["thrust_max"], point.u)


def _pointing_cone(point: StagePoint, p: Parameters) -> ca.SX:
    """Cone whose violation is the distance to it, in N: |u_yz| cos(eta) <= u_x sin(eta)."""
    angle = p["pointing_angle_max"]
    return ca.vertcat(ca.sin(angle) * point.u[0], ca.cos(angle) * point.u[1:3])


def _glideslope_cone(point: StagePoint, p: Parameters) -> ca.SX:
    """Cone above the landing point whose violation is the distance to it, in m."""
    offset, angle = point.x[0:3] - p["final_position"], p["glideslope_angle_max"]
    return ca.vertcat(ca.sin(angle) * offset[0], ca.cos(angle) * offset[1:3])


def _mass_flow_curvature(point: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
    """Second-order term of the burnt mass that linearising |u| drops, in kg.

    |u| = |u_ref| + e.du + |(I - ee')du|^2 / (2 |u_ref|) + ..., e the reference's direction.
    """
    change = point.u - reference.u
    thrust = norm(reference.u)
    across = change - reference.u * (ca.dot(reference.u, change) / thrust**2)
    return reference.step * _mass_flow_per_thrust(p) * ca.sumsqr(across) / (2 * thrust)


def _thrust_prox(point: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
    return p[THRUST_PROX] * _MASS_KG * ca.sumsqr((point.u - reference.u) / _THRUST_N)


def _initial_state(p: Parameters) -> ca.SX:
    return ca.vertcat(p["initial_position"], p["initial_velocity"], p["initial_mass"])


def _check_state(state: NDArray[np.float64], values: Mapping[str, Any]) -> None:
    """Refuse a start below the landing point, by more than what a certificate accepts.

    Raises:
        InvalidInputError: The altitude is below that of the final position.
    """
    ground = float(values["final_position"][0]) - _POSITION_TOLERANCE_M
    if state[0] < ground:
        raise InvalidInputError("x", float(state[0]), f">= {ground:g} m, the landing altitude")


def _check_parameters(values: Mapping[str, Any]) -> None:
    """Refuse an interval whose ends are the wrong way round.

    Raises:
        InvalidInputError: A least value above the greatest.
    """
    for lower, upper in (
        ("thrust_min", "thrust_max"),
        ("terminal_time_min", "terminal_time_max"),
    ):
        if values[lower] > values[upper]:
            raise InvalidInputError(lower, values[lower], f"<= {upper}, {values[upper]:g}")


def _terminal_time_guess(state: NDArray[np.float64], values: Mapping[str, Any]) -> float:
    """Time to fall to the landing altitude, between that at the present speed and twice that.

    A descent that brakes evenly takes the latter.
    """
    height = max(float(state[0] - values["final_position"][0]), _POSITION_TOLERANCE_M)
    descent_speed = max(-float(state[3]), float(np.sqrt(0.5 * values["gravity"] * height)))
    guess = 1.4 * height / descent_speed
    return float(np.clip(guess, values["terminal_time_min"], values["terminal_time_max"]))


def _component(name: str, index: int) -> Callable[[Parameters], ca.SX]:
    return lambda p: p[name][index]


_FINAL_STATE = {
    variable.name: _component("final_position" if i < 3 else "final_velocity", i % 3)
    for i, variable in enumerate(STATES[:6])
}

# What a certificate accepts: 0.1 % of thrust_max, and what landing sites are surveyed to.
_THRUST_TOLERANCE = 1e-3
_POSITION_TOLERANCE_M = 1.0
_SPEED_TOLERANCE_M_S = 0.5

_THRUST_FLOOR = PathConstraint(
    "thrust_min", _thrust_floor, _THRUST_N, "N", tolerance=_thrust_tolerance_n
)
# The midpoint rule burns |mean thrust|: alternating nodal directions would otherwise fly on less
# than thrust_min.
_MEAN_THRUST_FLOOR = PathConstraint(
    "mean_thrust_min",
    _mean_thrust_floor,
    _THRUST_N,
    "N",
    where=Where.MEAN,
    tolerance=_thrust_tolerance_n,
)
_LINEARISED_THRUST_CEILING = PathConstraint(
    "thrust_max", _thrust_ceiling, _THRUST_N, "N", tolerance=_thrust_tolerance_n
)
_THRUST_CONE = ConeConstraint(
    "thrust_max", _thrust_cone, _THRUST_N, "N", tolerance=_thrust_tolerance_n
)
_CONES = (
    ConeConstraint("pointing", _pointing_cone, _THRUST_N, "N", tolerance=_thrust_tolerance_n),
    # Node 0 is pinned; at the end the vehicle stands on the cone's apex.
    ConeConstraint(
        "glideslope",
        _glideslope_cone,
        _LENGTH_M,
        "m",
        skip_first=True,
        skip_last=True,
        tolerance=_POSITION_TOLERANCE_M,
    ),
)
_MISSES = (
    Miss(
        "miss_position",
        lambda x, p: norm(x[0:3] - p["final_position"]),
        "m",
        _POSITION_TOLERANCE_M,
    ),
    Miss(
        "miss_speed", lambda x, p: norm(x[3:6] - p["final_velocity"]), "m/s", _SPEED_TOLERANCE_M_S
    ),
)


NETWORK = Path(__file__).parent / "terminal_time.safetensors"
"""Terminal-time network of the default vehicle."""


def powered_descent(formulation: Formulation = Formulation.CONVERGENT) -> OptimalControlProblem:
    """Fuel-optimal powered descent as an optimal control problem.

    Args:
        formulation: Which subproblem is solved.
    """
    convergent = OptimalControlProblem(
        name=NAME,
        states=STATES,
        controls=CONTROLS,
        parameters=PARAMETERS,
        dynamics=dynamics,
        initial_state=_initial_state,
        final_state=_FINAL_STATE,
        terminal_cost=lambda x, time, p: p["time_weight"] * time - p["fuel_weight"] * x[6],
        terminal_time_bounds=lambda p: (p["terminal_time_min"], p["terminal_time_max"]),
        cost_unit="kg",
        cost_scale=_COST_KG,
        cost_terms=(
            CostTerm("mass_flow_curvature", _mass_flow_curvature, Where.MEAN, ControlHold.MEAN),
            # The curvature between the nodes is at most the mean of that at both.
            CostTerm(
                "nodal_mass_flow_curvature", _mass_flow_curvature, Where.NODE, ControlHold.LINEAR
            ),
            CostTerm(THRUST_PROX, _thrust_prox, Where.NODE),
        ),
        path_constraints=(_THRUST_FLOOR, _MEAN_THRUST_FLOOR),
        cone_constraints=(_THRUST_CONE, *_CONES),
        # Position and mass rows need none: with the velocity relaxed they can always be met.
        virtual_control_scale=(0.0,) * 3 + (1.0,) * 3 + (0.0,),
        virtual_control_weight=3e6,
        initial_guess=projected_guess,
        initial_state_parameters=("initial_position", "initial_velocity", "initial_mass"),
        check_parameters=_check_parameters,
        check_state=_check_state,
        terminal_time_guess=_terminal_time_guess,
        least_time_parameters={"fuel_weight": 0.0, "time_weight": 1000.0},
        misses=_MISSES,
        control_states=(3, 4, 5),
        formulation=Formulation.CONVERGENT.value,
        extras=Extras(
            figure=descent_figure, network=NETWORK, messages=MESSAGES, scene=scene_of_settings
        ),
    )
    if formulation is Formulation.CONVERGENT:
        return convergent
    return replace(
        convergent,
        formulation=formulation.value,
        parameters=tuple(p for p in PARAMETERS if p.name != THRUST_PROX),
        initial_guess=raw_guess,
        cost_terms=(),
        path_constraints=(_THRUST_FLOOR, _LINEARISED_THRUST_CEILING),
        cone_constraints=_CONES,
        virtual_control_scale=tuple(s.scale for s in STATES),
        virtual_control_weight=1e4 * _MASS_KG,
        # This weight leaves 5e-5 where a trajectory is feasible, and 8e-4 at 31.9 s, where none is.
        virtual_control_tolerance=1e-4,
        trust_region_control=(1e-3 * _MASS_KG / _COST_KG,) * 3,
    )


FAMILY = ProblemFamily(
    tuple(f.value for f in reversed(Formulation)), lambda name: powered_descent(Formulation(name))
)
