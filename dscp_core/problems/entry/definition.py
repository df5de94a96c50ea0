"""Hypersonic entry as an optimal control problem (section 4.2.1, entry appendix)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from enum import Enum
from typing import Any

import casadi as ca

from dscp_core.problem.declaration import (
    CostTerm,
    Miss,
    OptimalControlProblem,
    Parameters,
    PathConstraint,
    Quadrature,
    StagePoint,
    Variable,
    Where,
)
from dscp_core.problem.ending import EndEvent, Tolerance
from dscp_core.problem.extras import Extras
from dscp_core.problems.entry.aero_table import read_aerodynamic_table
from dscp_core.problems.entry.checks import check_parameters, check_printed, check_state
from dscp_core.problems.entry.figure import entry_figure
from dscp_core.problems.entry.guess import rolled_out_guess, terminal_time_guess
from dscp_core.problems.entry.messages import MESSAGES
from dscp_core.problems.entry.parameters import PARAMETERS
from dscp_core.problems.entry.physics import (
    ALPHA,
    BANK,
    GAMMA,
    HEADING,
    LATITUDE,
    LONGITUDE,
    RADIUS,
    SPEED,
    dynamic_pressure,
    dynamics,
    heat_rate,
    load_factor,
)
from dscp_core.problems.entry.scene import scene_of_settings
from dscp_core.problems.entry.simulation import EntrySimulated
from dscp_core.problems.loading import ProblemFamily

NAME = "entry"

_LENGTH_M = 1e5
_SPEED_M_S = 1e4
# The paper's trust-region weights refer to rates per scaled time unit, which is 10 s.
_RATE_RAD_S = _SPEED_M_S / _LENGTH_M


class Formulation(Enum):
    """Which subproblem is solved.

    PRINTED: the cost linearised, and a trust region that makes up for its missing curvature.
    PRINTED_PER_SECOND: the same with weights per second, which do not depend on the mesh.
    QUADRATIC: the cost with its curvature; the trust region is only a proximal term.
    """

    PRINTED = "printed"
    PRINTED_PER_SECOND = "printed_per_second"
    QUADRATIC = "quadratic"


STATES = (
    Variable("radius", "m", _LENGTH_M, "distance from the planet's centre"),
    Variable("longitude", "rad", 1.0, "longitude, eastwards"),
    Variable("latitude", "rad", 1.0, "latitude, northwards"),
    Variable("speed", "m/s", _SPEED_M_S, "speed against the rotating planet"),
    Variable("flight_path_angle", "rad", 1.0, "flight-path angle, upwards"),
    Variable("heading", "rad", 1.0, "heading, from north towards east"),
    Variable("angle_of_attack", "rad", 1.0, "angle of attack"),
    Variable("bank_angle", "rad", 1.0, "bank angle, positive to the right"),
)
CONTROLS = (
    Variable("angle_of_attack_rate", "rad/s", _RATE_RAD_S, "rate of the angle of attack"),
    Variable("bank_rate", "rad/s", _RATE_RAD_S, "rate of the bank angle"),
)


def _running_cost(x: ca.SX, u: ca.SX, p: Parameters) -> ca.SX:
    """Integrand C_1 gamma^2 + C_2 (u_1^2 + u_2^2)."""
    return p["flight_path_angle_weight"] * x[GAMMA] ** 2 + p["rate_weight"] * ca.sumsqr(u)


def _longer(at: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
    """Cost of a change of the interval length."""
    return (at.step - reference.step) * _running_cost(reference.x, reference.u, p)


def _quadratic_cost(at: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
    """T_ref times the exact quadratic; the product of both changes is left out, being no cone."""
    return reference.step * _running_cost(at.x, at.u, p) + _longer(at, reference, p)


def _linearised_cost(at: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
    """Eq. J1HGV, with the cost of the reference that the print leaves out."""
    along_gamma = reference.x[GAMMA] * (at.x[GAMMA] - reference.x[GAMMA])
    along_rates = ca.dot(reference.u, at.u - reference.u)
    change = p["flight_path_angle_weight"] * along_gamma + p["rate_weight"] * along_rates
    here = _running_cost(reference.x, reference.u, p)
    return reference.step * (here + 2 * change) + _longer(at, reference, p)


def _initial_state(p: Parameters) -> ca.SX:
    return ca.vertcat(*(p[name] for name in _INITIAL))


def _short_way(angle: ca.SX, start: ca.SX) -> ca.SX:
    """The angle, by whole turns within half a turn of the start."""
    change = angle - start
    return start + ca.atan2(ca.sin(change), ca.cos(change))


def _component(name: str) -> Callable[[Parameters], ca.SX]:
    return lambda p: p[name]


def _short_way_from_start(name: str) -> Callable[[Parameters], ca.SX]:
    return lambda p: _short_way(p[f"final_{name}"], p[f"initial_{name}"])


_INITIAL = tuple(f"initial_{state.name}" for state in STATES)
_FINAL_STATE = {
    "radius": _component("final_radius"),
    "longitude": _short_way_from_start("longitude"),
    "latitude": _component("final_latitude"),
    "flight_path_angle": _component("final_flight_path_angle"),
    "heading": _short_way_from_start("heading"),
}


# What a certificate accepts of controls and speed, both of which plans keep at the nodes.
_RATE_TOLERANCE_RAD_S = 1e-6
_SPEED_TOLERANCE_M_S = 1.0


def _accepted(name: str) -> Callable[[Mapping[str, Any]], float]:
    return lambda values: float(values[name])


def _share_of(name: str) -> Callable[[Mapping[str, Any]], float]:
    return lambda values: float(values["path_tolerance"] * values[name])


def _limit(
    name: str, quantity: Callable[[ca.SX, Parameters], ca.SX], scale: float, unit: str
) -> PathConstraint:
    """A quantity of the state below the parameter ``name_max``; the first state is pinned."""
    bound = f"{name}_max"
    return PathConstraint(
        bound,
        lambda at, p: quantity(at.x, p) - p[bound],
        scale,
        unit,
        skip_first=True,
        tolerance=_share_of(bound),
    )


def _box(
    name: str,
    component: Callable[[StagePoint], ca.SX],
    scale: float,
    unit: str,
    tolerance: Tolerance,
    *,
    skip_first: bool,
) -> tuple[PathConstraint, PathConstraint]:
    """A component between the parameters ``name_min`` and ``name_max``."""
    low, high = f"{name}_min", f"{name}_max"
    return (
        PathConstraint(
            low,
            lambda at, p: p[low] - component(at),
            scale,
            unit,
            skip_first=skip_first,
            tolerance=tolerance,
        ),
        PathConstraint(
            high,
            lambda at, p: component(at) - p[high],
            scale,
            unit,
            skip_first=skip_first,
            tolerance=tolerance,
        ),
    )


_CONSTRAINTS = (
    _limit("dynamic_pressure", dynamic_pressure, 1.1e5, "Pa"),
    _limit("heat_rate", heat_rate, 2.5e6, "W/m^2"),
    _limit("load_factor", load_factor, 2.0, "1"),
    *_box(
        "angle_of_attack",
        lambda at: at.x[ALPHA],
        1.0,
        "rad",
        _accepted("angle_tolerance"),
        skip_first=True,
    ),
    *_box(
        "bank_angle",
        lambda at: at.x[BANK],
        1.0,
        "rad",
        _accepted("angle_tolerance"),
        skip_first=True,
    ),
    *_box(
        "angle_of_attack_rate",
        lambda at: at.u[0],
        _RATE_RAD_S,
        "rad/s",
        _RATE_TOLERANCE_RAD_S,
        skip_first=False,
    ),
    *_box(
        "bank_rate",
        lambda at: at.u[1],
        _RATE_RAD_S,
        "rad/s",
        _RATE_TOLERANCE_RAD_S,
        skip_first=False,
    ),
    PathConstraint(
        "speed_min",
        lambda at, p: p["speed_min"] - at.x[SPEED],
        _SPEED_M_S,
        "m/s",
        skip_first=True,
        tolerance=_SPEED_TOLERANCE_M_S,
    ),
)


def _miss_position(x: ca.SX, p: Parameters) -> ca.SX:
    """Distance from the target in local axes, m."""
    east = x[LONGITUDE] - _short_way(p["final_longitude"], x[LONGITUDE])
    north = x[LATITUDE] - p["final_latitude"]
    radius = p["final_radius"]
    return ca.sqrt(
        (x[RADIUS] - radius) ** 2
        + (radius * north) ** 2
        + (radius * ca.cos(p["final_latitude"]) * east) ** 2
    )


def _miss_altitude(x: ca.SX, p: Parameters) -> ca.SX:
    return ca.fabs(x[RADIUS] - p["final_radius"])


def _risen(x: ca.SX, p: Parameters) -> ca.SX:
    return x[GAMMA] - p["final_flight_path_angle"]


def _turned(x: ca.SX, p: Parameters) -> ca.SX:
    return x[HEADING] - _short_way(p["final_heading"], x[HEADING])


def _miss_speed(x: ca.SX, p: Parameters) -> ca.SX:
    """Part of the velocity across the wanted direction, m/s; the speed itself is free."""
    return x[SPEED] * ca.sqrt(_risen(x, p) ** 2 + (ca.cos(x[GAMMA]) * _turned(x, p)) ** 2)


def _miss_flight_path_angle(x: ca.SX, p: Parameters) -> ca.SX:
    return ca.fabs(_risen(x, p))


def _miss_heading(x: ca.SX, p: Parameters) -> ca.SX:
    return ca.fabs(_turned(x, p))


# So that a flight to a target on the ground is not held to be one into it.
_GROUND_ROUNDING_M = 1.0


def _above_ground(x: ca.SX, p: Parameters) -> ca.SX:
    """Altitude above what counts as contact, m."""
    return x[RADIUS] - p["planet_radius"] + _GROUND_ROUNDING_M


_GROUND = EndEvent(
    "contact with the ground",
    _above_ground,
    "altitude_floor",
    "m",
    tolerance=0.0,
    meant=lambda values: False,
)


def _weighted(problem: OptimalControlProblem, gamma: float, rates: float) -> OptimalControlProblem:
    """The problem with default trust-region weights on the flight-path angle and the rates."""
    return replace(
        problem,
        trust_region_state=tuple(gamma * (i == GAMMA) for i in range(len(STATES))),
        trust_region_control=(rates, rates),
    )


# Case 4 of section 4.2.2; its curvature T C_1 = 27 and T C_2 / 100 = 0.3 at N = 100.
_PRINTED_WEIGHTS = (10**1.346, 10**-0.635)
_PRINTED_INTERVAL_S = 27.0
_PROXIMAL_WEIGHTS = (1e-2, 1e-4)


def entry(formulation: Formulation = Formulation.QUADRATIC) -> OptimalControlProblem:
    """Smooth entry flight with a free terminal time as an optimal control problem.

    Args:
        formulation: Which subproblem is solved.
    """
    quadratic = OptimalControlProblem(
        name=NAME,
        states=STATES,
        controls=CONTROLS,
        parameters=PARAMETERS,
        dynamics=dynamics,
        initial_state=_initial_state,
        final_state=_FINAL_STATE,
        running_cost=_running_cost,
        quadrature=Quadrature.SUM,
        # The paper's trust-region weights are in units of the cost.
        cost_scale=1.0,
        cost_magnitude=1e-2,
        cost_tolerance=1e-4,
        defect_tolerance=1e-5,
        cost_terms=(CostTerm("quadratic_cost", _quadratic_cost, Where.NODE),),
        path_constraints=_CONSTRAINTS,
        default_intervals=100,
        free_terminal_time=True,
        terminal_time_bounds=lambda p: (p["terminal_time_min"], p["terminal_time_max"]),
        initial_guess=rolled_out_guess,
        initial_state_parameters=_INITIAL,
        vehicle_tables={"aerodynamic_table": read_aerodynamic_table},
        check_parameters=check_parameters,
        check_state=check_state,
        terminal_time_guess=terminal_time_guess,
        misses=tuple(
            Miss(f"miss_{name}", miss, unit, _accepted(f"final_{name}_tolerance"))
            for name, miss, unit in (
                ("position", _miss_position, "m"),
                ("altitude", _miss_altitude, "m"),
                ("speed", _miss_speed, "m/s"),
                ("flight_path_angle", _miss_flight_path_angle, "rad"),
                ("heading", _miss_heading, "rad"),
            )
        ),
        end_event=_GROUND,
        control_states=(ALPHA, BANK),
        formulation=Formulation.QUADRATIC.value,
        extras=Extras(
            figure=entry_figure,
            messages=MESSAGES,
            scene=scene_of_settings,
            simulation=EntrySimulated(),
        ),
    )
    if formulation is Formulation.QUADRATIC:
        return _weighted(quadratic, *_PROXIMAL_WEIGHTS)
    printed = replace(
        quadratic,
        formulation=Formulation.PRINTED.value,
        cost_terms=(CostTerm("linearised_cost", _linearised_cost, Where.NODE),),
        check_parameters=check_printed,
    )
    if formulation is Formulation.PRINTED:
        return _weighted(printed, *_PRINTED_WEIGHTS)
    gamma, rates = (weight / _PRINTED_INTERVAL_S for weight in _PRINTED_WEIGHTS)
    return _weighted(
        replace(printed, trust_region_per_second=True, formulation=formulation.value), gamma, rates
    )


FAMILY = ProblemFamily(
    tuple(f.value for f in reversed(Formulation)), lambda name: entry(Formulation(name))
)
