"""What a powered descent gives up where it cannot land as it should, and in which order.

After Blackmore, Acikmese and Scharf, "Minimum-landing-error powered-descent guidance for Mars
landing using convex optimization", 2010, whose glideslope also has its apex where the vehicle
lands; there the speed at the end is zero, here it comes before the position.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.concessions import Concessions, Shortfall
from dscp_core.problem.declaration import (
    ConeConstraint,
    Parameters,
    PathConstraint,
    StagePoint,
    Variable,
)
from dscp_core.problems.powered_descent.guess import target
from dscp_core.problems.powered_descent.scales import LENGTH_M, SPEED_M_S

# Costs, in initial masses, of 1 m/s at contact, of 1 m from the target, of 1 m below the
# glideslope for 1 s. At these prices the errors are within 1e-4 of their least values, and the
# glideslope is kept wherever it can be.
_OF_SPEED, _OF_POSITION, _OF_GLIDESLOPE = 0.25, 0.01, 0.1
_CONTACT_AT_APEX_M = 0.1
_WIDEST_RAD = 1.57


def _mass(values: Mapping[str, Any]) -> float:
    return float(values["initial_mass"])


def _glideslope(at: StagePoint, p: Parameters) -> ca.SX:
    """The glideslope with its apex where the vehicle lands; its violation is a distance, in m."""
    angle, height = p["glideslope_angle_max"], at.x[0] - p["final_position"][0]
    away = at.x[1:3] - p["final_position"][1:3] - at.x[7:9]
    return ca.vertcat(ca.sin(angle) * height, ca.cos(angle) * away)


def _ends_above_apex(at: StagePoint, p: Parameters) -> ca.SX:
    """The end at the apex, or of a plan to a gate, within the cone above it."""
    angle, away = p["glideslope_angle_max"], at.x[1:3] - p["final_position"][1:3] - at.x[7:9]
    return ca.vertcat(_CONTACT_AT_APEX_M + ca.tan(angle) * p["gate_height"], away)


def _widen(state: NDArray[np.float64], values: Mapping[str, Any]) -> dict[str, float]:
    """The glideslope of a start outside it."""
    height, *away = state[:3] - np.asarray(values["final_position"])
    angle = math.atan2(math.hypot(*away), max(float(height), 0.0))
    given = float(values["glideslope_angle_max"])
    # By a little more: a start on the cone itself can hardly stay in it.
    return {"glideslope_angle_max": min(angle + 0.01, _WIDEST_RAD)} if angle > given else {}


CONCESSIONS = Concessions(
    shortfalls=(
        Shortfall(
            "final_speed_error",
            lambda x, p: x[3:6] - p["final_velocity"],
            "m/s",
            SPEED_M_S,
            ("vx", "vy", "vz"),
            lambda values: _OF_SPEED * _mass(values),
            tolerance=0.001,
        ),
        Shortfall(
            "final_position_error",
            lambda x, p: x[1:3] - target(p)[1:3],
            "m",
            LENGTH_M,
            ("y", "z"),
            lambda values: _OF_POSITION * _mass(values),
            tolerance=0.01,
        ),
    ),
    anchors=tuple(
        Variable(f"landing_{n}", "m", LENGTH_M, f"Landing point from the target along {n}.")
        for n in ("y", "z")
    ),
    constraints=(
        ConeConstraint("glideslope", _glideslope, LENGTH_M, "m", skip_first=True, skip_last=1),
        ConeConstraint("ends_above_apex", _ends_above_apex, LENGTH_M, "m", only_last=1),
        # Holds where the glideslope gives way.
        PathConstraint(
            "above_ground",
            lambda at, p: p["final_position"][0] - at.x[0],
            LENGTH_M,
            "m",
            skip_first=True,
            skip_last=1,
        ),
    ),
    softened={"glideslope": lambda values: _OF_GLIDESLOPE * _mass(values)},
    widen=_widen,
)
