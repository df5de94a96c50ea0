"""The vehicle as guidance knows it: what it may command, and how it moves under a command."""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError

Array = NDArray[np.float64]

_STEP_S = 0.025
"""Longest step, within which the thrust is that of its middle."""
_REMEMBERED_S = 30.0
"""How long a command is kept: far longer than any delay or latency."""


@dataclass(frozen=True)
class Vehicle:
    """What guidance takes from the planner's parameters.

    Attributes:
        thrust_min_n: Least thrust of the lit engine.
        thrust_max_n: Greatest thrust.
        exhaust_speed_m_s: Thrust over mass flow.
        gravity_m_s2: Downwards.
        pointing_angle_max_rad: Greatest angle of the thrust off the vertical.
        pad_m: (3,) where it lands, x up.
        thrust_rate_max_n_s: Greatest change of the thrust per time.
    """

    thrust_min_n: float
    thrust_max_n: float
    exhaust_speed_m_s: float
    gravity_m_s2: float
    pointing_angle_max_rad: float
    pad_m: Array
    thrust_rate_max_n_s: float

    @staticmethod
    def of(values: Mapping[str, Any]) -> Vehicle:
        """From the parameters of powered descent by name, SI."""
        return Vehicle(
            thrust_min_n=float(values["thrust_min"]),
            thrust_max_n=float(values["thrust_max"]),
            exhaust_speed_m_s=float(values["specific_impulse"]) * float(values["standard_gravity"]),
            gravity_m_s2=float(values["gravity"]),
            pointing_angle_max_rad=float(values["pointing_angle_max"]),
            pad_m=np.asarray(values["final_position"], dtype=np.float64),
            thrust_rate_max_n_s=float(values["thrust_rate_max"]),
        )

    def require_carries(self, mass_kg: float, when: str) -> None:
        """Refuse a vehicle that is heavier than its thrust.

        Raises:
            InvalidInputError: It is, at this mass.
        """
        weight_n = mass_kg * self.gravity_m_s2
        if self.thrust_max_n <= weight_n:
            bound = f"> {weight_n:g} N, the weight {when}"
            raise InvalidInputError("thrust_max", self.thrust_max_n, bound)

    def limited(self, force: Array, tilt_max_rad: float) -> Array:
        """The nearest thrust (3,) that may be commanded; the vertical part goes first."""
        tilt = min(tilt_max_rad, self.pointing_angle_max_rad)
        up = min(max(float(force[0]), self.thrust_min_n * math.cos(tilt)), self.thrust_max_n)
        most = min(up * math.tan(tilt), math.sqrt(self.thrust_max_n**2 - up**2))
        y, z = float(force[1]), float(force[2])
        size = math.hypot(y, z)
        if size > most:
            y, z = y * most / size, z * most / size
        short = self.thrust_min_n / math.sqrt(up * up + y * y + z * z)
        limited = np.array([up, y, z])
        return limited * short if short > 1.0 else limited


@dataclass(frozen=True)
class Motion:
    """Where the vehicle is, and what its engine does.

    Attributes:
        time_s: When.
        position: (3,) m, x up.
        velocity: (3,) m/s.
        mass: kg.
        thrust_n: Size of the thrust.
        direction: (3,) of the thrust, of length 1.
    """

    time_s: float
    position: Array
    velocity: Array
    mass: float
    thrust_n: float = 0.0
    direction: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))


class Engine:
    """Commands that were given, and the motion under them as guidance believes it goes."""

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        lag_s: float,
        attitude_response_s: float,
        throttle_rate_n_s: float,
        latency_s: float,
    ) -> None:
        """Nothing was commanded yet: the engine is off.

        Args:
            vehicle: The vehicle.
            lag_s: Time constant of the thrust's size.
            attitude_response_s: Time constant of its direction.
            throttle_rate_n_s: Greatest rate of its size.
            latency_s: From a command to its effect.
        """
        self._vehicle = vehicle
        self._lag_s, self._response_s = lag_s, attitude_response_s
        self._rate_n_s, self._latency_s = throttle_rate_n_s, latency_s
        self._times: list[float] = []
        self._forces: list[Array] = []

    def command(self, time_s: float, force: Array) -> None:
        """Remember a command (3,) in N that is given now.

        Raises:
            InvalidInputError: It is given before an earlier one.
        """
        if self._times and time_s + self._latency_s < self._times[-1]:
            bound = f">= {self._times[-1] - self._latency_s:g} s, that of the one before"
            raise InvalidInputError("time of a command", time_s, bound)
        self._times.append(time_s + self._latency_s)
        self._forces.append(force)
        if self._times[0] < time_s - 2.0 * _REMEMBERED_S:
            late = bisect.bisect_right(self._times, time_s - _REMEMBERED_S) - 1
            del self._times[:late], self._forces[:late]

    def advance(
        self, motion: Motion, until_s: float, acceleration: Array, more: tuple[Any, ...] = ()
    ) -> Motion:
        """The motion at a later time.

        Args:
            motion: Now.
            until_s: When.
            acceleration: (3,) that acts beside thrust and gravity, m/s^2.
            more: Pairs of time and force that will have been in effect from that time on.
        """
        times = self._times + [time_s for time_s, _ in more]
        forces = self._forces + [force for _, force in more]
        while motion.time_s < until_s - 1e-9:
            index = bisect.bisect_right(times, motion.time_s + 1e-9)
            end_s = min(until_s, motion.time_s + _STEP_S, *times[index : index + 1])
            force = forces[index - 1] if index else None
            motion = self.step(motion, end_s - motion.time_s, force, acceleration)
        return motion

    def step(
        self, motion: Motion, step_s: float, force: Array | None, acceleration: Array
    ) -> Motion:
        """The motion a short time later, under a command (3,) in N that is in effect meanwhile."""
        half_thrust, half_direction = self._answer(motion, 0.5 * step_s, force)
        flow = half_thrust / self._vehicle.exhaust_speed_m_s
        mass = motion.mass - 0.5 * step_s * flow
        a = half_direction * (half_thrust / mass) + acceleration
        a[0] -= self._vehicle.gravity_m_s2
        thrust, direction = self._answer(motion, step_s, force)
        return Motion(
            motion.time_s + step_s,
            motion.position + step_s * (motion.velocity + 0.5 * step_s * a),
            motion.velocity + step_s * a,
            motion.mass - step_s * flow,
            thrust,
            direction,
        )

    def _answer(self, motion: Motion, after_s: float, force: Array | None) -> tuple[float, Array]:
        """Thrust and direction some time after a command came into effect."""
        size = 0.0 if force is None else math.sqrt(float(force @ force))
        change = (size - motion.thrust_n) * _reached(after_s, self._lag_s)
        most = self._rate_n_s * after_s
        thrust = motion.thrust_n + min(max(change, -most), most)
        if force is None or size == 0.0:
            return thrust, motion.direction
        if motion.thrust_n == 0.0:  # ignition: it points where it is to burn
            return thrust, force / size
        reached = _reached(after_s, self._response_s)
        turned = motion.direction + reached * (force / size - motion.direction)
        return thrust, turned / math.sqrt(float(turned @ turned))


def _reached(after_s: float, constant_s: float) -> float:
    """Part of a change that a first-order response has made."""
    return -math.expm1(-after_s / constant_s) if constant_s > 0.0 else 1.0


def moved(motion: Motion, position: Array, velocity: Array, mass: float) -> Motion:
    """The same engine elsewhere."""
    return replace(motion, position=position, velocity=velocity, mass=mass)
