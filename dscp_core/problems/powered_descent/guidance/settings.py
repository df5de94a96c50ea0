"""Every number of the guidance, documented and checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from dscp_core.errors import InvalidInputError
from dscp_core.problem.options import option, validate
from dscp_core.problems.powered_descent.guidance.vehicle import Vehicle

_DEGREE = math.pi / 180.0
_EARTH_M_S2 = 9.80665
_LEAST_GATE_M = 0.5
_TUNED = "campaigns of the paper's vehicle"
_SCALED = f"{_TUNED}; `suited` scales it"


@dataclass(frozen=True)
class GuidanceSettings:
    """How guidance works. The defaults suit the paper's vehicle; `suited` suits any other.

    Example:
        >>> from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings
        >>> GuidanceSettings(replan_s=2.0).reserve
        0.03
    """

    tick_s: float = option(0.1, "s", "From one command to the next.", lower=1e-3, source=_SCALED)

    position_noise_m: float = option(
        0.2, "m", "Navigation noise of the position, per axis.", lower=1e-6, source="declared"
    )
    velocity_noise_m_s: float = option(
        0.02, "m/s", "Navigation noise of the velocity, per axis.", lower=1e-6, source="declared"
    )
    acceleration_noise_m_s2: float = option(
        0.1, "m/s^2", "Acceleration that lasts one tick, per axis: wind.", source="declared"
    )
    bias_walk: float = option(
        0.05,
        "m/s^2/sqrt(s)",
        "Random walk of the acceleration that the model leaves out, per axis.",
        lower=1e-9,
        source=_TUNED,
    )
    mass_gain: float = option(
        0.1, "1", "Part of a mass measurement's surprise that is believed.", upper=1.0
    )
    known_delay_s: float = option(
        0.05, "s", "Age of a measurement when it arrives.", upper=10.0, source="declared"
    )
    known_command_latency_s: float = option(
        0.02, "s", "From a command to its effect at the engine.", upper=10.0, source="declared"
    )
    known_lag_s: float = option(
        0.1, "s", "Time constant of the thrust's size, first order.", upper=10.0, source="declared"
    )
    known_attitude_response_s: float = option(
        0.1,
        "s",
        "Time constant of the thrust's direction, first order.",
        upper=10.0,
        source="declared",
    )
    known_throttle_rate_n_s: float = option(
        math.inf,
        "N/s",
        "Greatest rate of the thrust.",
        lower=1e-3,
        infinite=True,
        source="`suited` takes thrust_rate_max",
    )
    known_planning_latency_s: float = option(
        0.02,
        "s",
        "From a request to its plan; rounded up to ticks.",
        upper=100.0,
        source="declared",
    )

    replan_s: float = option(1.0, "s", "From one plan to the next.", lower=1e-3, source=_TUNED)
    last_replan_s: float = option(
        1.5, "s", "With less time to the gate, nothing is planned.", source=_TUNED
    )
    answer_timeout_s: float = option(
        2.0,
        "s",
        "After this long, or twice the known latency, without an answer the next is asked for.",
        lower=1e-3,
    )
    reserve: float = option(
        0.03, "1", "Part of the greatest thrust that every plan leaves.", upper=0.9, source=_TUNED
    )
    early_reserve: float = option(
        0.05,
        "1",
        "More of it that the first plan leaves; what is kept of it goes with the square root of "
        "the time to go.",
        upper=0.9,
        source=_TUNED,
    )
    approach_angle_max_rad: float = option(
        1.5,
        "rad",
        "Greatest angle between the line of sight from the pad and the vertical that plans keep "
        "within: whatever the mission allows, who is off the plan needs air below.",
        lower=1e-3,
        upper=1.57,
        source=_TUNED,
    )
    floor_reserve: float = option(
        0.0, "1", "Part of the least thrust that plans stay above it.", upper=0.9, source=_SCALED
    )

    tracking_position_gain: float = option(
        0.5, "1/s^2", "Acceleration per distance from the plan.", source=_TUNED
    )
    tracking_velocity_gain: float = option(
        1.2, "1/s", "Acceleration per velocity off the plan.", source=_TUNED
    )

    gate_altitude_m: float = option(
        6.0, "m", "Above the pad: plans end there.", lower=1e-3, source=_SCALED
    )
    profile_deceleration_m_s2: float = option(
        4.0, "m/s^2", "Of the last stretch.", lower=1e-3, source=_SCALED
    )
    contact_descent_m_s: float = option(
        0.25, "m/s", "Descent that the last stretch ends with.", lower=0.01, source=_SCALED
    )
    contact_margin_m: float = option(
        0.12,
        "m",
        "Altitude at which it is reached: three sigma of the observed altitude.",
        source=_SCALED,
    )
    descent_gain: float = option(
        3.0, "1/s", "Acceleration per descent off the profile.", source=_TUNED
    )
    lateral_position_gain: float = option(
        0.8, "1/s^2", "Acceleration per distance from the pad's axis.", source=_SCALED
    )
    lateral_velocity_gain: float = option(
        1.6, "1/s", "Acceleration per lateral velocity.", source=_SCALED
    )
    contact_tilt_max_rad: float = option(
        2.5 * _DEGREE, "rad", "Greatest commanded tilt at the ground.", source=_TUNED
    )
    tilt_per_altitude_rad_m: float = option(
        2.0 * _DEGREE, "rad/m", "More of it per altitude.", source=_SCALED
    )
    cut_off: float = option(
        0.0,
        "1",
        "1 for a vehicle that cannot hover: the engine goes off for good where a tick later the "
        "landing would be harder.",
        upper=1.0,
        source=_SCALED,
    )

    SUITED: ClassVar[tuple[str, ...]] = (
        "tick_s",
        "known_throttle_rate_n_s",
        "floor_reserve",
        "gate_altitude_m",
        "profile_deceleration_m_s2",
        "contact_descent_m_s",
        "contact_margin_m",
        "lateral_position_gain",
        "lateral_velocity_gain",
        "tilt_per_altitude_rad_m",
        "cut_off",
    )

    def __post_init__(self) -> None:
        validate(self)
        for name in ("contact_descent_m_s", "known_delay_s"):
            if not math.isfinite(getattr(self, name)):
                raise InvalidInputError(name, getattr(self, name), "finite")
        if self.reserve + self.early_reserve >= 1.0:
            raise InvalidInputError("early_reserve", self.early_reserve, "< 1 - reserve")
        if self.contact_margin_m >= self.gate_altitude_m:
            bound = f"< gate_altitude_m, {self.gate_altitude_m:g} m"
            raise InvalidInputError("contact_margin_m", self.contact_margin_m, bound)

    @property
    def gate_descent_m_s(self) -> float:
        """Descent with which plans end at the gate, where the last stretch begins."""
        return self.profile_descent_m_s(self.gate_altitude_m)

    def profile_descent_m_s(self, altitude_m: float) -> float:
        """Descent of the last stretch at an altitude above the pad."""
        above_m = max(altitude_m - self.contact_margin_m, 0.0)
        return math.sqrt(
            self.contact_descent_m_s**2 + 2.0 * self.profile_deceleration_m_s2 * above_m
        )

    @staticmethod
    def suited(
        values: Mapping[str, Any], landing_mass_kg: float, **changes: float
    ) -> GuidanceSettings:
        """Settings that suit a vehicle and its mission.

        Sideways a vehicle accelerates with gravity times tilt, so times go with 1 / sqrt(gravity);
        upwards with what its thrust has left at landing.

        Args:
            values: Parameters of powered descent by name, SI.
            landing_mass_kg: Expected mass at landing, from a nominal plan.
            **changes: Other settings by name, which win.

        Raises:
            InvalidInputError: The thrust does not carry the vehicle, a refused change, or a gate
                or contact margin above the start.
        """
        vehicle = Vehicle.of(values)
        gravity = vehicle.gravity_m_s2
        vehicle.require_carries(landing_mass_kg, "at landing")
        most = vehicle.thrust_max_n / landing_mass_kg - gravity
        least = vehicle.thrust_min_n / landing_mass_kg - gravity
        swift = math.sqrt(gravity / _EARTH_M_S2)
        if least < -0.05 * gravity:
            own = {"profile_deceleration_m_s2": min(0.41 * gravity, 0.35 * most)}
        else:
            # Least thrust has to leave authority downwards: else it stops metres up, and falls.
            # The more thrust is to be shed at the gate, the more of it.
            braking = max(least, 0.0) + max(3.5, 0.3 * least, 0.08 * (most - least))
            own = {
                "profile_deceleration_m_s2": braking,
                "contact_descent_m_s": 0.5,
                "contact_margin_m": 0.0,
                "cut_off": 1.0,
                "floor_reserve": 0.05,
                "tick_s": min(max(0.35 / braking, 0.02), 0.05),
            }
        lasts_s = 1.7 / swift
        gate_m = 0.12 + 0.5 * own["profile_deceleration_m_s2"] * lasts_s**2
        height_m = float(values["initial_position"][0]) - float(vehicle.pad_m[0])
        gate_m = min(gate_m, max(0.5 * height_m, _LEAST_GATE_M))
        own |= {
            "gate_altitude_m": gate_m,
            "known_throttle_rate_n_s": vehicle.thrust_rate_max_n_s,
            "lateral_position_gain": 0.8 * swift**2,
            "lateral_velocity_gain": 1.6 * swift,
            "tilt_per_altitude_rad_m": 12.0 * _DEGREE / gate_m,
        }
        suited = replace(GuidanceSettings(), **(own | changes))
        if suited.gate_altitude_m >= height_m:
            bound = f"< {height_m:g} m, the start's height above the pad"
            raise InvalidInputError("gate_altitude_m", suited.gate_altitude_m, bound)
        return suited
