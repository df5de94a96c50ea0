"""A landing in space: path, thrust arrows, glideslope cone.

The attitude of a node turns body +z (the thrust axis of a vehicle that stands on its tail) into the
thrust direction by the shortest rotation. Heading about that axis is free.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem.scene import Arrows, Line, Scene, Triangles, quaternion_from_z_axis
from dscp_core.problems.powered_descent.messages import message_from_core

if TYPE_CHECKING:
    from dscp_core.problem.trajectory import Plan

Array = NDArray[np.float64]

_CONE_SECTORS = 36
_CONE_MARGIN = 1.2
_CONE_COLOUR = (0.2, 0.8, 0.2, 0.15)


@dataclass(frozen=True)
class DescentStyle:
    """Sizes.

    Attributes:
        thrust_arrow_m: Length of the arrow of the plan's largest thrust.
        line_width_m: Width of the path.
        glideslope_angle_rad: Half angle of the glideslope cone from the vertical; None for no
            cone.
        apex_m: The cone's apex in the landing frame.
    """

    thrust_arrow_m: float = 500.0
    line_width_m: float = 10.0
    glideslope_angle_rad: float | None = None
    apex_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


def scene_of_settings(
    plan: Plan, parameters: Mapping[str, Any], settings: Mapping[str, Any]
) -> Scene:
    """Scene of a plan; see `dscp_core.problem.scene.SceneOf`."""
    x, y, z = message_from_core(parameters["final_position"])
    style = DescentStyle(
        thrust_arrow_m=settings["thrust_arrow_m"],
        glideslope_angle_rad=float(parameters["glideslope_angle_max"]),
        apex_m=(float(x), float(y), float(z)),
    )
    return descent_scene(plan, style)


def descent_scene(plan: Plan, style: DescentStyle) -> Scene:
    """Scene of a plan.

    Raises:
        InvalidInputError: A plan of another problem.
    """
    positions, thrusts = _positions_and_thrusts(plan)
    largest = float(np.linalg.norm(thrusts, axis=1).max())
    scale = style.thrust_arrow_m / largest if largest > 0.0 else 0.0
    shapes: list[Line | Arrows | Triangles] = [
        Line("path", positions, style.line_width_m),
        Arrows("thrust", positions, scale * thrusts, style.line_width_m),
    ]
    if style.glideslope_angle_rad is not None:
        shapes.append(_cone(style.apex_m, style.glideslope_angle_rad, positions))
    attitudes = np.array([quaternion_from_z_axis(thrust) for thrust in thrusts])
    return Scene(positions, attitudes, tuple(shapes))


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
    return message_from_core(plan.states[:, axes]), message_from_core(plan.controls[:, order])


def _cone(apex_m: tuple[float, float, float], angle_rad: float, positions: Array) -> Triangles:
    """Glideslope cone from its apex, as high or as wide as the path, whichever comes first."""
    apex = np.array(apex_m, dtype=np.float64)
    offsets = positions - apex
    slope = math.tan(angle_rad)
    width = _CONE_MARGIN * float(np.hypot(offsets[:, 0], offsets[:, 1]).max())
    radius = min(slope * max(0.0, float(offsets[:, 2].max())), width)
    height = radius / slope
    angles = np.linspace(0.0, 2.0 * math.pi, _CONE_SECTORS + 1)
    rim = [apex + np.array([radius * math.cos(a), radius * math.sin(a), height]) for a in angles]
    corners = [corner for first, second in pairwise(rim) for corner in (apex, first, second)]
    return Triangles("glideslope", np.array(corners), _CONE_COLOUR)
