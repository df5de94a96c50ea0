"""nav_msgs/Path and visualization_msgs/MarkerArray: a plan's scene for RViz and Foxglove.

Each shape of a scene has its name as the namespace of its markers: ids 0..M of arrows, 0 of
everything else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import Point
from nav_msgs.msg import Path
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem.scene import (
    Arrows,
    Colour,
    Line,
    Scene,
    SceneOf,
    Sphere,
    Triangles,
)
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.frames import Array
from msg_adapters.path import path_message
from msg_adapters.stamps import stamp_from_nanoseconds

if TYPE_CHECKING:
    from dscp_core.problem.trajectory import Plan


@dataclass(frozen=True)
class Drawing:
    """How the plans of one problem are drawn.

    Attributes:
        scene: Makes the scene of a plan.
        parameters: Parameters by name, SI.
        settings: Settings that the problem brings, by name.
    """

    scene: SceneOf
    parameters: Mapping[str, Any]
    settings: Mapping[str, Any]

    def draw(self, plan: Plan, stamp_ns: int, *, frame: str) -> tuple[Path, MarkerArray]:
        """Path and markers of a plan.

        Args:
            plan: The plan.
            stamp_ns: Time of the state that it starts from.
            frame: Frame of everything.

        Raises:
            InvalidInputError: The scene is none.
            RejectedInputError: NOT_FINITE.
        """
        for field in ("times_s", "states", "controls"):
            _require_finite(f"plan.{field}", getattr(plan, field))
        scene = self.scene(plan, self.parameters, self.settings)
        return (
            path_from_scene(scene, plan.times_s, stamp_ns, frame=frame),
            markers_from_scene(scene, stamp_ns, frame=frame),
        )


def path_from_scene(scene: Scene, times_s: Array, stamp_ns: int, *, frame: str) -> Path:
    """One pose per node, stamped with the node's time.

    Raises:
        InvalidInputError: Positions or attitudes of another shape.
        RejectedInputError: NOT_FINITE.
    """
    nodes = len(times_s)
    positions = _checked("scene.positions", scene.positions, (nodes, 3))
    attitudes = np.tile([0.0, 0.0, 0.0, 1.0], (nodes, 1))
    if scene.attitudes is not None:
        attitudes = _checked("scene.attitudes", scene.attitudes, (nodes, 4))
    return path_message(positions, attitudes, times_s, stamp_ns, frame)


def markers_from_scene(scene: Scene, stamp_ns: int, *, frame: str) -> MarkerArray:
    """Markers with fixed names, so that a plan's replace those of the plan before.

    Raises:
        InvalidInputError: A shape's array of another size.
        RejectedInputError: NOT_FINITE.
    """
    header = Header(stamp=stamp_from_nanoseconds(stamp_ns), frame_id=frame)
    return MarkerArray(markers=[m for shape in scene.shapes for m in _markers(header, shape)])


def no_markers(stamp_ns: int, *, frame: str) -> MarkerArray:
    """Message that removes every marker: there is no plan to show."""
    header = Header(stamp=stamp_from_nanoseconds(stamp_ns), frame_id=frame)
    return MarkerArray(markers=[Marker(header=header, action=Marker.DELETEALL)])


def _markers(header: Header, shape: Line | Arrows | Sphere | Triangles) -> list[Marker]:
    name = shape.name
    if isinstance(shape, Arrows):
        return _arrows(header, shape)
    if isinstance(shape, Line):
        line = _marker(header, name, 0, Marker.LINE_STRIP, shape.colour)
        line.scale.x = float(shape.width_m)
        line.points = [_point(p) for p in _checked(f"{name}.points", shape.points, (None, 3))]
        return [line]
    if isinstance(shape, Sphere):
        sphere = _marker(header, name, 0, Marker.SPHERE, shape.colour)
        sphere.pose.position = _point(_checked(f"{name}.centre", shape.centre, (3,)))
        sphere.scale.x = sphere.scale.y = sphere.scale.z = 2.0 * float(shape.radius_m)
        return [sphere]
    triangles = _marker(header, name, 0, Marker.TRIANGLE_LIST, shape.colour)
    triangles.scale.x = triangles.scale.y = triangles.scale.z = 1.0
    triangles.points = [_point(p) for p in _checked(f"{name}.corners", shape.corners, (None, 3))]
    return [triangles]


def _arrows(header: Header, shape: Arrows) -> list[Marker]:
    tails = _checked(f"{shape.name}.tails", shape.tails, (None, 3))
    vectors = _checked(f"{shape.name}.vectors", shape.vectors, tails.shape)
    messages = []
    for k, tail, vector in zip(count(), tails, vectors, strict=False):
        arrow = _marker(header, shape.name, k, Marker.ARROW, shape.colour)
        arrow.scale.x, arrow.scale.y = 2.0 * float(shape.width_m), 4.0 * float(shape.width_m)
        arrow.points = [_point(tail), _point(tail + vector)]
        messages.append(arrow)
    return messages


def _marker(header: Header, namespace: str, identifier: int, kind: int, colour: Colour) -> Marker:
    """Marker without size or points."""
    red, green, blue, alpha = (float(part) for part in colour)
    message = Marker(header=header, ns=namespace, id=identifier, type=kind, action=Marker.ADD)
    message.pose.orientation.w = 1.0
    message.color = ColorRGBA(r=red, g=green, b=blue, a=alpha)
    return message


def _point(vector: Sequence[float] | Array) -> Point:
    x, y, z = (float(component) for component in vector)
    return Point(x=x, y=y, z=z)


def _checked(field: str, values: Array, shape: tuple[int | None, ...]) -> Array:
    array = np.asarray(values, dtype=np.float64)
    fits = len(array.shape) == len(shape) and all(
        wanted in (None, size) for wanted, size in zip(shape, array.shape, strict=True)
    )
    if not fits:
        sizes = ", ".join("M" if wanted is None else str(wanted) for wanted in shape)
        raise InvalidInputError(field, f"shape {array.shape}", f"shape ({sizes})")
    _require_finite(field, array)
    return array


def _require_finite(field: str, values: Array) -> None:
    if not np.all(np.isfinite(values)):
        raise RejectedInputError(InputCode.NOT_FINITE, field, "NaN or infinity", "finite")
