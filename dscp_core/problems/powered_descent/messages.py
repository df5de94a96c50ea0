"""Powered descent in messages: a landing frame with z up, odometry, limits.

The mapping of the axes is cyclic, hence right-handed too::

    messages (x, y, z) = core (y, z, x)        core (x, y, z) = messages (z, x, y)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.messages import Messages, Odometry, StateLimit, StateLimitError
from dscp_core.problem.parameters import Parameter

Array = NDArray[np.float64]

LANDING_FRAME = "landing_site"
"""Default landing frame: z up, origin at the touchdown point."""

_AXES = (1, 2, 0)
_ODOMETRY = Odometry(mass="mass")


def message_from_core(vectors: Array) -> Array:
    """Vectors of shape (..., 3) from core axes (x up) to landing-frame axes (z up)."""
    return np.asarray(vectors, dtype=np.float64)[..., _AXES]


@dataclass(frozen=True)
class DescentLimits:
    """Bounds beyond which the state of a landing vehicle is taken for an error.

    Attributes:
        position_max_m: Largest distance from the landing site.
        speed_max_m_s: Largest speed.
        ground_tolerance_m: How far below the landing site an altitude may be, for sensor noise.
    """

    position_max_m: float = 1e6
    speed_max_m_s: float = 1e4
    ground_tolerance_m: float = 1.0

    def admit(self, named: Mapping[str, float]) -> dict[str, float]:
        """The same scalars, after range checks of those groups of names that are there.

        Raises:
            StateLimitError: A value is out of range.
        """
        if all(name in named for name in _ODOMETRY.position):
            self._check_position([named[name] for name in _ODOMETRY.position])
        if all(name in named for name in _ODOMETRY.velocity):
            velocity_m_s = [named[name] for name in _ODOMETRY.velocity]
            _check_norm("velocity", velocity_m_s, self.speed_max_m_s, "m/s")
        if "mass" in named and not named["mass"] > 0.0:
            kind = StateLimit.MASS_NOT_POSITIVE
            raise StateLimitError(kind, "mass", float(named["mass"]), "> 0 kg")
        return dict(named)

    def _check_position(self, position_m: Sequence[float]) -> None:
        _check_norm("position", position_m, self.position_max_m, "m")
        altitude_m = float(position_m[2])
        if altitude_m < -self.ground_tolerance_m:
            bound = f">= {-self.ground_tolerance_m:g} m"
            raise StateLimitError(StateLimit.BELOW_GROUND, "position.z", altitude_m, bound)


def _check_norm(field: str, vector: Sequence[float], largest: float, unit: str) -> None:
    norm = math.hypot(*vector)
    if not norm <= largest:
        bound = f"<= {largest:g} {unit}"
        raise StateLimitError(StateLimit.OUT_OF_RANGE, f"norm of {field}", norm, bound)


def _admit(
    named: Mapping[str, float], _parameters: Mapping[str, Any], settings: Mapping[str, Any]
) -> dict[str, float]:
    limits = DescentLimits(
        settings["position_max_m"], settings["speed_max_m_s"], settings["ground_tolerance_m"]
    )
    return limits.admit(named)


_LIMITS = DescentLimits()

MESSAGES = Messages(
    states=(
        ("x", "y"),
        ("y", "z"),
        ("z", "x"),
        ("vx", "vy"),
        ("vy", "vz"),
        ("vz", "vx"),
        ("mass", "mass"),
    ),
    axes=_AXES,
    frame=LANDING_FRAME,
    frame_parameter="landing_frame",
    frame_description="Frame of states and plans: z up, origin at the ground point that targets "
    "refer to.",
    odometry=_ODOMETRY,
    settings=(
        Parameter(
            "position_max_m",
            _LIMITS.position_max_m,
            "m",
            "Distance from the landing site beyond which a state is refused.",
            1.0,
            1e9,
        ),
        Parameter(
            "speed_max_m_s",
            _LIMITS.speed_max_m_s,
            "m/s",
            "Speed beyond which a state is refused.",
            1.0,
            1e6,
        ),
        Parameter(
            "ground_tolerance_m",
            _LIMITS.ground_tolerance_m,
            "m",
            "How far below the landing site a state may be, for sensor noise.",
            0.0,
            1e4,
        ),
        Parameter(
            "thrust_arrow_m", 500.0, "m", "Marker length of a plan's largest thrust.", 0.0, 1e5
        ),
    ),
    admit=_admit,
)
