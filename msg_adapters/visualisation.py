"""nav_msgs/Path and visualization_msgs/MarkerArray: a landing for RViz and Foxglove.

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
from nav_msgs.msg import Path
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from dscp_core.errors import InvalidInputError
from msg_adapters import drawing
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.frames import (
    LANDING_FRAME,
    Array,
    quaternion_from_z_axis,
    ros_from_core,
    rotate,
)
from msg_adapters.path import path_message, poses_from_path
from msg_adapters.stamps import stamp_from_nanoseconds

if TYPE_CHECKING:
    from dscp_core.planning.plan import Plan

_CONE_SECTORS = 36
_CONE_MARGIN = 1.2
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

    def path(self, plan: Plan, stamp_ns: int, *, frame: str) -> Path:
        """`path_from_plan`."""
        return path_from_plan(plan, stamp_ns, frame=frame)

    def markers(self, plan: Plan, stamp_ns: int, *, frame: str) -> MarkerArray:
        """`markers_from_plan`."""
        return markers_from_plan(plan, stamp_ns, self, frame=frame)


def path_from_plan(plan: Plan, stamp_ns: int, *, frame: str = LANDING_FRAME) -> Path:
    """Path of a powered-descent plan; each pose is stamped with the time of its node.

    Raises:
        RejectedInputError: NOT_FINITE.
    """
    positions, thrusts = _positions_and_thrusts(plan)
    attitudes = np.array([quaternion_from_z_axis(thrust) for thrust in thrusts])
    return path_message(positions, attitudes, plan.times_s, stamp_ns, frame)


def points_from_path(message: Path, *, frame: str = LANDING_FRAME) -> tuple[Array, Array]:
    """Positions and thrust directions of a path.

    Returns:
        Positions in metres and unit thrust directions, both of shape (N+1, 3) in the landing
        frame.

    Raises:
        RejectedInputError: NOT_FINITE, EMPTY_FRAME, WRONG_FRAME, NON_UNIT_QUATERNION or
            INVALID_STAMP.
    """
    positions, attitudes = poses_from_path(message, frame=frame)
    up = np.array([0.0, 0.0, 1.0])
    directions = [rotate(attitude, up) for attitude in attitudes]
    return positions, np.array(directions).reshape(-1, 3)


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
    width = style.line_width_m
    markers = [
        drawing.line(header, "path", positions, width_m=width, colour=drawing.PATH_COLOUR),
        *drawing.arrows(
            header,
            "thrust",
            positions,
            scale * thrusts,
            width_m=width,
            colour=drawing.ARROW_COLOUR,
        ),
    ]
    if style.glideslope_angle_rad is not None:
        markers.append(_cone(header, style, positions))
    return MarkerArray(markers=markers)


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


def _cone(header: Header, style: MarkerStyle, positions: Array) -> Marker:
    """Glideslope cone from its apex, as high or as wide as the path, whichever comes first."""
    assert style.glideslope_angle_rad is not None
    marker = drawing.marker(header, "glideslope", 0, Marker.TRIANGLE_LIST, _CONE_COLOUR)
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
        marker.points.extend([drawing.point(apex), drawing.point(first), drawing.point(second)])
    return marker
