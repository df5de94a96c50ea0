"""The world of a simulated entry, which guidance does not know: air, vehicle, navigation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.crossing import crossing
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.options import option, validate
from dscp_core.problems.entry.motion import LIMITED, Motion
from dscp_core.problems.entry.physics import LATITUDE, LONGITUDE, RADIUS

Array = NDArray[np.float64]

_DEGREE = math.radians(1.0)
_LONGEST_STEP_S = 2.0
"""Of the Runge-Kutta method: its error over the paper's flight is below a centimetre."""


@dataclass(frozen=True)
class TruthSettings:
    """Standard deviations of what differs; normally distributed, 0 switches one off."""

    dispersion: float = option(1.0, "1", "Factor on all errors.", upper=100.0)
    initial_radius_m: float = option(200.0, "m", "Altitude at the start.")
    initial_place_m: float = option(2000.0, "m", "Place at the start, east and north.")
    initial_speed_m_s: float = option(5.0, "m/s", "Speed at the start.")
    initial_flight_path_angle_rad: float = option(
        0.02 * _DEGREE, "rad", "Flight-path angle at the start."
    )
    initial_heading_rad: float = option(0.05 * _DEGREE, "rad", "Heading at the start.")
    initial_attitude_rad: float = option(
        0.2 * _DEGREE, "rad", "Angle of attack and bank at the start."
    )
    density: float = option(
        0.05, "1", "Density of the air, relative, the same all the way.", upper=0.3
    )
    scale_height: float = option(
        0.01,
        "1",
        "Scale height of the atmosphere, relative; the density at ground stays.",
        upper=0.1,
    )
    lift: float = option(0.02, "1", "Lift coefficients, relative.", upper=0.2)
    drag: float = option(0.02, "1", "Drag coefficients, relative.", upper=0.2)
    mass: float = option(0.005, "1", "Mass, relative.", upper=0.1)
    navigation_radius_m: float = option(20.0, "m", "Measured altitude, per measurement.")
    navigation_place_m: float = option(20.0, "m", "Measured place, east and north, likewise.")
    navigation_speed_m_s: float = option(0.1, "m/s", "Measured speed, likewise.")
    navigation_path_rad: float = option(
        1e-4, "rad", "Measured flight-path angle and heading, likewise."
    )
    navigation_attitude_rad: float = option(
        5e-4, "rad", "Measured angle of attack and bank, likewise."
    )
    planning_latency_s: float = option(
        1.0, "s", "From a measurement to the plan that is made of it.", upper=1000.0
    )

    def __post_init__(self) -> None:
        validate(self)


@dataclass(frozen=True)
class EntryErrors:
    """What was drawn for one flight.

    Attributes:
        initial_state: (8,) difference from the nominal initial state, SI.
        relative: Errors of parameters by `TruthSettings` name.
    """

    initial_state: Array
    relative: dict[str, float]


def draw(
    truth: TruthSettings, values: Mapping[str, Any], random: np.random.Generator
) -> EntryErrors:
    """One flight's errors, the same numbers whatever is switched off."""
    start, _ = _deviations(truth, values)
    names = ("density", "scale_height", "lift", "drag", "mass")
    draws = random.standard_normal(8 + len(names))
    relative = {
        name: truth.dispersion * getattr(truth, name) * float(drawn)
        for name, drawn in zip(names, draws[8:], strict=True)
    }
    return EntryErrors(start * draws[:8], relative)


def measure(
    state: Array, truth: TruthSettings, values: Mapping[str, Any], random: np.random.Generator
) -> Array:
    """State (8,) as navigation sees it."""
    _, noise = _deviations(truth, values)
    return np.asarray(state + noise * random.standard_normal(8))


def _deviations(truth: TruthSettings, values: Mapping[str, Any]) -> tuple[Array, Array]:
    """Standard deviations (8,) of the start and of every measurement."""
    arc = 1.0 / float(values["planet_radius"])
    start = (
        *(truth.initial_radius_m, truth.initial_place_m * arc, truth.initial_place_m * arc),
        *(truth.initial_speed_m_s, truth.initial_flight_path_angle_rad),
        *(truth.initial_heading_rad, truth.initial_attitude_rad, truth.initial_attitude_rad),
    )
    noise = (
        *(truth.navigation_radius_m, truth.navigation_place_m * arc),
        *(truth.navigation_place_m * arc, truth.navigation_speed_m_s),
        *(truth.navigation_path_rad, truth.navigation_path_rad),
        *(truth.navigation_attitude_rad, truth.navigation_attitude_rad),
    )
    return truth.dispersion * np.array(start), truth.dispersion * np.array(noise)


def true_values(values: Mapping[str, Any], errors: EntryErrors) -> dict[str, Any]:
    """Parameters by name, of which some are not what guidance assumes."""
    relative = errors.relative
    changed = {
        "sea_level_density": 1.0 + relative["density"],
        "scale_height": 1.0 + relative["scale_height"],
        "lift_coefficients": 1.0 + relative["lift"],
        "drag_coefficients": 1.0 + relative["drag"],
        "mass": 1.0 + relative["mass"],
    }
    return {n: v * changed[n] if n in changed else v for n, v in values.items()}


class TrueMotion:
    """Flies until something ends the flight, and keeps the greatest loads."""

    def __init__(self, problem: OptimalControlProblem) -> None:
        """Compile the equations of motion, once for any vehicle and flight."""
        self._motion = Motion(problem)

    def fly(
        self, state: Array, rates: Array, parameters: Array, duration_s: float, target: Target
    ) -> tuple[float, Array, Array, str]:
        """Time flown, state then, greatest loads (3,) on the way, and how it ended.

        Args:
            state: (8,).
            rates: (2,) of angle of attack and bank, held.
            parameters: Packed parameters of the true world.
            duration_s: How long to fly.
            target: Where flights end.

        Returns:
            The end is empty where the flight goes on.
        """
        steps = max(1, math.ceil(duration_s / _LONGEST_STEP_S - 1e-9))
        step_s = duration_s / steps
        worst = np.zeros(len(LIMITED))
        for number in range(steps):
            start = state

            def after(part_s: float, start: Array = start) -> Array:
                return self._motion.step(start, rates, parameters, part_s)

            state = after(step_s)
            ends = [
                (crossing(lambda part, e=event: e(after(part)), step_s), ending)
                for ending, event in ((ARRIVED, target.passed_m), (GROUND, target.below_m))
                if event(start) < 0.0 <= event(state)
            ]
            if ends:
                part_s, ending = min(ends)
                state = after(part_s)
                worst = np.maximum(worst, self._motion.loads(state, parameters))
                return number * step_s + part_s, state, worst, ending
            worst = np.maximum(worst, self._motion.loads(state, parameters))
        return duration_s, state, worst, ""


ARRIVED, GROUND = "arrived", "hit the ground"


@dataclass(frozen=True)
class Target:
    """Where a flight ends: where it passes the target, whatever its altitude there.

    The wanted path is flat there, so that a metre of altitude is worth hundreds of metres along it:
    where it meets the altitude of the target says little.

    Attributes:
        radius_m: Distance from the planet's centre.
        longitude_rad: Eastwards.
        latitude_rad: Northwards.
        heading_rad: Wanted, from north towards east.
        ground_m: Radius of the ground.
    """

    radius_m: float
    longitude_rad: float
    latitude_rad: float
    heading_rad: float
    ground_m: float

    @staticmethod
    def of(values: Mapping[str, Any]) -> Target:
        """That of a mission, from its parameters by name."""
        return Target(
            radius_m=float(values["final_radius"]),
            longitude_rad=float(values["final_longitude"]),
            latitude_rad=float(values["final_latitude"]),
            heading_rad=float(values["final_heading"]),
            ground_m=float(values["planet_radius"]),
        )

    def offset_m(self, state: Array) -> tuple[float, float]:
        """Distance beyond the target along the wanted heading, and to its right."""
        turned = (state[LONGITUDE] - self.longitude_rad + math.pi) % (2.0 * math.pi) - math.pi
        east = self.radius_m * math.cos(self.latitude_rad) * turned
        north = self.radius_m * (state[LATITUDE] - self.latitude_rad)
        sine, cosine = math.sin(self.heading_rad), math.cos(self.heading_rad)
        return float(east * sine + north * cosine), float(east * cosine - north * sine)

    def passed_m(self, state: Array) -> float:
        """Above zero beyond the target; far from it, where that says nothing, below."""
        along, across = self.offset_m(state)
        return along if abs(along) < _NEAR_M and abs(across) < _NEAR_M else -_NEAR_M

    def below_m(self, state: Array) -> float:
        """Above zero below the ground."""
        return float(self.ground_m - state[RADIUS])


_NEAR_M = 5e5
