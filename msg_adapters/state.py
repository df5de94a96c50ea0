"""Vehicle states between messages and the core, and the range checks they all share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.frames import Array, StateLayout

POSITION_NAMES = ("x", "y", "z")
VELOCITY_NAMES = ("vx", "vy", "vz")
MASS_NAME = "mass"


class StateLimits(Protocol):
    """What the named scalars of a problem's state have to satisfy."""

    def admit(self, named: Mapping[str, float]) -> dict[str, float]:
        """Finite named scalars as the planner takes them, which may be the same in other numbers.

        Raises:
            RejectedInputError: A value is out of range.
        """
        ...


@dataclass(frozen=True)
class InputLimits:
    """Bounds beyond which the state of a landing vehicle is taken for an error.

    Attributes:
        position_max_m: Largest distance from the landing site.
        speed_max_m_s: Largest speed.
        ground_tolerance_m: How far below the landing site an altitude may be, for sensor noise.
    """

    position_max_m: float = 1e6
    speed_max_m_s: float = 1e4
    ground_tolerance_m: float = 1.0

    def admit(self, named: Mapping[str, float]) -> dict[str, float]:
        """The same scalars, after range checks of those groups of names that are there.

        Raises:
            RejectedInputError: OUT_OF_RANGE, BELOW_GROUND or MASS_NOT_POSITIVE.
        """
        if all(name in named for name in POSITION_NAMES):
            check_position("position", [named[name] for name in POSITION_NAMES], self)
        if all(name in named for name in VELOCITY_NAMES):
            check_velocity("velocity", [named[name] for name in VELOCITY_NAMES], self)
        if MASS_NAME in named:
            check_mass(MASS_NAME, named[MASS_NAME])
        return dict(named)


@dataclass(frozen=True)
class Kinematics:
    """Position and velocity in the landing frame (z up).

    Attributes:
        stamp_ns: Time of validity, ns.
        position_m: Shape (3,).
        velocity_m_s: Shape (3,), of the body relative to the landing frame, in its axes.
    """

    stamp_ns: int
    position_m: Array
    velocity_m_s: Array


@dataclass(frozen=True)
class StampedMass:
    """Vehicle mass.

    Attributes:
        stamp_ns: Time of validity, ns.
        mass_kg: Mass.
    """

    stamp_ns: int
    mass_kg: float


@dataclass(frozen=True)
class StampedState:
    """A complete state for the planner.

    Attributes:
        stamp_ns: Time of validity, ns.
        values: State in the core's order and axes, SI, shape (nx,).
    """

    stamp_ns: int
    values: Array


def state_from_kinematics(
    kinematics: Kinematics, mass_kg: float, layout: StateLayout
) -> StampedState:
    """Complete state of a landing vehicle; its stamp is that of the kinematics."""
    named = dict(zip(POSITION_NAMES, kinematics.position_m, strict=True))
    named |= dict(zip(VELOCITY_NAMES, kinematics.velocity_m_s, strict=True))
    named[MASS_NAME] = mass_kg
    values = np.array([named[name] for name in layout.message_names], dtype=np.float64)
    return StampedState(kinematics.stamp_ns, layout.to_core_order(values))


def check_position(field: str, position_m: Sequence[float], limits: InputLimits) -> None:
    """Check a landing-frame position (x, y, z up).

    Raises:
        RejectedInputError: OUT_OF_RANGE or BELOW_GROUND.
    """
    distance_m = math.hypot(*position_m)
    if not distance_m <= limits.position_max_m:
        bound = f"<= {limits.position_max_m:g} m"
        raise RejectedInputError(InputCode.OUT_OF_RANGE, f"norm of {field}", distance_m, bound)
    altitude_m = float(position_m[2])
    if altitude_m < -limits.ground_tolerance_m:
        bound = f">= {-limits.ground_tolerance_m:g} m"
        raise RejectedInputError(InputCode.BELOW_GROUND, f"{field}.z", altitude_m, bound)


def check_velocity(field: str, velocity_m_s: Sequence[float], limits: InputLimits) -> None:
    """Check a velocity, whose norm is the same in every frame.

    Raises:
        RejectedInputError: OUT_OF_RANGE.
    """
    speed_m_s = math.hypot(*velocity_m_s)
    if not speed_m_s <= limits.speed_max_m_s:
        bound = f"<= {limits.speed_max_m_s:g} m/s"
        raise RejectedInputError(InputCode.OUT_OF_RANGE, f"norm of {field}", speed_m_s, bound)


def check_mass(field: str, mass_kg: float) -> None:
    """Check a mass.

    Raises:
        RejectedInputError: MASS_NOT_POSITIVE.
    """
    if not mass_kg > 0.0:
        raise RejectedInputError(InputCode.MASS_NOT_POSITIVE, field, float(mass_kg), "> 0 kg")
