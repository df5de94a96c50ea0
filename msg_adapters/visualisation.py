"""nav_msgs/Path and visualization_msgs/MarkerArray: a plan for RViz and Foxglove.

Path: one pose per node; its orientation turns body +z (the thrust axis of a vehicle that stands on
its tail) into the thrust direction by the shortest rotation. Heading about that axis is free.

Markers: namespace ``path`` id 0 (line strip), ``thrust`` ids 0..N (an arrow per node, along the
thrust), ``glideslope`` id 0 (the cone that the path stays inside). The ids are fixed, so that a
plan's markers replace those of the plan before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Path
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from dscp_core.errors import InvalidInputError
from msg_adapters.checks import require_finite, require_frame
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.frames import (
    LANDING_FRAME,
    Array,
    quaternion_from_z_axis,
    ros_from_core,
    rotate,
    unit_quaternion,
)
from msg_adapters.stamps import (
    nanoseconds_from_seconds,
    nanoseconds_from_stamp,
    stamp_from_nanoseconds,
)

if TYPE_CHECKING:
    from dscp_core.plan import Plan

_CONE_SECTORS = 36
_CONE_MARGIN = 1.2
_PATH_COLOUR = (0.1, 0.5, 1.0, 1.0)
_THRUST_COLOUR = (1.0, 0.45, 0.0, 0.9)
_CONE_COLOUR = (0.2, 0.8, 0.2, 0.15)


@dataclass(frozen=True)
class MarkerStyle:
    """Sizes of the markers.

    Attributes:
        thrust_arrow_m: Length of the arrow of the plan's largest thrust.
        line_width_m: Width of the path; arrow shafts and heads are two and four times as wide.
        glideslope_angle_rad: Half angle of the glideslope cone from the vertical; None for no
            cone.
        apex_m: The cone's apex in the landing frame.
    """

    thrust_arrow_m: float = 500.0
    line_width_m: float = 10.0
    glideslope_angle_rad: float | None = None
    apex_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


def path_from_plan(plan: Plan, stamp_ns: int, *, frame: str = LANDING_FRAME) -> Path:
    """Path of a powered-descent plan; each pose is stamped with the time of its node.

    Raises:
        RejectedInputError: NOT_FINITE.
    """
    positions, thrusts = _positions_and_thrusts(plan)
    message = Path(header=Header(stamp=stamp_from_nanoseconds(stamp_ns), frame_id=frame))
    message.poses = [
        _pose(position, thrust, stamp_ns + nanoseconds_from_seconds(time_s), frame)
        for position, thrust, time_s in zip(positions, thrusts, plan.times_s, strict=True)
    ]
    return message


def points_from_path(message: Path, *, frame: str = LANDING_FRAME) -> tuple[Array, Array]:
    """Positions and thrust directions of a path.

    Returns:
        Positions in metres and unit thrust directions, both of shape (N+1, 3) in the landing
        frame.

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
    up = np.array([0.0, 0.0, 1.0])
    directions = [
        rotate(unit_quaternion(f"poses[{k}].orientation", attitude), up)
        for k, attitude in enumerate(attitudes)
    ]
    return np.array(positions).reshape(-1, 3), np.array(directions).reshape(-1, 3)


def markers_from_plan(
    plan: Plan, stamp_ns: int, style: MarkerStyle, *, frame: str = LANDING_FRAME
) -> MarkerArray:
    """Markers of a powered-descent plan.

    Raises:
        RejectedInputError: NOT_FINITE.
    """
    positions, thrusts = _positions_and_thrusts(plan)
    header = Header(stamp=stamp_from_nanoseconds(stamp_ns), frame_id=frame)
    largest = float(np.linalg.norm(thrusts, axis=1).max())
    scale = style.thrust_arrow_m / largest if largest > 0.0 else 0.0
    line = _marker(header, "path", 0, Marker.LINE_STRIP, _PATH_COLOUR)
    line.scale.x = float(style.line_width_m)
    line.points = [_point(position) for position in positions]
    markers = [line]
    for k, (position, thrust) in enumerate(zip(positions, thrusts, strict=True)):
        arrow = _marker(header, "thrust", k, Marker.ARROW, _THRUST_COLOUR)
        arrow.scale.x, arrow.scale.y = 2.0 * style.line_width_m, 4.0 * style.line_width_m
        arrow.points = [_point(position), _point(position + scale * thrust)]
        markers.append(arrow)
    if style.glideslope_angle_rad is not None:
        markers.append(_cone(header, style, positions))
    return MarkerArray(markers=markers)


def no_markers(stamp_ns: int, *, frame: str = LANDING_FRAME) -> MarkerArray:
    """Message that removes every marker: there is no plan to show."""
    header = Header(stamp=stamp_from_nanoseconds(stamp_ns), frame_id=frame)
    return MarkerArray(markers=[Marker(header=header, action=Marker.DELETEALL)])


def _positions_and_thrusts(plan: Plan) -> tuple[Array, Array]:
    """Positions and thrusts (N+1, 3) in the landing frame."""
    names = list(plan.state_names)
    try:
        axes = [names.index(name) for name in ("x", "y", "z")]
        order = [list(plan.control_states).index(names.index(name)) for name in ("vx", "vy", "vz")]
    except ValueError:
        raise InvalidInputError(
            "plan.state_names", names, "x y z, and thrust on vx vy vz"
        ) from None
    if not (np.all(np.isfinite(plan.states)) and np.all(np.isfinite(plan.controls))):
        raise RejectedInputError(InputCode.NOT_FINITE, "plan", "NaN or infinity", "finite")
    return ros_from_core(plan.states[:, axes]), ros_from_core(plan.controls[:, order])


def _pose(position: Array, thrust: Array, stamp_ns: int, frame: str) -> PoseStamped:
    message = PoseStamped(header=Header(stamp=stamp_from_nanoseconds(stamp_ns), frame_id=frame))
    message.pose.position = _point(position)
    orientation = message.pose.orientation
    quaternion = quaternion_from_z_axis(thrust)
    orientation.x, orientation.y, orientation.z, orientation.w = (float(q) for q in quaternion)
    return message


def _cone(header: Header, style: MarkerStyle, positions: Array) -> Marker:
    """Glideslope cone from its apex, as high or as wide as the path, whichever comes first."""
    assert style.glideslope_angle_rad is not None
    marker = _marker(header, "glideslope", 0, Marker.TRIANGLE_LIST, _CONE_COLOUR)
    marker.scale.x = marker.scale.y = marker.scale.z = 1.0
    apex = np.array(style.apex_m, dtype=np.float64)
    offsets = positions - apex
    slope = math.tan(style.glideslope_angle_rad)
    width = _CONE_MARGIN * float(np.hypot(offsets[:, 0], offsets[:, 1]).max())
    radius = min(slope * max(0.0, float(offsets[:, 2].max())), width)
    height = radius / slope
    angles = np.linspace(0.0, 2.0 * math.pi, _CONE_SECTORS + 1)
    rim = [apex + np.array([radius * math.cos(a), radius * math.sin(a), height]) for a in angles]
    for first, second in pairwise(rim):
        marker.points.extend([_point(apex), _point(first), _point(second)])
    return marker


def _marker(
    header: Header,
    namespace: str,
    identifier: int,
    kind: int,
    colour: tuple[float, float, float, float],
) -> Marker:
    red, green, blue, alpha = colour
    marker = Marker(header=header, ns=namespace, id=identifier, type=kind, action=Marker.ADD)
    marker.pose.orientation.w = 1.0
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=alpha)
    return marker


def _point(vector: Array) -> Point:
    x, y, z = (float(component) for component in vector)
    return Point(x=x, y=y, z=z)
