"""Vehicle states between messages and the core."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.frames import Array
from msg_adapters.layout import StateLayout
from msg_adapters.limits import StateLimits, admitted


@dataclass(frozen=True)
class Kinematics:
    """Position and velocity in the frame of states and plans (z up).

    Attributes:
        stamp_ns: Time of validity, ns.
        position_m: Shape (3,).
        velocity_m_s: Shape (3,), of the body relative to the frame, in its axes.
    """

    stamp_ns: int
    position_m: Array
    velocity_m_s: Array

    def named(self, layout: StateLayout) -> dict[str, float]:
        """The six scalars by the names of messages, of a problem with odometry."""
        assert layout.odometry is not None
        names = (*layout.odometry.position, *layout.odometry.velocity)
        numbers = (*self.position_m, *self.velocity_m_s)
        return {name: float(v) for name, v in zip(names, numbers, strict=True)}


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
    kinematics: Kinematics,
    mass_kg: float | None,
    layout: StateLayout,
    *,
    limits: StateLimits | None = None,
) -> StampedState:
    """Complete state of a problem with odometry; its stamp is that of the kinematics.

    Args:
        kinematics: Position and velocity.
        mass_kg: Mass, of a problem whose state has one.
        layout: Names and order of the problem's state.
        limits: Range limits; those of the layout if None.

    Raises:
        RejectedInputError: OUT_OF_RANGE, BELOW_GROUND or MASS_NOT_POSITIVE.
    """
    named = kinematics.named(layout)
    if layout.odometry is not None and layout.odometry.mass is not None:
        assert mass_kg is not None
        named[layout.odometry.mass] = mass_kg
    passed = admitted(limits or layout.limits, named)
    values = np.array([passed[name] for name in layout.message_names], dtype=np.float64)
    return StampedState(kinematics.stamp_ns, layout.to_core_order(values))


def check_mass(field: str, mass_kg: float) -> None:
    """Check a mass.

    Raises:
        RejectedInputError: MASS_NOT_POSITIVE.
    """
    if not mass_kg > 0.0:
        raise RejectedInputError(InputCode.MASS_NOT_POSITIVE, field, float(mass_kg), "> 0 kg")
