"""Random landings that end near their bounds: on either side of some of them.

Each is flown backwards from a random state near contact under random thrust, so that its start is
that of a flight which nearly, or just, lands. Vehicle and mission are then drawn around it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .powered_descent_physics import DescentParameters, ThrustLaw, state_rate

Array = NDArray[np.float64]

_BACKWARD_STEPS = 10


@dataclass(frozen=True)
class RandomLanding:
    """A plan with the vehicle and mission that it is for.

    Attributes:
        times_s: (N+1,).
        states: (N+1, 7), of which only the first says anything.
        controls: (N+1, 3).
        law: Thrust between the nodes.
        values: Parameters by name, SI.
    """

    times_s: Array
    states: Array
    controls: Array
    law: ThrustLaw
    values: dict[str, Any]


def random_landing(rng: np.random.Generator, intervals: int) -> RandomLanding:
    """One landing on N intervals."""
    gravity = float(rng.choice([1.62, 3.71, 9.81]))
    impulse = float(rng.uniform(180.0, 330.0))
    vehicle = DescentParameters(
        specific_impulse_s=impulse, gravity_m_s2=gravity, mass_flow_gravity_m_s2=9.80665
    )
    mass = float(10.0 ** rng.uniform(2.0, 5.0))
    seconds = float(rng.uniform(4.0, 25.0))
    law = ThrustLaw(rng.choice([law.value for law in ThrustLaw]))
    controls = _controls(rng, intervals, gravity * mass)
    contact = np.concatenate(
        [
            [rng.choice([0.0, rng.uniform(-0.03, 0.03)])],
            rng.normal(0.0, 0.4, 2),
            [-abs(rng.normal(0.0, 0.25))],
            rng.normal(0.0, 0.15, 2),
            [mass],
        ]
    )
    times = np.linspace(0.0, seconds, intervals + 1)
    start = flown_backwards(times, controls, contact, vehicle, law)
    values = {
        "specific_impulse": impulse,
        "gravity": gravity,
        "standard_gravity": 9.80665,
        "final_position": [0.0, 0.0, 0.0],
        "final_velocity": [0.0, 0.0, 0.0],
        **_bounds(rng, times, controls, law),
        "dry_mass": float(rng.choice([0.0, mass * (1 + rng.normal(0.0, 2e-6)), 0.9 * mass])),
    }
    states = np.tile(start, (intervals + 1, 1))
    return RandomLanding(times, states, controls, law, values)


def _controls(rng: np.random.Generator, intervals: int, weight: float) -> Array:
    """Thrust around the weight, more than it at the end, in directions that wander."""
    size = weight * np.exp(np.cumsum(rng.normal(0.0, 0.15, intervals + 1))[::-1])
    size *= rng.uniform(1.05, 1.6) / (size[-1] / weight)
    tilt = np.abs(np.cumsum(rng.normal(0.0, 0.06, intervals + 1))[::-1])
    azimuth = np.cumsum(rng.normal(0.0, 0.8, intervals + 1))
    return np.column_stack(
        [
            size * np.cos(tilt),
            size * np.sin(tilt) * np.cos(azimuth),
            size * np.sin(tilt) * np.sin(azimuth),
        ]
    )


def flown_backwards(
    times: Array, controls: Array, state: Array, vehicle: DescentParameters, law: ThrustLaw
) -> Array:
    """Start of a flight, by classical Runge-Kutta steps back from its end."""
    for n in range(times.size - 2, -1, -1):
        first, last = controls[n], controls[n + 1]
        if law is ThrustLaw.INTERVAL_MEAN:
            first = last = (first + last) / 2
        h = -float(times[n + 1] - times[n]) / _BACKWARD_STEPS
        for k in range(_BACKWARD_STEPS):
            shares = [1.0 - (k + part) / _BACKWARD_STEPS for part in (0.0, 0.5, 1.0)]
            u = [first + share * (last - first) for share in shares]
            k1 = state_rate(state, u[0], vehicle)
            k2 = state_rate(state + h / 2 * k1, u[1], vehicle)
            k3 = state_rate(state + h / 2 * k2, u[1], vehicle)
            k4 = state_rate(state + h * k3, u[2], vehicle)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state


def _bounds(
    rng: np.random.Generator, times: Array, controls: Array, law: ThrustLaw
) -> dict[str, float]:
    """Limits that the nodes keep with room, or nearly keep or break, each by chance."""

    def near(loose: float, width: float) -> float:
        return 1.0 + (rng.normal(0.0, width) if rng.random() < 0.25 else loose)

    size = np.linalg.norm(controls, axis=1)
    tilt = np.arctan2(np.linalg.norm(controls[:, 1:], axis=1), controls[:, 0])
    rates = np.linalg.norm(np.diff(controls, axis=0), axis=1) / np.diff(times)
    limited = law is ThrustLaw.LINEAR and rng.random() < 0.5
    pointing = float(np.clip(tilt.max() * near(0.2, 0.003), 2e-3, 1.5))
    speed = float(rng.uniform(0.2, 1.0))
    return {
        "thrust_min": float(size.min() * near(-0.3, 0.005)),
        "thrust_max": float(size.max() * near(0.2, 0.003)),
        "pointing_angle_max": pointing,
        "contact_tilt_max": float(np.clip(tilt[-1] * near(0.5, 0.003), 2e-3, 1.5)),
        "thrust_rate_max": float(rates.max() * near(0.3, 0.003)) if limited else math.inf,
        "glideslope_angle_max": float(rng.choice([1.57, rng.uniform(0.9, 1.55)])),
        "contact_position_max": float(rng.uniform(0.3, 2.0)),
        "contact_speed_max": speed,
        "contact_lateral_speed_max": float(speed * rng.uniform(0.3, 1.0)),
    }
