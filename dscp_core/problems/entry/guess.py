"""Initial reference of entry: the appendix's control profile, integrated."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.declaration import TERMINAL_TIME, InitialGuess
from dscp_core.problems.entry.physics import ALPHA, LATITUDE, LONGITUDE, SPEED, dynamics
from dscp_core.transcription.compiled import Symbol

# Steps of the whole flight: 12 s each, where the trajectory swings with periods of minutes. Its
# error, 1.4 m and 0.02 m/s, matters to nobody; more steps make the guess and its derivative slower.
_STEPS = 200
# What is left at the end of a flight that does not waste its energy.
_FINAL_SPEED_M_S = 2000.0
# Of the time at the mean of the speeds at both ends: 0.9 of the best time.
_SHORTER = 0.82

# What the dynamics and the profile need.
_NAMES = (
    TERMINAL_TIME,
    "initial_angle_of_attack",
    "initial_bank_angle",
    "bank_angle_max",
    "guess_angle_of_attack",
    "mass",
    "reference_area",
    "surface_to_mass_ratio",
    "lift_coefficients",
    "drag_coefficients",
    "planet_radius",
    "gravitational_parameter",
    "rotation_rate",
    "sea_level_density",
    "scale_height",
    "speed_of_sound",
)
_START = tuple(
    f"initial_{name}"
    for name in ("radius", "longitude", "latitude", "speed", "flight_path_angle", "heading")
)


def _angles(fraction: Symbol, p: Mapping[str, Symbol]) -> Symbol:
    """Angle of attack and bank at a fraction of the flight, (2, n): the profile in closed form."""
    phase = 2 * math.pi * fraction
    alpha = p["initial_angle_of_attack"] + fraction * (
        p["guess_angle_of_attack"] - p["initial_angle_of_attack"]
    )
    swing = ca.sin(phase) / 3 + fraction / 6
    return ca.vertcat(alpha, p["initial_bank_angle"] - p["bank_angle_max"] * swing)


def _rates(fraction: Symbol, p: Mapping[str, Symbol]) -> Symbol:
    """Their rates u_1 and u_2, (2, n), rad/s."""
    change = p["guess_angle_of_attack"] - p["initial_angle_of_attack"]
    swing = 2 * math.pi / 3 * ca.cos(2 * math.pi * fraction) + 1 / 6
    rates = ca.vertcat(change * ca.DM.ones(1, fraction.numel()), -p["bank_angle_max"] * swing)
    return rates / p[TERMINAL_TIME]


def _interval(values: Mapping[str, ca.MX], intervals: int) -> ca.Function:
    """(first six states, fraction, parameters) to the states one interval later, by Runge-Kutta."""
    symbols = {name: ca.SX.sym(name, values[name].numel()) for name in _NAMES}
    state, start = ca.SX.sym("state", 6), ca.SX.sym("fraction")
    substeps = max(1, math.ceil(_STEPS / intervals))
    share = 1.0 / (intervals * substeps)
    step = symbols[TERMINAL_TIME] * share

    def slope(fraction: ca.SX, y: ca.SX) -> ca.SX:
        x = ca.vertcat(y, _angles(fraction, symbols))
        return dynamics(x, ca.SX.zeros(2), symbols)[:ALPHA]

    y = ca.SX.sym("y", 6)
    fraction = ca.SX.sym("f")
    first = slope(fraction, y)
    second = slope(fraction + share / 2, y + step / 2 * first)
    third = slope(fraction + share / 2, y + step / 2 * second)
    fourth = slope(fraction + share, y + step * third)
    packed = ca.vertcat(*symbols.values())
    once = ca.Function(
        "entry_step",
        [y, fraction, packed],
        [y + step / 6 * (first + 2 * second + 2 * third + fourth)],
    )
    reached = state
    for substep in range(substeps):
        reached = once(reached, start + substep * share, packed)
    return ca.Function("entry_interval", [state, start, packed], [reached])


def rolled_out_guess(p: Mapping[str, ca.MX], intervals: int) -> InitialGuess:
    """The appendix's reference: its fixed control profile flown from the initial state.

    Angle of attack and bank have closed forms; the other states are integrated by the classical
    Runge-Kutta method.
    """
    packed = ca.vertcat(*(p[name] for name in _NAMES))
    start = ca.vertcat(*(p[name] for name in _START))
    fractions = np.linspace(0.0, 1.0, intervals + 1)
    flight = _interval(p, intervals).mapaccum("entry_rollout", intervals)
    flown = flight(start, ca.DM(fractions[:-1]).T, ca.repmat(packed, 1, intervals))
    nodes = ca.MX(ca.DM(fractions).T)
    states = ca.vertcat(ca.horzcat(start, flown), _angles(nodes, p))
    return InitialGuess(states, _rates(nodes, p))


def terminal_time_guess(state: NDArray[np.float64], values: Mapping[str, Any]) -> float:
    """Flight time over the great circle to the target, on the short side.

    From a reference that takes too long and runs out of speed there is no feasible subproblem;
    from one that is too fast there is.

    Args:
        state: (8,), SI.
        values: Parameters by name.
    """
    latitudes = float(state[LATITUDE]), float(values["final_latitude"])
    turned = float(values["final_longitude"]) - float(state[LONGITUDE])
    cosine = math.sin(latitudes[0]) * math.sin(latitudes[1])
    cosine += math.cos(latitudes[0]) * math.cos(latitudes[1]) * math.cos(turned)
    distance = float(values["planet_radius"]) * math.acos(min(1.0, max(-1.0, cosine)))
    mean_speed = 0.5 * (float(state[SPEED]) + _FINAL_SPEED_M_S)
    low, high = float(values["terminal_time_min"]), float(values["terminal_time_max"])
    return float(np.clip(_SHORTER * distance / mean_speed, low, high))
