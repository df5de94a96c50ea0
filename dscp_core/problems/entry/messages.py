"""Entry in messages: spherical coordinates of a planet-fixed frame, in one message only.

Odometry knows no angle of attack and no bank angle, so it does not tell the state. States are
checked for their range, and their angles turned to one branch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dscp_core.problem.messages import Messages, StateLimit, StateLimitError
from dscp_core.problem.parameters import Parameter

PLANET_FRAME = "earth"
"""Default planet-fixed frame (REP 105): origin at the planet's centre, z through the north pole, x
through longitude zero on the equator."""

_TURN_RAD = 2.0 * math.pi


@dataclass(frozen=True)
class EntryLimits:
    """Bounds beyond which the state of an entry vehicle is taken for an error.

    An altitude in place of the radius and kilometres in place of metres always break one of them,
    degrees in place of radians nearly always.

    Attributes:
        planet_radius_m: Radius of the ground.
        altitude_max_m: Largest altitude: the model's atmosphere ends somewhere.
        speed_min_m_s: Least speed: the equations divide by it.
        speed_max_m_s: Largest speed.
        angle_of_attack_min_rad: Least angle of attack.
        angle_of_attack_max_rad: Greatest angle of attack.
        bank_angle_min_rad: Least bank angle.
        bank_angle_max_rad: Greatest bank angle.
        angle_tolerance_rad: How far the two may be beyond their bounds, for sensor noise.
        steepest_rad: Largest size of latitude and flight-path angle: the equations of motion
            break down at the poles and in vertical flight.
        longitude_centre_rad: Longitudes are turned to within half a turn of this one.
        heading_centre_rad: The same of headings.
    """

    planet_radius_m: float = 6371.1e3
    altitude_max_m: float = 150e3
    speed_min_m_s: float = 100.0
    speed_max_m_s: float = 12e3
    angle_of_attack_min_rad: float = 0.0
    angle_of_attack_max_rad: float = math.radians(40.0)
    bank_angle_min_rad: float = -math.radians(60.0)
    bank_angle_max_rad: float = math.radians(60.0)
    angle_tolerance_rad: float = math.radians(0.5)
    steepest_rad: float = 1.2
    longitude_centre_rad: float = math.radians(120.0)
    heading_centre_rad: float = math.radians(90.0)

    def admit(self, named: Mapping[str, float]) -> dict[str, float]:
        """Checked scalars, with longitude and heading turned to their branch.

        Raises:
            StateLimitError: A value is out of range.
        """
        self._check_altitude(named["r"])
        speed_m_s = named["speed"]
        if not self.speed_min_m_s <= speed_m_s <= self.speed_max_m_s:
            bound = f"[{self.speed_min_m_s:g}, {self.speed_max_m_s:g}] m/s"
            raise _out_of_range("speed", speed_m_s, bound)
        for name in ("latitude", "flight_path_angle"):
            _check_interval(name, named[name], -self.steepest_rad, self.steepest_rad)
        for name in ("longitude", "heading"):
            _check_interval(name, named[name], -_TURN_RAD, _TURN_RAD)
        margin = self.angle_tolerance_rad
        for name, lower, upper in (
            ("angle_of_attack", self.angle_of_attack_min_rad, self.angle_of_attack_max_rad),
            ("bank_angle", self.bank_angle_min_rad, self.bank_angle_max_rad),
        ):
            _check_interval(name, named[name], lower - margin, upper + margin)
        return {
            **named,
            "longitude": turned(named["longitude"], self.longitude_centre_rad),
            "heading": turned(named["heading"], self.heading_centre_rad),
        }

    def _check_altitude(self, radius_m: float) -> None:
        if radius_m < self.planet_radius_m:
            bound = f">= {self.planet_radius_m:.12g} m, the ground"
            raise StateLimitError(StateLimit.BELOW_GROUND, "r", radius_m, bound)
        highest_m = self.planet_radius_m + self.altitude_max_m
        if not radius_m <= highest_m:
            bound = f"<= {highest_m:.12g} m, {self.altitude_max_m:g} m above the ground"
            raise _out_of_range("r", radius_m, bound)


def turned(angle_rad: float, centre_rad: float) -> float:
    """The same direction within half a turn of a centre; unchanged where it is there already."""
    if abs(angle_rad - centre_rad) <= math.pi:
        return angle_rad
    return centre_rad + math.remainder(angle_rad - centre_rad, _TURN_RAD)


def _check_interval(name: str, angle_rad: float, lower_rad: float, upper_rad: float) -> None:
    if not lower_rad <= angle_rad <= upper_rad:
        raise _out_of_range(name, angle_rad, f"[{lower_rad:.6g}, {upper_rad:.6g}] rad")


def _out_of_range(field: str, value: float, bound: str) -> StateLimitError:
    return StateLimitError(StateLimit.OUT_OF_RANGE, field, value, bound)


def _admit(
    named: Mapping[str, float], parameters: Mapping[str, Any], settings: Mapping[str, Any]
) -> dict[str, float]:
    def own(name: str) -> float:
        return float(parameters[name])

    limits = EntryLimits(
        planet_radius_m=own("planet_radius"),
        altitude_max_m=settings["altitude_max_m"],
        speed_max_m_s=settings["speed_max_m_s"],
        angle_of_attack_min_rad=own("angle_of_attack_min"),
        angle_of_attack_max_rad=own("angle_of_attack_max"),
        bank_angle_min_rad=own("bank_angle_min"),
        bank_angle_max_rad=own("bank_angle_max"),
        longitude_centre_rad=own("final_longitude"),
        heading_centre_rad=own("final_heading"),
    )
    return limits.admit(named)


_LIMITS = EntryLimits()

MESSAGES = Messages(
    states=(
        ("r", "radius"),
        ("longitude", "longitude"),
        ("latitude", "latitude"),
        ("speed", "speed"),
        ("flight_path_angle", "flight_path_angle"),
        ("heading", "heading"),
        ("angle_of_attack", "angle_of_attack"),
        ("bank_angle", "bank_angle"),
    ),
    controls_are_rates=True,
    frame=PLANET_FRAME,
    frame_parameter="planet_frame",
    frame_description="Frame of states and plans: turns with the planet, origin at its centre, z "
    "through the north pole, x through longitude zero.",
    settings=(
        Parameter(
            "altitude_max_m",
            _LIMITS.altitude_max_m,
            "m",
            "Altitude beyond which a state is refused: no air to steer by.",
            1.0,
            _LIMITS.altitude_max_m,
        ),
        Parameter(
            "speed_max_m_s",
            _LIMITS.speed_max_m_s,
            "m/s",
            "Speed beyond which a state is refused.",
            100.0,
            2e4,
        ),
        Parameter(
            "lift_arrow_m", 200e3, "m", "Marker length of the arrows along the lift.", 0.0, 1e7
        ),
    ),
    defaults={
        # Flown, a plan of 50 intervals misses the target by a kilometre, one of 100 by 0.3 km.
        "intervals": 100,
        # The entry problem's own costs 0.1 km of that.
        "defect_tolerance": 1e-6,
        # Twice the variables of a landing, and minutes in place of seconds to fly them.
        "deadline_s": 2.0,
        # The paper's 1800 s hold at the start of an entry. In flight, what is left may be anything.
        "parameters.terminal_time_min": 10.0,
    },
    admit=_admit,
)
