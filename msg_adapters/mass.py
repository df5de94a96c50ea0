"""geometry_msgs/InertiaStamped: vehicle mass."""

from __future__ import annotations

from geometry_msgs.msg import InertiaStamped

from msg_adapters.checks import require_finite
from msg_adapters.frames import BODY_FRAME
from msg_adapters.stamps import nanoseconds_from_stamp, stamp_from_nanoseconds
from msg_adapters.state import StampedMass, check_mass


def mass_from_inertia(message: InertiaStamped) -> StampedMass:
    """Mass and its time. The frame and the rest of the inertia are not used and not checked.

    Raises:
        RejectedInputError: NOT_FINITE, MASS_NOT_POSITIVE or INVALID_STAMP.
    """
    require_finite([("inertia.m", message.inertia.m)])
    check_mass("inertia.m", message.inertia.m)
    return StampedMass(nanoseconds_from_stamp(message.header.stamp), float(message.inertia.m))


def inertia_from_mass(mass: StampedMass, *, frame: str = BODY_FRAME) -> InertiaStamped:
    """Message of a mass; centre of mass and moments of inertia stay zero.

    Raises:
        RejectedInputError: NOT_FINITE or MASS_NOT_POSITIVE.
    """
    require_finite([("mass_kg", mass.mass_kg)])
    check_mass("mass_kg", mass.mass_kg)
    message = InertiaStamped()
    message.header.stamp = stamp_from_nanoseconds(mass.stamp_ns)
    message.header.frame_id = frame
    message.inertia.m = float(mass.mass_kg)
    return message
