"""Initial states to learn from and to test on (section 4.1.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from dscp_core.errors import InvalidInputError

Array = NDArray[np.float64]

_LATERAL = ((1, 2), (4, 5))
_OUTBOUND = 0.44  # of the product of both half-widths; r.v reaches twice that product
_SLOW = 0.35


@dataclass(frozen=True)
class Mixture:
    """Which states to learn from, as shares of all of them; the rest is spread evenly.

    Attributes:
        edges: Share, of the evenly spread ones, that is moved to edges, see `StateBox.spread`.
        outbound: Share that flies away from the target fast. The optimal time varies most there.
        slow: Share with little or no lateral velocity, to which the paper's profiles belong.
    """

    edges: float = 0.0
    outbound: float = 0.0
    slow: float = 0.0

    def __post_init__(self) -> None:
        for name in ("edges", "outbound", "slow"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidInputError(name, getattr(self, name), "[0, 1]")
        if self.outbound + self.slow > 1.0:
            raise InvalidInputError("outbound + slow", self.outbound + self.slow, "<= 1")


@dataclass(frozen=True)
class StateBox:
    """Axis-aligned box of initial states at one mass, x up, SI.

    Attributes:
        center: (6,) position and velocity.
        half_width: (6,).
        mass_kg: Initial mass.
    """

    center: tuple[float, ...] = (5200.0, 0.0, 0.0, -135.0, 0.0, 0.0)
    half_width: tuple[float, ...] = (200.0, 600.0, 600.0, 15.0, 30.0, 30.0)
    mass_kg: float = 38000.0

    def __post_init__(self) -> None:
        for name in ("center", "half_width"):
            if len(getattr(self, name)) != 6 or not np.all(np.isfinite(getattr(self, name))):
                raise InvalidInputError(name, getattr(self, name), "6 finite numbers")
        if min(self.half_width) < 0.0:
            raise InvalidInputError("half_width", self.half_width, ">= 0")

    def widened(self, share: float) -> StateBox:
        """The box with every half-width larger by a share."""
        return replace(self, half_width=tuple(w * (1.0 + share) for w in self.half_width))

    def bounds(self, mass_tolerance: float = 0.0) -> tuple[Array, Array]:
        """Least and greatest state, each (7,).

        Args:
            mass_tolerance: Half-width of the mass, relative.
        """
        center, width = np.array(self.center), np.array(self.half_width)
        spread = mass_tolerance * self.mass_kg
        return (
            np.append(center - width, self.mass_kg - spread),
            np.append(center + width, self.mass_kg + spread),
        )

    def uniform(self, count: int, rng: np.random.Generator) -> Array:
        """Independent, uniform states (count, 7)."""
        return self._place(rng.uniform(-1.0, 1.0, (count, 6)))

    def spread(self, count: int, rng: np.random.Generator, *, edges: float = 0.0) -> Array:
        """States (count, 7) that cover the box evenly: a scrambled Sobol sequence.

        Args:
            count: How many.
            rng: Scrambles.
            edges: Share of the states in which each of height, vertical speed, lateral position
                and lateral velocity has an even chance to be moved to its edge: a face of the
                box or, for the lateral ones, the vertical axis. A smooth fit is worst there.
        """
        exponent = max(int(np.ceil(np.log2(max(count, 1)))), 0)
        unit = 2.0 * qmc.Sobol(6, seed=rng).random_base2(exponent)[:count] - 1.0
        unit = rng.permutation(unit)
        at_edge = unit[: round(edges * count)]
        for axis in (0, 3):
            moved = rng.random(len(at_edge)) < 0.5
            at_edge[moved, axis] = np.where(at_edge[moved, axis] < 0.0, -1.0, 1.0)
        for pair in _LATERAL:
            choice = rng.random(len(at_edge))
            lateral = at_edge[:, pair]
            outwards = lateral / np.max(np.abs(lateral), axis=1, keepdims=True)
            lateral = np.where(choice[:, None] < 0.25, 0.0, lateral)
            lateral = np.where(choice[:, None] > 0.75, outwards, lateral)
            at_edge[:, pair] = lateral
        return self._place(rng.permutation(unit))

    def training(self, count: int, rng: np.random.Generator, mixture: Mixture) -> Array:
        """States (count, 7) to learn from, in random order.

        Args:
            count: How many.
            rng: Chooses.
            mixture: Where more of them lie than an even spread would put there.
        """
        outbound, slow = (round(share * count) for share in (mixture.outbound, mixture.slow))
        parts = [
            self.spread(count - outbound - slow, rng, edges=mixture.edges),
            self._outbound(outbound, rng),
            self._slow(slow, rng),
        ]
        return rng.permutation(np.concatenate(parts))

    def _outbound(self, count: int, rng: np.random.Generator) -> Array:
        """States that fly away from the target fast, in the upper part of what the box allows."""
        width = np.array(self.half_width)
        least = _OUTBOUND * width[1] * width[4]
        found = np.zeros((0, 7))
        while len(found) < count:
            states = self.spread(max(8 * count, 64), rng)
            r, v = states[:, 1:3], states[:, 4:6]
            found = np.concatenate([found, states[np.sum(r * v, axis=1) > least]])
        return found[:count]

    def _slow(self, count: int, rng: np.random.Generator) -> Array:
        """States with little lateral velocity; half of them with none."""
        states = self.spread(count, rng)
        factor = _SLOW * np.maximum(rng.uniform(-1.0, 1.0, (count, 1)), 0.0)
        states[:, 4:6] = self.center[4:6] + factor * (states[:, 4:6] - self.center[4:6])
        return states

    def _place(self, unit: Array) -> Array:
        states = np.array(self.center) + unit * np.array(self.half_width)
        return np.column_stack([states, np.full(len(states), self.mass_kg)])


PAPER_BOX = StateBox()
"""The states that the paper samples from."""


def vertical_profile(per_axis: int, box: StateBox = PAPER_BOX) -> Array:
    """The paper's vertical velocity-altitude profile, (per_axis^2, 7), altitude varying slowest.

    r_y = r_z = 100 m, no lateral velocity.
    """
    lower, upper = box.bounds()
    states = np.zeros((per_axis, per_axis, 7))
    states[..., 0] = np.linspace(lower[0], upper[0], per_axis)[:, None]
    states[..., 1:3] = 100.0
    states[..., 3] = np.linspace(lower[3], upper[3], per_axis)
    states[..., 6] = box.mass_kg
    return states.reshape(-1, 7)


def horizontal_profile(per_axis: int, box: StateBox = PAPER_BOX) -> Array:
    """The paper's horizontal profile, (per_axis^2, 7), r_y varying slowest.

    r_x = 5200 m, v_x = -135 m/s, no lateral velocity.
    """
    lower, upper = box.bounds()
    states = np.zeros((per_axis, per_axis, 7))
    states[..., 0], states[..., 3] = box.center[0], box.center[3]
    states[..., 1] = np.linspace(lower[1], upper[1], per_axis)[:, None]
    states[..., 2] = np.linspace(lower[2], upper[2], per_axis)
    states[..., 6] = box.mass_kg
    return states.reshape(-1, 7)
