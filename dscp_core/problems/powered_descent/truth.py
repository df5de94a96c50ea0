"""The world of a simulated landing, which guidance does not know: vehicle, air, navigation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from dscp_core.errors import InvalidInputError
from dscp_core.problem.options import option, validate
from dscp_core.problems.powered_descent.motion import (
    DIRECTION,
    LONGEST_STEP_S,
    MASS,
    POSITION,
    THRUST,
    VELOCITY,
    Array,
    Event,
    TrueMotion,
)

_PAPER_PATH_M, _PAPER_SPEED_M_S = 5050.0, 222.5
"""Distance of the paper's start from its pad, and sqrt(gravity times that)."""


@dataclass(frozen=True)
class TruthSettings:
    """Standard deviations of what differs, and how vehicle, air and planner really are.

    Errors are normally distributed, drawn once a flight if nothing else is said; 0 switches one
    off. `suited` scales those of the start to a vehicle and its mission.
    """

    dispersion: float = option(
        1.0, "1", "Factor on all errors of start, vehicle and navigation.", upper=100.0
    )
    initial_position_m: float = option(
        50.0, "m", "Position at the start, per axis.", source="1 % of the distance to the pad"
    )
    initial_velocity_m_s: float = option(
        3.0, "m/s", "Velocity at the start, per axis.", source="1.35 % of sqrt(gravity distance)"
    )
    initial_mass: float = option(0.005, "1", "Mass at the start, relative.", upper=0.1)
    specific_impulse: float = option(0.003, "1", "Specific impulse, relative.", upper=0.1)
    thrust_scale: float = option(0.003, "1", "Thrust over command, relative.", upper=0.1)
    thrust_direction_rad: float = option(
        0.005, "rad", "Misalignment of the thrust about each lateral axis.", upper=0.1
    )

    navigation_position_m: float = option(0.2, "m", "Measured position, per axis and measurement.")
    navigation_velocity_m_s: float = option(
        0.02, "m/s", "Measured velocity, per axis and measurement."
    )
    navigation_mass: float = option(
        0.0005, "1", "Measured mass, relative, per measurement.", upper=0.1
    )
    navigation_bias_m: float = option(0.0, "m", "Measured position, per axis, constant.")
    navigation_bias_m_s: float = option(0.0, "m/s", "Measured velocity, per axis, constant.")
    delay_s: float = option(0.05, "s", "Age of a measurement when it arrives.", upper=10.0)

    wind_m_s2: float = option(0.1, "m/s^2", "Acceleration by wind, per axis.")
    wind_correlation_s: float = option(
        0.0, "s", "Correlation time of the wind; at 0 it is drawn anew every tick."
    )
    drag_area_m2: float = option(0.0, "m^2", "Drag coefficient times area.")
    air_density_kg_m3: float = option(
        1.225, "kg/m^3", "Of the air at the pad.", source="standard atmosphere"
    )
    scale_height_m: float = option(
        8500.0, "m", "Height in which the air thins to 1/e.", lower=1.0, source="Earth"
    )

    lag_s: float = option(0.1, "s", "Time constant of the thrust's size, first order.", upper=10.0)
    attitude_response_s: float = option(
        0.1, "s", "Time constant of the thrust's direction, first order.", upper=10.0
    )
    throttle_rate_n_s: float = option(
        math.inf,
        "N/s",
        "Greatest rate of the thrust.",
        lower=1e-3,
        source="thrust_rate_max",
        infinite=True,
    )
    command_latency_s: float = option(0.02, "s", "From a command to the engine.", upper=10.0)

    planning_latency_s: float = option(
        0.02, "s", "From a request to its plan; negative: as measured.", lower=-1.0, upper=100.0
    )
    late_plans: float = option(0.0, "1", "Part of the plans that are late.", upper=1.0)
    late_plan_s: float = option(2.0, "s", "How late they are.", upper=100.0)
    outage_start_s: float = option(0.0, "s", "When the planner stops to answer.")
    outage_s: float = option(0.0, "s", "For how long it does.")

    SUITED: ClassVar[tuple[str, ...]] = (
        "initial_position_m",
        "initial_velocity_m_s",
        "throttle_rate_n_s",
    )

    def __post_init__(self) -> None:
        validate(self)
        for name in ("lag_s", "attitude_response_s"):
            value = getattr(self, name)
            if 0.0 < value < _LEAST_LAG_S:
                raise InvalidInputError(name, value, f"0, or >= {_LEAST_LAG_S:g} s")
        relative = max(
            self.initial_mass, self.specific_impulse, self.thrust_scale, self.navigation_mass
        )
        if self.dispersion * relative > _MOST_RELATIVE:
            bound = f"<= {_MOST_RELATIVE / relative:g}, with relative errors of {relative:g}"
            raise InvalidInputError("dispersion", self.dispersion, bound)
        if math.isfinite(self.throttle_rate_n_s) and self.lag_s == 0.0:
            raise InvalidInputError("lag_s", self.lag_s, "> 0 with a finite throttle_rate_n_s")

    @staticmethod
    def suited(values: Mapping[str, Any], **changes: float) -> TruthSettings:
        """Errors of the start that suit a vehicle and its mission, and its own throttle rate.

        Args:
            values: Parameters of powered descent by name, SI.
            **changes: Other settings by name, which win.

        Raises:
            InvalidInputError: A refused change.
        """
        path = np.asarray(values["initial_position"]) - np.asarray(values["final_position"])
        distance_m = float(np.linalg.norm(path))
        gravity_m_s2, mass_kg = float(values["gravity"]), float(values["initial_mass"])
        speed_m_s = math.sqrt(gravity_m_s2 * distance_m)
        own = {
            "initial_position_m": 50.0 * distance_m / _PAPER_PATH_M,
            "initial_velocity_m_s": 3.0 * speed_m_s / _PAPER_SPEED_M_S,
            "throttle_rate_n_s": float(values["thrust_rate_max"]),
        }
        truth = replace(TruthSettings(), **(own | changes))
        fastest_m_s = float(np.linalg.norm(values["initial_velocity"])) + 1.5 * speed_m_s
        per_area = truth.air_density_kg_m3 * fastest_m_s * LONGEST_STEP_S / mass_kg
        if truth.drag_area_m2 * per_area > 1.0:
            bound = f"<= {1.0 / per_area:.3g} m^2, for air that does not stop it at once"
            raise InvalidInputError("drag_area_m2", truth.drag_area_m2, bound)
        return truth

    def require_carries(self, weight_n: float, within_s: float) -> None:
        """Refuse an engine that would not carry the vehicle by the end of its flight.

        Raises:
            InvalidInputError: Its thrust rises too slowly.
        """
        if self.throttle_rate_n_s * within_s < weight_n:
            bound = f">= {weight_n / within_s:g} N/s, to reach the weight within {within_s:.3g} s"
            raise InvalidInputError("throttle_rate_n_s", self.throttle_rate_n_s, bound)


_LEAST_LAG_S = 0.005
_MOST_RELATIVE = 0.2
"""Of a relative error (sigma), beyond which masses and the like are drawn below zero."""


@dataclass(frozen=True)
class VehicleErrors:
    """What was drawn for one flight.

    Attributes:
        initial_state: (7,) difference from the nominal initial state, SI.
        specific_impulse: Relative error.
        thrust: Relative error of the magnitude.
        thrust_direction_rad: (2,) rotation of the thrust about the core's y and z axes.
        navigation_bias: (7,) constant error of measurements, SI.
    """

    initial_state: Array
    specific_impulse: float
    thrust: float
    thrust_direction_rad: Array
    navigation_bias: Array


def true_parameters(values: Mapping[str, Any], truth: TruthSettings, isp_error: float) -> Array:
    """Parameters (8,) of the true motion."""
    impulse_s = float(values["specific_impulse"]) * (1.0 + isp_error)
    return np.array(
        [
            impulse_s * float(values["standard_gravity"]),
            truth.lag_s,
            truth.attitude_response_s,
            truth.throttle_rate_n_s,
            float(values["gravity"]),
            0.5 * truth.air_density_kg_m3 * truth.drag_area_m2,
            truth.scale_height_m,
            float(np.atleast_1d(values["final_position"])[0]),
        ]
    )


class World:
    """One flight's truth: the errors drawn, the vehicle's motion, what navigation tells.

    Attributes:
        errors: What was drawn.
        planner: Random numbers of the planner's delays.
        time_s: Now.
        state: (11,) of `TrueMotion` now.
        landed: Whether there was contact.
        dry_s: When the last propellant was burnt, after which there is no thrust; infinite before.
    """

    def __init__(
        self, motion: TrueMotion, values: Mapping[str, Any], truth: TruthSettings, seed: int
    ) -> None:
        start, self._navigation, self._air, self.planner = (
            np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(4)
        )
        factor = truth.dispersion
        nominal = np.array(
            [*values["initial_position"], *values["initial_velocity"], values["initial_mass"]]
        )
        spread = np.array(
            [truth.initial_position_m] * 3
            + [truth.initial_velocity_m_s] * 3
            + [truth.initial_mass * nominal[MASS]]
        )
        bias = np.array([truth.navigation_bias_m] * 3 + [truth.navigation_bias_m_s] * 3 + [0.0])
        self.errors = VehicleErrors(
            initial_state=factor * spread * start.standard_normal(7),
            specific_impulse=factor * truth.specific_impulse * start.standard_normal(),
            thrust=factor * truth.thrust_scale * start.standard_normal(),
            thrust_direction_rad=factor * truth.thrust_direction_rad * start.standard_normal(2),
            navigation_bias=factor * bias * start.standard_normal(7),
        )
        self._truth, self._motion = truth, motion
        self._gravity = np.array([-float(values["gravity"]), 0.0, 0.0])
        self._bounds_n = float(values["thrust_min"]), float(values["thrust_max"])
        self._ground_m = float(np.atleast_1d(values["final_position"])[0])
        self._parameters = true_parameters(values, truth, self.errors.specific_impulse)
        self._wind = truth.wind_m_s2 * self._air.standard_normal(3)
        self._command = np.array([0.0, 1.0, 0.0, 0.0])
        self._dry_kg = float(values["dry_mass"])
        self.time_s = 0.0
        self.state = np.concatenate([nominal + self.errors.initial_state, self._command])
        self.landed = False
        self.dry_s = 0.0 if self.state[MASS] <= self._dry_kg else math.inf

    @property
    def thrust(self) -> Array:
        """Thrust (3,) of the engine now, in N."""
        direction = self.state[DIRECTION]
        return np.asarray(self.state[THRUST] / np.linalg.norm(direction) * direction)

    def set_command(self, force: Array | None) -> None:
        """The command (3,) in N that now reaches the engine; None switches it off."""
        if force is None or self.dry_s < math.inf:
            self._command = np.concatenate([[0.0], self._command[1:4]])
        else:
            about_y, about_z = self.errors.thrust_direction_rad
            # A rotation vector crossed with the thrust: first order is enough for a misalignment.
            turned = force + np.cross([0.0, about_y, about_z], force)
            low, high = self._bounds_n
            size = (1.0 + self.errors.thrust) * float(np.linalg.norm(force))
            made = min(max(size, low), high)
            self._command = np.concatenate([[made], turned / np.linalg.norm(turned)])
            if self.state[THRUST] == 0.0 or self._truth.attitude_response_s == 0.0:
                self.state[DIRECTION] = self._command[1:4]
        if self._truth.lag_s == 0.0:
            self.state[THRUST] = self._command[0]

    def fly(self, until_s: float) -> bool:
        """Fly on, at most to the ground; whether it is still in the air."""
        while not self.landed and self.time_s < until_s:
            flown_s, self.state, event = self._motion.fly(
                self.state,
                self._command,
                self._wind,
                self._parameters,
                until_s - self.time_s,
                self._ground_m,
                self._dry_kg,
            )
            self.time_s = until_s if event is None else self.time_s + flown_s
            self.landed = event is Event.CONTACT
            if event is Event.DRY:
                self.dry_s = self.time_s
                self.state[THRUST] = 0.0
                self.set_command(None)
        return not self.landed

    def blow(self, for_s: float) -> None:
        """Draw the wind of the next tick."""
        fresh = self._truth.wind_m_s2 * self._air.standard_normal(3)
        kept = 0.0
        if self._truth.wind_correlation_s > 0.0:
            kept = math.exp(-for_s / self._truth.wind_correlation_s)
        self._wind = kept * self._wind + math.sqrt(1.0 - kept**2) * fresh

    def before_start(self, by_s: float) -> Array:
        """State (7,) some time before the start, the engine being off."""
        state = self.state[:7].copy()
        state[POSITION] += by_s * (-state[VELOCITY] + 0.5 * by_s * self._gravity)
        state[VELOCITY] -= by_s * self._gravity
        return state

    def measure(self, state: Array) -> Array:
        """A state (7,) as navigation sees it."""
        truth = self._truth
        size = np.array(
            [truth.navigation_position_m] * 3
            + [truth.navigation_velocity_m_s] * 3
            + [truth.navigation_mass * state[MASS]]
        )
        noise = truth.dispersion * size * self._navigation.standard_normal(7)
        return np.asarray(state + noise + self.errors.navigation_bias)
