"""What powered descent refuses: values that contradict each other, and starts of no plan."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problems.powered_descent.limits import lands

_LEAST_HEIGHT_M = 1.0


def check_state(state: NDArray[np.float64], values: Mapping[str, Any]) -> None:
    """Refuse a start below where the plan ends, by more than what a certificate accepts.

    Raises:
        InvalidInputError: The altitude is below that of the landing point, or of the gate above
            it, or the mass below the dry mass.
    """
    end, gate = float(_end_altitude(values)), float(values["gate_height"])
    what = "the landing altitude" if lands(values) else f"{gate:g} m (gate_height) above the pad"
    if state[0] < end - values["altitude_floor_tolerance"]:
        raise InvalidInputError("x", float(state[0]), f">= {end:g} m, {what}")
    if state[6] <= values["dry_mass"]:
        bound = f"above dry_mass, {values['dry_mass']:g} kg (0: unknown)"
        raise InvalidInputError("mass", float(state[6]), bound)


def _end_altitude(values: Mapping[str, Any]) -> float:
    return float(values["final_position"][0] + values["gate_height"])


def check_parameters(values: Mapping[str, Any]) -> None:
    """Refuse an interval whose ends are the wrong way round, and tolerances likewise.

    Raises:
        InvalidInputError: A least value above the greatest, or a part accepted above the whole.
    """
    for lower, upper in (
        ("thrust_min", "thrust_max"),
        ("terminal_time_min", "terminal_time_max"),
        ("contact_lateral_speed_max", "contact_speed_max"),
        ("altitude_floor_tolerance", "contact_position_max"),
    ):
        if values[lower] > values[upper]:
            raise InvalidInputError(lower, values[lower], f"<= {upper}, {values[upper]:g}")
    upwards = float(values["final_velocity"][0])
    if lands(values) and upwards > 0.0:
        bound = "<= 0 m/s, or a gate_height: nothing comes into contact on the way up"
        raise InvalidInputError("final_velocity[0]", upwards, bound)


def terminal_time_guess(state: NDArray[np.float64], values: Mapping[str, Any]) -> float:
    """Time to fall to the landing altitude, between that at the present speed and twice that.

    A descent that brakes evenly takes the latter.
    """
    height = max(float(state[0]) - _end_altitude(values), _LEAST_HEIGHT_M)
    descent_speed = max(-float(state[3]), float(np.sqrt(0.5 * values["gravity"] * height)))
    guess = 1.4 * height / descent_speed
    return float(np.clip(guess, values["terminal_time_min"], values["terminal_time_max"]))
