"""What a plan looks like in space, as plain arrays in metres and the axes of messages."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.trajectory import Plan

Array = NDArray[np.float64]

Colour = tuple[float, float, float, float]
"""Red, green, blue and opacity, each from 0 to 1."""

PATH_COLOUR: Colour = (0.1, 0.5, 1.0, 1.0)
ARROW_COLOUR: Colour = (1.0, 0.45, 0.0, 0.9)


@dataclass(frozen=True, eq=False)
class Line:
    """Line through points (M, 3).

    Attributes:
        name: Unique name.
        points: (M, 3).
        width_m: Its width.
        colour: Its colour.

    Example:
        >>> import numpy as np
        >>> from dscp_core import Line
        >>> Line("path", np.zeros((3, 3)), width_m=2.0).points.shape
        (3, 3)
    """

    name: str
    points: Array
    width_m: float
    colour: Colour = PATH_COLOUR


@dataclass(frozen=True, eq=False)
class Arrows:
    """One arrow per row.

    Attributes:
        name: Unique name.
        tails: (M, 3).
        vectors: (M, 3), from tail to tip.
        width_m: A line of this width; shafts are twice, heads four times as wide.
        colour: Their colour.

    Example:
        >>> import numpy as np
        >>> from dscp_core import Arrows
        >>> Arrows("thrust", np.zeros((5, 3)), np.ones((5, 3)), width_m=1.0).name
        'thrust'
    """

    name: str
    tails: Array
    vectors: Array
    width_m: float
    colour: Colour = ARROW_COLOUR


@dataclass(frozen=True, eq=False)
class Sphere:
    """Sphere.

    Attributes:
        name: Unique name.
        centre: (3,).
        radius_m: Its radius.
        colour: Its colour.

    Example:
        >>> import numpy as np
        >>> from dscp_core import Sphere
        >>> Sphere("keep_out", np.zeros(3), 50.0, colour=(1.0, 0.0, 0.0, 0.3)).radius_m
        50.0
    """

    name: str
    centre: Array
    radius_m: float
    colour: Colour


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles, for example a surface.

    Attributes:
        name: Unique name.
        corners: (3 M, 3), three rows per triangle.
        colour: Their colour.

    Example:
        >>> import numpy as np
        >>> from dscp_core import Triangles
        >>> pad = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        >>> Triangles("pad", pad, colour=(0.5, 0.5, 0.5, 1.0)).corners.shape
        (3, 3)
    """

    name: str
    corners: Array
    colour: Colour


@dataclass(frozen=True, eq=False)
class Scene:
    """A plan in space.

    Attributes:
        positions: (N+1, 3), one per node.
        attitudes: (N+1, 4) quaternions (x, y, z, w), or None for none.
        shapes: What is drawn. The names stay from plan to plan, so that a plan's shapes replace
            those of the plan before.

    Example:
        >>> from dscp_core import Extras, Line, Scene
        >>> def scene(plan, parameters, settings):
        ...     positions = plan.states[:, :3]
        ...     return Scene(positions, shapes=(Line("path", positions, width_m=1.0),))
        >>> Extras(scene=scene).scene is scene
        True
    """

    positions: Array
    attitudes: Array | None = None
    shapes: tuple[Line | Arrows | Sphere | Triangles, ...] = ()


SceneOf = Callable[[Plan, Mapping[str, Any], Mapping[str, Any]], Scene]
"""Scene of a plan, its parameters by name (SI) and the settings of `Messages` by name."""


def quaternion_from_z_axis(direction: Array) -> Array:
    """Shortest rotation that takes +z to ``direction``, as (x, y, z, w).

    A zero direction gives the identity. Straight down is a half turn about x.
    """
    norm = math.hypot(*direction)
    if norm == 0.0:
        return np.array([0.0, 0.0, 0.0, 1.0])
    x, y, z = (float(component) / norm for component in direction)
    # Half-angle form: (1 + cos) = 2 cos^2(angle / 2); it vanishes only for straight down.
    scalar = math.sqrt(max(0.0, (1.0 + z) / 2.0))
    # Below, sin(angle/2) * axis = (-y, x, 0) / (2 scalar), which is 0/0 for straight down.
    if scalar < 1e-9:
        return np.array([1.0, 0.0, 0.0, 0.0])
    quaternion = np.array([-y / (2.0 * scalar), x / (2.0 * scalar), 0.0, scalar])
    unit: Array = quaternion / np.linalg.norm(quaternion)
    return unit
