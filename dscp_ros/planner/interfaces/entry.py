"""Entry: spherical coordinates of a planet-fixed frame, in one message only.

Odometry knows no angle of attack and no bank angle, so it is not listened to.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dscp_ros.planner.declaration import NodeParameter
from dscp_ros.planner.input_checks import InputSettings
from dscp_ros.planner.interfaces.interface import VEHICLE_PREFIX, ProblemInterface
from msg_adapters.entry_state import EntryLimits
from msg_adapters.entry_visualisation import EntryMarkerStyle
from msg_adapters.frames import PLANET_FRAME

_LIMITS = EntryLimits()
_STYLE = EntryMarkerStyle()

_PARAMETERS = (
    NodeParameter(
        "planet_frame",
        PLANET_FRAME,
        "Frame of states and plans: turns with the planet, origin at its centre, z through the "
        "north pole, x through longitude zero.",
        read_only=True,
    ),
    NodeParameter(
        "altitude_max_m",
        _LIMITS.altitude_max_m,
        "Altitude beyond which a state is refused: no air to steer by.",
        "m",
        1.0,
        _LIMITS.altitude_max_m,
    ),
    NodeParameter(
        "speed_max_m_s",
        _LIMITS.speed_max_m_s,
        "Speed beyond which a state is refused.",
        "m/s",
        100.0,
        2e4,
    ),
    NodeParameter(
        "lift_arrow_m",
        _STYLE.lift_arrow_m,
        "Marker length of the arrows along the lift.",
        "m",
        0.0,
        1e7,
    ),
)

_DEFAULTS = {
    # Flown, a plan of 50 intervals misses the target by a kilometre, one of 100 by 0.3 km.
    "intervals": 100,
    # The entry problem's own costs 0.1 km of that.
    "defect_tolerance": 1e-6,
    # Twice the variables of a landing, and minutes in place of seconds to fly them.
    "deadline_s": 2.0,
    # The paper's 1800 s hold at the start of an entry. In flight, what is left may be anything.
    VEHICLE_PREFIX + "terminal_time_min": 10.0,
}


def _inputs(values: Mapping[str, Any]) -> InputSettings:
    def own(name: str) -> float:
        return float(values[VEHICLE_PREFIX + name])

    return InputSettings(
        frame=values["planet_frame"],
        state_max_age_s=values["state_max_age_s"],
        future_tolerance_s=values["future_tolerance_s"],
        limits=EntryLimits(
            planet_radius_m=own("planet_radius"),
            altitude_max_m=values["altitude_max_m"],
            speed_max_m_s=values["speed_max_m_s"],
            angle_of_attack_min_rad=own("angle_of_attack_min"),
            angle_of_attack_max_rad=own("angle_of_attack_max"),
            bank_angle_min_rad=own("bank_angle_min"),
            bank_angle_max_rad=own("bank_angle_max"),
            longitude_centre_rad=own("final_longitude"),
            heading_centre_rad=own("final_heading"),
        ),
    )


def _drawing(values: Mapping[str, Any]) -> EntryMarkerStyle:
    return EntryMarkerStyle(
        planet_radius_m=float(values[VEHICLE_PREFIX + "planet_radius"]),
        lift_arrow_m=values["lift_arrow_m"],
    )


ENTRY_INTERFACE = ProblemInterface(
    _PARAMETERS, _inputs, _drawing, odometry=False, defaults=_DEFAULTS
)
