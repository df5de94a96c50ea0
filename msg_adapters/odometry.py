"""nav_msgs/Odometry: position and velocity of a vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from nav_msgs.msg import Odometry

from msg_adapters.checks import require_finite, require_frame
from msg_adapters.errors import RejectedInputError
from msg_adapters.frames import BODY_FRAME, Array, rotate, unit_quaternion
from msg_adapters.layout import StateLayout
from msg_adapters.limits import StateLimits, admitted
from msg_adapters.stamps import nanoseconds_from_stamp, stamp_from_nanoseconds
from msg_adapters.state import Kinematics

_POSITION = "pose.pose.position"
_ORIENTATION = "pose.pose.orientation"
_VELOCITY = "twist.twist.linear"


def kinematics_from_odometry(
    message: Odometry,
    layout: StateLayout,
    *,
    frame: str | None = None,
    limits: StateLimits | None = None,
) -> Kinematics:
    """Position and velocity in the frame of states and plans.

    The message's twist is in ``child_frame_id``: it is rotated by the attitude, unless both frames
    are the same. Angular velocity and covariances are not used and not checked.

    Args:
        message: The message.
        layout: Of a problem with odometry.
        frame: Expected ``header.frame_id``; that of the layout if None.
        limits: Range limits; those of the layout if None.

    Raises:
        RejectedInputError: NOT_FINITE, EMPTY_FRAME, WRONG_FRAME, NON_UNIT_QUATERNION,
            OUT_OF_RANGE, BELOW_GROUND or INVALID_STAMP, checked in this order.
    """
    frame = frame or layout.frame
    point = message.pose.pose.position
    attitude = message.pose.pose.orientation
    linear = message.twist.twist.linear
    position = (point.x, point.y, point.z)
    quaternion = (attitude.x, attitude.y, attitude.z, attitude.w)
    velocity = (linear.x, linear.y, linear.z)

    for field, axes, values in (
        (_POSITION, "xyz", position),
        (_ORIENTATION, "xyzw", quaternion),
        (_VELOCITY, "xyz", velocity),
    ):
        require_finite((f"{field}.{axis}", v) for axis, v in zip(axes, values, strict=True))
    require_frame("header.frame_id", message.header.frame_id, frame)
    require_frame("child_frame_id", message.child_frame_id)
    rotated = message.child_frame_id != frame
    unit = unit_quaternion(_ORIENTATION, quaternion) if rotated else None
    body_velocity = np.array(velocity, dtype=np.float64)
    kinematics = Kinematics(
        stamp_ns=0,
        position_m=np.array(position, dtype=np.float64),
        velocity_m_s=body_velocity if unit is None else rotate(unit, body_velocity),
    )
    _check_range(kinematics, layout, limits or layout.limits)
    return replace(kinematics, stamp_ns=nanoseconds_from_stamp(message.header.stamp))


def _check_range(kinematics: Kinematics, layout: StateLayout, limits: StateLimits) -> None:
    """Check the limits of what an odometry tells; an error has the message's own field names."""
    try:
        admitted(limits, kinematics.named(layout))
    except RejectedInputError as error:
        field = error.field.replace("position", _POSITION).replace("velocity", _VELOCITY)
        raise RejectedInputError(error.code, field, error.value, error.bound) from None


def odometry_from_kinematics(
    kinematics: Kinematics,
    *,
    frame: str,
    attitude: Array | None = None,
    child_frame: str = BODY_FRAME,
) -> Odometry:
    """Message of a position and velocity.

    Args:
        kinematics: In that frame.
        frame: ``header.frame_id``.
        attitude: Quaternion (x, y, z, w) that rotates body axes into the frame's; identity if None.
            The twist is written in body axes, unless the two frames are the same.
        child_frame: ``child_frame_id``.

    Raises:
        RejectedInputError: NOT_FINITE or NON_UNIT_QUATERNION.
    """
    quaternion = (0.0, 0.0, 0.0, 1.0) if attitude is None else tuple(float(q) for q in attitude)
    require_finite(("position_m", float(value)) for value in kinematics.position_m)
    require_finite(("velocity_m_s", float(value)) for value in kinematics.velocity_m_s)
    require_finite(("attitude", value) for value in quaternion)
    unit = unit_quaternion("attitude", quaternion)
    conjugate = unit * np.array([-1.0, -1.0, -1.0, 1.0])
    velocity = kinematics.velocity_m_s
    if child_frame != frame:
        velocity = rotate(conjugate, velocity)

    message = Odometry()
    message.header.stamp = stamp_from_nanoseconds(kinematics.stamp_ns)
    message.header.frame_id = frame
    message.child_frame_id = child_frame
    position = message.pose.pose.position
    position.x, position.y, position.z = (float(value) for value in kinematics.position_m)
    orientation = message.pose.pose.orientation
    orientation.x, orientation.y, orientation.z, orientation.w = (float(q) for q in unit)
    linear = message.twist.twist.linear
    linear.x, linear.y, linear.z = (float(value) for value in velocity)
    return message
