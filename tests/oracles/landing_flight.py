"""A plan of a landing flown to contact by scipy's DOP853, with event detection of its own.

Shares no code with the packages. Limits are looked for on a dense output, far finer than a plan's
nodes, and improved by a parabola through the worst three points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from .powered_descent_physics import DescentParameters, ThrustLaw, state_rate

Array = NDArray[np.float64]

_POINTS = 60
"""Of the dense output, per interval."""
_LONGEST_FALL_S = 30.0


@dataclass(frozen=True)
class Landing:
    """How a flight went.

    Attributes:
        contact_s: Time of contact, or None where it did not come to that.
        state: (7,) state there.
        excess: By limit, how far it is passed, in units of what is accepted beyond it: up to 1 is
            accepted.
    """

    contact_s: float | None
    state: Array
    excess: dict[str, float]


def land(
    times_s: Array, controls_n: Array, start: Array, values: dict[str, Any], law: ThrustLaw
) -> Landing:
    """Fly a plan until contact, engine off after its end.

    Args:
        times_s: (N+1,) node times.
        controls_n: (N+1, 3) thrust at the nodes.
        start: (7,) first state.
        values: Parameters of powered descent by name, SI.
        law: Thrust between the nodes.
    """
    vehicle = DescentParameters(
        specific_impulse_s=values["specific_impulse"],
        gravity_m_s2=values["gravity"],
        mass_flow_gravity_m_s2=values["standard_gravity"],
    )
    pad = np.asarray(values["final_position"], dtype=np.float64)
    state, excess = np.array(start, dtype=np.float64), dict.fromkeys(_ALONG, -math.inf)
    held = controls_n[0]
    for n in range(times_s.size - 1):
        first, last = controls_n[n], controls_n[n + 1]
        if law is ThrustLaw.INTERVAL_MEAN:
            first = last = (first + last) / 2
        length = float(times_s[n + 1] - times_s[n])

        def thrust(
            after: float, first: Array = first, last: Array = last, h: float = length
        ) -> Array:
            return first + (last - first) * (after / h)

        state, contact_s, flown = _leg(state, length, thrust, vehicle, pad)
        _watch(excess, flown, thrust, values, pad)
        if law is ThrustLaw.LINEAR:
            rate = float(np.linalg.norm(last - first)) / length
            over = (rate - values["thrust_rate_max"]) * length
            excess["thrust_rate_max"] = max(excess["thrust_rate_max"], over / _newtons(values))
        if contact_s is not None:
            held = thrust(contact_s)
            return _landed(float(times_s[n]) + contact_s, state, held, values, pad, excess)
        held = last
    state, contact_s, flown = _leg(state, _LONGEST_FALL_S, lambda _: np.zeros(3), vehicle, pad)
    if contact_s is None:
        return Landing(None, state, excess)
    below = np.max(pad[0] - flown[1][:, 0]) / max(values["altitude_floor_tolerance"], 1e-300)
    excess["altitude_floor"] = max(excess["altitude_floor"], float(below))
    return _landed(float(times_s[-1]) + contact_s, state, held, values, pad, excess)


_ALONG = (
    "altitude_floor",
    "thrust_min",
    "thrust_max",
    "pointing",
    "glideslope",
    "thrust_rate_max",
)


def _leg(
    state: Array, length: float, thrust: Any, vehicle: DescentParameters, pad: Array
) -> tuple[Array, float | None, tuple[Array, Array]]:
    """State at the end, time of contact within, and (times, states) of a dense output."""

    def contact(_: float, x: Array) -> float:
        return float(x[0] - pad[0])

    contact.terminal = True  # type: ignore[attr-defined]
    contact.direction = -1.0  # type: ignore[attr-defined]
    result = solve_ivp(
        lambda t, x: state_rate(x, thrust(t), vehicle),
        (0.0, length),
        state,
        method="DOP853",
        rtol=1e-11,
        atol=1e-9,
        events=contact,
        dense_output=True,
        # Short, so that a dip below the ground within a step is not overlooked.
        max_step=length / 20.0 if length < _LONGEST_FALL_S else np.inf,
    )
    if not result.success:
        raise RuntimeError(result.message)
    assert result.t_events is not None
    assert result.sol is not None
    times = np.linspace(0.0, float(result.t[-1]), _POINTS + 1)
    when = float(result.t_events[0][0]) if result.t_events[0].size else None
    return result.y[:, -1], when, (times, result.sol(times).T)


def _newtons(values: dict[str, Any]) -> float:
    return float(values["thrust_tolerance"] * values["thrust_max"])


def _watch(
    excess: dict[str, float],
    flown: tuple[Array, Array],
    thrust: Any,
    values: dict[str, Any],
    pad: Array,
) -> None:
    times, states = flown
    thrusts = np.array([thrust(t) for t in times])
    size = np.linalg.norm(thrusts, axis=1)
    lateral = np.linalg.norm(thrusts[:, 1:], axis=1)
    tilt, slope = values["pointing_angle_max"], values["glideslope_angle_max"]
    offset = states[:, :3] - pad
    aside = np.linalg.norm(offset[:, 1:], axis=1)
    newtons = _newtons(values)
    found = {
        "altitude_floor": (-offset[:, 0], values["altitude_floor_tolerance"]),
        "thrust_min": (values["thrust_min"] - size, newtons),
        "thrust_max": (size - values["thrust_max"], newtons),
        "pointing": (math.cos(tilt) * lateral - math.sin(tilt) * thrusts[:, 0], newtons),
        "glideslope": (
            math.cos(slope) * aside - math.sin(slope) * offset[:, 0],
            values["glideslope_tolerance"],
        ),
    }
    for name, (violation, accepted) in found.items():
        excess[name] = max(excess[name], _peak(violation) / accepted)


def _peak(values: Array) -> float:
    """Largest value, improved by the parabola through it and its neighbours."""
    best = int(np.argmax(values))
    if not 0 < best < values.size - 1:
        return float(values[best])
    before, top, after = values[best - 1 : best + 2]
    bend = before - 2 * top + after
    return float(top if bend == 0.0 else top - (after - before) ** 2 / (8 * bend))


def _landed(
    contact_s: float,
    state: Array,
    held: Array,
    values: dict[str, Any],
    pad: Array,
    excess: dict[str, float],
) -> Landing:
    velocity = state[3:6] - np.asarray(values["final_velocity"])
    lateral = float(np.linalg.norm(velocity[1:]))
    tilt = math.atan2(float(np.linalg.norm(held[1:])), float(held[0]))
    tilt_max = values["contact_tilt_max"] * (1.0 + values["thrust_tolerance"])
    excess = excess | {
        "miss_position": np.linalg.norm(state[:3] - pad) / values["contact_position_max"],
        "miss_speed": np.linalg.norm(velocity) / values["contact_speed_max"],
        "contact_lateral_speed": lateral / values["contact_lateral_speed_max"],
        "contact_tilt": tilt / tilt_max,
    }
    if values["dry_mass"] > 0.0:
        # What a solver leaves, 1e-6 of it, is accepted.
        missing = values["dry_mass"] - state[6]
        excess["dry_mass"] = missing / (1e-6 * values["dry_mass"])
    return Landing(contact_s, state, {name: float(value) for name, value in excess.items()})
