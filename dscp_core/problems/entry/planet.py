"""Entry states in the axes of the planet-fixed frame: positions, directions, attitudes.

Longitude is positive eastwards, latitude northwards; heading is the azimuth of the velocity,
clockwise from north; a positive bank turns the lift to the right of the velocity, which is where
the equations of motion turn the heading. Body axes: x through the nose, y left, z up (REP 103);
without bank, the angle of attack lifts the nose out of the velocity's direction; no sideslip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError

Array = NDArray[np.float64]

_NAMES = (
    "radius",
    "longitude",
    "latitude",
    "flight_path_angle",
    "heading",
    "angle_of_attack",
    "bank_angle",
)


@dataclass(frozen=True)
class PlanetFixed:
    """States in planet-fixed axes; rows are states.

    Attributes:
        positions_m: (M, 3).
        up: (M, 3) unit vectors away from the planet's centre.
        lift: (M, 3) unit vectors along the lift.
        attitudes: (M, 4) quaternions (x, y, z, w) that rotate body axes into planet-fixed ones.
    """

    positions_m: Array
    up: Array
    lift: Array
    attitudes: Array


def planet_fixed(state_names: Sequence[str], states: Array) -> PlanetFixed:
    """Entry states in planet-fixed axes.

    Args:
        state_names: Core names of the columns.
        states: (M, nx), SI.

    Raises:
        InvalidInputError: A state is missing.
    """
    names = list(state_names)
    if missing := sorted(set(_NAMES) - set(names)):
        raise InvalidInputError("plan.state_names", names, f"names that include {missing}")
    radius, longitude, latitude, climb, heading, attack, bank = (
        states[:, names.index(name)] for name in _NAMES
    )
    from scipy.spatial.transform import Rotation  # a fifth of a second, for drawings alone

    # Body to wind to local axes (north, west, up) to planet-fixed ones, each a right-handed turn:
    # pitching the nose up is a negative turn about y (left), banking right a positive one about x.
    wind_from_body = Rotation.from_euler("Y", -attack[:, np.newaxis])
    local_from_wind = Rotation.from_euler("ZYX", np.column_stack([-heading, -climb, bank]))
    # At longitude and latitude zero, north is z, west is -y and up is x.
    at_origin = Rotation.from_matrix([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    turned = Rotation.from_euler("ZY", np.column_stack([longitude, -latitude]))
    planet_from_local = turned * at_origin
    planet_from_wind = planet_from_local * local_from_wind
    up = planet_from_local.apply([0.0, 0.0, 1.0])
    return PlanetFixed(
        positions_m=radius[:, np.newaxis] * up,
        up=up,
        lift=planet_from_wind.apply([0.0, 0.0, 1.0]),
        attitudes=(planet_from_wind * wind_from_body).as_quat(),
    )
