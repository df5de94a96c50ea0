"""State observer: a steady Kalman filter per axis, behind the known engine, delay and latency."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from dscp_core.errors import InvalidInputError
from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings
from dscp_core.problems.powered_descent.guidance.vehicle import Array, Engine, Motion, moved

_MOST_STEPS = 100_000
_SETTLED = 1e-12
_LONGEST_S = 1000.0
"""Without a measurement: far longer than any delay or latency."""


@lru_cache(maxsize=8)
def steady_gain(settings: GuidanceSettings) -> Array:
    """Gain (3, 2) from position and velocity to position, velocity and acceleration bias.

    The fixed point of the Riccati recursion for x+ = F x + w, z = H x + v at the settings' tick.
    """
    tick = settings.tick_s
    f = np.array([[1.0, tick, 0.5 * tick**2], [0.0, 1.0, tick], [0.0, 0.0, 1.0]])
    h = np.eye(2, 3)
    push = np.array([0.5 * tick**2, tick, 0.0]) * settings.acceleration_noise_m_s2
    walk = np.array([tick**2 / 6.0, 0.5 * tick, 1.0]) * settings.bias_walk * math.sqrt(tick)
    q = np.outer(push, push) + np.outer(walk, walk)
    r = np.diag([settings.position_noise_m**2, settings.velocity_noise_m_s**2])
    p, gain = np.asarray(np.eye(3)), np.zeros((3, 2))
    for _ in range(_MOST_STEPS):
        before = gain
        gain = np.asarray(np.linalg.solve(h @ p @ h.T + r, h @ p).T)
        p = f @ (p - gain @ h @ p) @ f.T + q
        if np.all(np.abs(gain - before) <= _SETTLED * (1.0 + np.abs(gain))):
            break
    return gain


class Observer:
    """Position, velocity, mass, and the acceleration that the model leaves out."""

    def __init__(self, settings: GuidanceSettings, engine: Engine) -> None:
        self._gain = steady_gain(settings)
        self._mass_gain = settings.mass_gain
        self._delay_s = settings.known_delay_s
        self._engine = engine
        self._motion: Motion | None = None
        self.bias = np.zeros(3)

    @property
    def started(self) -> bool:
        """Whether there was a measurement."""
        return self._motion is not None

    def measure(self, time_s: float, state: Array) -> None:
        """Take a measurement (7,), SI, that arrives now.

        Raises:
            InvalidInputError: It is not finite, without mass, or not after the one before.
        """
        if state.shape != (7,) or not np.all(np.isfinite(state)):
            raise InvalidInputError("measured state", state.tolist(), "seven finite numbers")
        if not math.isfinite(time_s):
            raise InvalidInputError("time of a measurement", time_s, "finite")
        if not state[6] > 0.0:
            raise InvalidInputError("measured mass", float(state[6]), "> 0 kg")
        at_s = time_s - self._delay_s
        if self._motion is None:
            self._motion = Motion(at_s, state[0:3].copy(), state[3:6].copy(), float(state[6]))
            return
        if not at_s > self._motion.time_s:
            bound = f"> {self._motion.time_s + self._delay_s:g} s, that of the one before"
            raise InvalidInputError("time of a measurement", time_s, bound)
        seen = self._engine.advance(self._motion, at_s, self.bias)
        surprise = np.array([state[0:3] - seen.position, state[3:6] - seen.velocity])
        position, velocity, bias = self._gain @ surprise
        self.bias = self.bias + bias
        mass = seen.mass + self._mass_gain * (float(state[6]) - seen.mass)
        self._motion = moved(seen, seen.position + position, seen.velocity + velocity, mass)

    def at(self, time_s: float, more: tuple[tuple[float, Array], ...] = ()) -> Motion:
        """The motion at a time after the last measurement.

        Args:
            time_s: When.
            more: Commands that will have come into effect by then, beside those given.

        Raises:
            InvalidInputError: There was no measurement yet, or none for very long.
        """
        if self._motion is None:
            raise InvalidInputError("measurements", 0, "one before the state is asked for")
        if not time_s - self._motion.time_s <= _LONGEST_S:
            bound = f"at most {_LONGEST_S:g} s after the last measurement"
            raise InvalidInputError("time", time_s, bound)
        return self._engine.advance(self._motion, time_s, self.bias, more)
