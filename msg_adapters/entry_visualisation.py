"""nav_msgs/Path and visualization_msgs/MarkerArray: an entry for RViz and Foxglove.

Path: one pose per node in the planet-fixed frame; its orientation is the attitude of the body,
x through the nose, y left, z up (see `planet`).

Markers: namespace ``path`` id 0 (line strip), ``ground_track`` id 0 (the same on the ground),
``lift`` ids 0..N (an arrow per node along the lift: upwards without bank), ``planet`` id 0
(sphere). The ids are fixed, so that a plan's markers replace those of the plan before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from nav_msgs.msg import Path
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from msg_adapters import drawing
from msg_adapters.path import path_message
from msg_adapters.planet import planet_fixed
from msg_adapters.stamps import stamp_from_nanoseconds

if TYPE_CHECKING:
    from dscp_core.planning.plan import Plan

_TRACK_COLOUR: drawing.Colour = (0.9, 0.9, 0.2, 0.9)
_PLANET_COLOUR: drawing.Colour = (0.2, 0.35, 0.6, 0.6)


@dataclass(frozen=True)
class EntryMarkerStyle:
    """Sizes of the markers.

    Attributes:
        planet_radius_m: Radius of the ground.
        lift_arrow_m: Length of the arrows along the lift.
        line_width_m: Width of path and ground track; arrow shafts and heads are two and four times
            as wide.
    """

    planet_radius_m: float = 6371.1e3
    lift_arrow_m: float = 200e3
    line_width_m: float = 10e3

    def path(self, plan: Plan, stamp_ns: int, *, frame: str) -> Path:
        """Path of an entry plan; each pose is stamped with the time of its node.

        Raises:
            InvalidInputError: A plan of another problem.
            RejectedInputError: NOT_FINITE.
        """
        flight = planet_fixed(plan.state_names, plan.states)
        return path_message(flight.positions_m, flight.attitudes, plan.times_s, stamp_ns, frame)

    def markers(self, plan: Plan, stamp_ns: int, *, frame: str) -> MarkerArray:
        """Markers of an entry plan.

        Raises:
            InvalidInputError: A plan of another problem.
            RejectedInputError: NOT_FINITE.
        """
        flight = planet_fixed(plan.state_names, plan.states)
        header = Header(stamp=stamp_from_nanoseconds(stamp_ns), frame_id=frame)
        width = self.line_width_m
        track = self.planet_radius_m * flight.up
        planet = drawing.marker(header, "planet", 0, Marker.SPHERE, _PLANET_COLOUR)
        planet.scale.x = planet.scale.y = planet.scale.z = 2.0 * float(self.planet_radius_m)
        return MarkerArray(
            markers=[
                drawing.line(
                    header, "path", flight.positions_m, width_m=width, colour=drawing.PATH_COLOUR
                ),
                drawing.line(header, "ground_track", track, width_m=width, colour=_TRACK_COLOUR),
                *drawing.arrows(
                    header,
                    "lift",
                    flight.positions_m,
                    self.lift_arrow_m * flight.lift,
                    width_m=width,
                    colour=drawing.ARROW_COLOUR,
                ),
                planet,
            ]
        )
