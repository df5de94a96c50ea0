"""nav_msgs/Odometry: position and velocity of a landing vehicle."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Odometry

from msg_adapters.checks import require_finite, require_frame
from msg_adapters.frames import BODY_FRAME, LANDING_FRAME, Array, rotate, unit_quaternion
from msg_adapters.stamps import nanoseconds_from_stamp, stamp_from_nanoseconds
from msg_adapters.state import InputLimits, Kinematics, check_position, check_velocity

_POSITION = "pose.pose.position"
_ORIENTATION = "pose.pose.orientation"
_VELOCITY = "twist.twist.linear"


def kinematics_from_odometry(
    message: Odometry, *, frame: str = LANDING_FRAME, limits: InputLimits | None = None
) -> Kinematics:
    """Position and velocity in the landing frame.

    The message's twist is in ``child_frame_id``: it is rotated by the attitude, unless both frames
    are the same. Angular velocity and covariances are not used and not checked.

    Args:
        message: The message.
        frame: Expected ``header.frame_id``.
        limits: Range limits; the defaults of `InputLimits` if None.

    Raises:
        RejectedInputError: NOT_FINITE, EMPTY_FRAME, WRONG_FRAME, NON_UNIT_QUATERNION,
            OUT_OF_RANGE, BELOW_GROUND or INVALID_STAMP, checked in this order.
    """
    limits = limits or InputLimits()
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
    check_position(_POSITION, position, limits)
    check_velocity(_VELOCITY, velocity, limits)
    stamp_ns = nanoseconds_from_stamp(message.header.stamp)

    body_velocity = np.array(velocity, dtype=np.float64)
    return Kinematics(
        stamp_ns=stamp_ns,
        position_m=np.array(position, dtype=np.float64),
        velocity_m_s=body_velocity if unit is None else rotate(unit, body_velocity),
    )


def odometry_from_kinematics(
    kinematics: Kinematics,
    *,
    attitude: Array | None = None,
    frame: str = LANDING_FRAME,
    child_frame: str = BODY_FRAME,
) -> Odometry:
    """Message of a position and velocity.

    Args:
        kinematics: In the landing frame.
        attitude: Quaternion (x, y, z, w) that rotates body axes into landing-frame axes; identity
            if None. The twist is written in body axes, unless the two frames are the same.
        frame: ``header.frame_id``.
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
