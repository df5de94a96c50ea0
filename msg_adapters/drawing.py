"""What every drawing of a plan is made of: markers and points; what it offers to the node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from geometry_msgs.msg import Point
from nav_msgs.msg import Path
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from msg_adapters.frames import Array
from msg_adapters.stamps import stamp_from_nanoseconds

if TYPE_CHECKING:
    from dscp_core.planning.plan import Plan

Colour = tuple[float, float, float, float]
"""Red, green, blue and opacity, each from 0 to 1."""

PATH_COLOUR: Colour = (0.1, 0.5, 1.0, 1.0)
ARROW_COLOUR: Colour = (1.0, 0.45, 0.0, 0.9)


class Drawing(Protocol):
    """How plans of one problem are drawn."""

    def path(self, plan: Plan, stamp_ns: int, *, frame: str) -> Path:
        """One pose per node, stamped with the node's time.

        Raises:
            RejectedInputError: NOT_FINITE.
        """
        ...

    def markers(self, plan: Plan, stamp_ns: int, *, frame: str) -> MarkerArray:
        """Markers with fixed names, so that a plan's replace those of the plan before.

        Raises:
            RejectedInputError: NOT_FINITE.
        """
        ...


def line(
    header: Header, namespace: str, points: Array, *, width_m: float, colour: Colour
) -> Marker:
    """Line strip through points (M, 3)."""
    message = marker(header, namespace, 0, Marker.LINE_STRIP, colour)
    message.scale.x = float(width_m)
    message.points = [point(position) for position in points]
    return message


def arrows(
    header: Header,
    namespace: str,
    tails: Array,
    vectors: Array,
    *,
    width_m: float,
    colour: Colour,
) -> list[Marker]:
    """One arrow per row of tails and vectors (M, 3).

    The shaft is twice, the head four times as wide as a line of this width.
    """
    messages = []
    for k, (tail, vector) in enumerate(zip(tails, vectors, strict=True)):
        arrow = marker(header, namespace, k, Marker.ARROW, colour)
        arrow.scale.x, arrow.scale.y = 2.0 * width_m, 4.0 * width_m
        arrow.points = [point(tail), point(tail + vector)]
        messages.append(arrow)
    return messages


def marker(header: Header, namespace: str, identifier: int, kind: int, colour: Colour) -> Marker:
    """Marker without size or points."""
    red, green, blue, alpha = colour
    message = Marker(header=header, ns=namespace, id=identifier, type=kind, action=Marker.ADD)
    message.pose.orientation.w = 1.0
    message.color = ColorRGBA(r=red, g=green, b=blue, a=alpha)
    return message


def no_markers(stamp_ns: int, *, frame: str) -> MarkerArray:
    """Message that removes every marker: there is no plan to show."""
    header = Header(stamp=stamp_from_nanoseconds(stamp_ns), frame_id=frame)
    return MarkerArray(markers=[Marker(header=header, action=Marker.DELETEALL)])


def point(vector: Sequence[float] | Array) -> Point:
    """Point of three numbers."""
    x, y, z = (float(component) for component in vector)
    return Point(x=x, y=y, z=z)
