"""Powered descent guidance as an optimal control problem (section 4.1, appendix A).

The core's landing frame has x up; position and velocity are relative to the ground point that
``final_position`` refers to.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from enum import Enum
from pathlib import Path

import casadi as ca

from dscp_core.problem.declaration import (
    CostTerm,
    OptimalControlProblem,
    Parameters,
    Propellant,
    StagePoint,
    Variable,
    Where,
)
from dscp_core.problem.extras import Extras
from dscp_core.problem.flight import ControlHold
from dscp_core.problems.loading import ProblemFamily
from dscp_core.problems.powered_descent.best_effort import CONCESSIONS
from dscp_core.problems.powered_descent.checks import (
    check_parameters,
    check_state,
    terminal_time_guess,
)
from dscp_core.problems.powered_descent.figure import descent_figure
from dscp_core.problems.powered_descent.guess import norm, projected_guess, raw_guess, target
from dscp_core.problems.powered_descent.guidance.offered import LandingGuidances
from dscp_core.problems.powered_descent.limits import (
    CONES,
    CONTACT,
    DRY_MASS,
    LINEARISED_THRUST_CEILING,
    MEAN_THRUST_FLOOR,
    MISSES,
    THRUST_CONE,
    THRUST_FLOOR,
)
from dscp_core.problems.powered_descent.messages import MESSAGES
from dscp_core.problems.powered_descent.parameters import PARAMETERS, THRUST_PROX, TILT_UPPER_RAD
from dscp_core.problems.powered_descent.scales import LENGTH_M, MASS_KG, SPEED_M_S, THRUST_N
from dscp_core.problems.powered_descent.scene import scene_of_settings
from dscp_core.problems.powered_descent.simulation import DescentSimulations

NAME = "powered_descent"

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
    *(Variable(n, "m", LENGTH_M, f"position along {n}, x up") for n in ("x", "y", "z")),
    *(Variable(f"v{n}", "m/s", SPEED_M_S, f"velocity along {n}") for n in ("x", "y", "z")),
    Variable("mass", "kg", MASS_KG, "vehicle mass"),
)
CONTROLS = tuple(
    Variable(f"thrust_{n}", "N", THRUST_N, f"thrust along {n}") for n in ("x", "y", "z")
)


def _mass_flow_per_thrust(p: Mapping[str, ca.SX]) -> ca.SX:
    return 1.0 / (p["specific_impulse"] * p["standard_gravity"])


def dynamics(x: ca.SX, u: ca.SX, p: Parameters) -> ca.SX:
    """Point mass under thrust and constant gravity, (7, 1), SI."""
    mass = x[6]
    gravity = ca.vertcat(-p["gravity"], 0, 0)
    return ca.vertcat(x[3:6], u / mass + gravity, -_mass_flow_per_thrust(p) * norm(u))


def _mass_flow_curvature(point: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
    """Second-order term of the burnt mass that linearising |u| drops, in kg.

    |u| = |u_ref| + e.du + |(I - ee')du|^2 / (2 |u_ref|) + ..., e the reference's direction.
    """
    change = point.u - reference.u
    thrust = norm(reference.u)
    across = change - reference.u * (ca.dot(reference.u, change) / thrust**2)
    return reference.step * _mass_flow_per_thrust(p) * ca.sumsqr(across) / (2 * thrust)


def _thrust_prox(point: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
    return p[THRUST_PROX] * MASS_KG * ca.sumsqr((point.u - reference.u) / THRUST_N)


def _initial_state(p: Parameters) -> ca.SX:
    return ca.vertcat(p["initial_position"], p["initial_velocity"], p["initial_mass"])


def _target_component(index: int) -> Callable[[Parameters], ca.SX]:
    return lambda p: target(p)[index]


def _final_velocity(index: int) -> Callable[[Parameters], ca.SX]:
    return lambda p: p["final_velocity"][index]


_FINAL_STATE = {
    **{v.name: _target_component(i) for i, v in enumerate(STATES[:3])},
    **{v.name: _final_velocity(i) for i, v in enumerate(STATES[3:6])},
}

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
        path_constraints=(THRUST_FLOOR, MEAN_THRUST_FLOOR, DRY_MASS),
        cone_constraints=(THRUST_CONE, *CONES),
        # Position and mass rows need none: with the velocity relaxed they can always be met.
        virtual_control_scale=(0.0,) * 3 + (1.0,) * 3 + (0.0,),
        virtual_control_weight=3e6,
        initial_guess=projected_guess,
        initial_state_parameters=("initial_position", "initial_velocity", "initial_mass"),
        check_parameters=check_parameters,
        check_state=check_state,
        terminal_time_guess=terminal_time_guess,
        least_time_parameters={"fuel_weight": 0.0, "time_weight": 1000.0},
        misses=MISSES,
        end_event=CONTACT,
        propellant=Propellant("mass", "dry_mass"),
        # The defaults are facts about the paper's vehicle; without them there is no limit.
        file_defaults={"dry_mass": 0.0, "contact_tilt_max": TILT_UPPER_RAD},
        control_states=(3, 4, 5),
        formulation=Formulation.CONVERGENT.value,
        concessions=CONCESSIONS,
        extras=Extras(
            figure=descent_figure,
            network=NETWORK,
            messages=MESSAGES,
            scene=scene_of_settings,
            simulation=DescentSimulations(),
            guidance=LandingGuidances(),
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
        concessions=None,
        path_constraints=(THRUST_FLOOR, LINEARISED_THRUST_CEILING, DRY_MASS),
        cone_constraints=CONES,
        virtual_control_scale=tuple(s.scale for s in STATES),
        virtual_control_weight=1e4 * MASS_KG,
        # This weight leaves 5e-5 where a trajectory is feasible, and 8e-4 at 31.9 s, where none is.
        virtual_control_tolerance=1e-4,
        trust_region_control=(1e-3 * MASS_KG / _COST_KG,) * 3,
    )


FAMILY = ProblemFamily(
    tuple(f.value for f in reversed(Formulation)), lambda name: powered_descent(Formulation(name))
)
