"""Axes, rotations, and the order of a problem's state in messages.

The landing frame is right-handed with z up. The core's powered descent has x up. The mapping is
cyclic, hence right-handed too::

    ros (x, y, z) = core (y, z, x)        core (x, y, z) = ros (z, x, y)

Entry states are spherical coordinates of a planet-fixed frame; `planet` turns them into its axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from msg_adapters.errors import InputCode, RejectedInputError

LANDING_FRAME = "landing_site"
"""Default landing frame: z up, origin at the touchdown point."""

PLANET_FRAME = "earth"
"""Default planet-fixed frame (REP 105): origin at the planet's centre, z through the north pole, x
through longitude zero on the equator."""

BODY_FRAME = "base_link"
"""Default body frame (REP 105)."""

QUATERNION_NORM_TOLERANCE = 1e-3
"""Permitted distance of a quaternion's norm from 1: single precision and rounding, no more."""

_ROS_FROM_CORE = (1, 2, 0)
_CORE_FROM_ROS = (2, 0, 1)

Array = NDArray[np.float64]


def ros_from_core(vectors: Array) -> Array:
    """Vectors of shape (..., 3) from core axes (x up) to landing-frame axes (z up)."""
    return np.asarray(vectors, dtype=np.float64)[..., _ROS_FROM_CORE]


def core_from_ros(vectors: Array) -> Array:
    """Vectors of shape (..., 3) from landing-frame axes (z up) to core axes (x up)."""
    return np.asarray(vectors, dtype=np.float64)[..., _CORE_FROM_ROS]


def unit_quaternion(field: str, quaternion: Sequence[float]) -> Array:
    """Quaternion (x, y, z, w) normalised exactly, after a check that it nearly is.

    Raises:
        RejectedInputError: NON_UNIT_QUATERNION.
    """
    norm = math.hypot(*quaternion)
    if abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE:
        bound = f"1 +- {QUATERNION_NORM_TOLERANCE:g}"
        raise RejectedInputError(InputCode.NON_UNIT_QUATERNION, f"norm of {field}", norm, bound)
    return np.array(quaternion, dtype=np.float64) / norm


def rotate(quaternion: Array, vector: Array) -> Array:
    """Rotate a vector (3,) by a unit quaternion (x, y, z, w), from child to parent frame."""
    axis, scalar = quaternion[:3], quaternion[3]
    twice = 2.0 * np.cross(axis, vector)
    rotated: Array = vector + scalar * twice + np.cross(axis, twice)
    return rotated


def quaternion_from_z_axis(direction: Array) -> Array:
    """Shortest rotation that takes +z to ``direction``, as (x, y, z, w).

    A zero direction gives the identity. Straight down is a half turn about x.
    """
    norm = math.hypot(*direction)
    if norm == 0.0:
        return np.array([0.0, 0.0, 0.0, 1.0])
    x, y, z = (float(component) / norm for component in direction)
    # Half-angle form: (1 + cos) = 2 cos^2(angle / 2); it vanishes only for straight down.
    scalar = math.sqrt(max(0.0, (1.0 + z) / 2.0))
    # Below, sin(angle/2) * axis = (-y, x, 0) / (2 scalar), which is 0/0 for straight down.
    if scalar < 1e-9:
        return np.array([1.0, 0.0, 0.0, 0.0])
    quaternion = np.array([-y / (2.0 * scalar), x / (2.0 * scalar), 0.0, scalar])
    unit: Array = quaternion / np.linalg.norm(quaternion)
    return unit


class ControlField(Enum):
    """Field of a trajectory point that holds the controls, at the states that they act on."""

    EFFORT = "effort"
    """Forces."""
    VELOCITIES = "velocities"
    """Controls that are the rates of these states; ``effort`` stays empty."""


@dataclass(frozen=True)
class StateLayout:
    """How a problem's state vector is named and ordered in messages.

    Attributes:
        problem: Name of the problem.
        message_names: Names of the state's entries in messages, in message order.
        core_names: Names of the same quantities in the core, in message order.
        state_names: Names of the core's state vector, in the core's order.
        control_field: Where trajectories hold the controls.
    """

    problem: str
    message_names: tuple[str, ...]
    core_names: tuple[str, ...]
    state_names: tuple[str, ...]
    control_field: ControlField = ControlField.EFFORT

    def __post_init__(self) -> None:
        if sorted(self.core_names) != sorted(self.state_names):
            raise InvalidInputError(
                f"state of {self.problem}", self.state_names, f"names {self.core_names}"
            )

    @cached_property
    def _core_index(self) -> list[int]:
        return [self.state_names.index(name) for name in self.core_names]

    @cached_property
    def _message_index(self) -> list[int]:
        return [self.core_names.index(name) for name in self.state_names]

    def to_message_order(self, values: Array) -> Array:
        """Values (..., nx) from the core's order to message order."""
        return np.asarray(values, dtype=np.float64)[..., self._core_index]

    def to_core_order(self, values: Array) -> Array:
        """Values (..., nx) from message order to the core's order."""
        return np.asarray(values, dtype=np.float64)[..., self._message_index]


_POWERED_DESCENT_NAMES = (
    ("x", "y"),
    ("y", "z"),
    ("z", "x"),
    ("vx", "vy"),
    ("vy", "vz"),
    ("vz", "vx"),
    ("mass", "mass"),
)
"""Pairs of message name (z up) and core name (x up)."""

_ENTRY_NAMES = (
    ("r", "radius"),
    ("longitude", "longitude"),
    ("latitude", "latitude"),
    ("speed", "speed"),
    ("flight_path_angle", "flight_path_angle"),
    ("heading", "heading"),
    ("angle_of_attack", "angle_of_attack"),
    ("bank_angle", "bank_angle"),
)
"""Pairs of message name and core name."""

POWERED_DESCENT = "powered_descent"
ENTRY = "entry"

_LAYOUTS = {
    POWERED_DESCENT: (_POWERED_DESCENT_NAMES, ControlField.EFFORT),
    ENTRY: (_ENTRY_NAMES, ControlField.VELOCITIES),
}


def state_layout(problem: str, state_names: Sequence[str]) -> StateLayout:
    """Layout of a problem; of one that is not known here, the core's own names and order.

    Raises:
        InvalidInputError: The state's names are not those of the problem.
    """
    names = tuple(state_names)
    if problem not in _LAYOUTS:
        return StateLayout(problem, names, names, names)
    pairs, control_field = _LAYOUTS[problem]
    message_names, core_names = zip(*pairs, strict=True)
    return StateLayout(problem, tuple(message_names), tuple(core_names), names, control_field)
