"""Powered descent: states in a landing frame, by odometry and mass or in one message."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dscp_ros.planner.declaration import NodeParameter
from dscp_ros.planner.input_checks import InputSettings
from dscp_ros.planner.interfaces.interface import VEHICLE_PREFIX, ProblemInterface
from msg_adapters.frames import LANDING_FRAME
from msg_adapters.state import InputLimits
from msg_adapters.visualisation import MarkerStyle

_INPUTS = InputSettings()
_LIMITS = InputLimits()

_PARAMETERS = (
    NodeParameter(
        "landing_frame",
        LANDING_FRAME,
        "Frame of states and plans: z up, origin at the ground point that targets refer to.",
        read_only=True,
    ),
    NodeParameter(
        "mass_max_age_s",
        _INPUTS.mass_max_age_s,
        "Largest age of a mass message, at its arrival and against the state that it completes.",
        "s",
        0.0,
        1e9,
    ),
    NodeParameter(
        "mass_fallback_kg",
        _INPUTS.mass_fallback_kg,
        "Mass for states without a fresh mass message; 0 to refuse such states.",
        "kg",
        0.0,
        1e7,
    ),
    NodeParameter(
        "position_max_m",
        _LIMITS.position_max_m,
        "Distance from the landing site beyond which a state is refused.",
        "m",
        1.0,
        1e9,
    ),
    NodeParameter(
        "speed_max_m_s",
        _LIMITS.speed_max_m_s,
        "Speed beyond which a state is refused.",
        "m/s",
        1.0,
        1e6,
    ),
    NodeParameter(
        "ground_tolerance_m",
        _LIMITS.ground_tolerance_m,
        "How far below the landing site a state may be, for sensor noise.",
        "m",
        0.0,
        1e4,
    ),
    NodeParameter(
        "thrust_arrow_m", 500.0, "Marker length of a plan's largest thrust.", "m", 0.0, 1e5
    ),
)


def _inputs(values: Mapping[str, Any]) -> InputSettings:
    return InputSettings(
        frame=values["landing_frame"],
        state_max_age_s=values["state_max_age_s"],
        mass_max_age_s=values["mass_max_age_s"],
        future_tolerance_s=values["future_tolerance_s"],
        mass_fallback_kg=values["mass_fallback_kg"],
        limits=InputLimits(
            position_max_m=values["position_max_m"],
            speed_max_m_s=values["speed_max_m_s"],
            ground_tolerance_m=values["ground_tolerance_m"],
        ),
    )


def _drawing(values: Mapping[str, Any]) -> MarkerStyle:
    return MarkerStyle(
        thrust_arrow_m=values["thrust_arrow_m"],
        glideslope_angle_rad=values[VEHICLE_PREFIX + "glideslope_angle_max"],
        apex_m=tuple(values[VEHICLE_PREFIX + "final_position"]),
    )


LANDING_INTERFACE = ProblemInterface(_PARAMETERS, _inputs, _drawing, odometry=True)
