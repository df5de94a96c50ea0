"""An entry in space: path, ground track, lift arrows and the planet, in planet-fixed axes.

The attitude of a node is that of the body: x through the nose, y left, z up (see `planet`). Arrows
stand along the lift: upwards without bank.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dscp_core.problem.scene import Arrows, Colour, Line, Scene, Sphere
from dscp_core.problems.entry.planet import planet_fixed

if TYPE_CHECKING:
    from dscp_core.problem.trajectory import Plan

_TRACK_COLOUR: Colour = (0.9, 0.9, 0.2, 0.9)
_PLANET_COLOUR: Colour = (0.2, 0.35, 0.6, 0.6)


@dataclass(frozen=True)
class EntryStyle:
    """Sizes.

    Attributes:
        planet_radius_m: Radius of the ground.
        lift_arrow_m: Length of the arrows along the lift.
        line_width_m: Width of path and ground track.
    """

    planet_radius_m: float = 6371.1e3
    lift_arrow_m: float = 200e3
    line_width_m: float = 10e3


def scene_of_settings(
    plan: Plan, parameters: Mapping[str, Any], settings: Mapping[str, Any]
) -> Scene:
    """Scene of a plan; see `dscp_core.problem.scene.SceneOf`."""
    style = EntryStyle(float(parameters["planet_radius"]), settings["lift_arrow_m"])
    return entry_scene(plan, style)


def entry_scene(plan: Plan, style: EntryStyle) -> Scene:
    """Scene of a plan.

    Raises:
        InvalidInputError: A plan of another problem.
    """
    flight = planet_fixed(plan.state_names, plan.states)
    width = style.line_width_m
    track = style.planet_radius_m * flight.up
    lift = style.lift_arrow_m * flight.lift
    return Scene(
        flight.positions_m,
        flight.attitudes,
        (
            Line("path", flight.positions_m, width),
            Line("ground_track", track, width, _TRACK_COLOUR),
            Arrows("lift", flight.positions_m, lift, width),
            Sphere("planet", np.zeros(3), style.planet_radius_m, _PLANET_COLOUR),
        ),
    )
