"""nav_msgs/Path as positions and attitudes, both ways."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Path
from std_msgs.msg import Header

from msg_adapters.checks import require_finite, require_frame
from msg_adapters.frames import Array, unit_quaternion
from msg_adapters.stamps import (
    nanoseconds_from_seconds,
    nanoseconds_from_stamp,
    stamp_from_nanoseconds,
)


def path_message(
    positions: Array, attitudes: Array, times_s: Array, stamp_ns: int, frame: str
) -> Path:
    """Path of poses, each stamped with its time.

    Args:
        positions: (M, 3), metres.
        attitudes: (M, 4) quaternions (x, y, z, w).
        times_s: (M,) from the stamp.
        stamp_ns: Time of the path's start.
        frame: Frame of everything.
    """
    message = Path(header=Header(stamp=stamp_from_nanoseconds(stamp_ns), frame_id=frame))
    message.poses = [
        _pose(position, attitude, stamp_ns + nanoseconds_from_seconds(time_s), frame)
        for position, attitude, time_s in zip(positions, attitudes, times_s, strict=True)
    ]
    return message


def _pose(position: Array, attitude: Array, stamp_ns: int, frame: str) -> PoseStamped:
    message = PoseStamped(header=Header(stamp=stamp_from_nanoseconds(stamp_ns), frame_id=frame))
    x, y, z = (float(component) for component in position)
    message.pose.position = Point(x=x, y=y, z=z)
    orientation = message.pose.orientation
    orientation.x, orientation.y, orientation.z, orientation.w = (float(q) for q in attitude)
    return message


def poses_from_path(message: Path, *, frame: str) -> tuple[Array, Array]:
    """Positions (M, 3) in metres and unit quaternions (M, 4), x y z w.

    Raises:
        RejectedInputError: NOT_FINITE, EMPTY_FRAME, WRONG_FRAME, NON_UNIT_QUATERNION or
            INVALID_STAMP.
    """
    poses = [stamped.pose for stamped in message.poses]
    positions = [(p.position.x, p.position.y, p.position.z) for p in poses]
    attitudes = [
        (p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w) for p in poses
    ]
    for k, (position, attitude) in enumerate(zip(positions, attitudes, strict=True)):
        require_finite((f"poses[{k}]", value) for value in (*position, *attitude))
    require_frame("header.frame_id", message.header.frame_id, frame)
    nanoseconds_from_stamp(message.header.stamp)
    units = [
        unit_quaternion(f"poses[{k}].orientation", attitude) for k, attitude in enumerate(attitudes)
    ]
    return np.array(positions).reshape(-1, 3), np.array(units).reshape(-1, 4)
