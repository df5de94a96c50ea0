"""What entry refuses: values that contradict each other, and states outside the model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import TRUST_REGION_CONTROL, TRUST_REGION_STATE
from dscp_core.problems.entry.physics import ALPHA, BANK, GAMMA, RADIUS, SPEED, coefficients

ALTITUDE_MAX_M = 150e3
"""Above, an exponential atmosphere says nothing, and nothing steers."""

_SPEED_LEAST_M_S = 100.0
_GRID = 41

_INTERVALS = (
    ("terminal_time_min", "terminal_time_max"),
    ("angle_of_attack_min", "angle_of_attack_max"),
    ("bank_angle_min", "bank_angle_max"),
    ("angle_of_attack_rate_min", "angle_of_attack_rate_max"),
    ("bank_rate_min", "bank_rate_max"),
    ("final_altitude_tolerance", "final_position_tolerance"),
)


def check_state(state: NDArray[np.float64], values: Mapping[str, Any]) -> None:
    """Refuse a start outside the model.

    Args:
        state: (8,), SI.
        values: Parameters by name.

    Raises:
        InvalidInputError: Altitude, speed, angle of attack or bank out of range.
    """
    _check_altitude("radius", float(state[RADIUS]), values)
    if not state[SPEED] >= _SPEED_LEAST_M_S:
        raise InvalidInputError("speed", float(state[SPEED]), f">= {_SPEED_LEAST_M_S:g} m/s")
    for name, index in (("angle_of_attack", ALPHA), ("bank_angle", BANK)):
        low, high = float(values[f"{name}_min"]), float(values[f"{name}_max"])
        tolerance = float(values["angle_tolerance"])
        if not low - tolerance <= state[index] <= high + tolerance:
            raise InvalidInputError(name, float(state[index]), f"[{low:.4f}, {high:.4f}] rad")


def check_parameters(values: Mapping[str, Any]) -> None:
    """Refuse values that contradict each other.

    Raises:
        InvalidInputError: A least value above the greatest, a target outside the atmosphere, or
            coefficients that make no drag somewhere in the flight envelope.
    """
    for lower, upper in _INTERVALS:
        if values[lower] > values[upper]:
            raise InvalidInputError(lower, values[lower], f"<= {upper}, {values[upper]:g}")
    _check_altitude("final_radius", float(values["final_radius"]), values)
    _check_coefficients(values)


def check_printed(values: Mapping[str, Any]) -> None:
    """The same for a linearised cost, which has no minimum without its trust region.

    Raises:
        InvalidInputError: As `check_parameters`, or a weight that is not positive.
    """
    check_parameters(values)
    weights = {
        f"{TRUST_REGION_STATE}[flight_path_angle]": values[TRUST_REGION_STATE][GAMMA],
        f"{TRUST_REGION_CONTROL}[angle_of_attack_rate]": values[TRUST_REGION_CONTROL][0],
        f"{TRUST_REGION_CONTROL}[bank_rate]": values[TRUST_REGION_CONTROL][1],
    }
    for name, weight in weights.items():
        if not weight > 0.0:
            raise InvalidInputError(name, float(weight), "> 0")


def _check_altitude(name: str, radius: float, values: Mapping[str, Any]) -> None:
    ground = float(values["planet_radius"])
    if not ground <= radius <= ground + ALTITUDE_MAX_M:
        bound = f"[{ground:.0f}, {ground + ALTITUDE_MAX_M:.0f}] m, altitude 0 to 150 km"
        raise InvalidInputError(name, radius, bound)


def _check_coefficients(values: Mapping[str, Any]) -> None:
    """The drag polynomial must be positive wherever the vehicle may fly."""
    fastest = max(float(values["initial_speed"]), float(values["speed_min"]))
    alpha, mach = np.meshgrid(
        np.linspace(values["angle_of_attack_min"], values["angle_of_attack_max"], _GRID),
        np.linspace(values["speed_min"], fastest, _GRID) / float(values["speed_of_sound"]),
    )
    drag = coefficients(alpha, mach, values)[1]
    worst = np.unravel_index(int(np.argmin(drag)), drag.shape)
    if not drag[worst] > 0.0:
        raise InvalidInputError(
            "drag_coefficients",
            f"C_D = {drag[worst]:.3g} at {alpha[worst]:.3g} rad, Mach {mach[worst]:.3g}",
            "C_D > 0 from speed_min to initial_speed, at every angle of attack",
        )
