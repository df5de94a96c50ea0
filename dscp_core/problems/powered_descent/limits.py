"""Limits of powered descent: what plans are held to, and what a certificate checks of flights."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca

from dscp_core.problem.declaration import (
    ConeConstraint,
    EndEvent,
    EventLimit,
    Miss,
    Parameters,
    PathConstraint,
    StagePoint,
    Where,
)
from dscp_core.problems.powered_descent.guess import norm, target
from dscp_core.problems.powered_descent.scales import LENGTH_M, MASS_KG, THRUST_N


def _thrust_tolerance_n(values: Mapping[str, Any]) -> float:
    return float(values["thrust_tolerance"] * values["thrust_max"])


def lands(values: Mapping[str, Any]) -> bool:
    """Whether a plan ends in contact, not at a gate above."""
    return float(values["gate_height"]) == 0.0


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


def _contact_pointing_cone(point: StagePoint, p: Parameters) -> ca.SX:
    """The same with the limit at contact, if that is tighter."""
    angle = ca.fmin(p["contact_tilt_max"], p["pointing_angle_max"])
    return ca.vertcat(ca.sin(angle) * point.u[0], ca.cos(angle) * point.u[1:3])


def _thrust_rate_cone(point: StagePoint, p: Parameters) -> ca.SX:
    """Cone over one interval; without a limit, its slope over the interval length is none."""
    limited = p["thrust_rate_max"] < math.inf
    rate = ca.if_else(limited, p["thrust_rate_max"], 0.0)
    return ca.vertcat(rate * point.step + _unless(limited), point.u_change)


def _burnt_too_much(point: StagePoint, p: Parameters) -> ca.SX:
    return p["dry_mass"] - point.x[6] - _unless(p["dry_mass"] > 0.0)


def _unless(imposed: ca.SX) -> ca.SX:
    """Infinity, which takes a constraint away, unless this is true."""
    return ca.if_else(imposed, 0.0, math.inf)


def _glideslope_cone(point: StagePoint, p: Parameters) -> ca.SX:
    """Cone above the landing point whose violation is the distance to it, in m."""
    offset, angle = point.x[0:3] - p["final_position"], p["glideslope_angle_max"]
    return ca.vertcat(ca.sin(angle) * offset[0], ca.cos(angle) * offset[1:3])


def _bound(name: str) -> Callable[[Mapping[str, Any]], float]:
    return lambda values: float(values[name])


def _velocity_error(x: ca.SX, p: Parameters) -> ca.SX:
    return x[3:6] - p["final_velocity"]


_AT_CONTACT = 2
"""Last nodes: the thrust of the last interval, however it is held, is between theirs."""

THRUST_FLOOR = PathConstraint(
    "thrust_min", _thrust_floor, THRUST_N, "N", tolerance=_thrust_tolerance_n
)
# The midpoint rule burns |mean thrust|: alternating nodal directions would otherwise fly on less
# than thrust_min.
MEAN_THRUST_FLOOR = PathConstraint(
    "mean_thrust_min",
    _mean_thrust_floor,
    THRUST_N,
    "N",
    where=Where.MEAN,
    tolerance=_thrust_tolerance_n,
)
LINEARISED_THRUST_CEILING = PathConstraint(
    "thrust_max", _thrust_ceiling, THRUST_N, "N", tolerance=_thrust_tolerance_n
)
THRUST_CONE = ConeConstraint(
    "thrust_max", _thrust_cone, THRUST_N, "N", tolerance=_thrust_tolerance_n
)
DRY_MASS = PathConstraint(
    "dry_mass",
    _burnt_too_much,
    MASS_KG,
    "kg",
    # What solvers leave.
    tolerance=lambda values: 1e-6 * float(values["dry_mass"]),
    only_last=1,
)
CONES = (
    ConeConstraint(
        "pointing",
        _pointing_cone,
        THRUST_N,
        "N",
        skip_last=_AT_CONTACT,
        tolerance=_thrust_tolerance_n,
    ),
    # Node 0 is pinned; at the end the vehicle stands on the cone's apex.
    ConeConstraint(
        "glideslope",
        _glideslope_cone,
        LENGTH_M,
        "m",
        skip_first=True,
        skip_last=1,
        tolerance=_bound("glideslope_tolerance"),
    ),
    ConeConstraint(
        "contact_pointing",
        _contact_pointing_cone,
        THRUST_N,
        "N",
        tolerance=_thrust_tolerance_n,
        only_last=_AT_CONTACT,
    ),
    ConeConstraint(
        "thrust_rate_max",
        _thrust_rate_cone,
        THRUST_N,
        "N",
        where=Where.MEAN,
        tolerance=_thrust_tolerance_n,
    ),
)


MISSES = (
    Miss(
        "miss_position",
        lambda x, p: norm(x[0:3] - target(p)),
        "m",
        _bound("contact_position_max"),
    ),
    Miss(
        "miss_speed", lambda x, p: norm(_velocity_error(x, p)), "m/s", _bound("contact_speed_max")
    ),
)
CONTACT = EndEvent(
    "contact",
    lambda x, p: x[0] - p["final_position"][0],
    "altitude_floor",
    "m",
    tolerance=_bound("altitude_floor_tolerance"),
    meant=lands,
    # The engine is off once the plan has ended.
    after=lambda values: (0.0, 0.0, 0.0),
    limits=(
        EventLimit(
            "contact_vertical_speed",
            lambda x, u, p: ca.fabs(_velocity_error(x, p)[0]),
            "m/s",
            _bound("contact_speed_max"),
        ),
        EventLimit(
            "contact_lateral_speed",
            lambda x, u, p: norm(_velocity_error(x, p)[1:3]),
            "m/s",
            _bound("contact_lateral_speed_max"),
        ),
        EventLimit(
            "contact_tilt",
            lambda x, u, p: ca.atan2(norm(u[1:3]), u[0]),
            "rad",
            lambda values: float(values["contact_tilt_max"] * (1.0 + values["thrust_tolerance"])),
        ),
    ),
)
