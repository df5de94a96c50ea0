"""Rotations, and the default body frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from msg_adapters.errors import InputCode, RejectedInputError

BODY_FRAME = "base_link"
"""Default body frame (REP 105)."""

QUATERNION_NORM_TOLERANCE = 1e-3
"""Permitted distance of a quaternion's norm from 1: single precision and rounding, no more."""

Array = NDArray[np.float64]


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
