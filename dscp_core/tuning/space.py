"""The vector that the optimisers move: logarithms of weights, angles of bounded parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.tuning.quantities import (
    DEFAULT_WEIGHT_START,
    WEIGHTS,
    TunedParameter,
    components,
)

Array = NDArray[np.float64]

_LOG_SPAN = 100.0
# A start at a bound is moved inside by 0.05 % of the range: at the bound, the angle's slope is 0.
_LARGEST_SINE = 0.999


@dataclass(frozen=True)
class _Coordinate:
    """One component: ``value = f(middle + half sin(angle))``, or ``exp(coordinate)`` unbounded.

    f is the exponential for a logarithmic one, else the identity.
    """

    index: int
    label: str
    start: float
    logarithmic: bool
    lower: float
    upper: float

    @property
    def _bounded(self) -> bool:
        return math.isfinite(self.upper)

    def _limits(self) -> tuple[float, float]:
        low, high = self.lower, self.upper
        if self.logarithmic:
            low, high = math.log(low), math.log(high)
        return 0.5 * (low + high), 0.5 * (high - low)

    def coordinate(self) -> float:
        """Of the start."""
        value = math.log(self.start) if self.logarithmic else self.start
        if not self._bounded:
            return value
        middle, half = self._limits()
        sine = min(max((value - middle) / half, -_LARGEST_SINE), _LARGEST_SINE)
        return math.asin(sine)

    def value_and_slope(self, coordinate: float) -> tuple[float, float]:
        """SI value, and its derivative by the coordinate."""
        value, slope = coordinate, 1.0
        if self._bounded:
            middle, half = self._limits()
            value = middle + half * math.sin(coordinate)
            slope = half * math.cos(coordinate)
        if self.logarithmic:
            value = math.exp(value)
            slope *= value
        if self._bounded:
            value = min(max(value, self.lower), self.upper)  # what rounding adds
        return value, slope


class SearchSpace:
    """Coordinates (D,) of the tuned parameters, without the network's weights.

    Attributes:
        labels: Names of the coordinates.
        notes: Starts that are not the present values, in words.
    """

    def __init__(
        self, problem: OptimalControlProblem, tuned: Sequence[TunedParameter], base: Array
    ) -> None:
        """Choose coordinates.

        Args:
            problem: Whose parameters they are.
            tuned: What is tuned.
            base: (P,) present packed parameters, SI.

        Raises:
            InvalidInputError: A start outside the bounds.
        """
        self._base = base.copy()
        self._coordinates: list[_Coordinate] = []
        notes: list[str] = []
        for quantity in tuned:
            if quantity.is_network:
                continue
            declared = problem.table[quantity.name]
            first = problem.table.slice(quantity.name).start
            names = _component_names(problem, quantity.name, declared.size)
            for component in components(quantity, declared):
                index = first + component
                label = f"{quantity.name}.{names[component]}" if names else quantity.name
                present = float(base[index])
                start = _start(quantity, label, present)
                if start != present:
                    notes.append(f"{label} is {present:g} now and tuned from {start:g}")
                self._coordinates.append(
                    _Coordinate(
                        index,
                        label,
                        start,
                        _logarithmic(quantity),
                        quantity.lower,
                        quantity.upper,
                    )
                )
        self.labels = tuple(c.label for c in self._coordinates)
        self.notes = tuple(notes)

    @property
    def size(self) -> int:
        """Number of coordinates D."""
        return len(self._coordinates)

    def start(self) -> Array:
        """Coordinates (D,) of the starts."""
        return np.array([c.coordinate() for c in self._coordinates])

    def packed(self, point: Array) -> Array:
        """Packed parameters (P,) at coordinates (D,), SI."""
        packed = self._base.copy()
        for coordinate, at in zip(self._coordinates, point, strict=True):
            packed[coordinate.index] = coordinate.value_and_slope(float(at))[0]
        return packed

    def pull(self, point: Array, gradient: Array) -> Array:
        """Gradient by the coordinates (D,) from that by the packed parameters (P,)."""
        return np.array(
            [
                gradient[coordinate.index] * coordinate.value_and_slope(float(at))[1]
                for coordinate, at in zip(self._coordinates, point, strict=True)
            ]
        )

    def values(self, point: Array) -> dict[str, float]:
        """SI values by label at coordinates (D,)."""
        packed = self.packed(point)
        return {c.label: float(packed[c.index]) for c in self._coordinates}


def _component_names(problem: OptimalControlProblem, name: str, size: int) -> list[str]:
    """Names of a vector's components; empty for a scalar."""
    if not problem.table[name].is_vector:
        return []
    if name.startswith("trust_region_state"):
        return [s.name for s in problem.states]
    if name.startswith("trust_region_control"):
        return [c.name for c in problem.controls]
    return [str(i) for i in range(size)]


def _logarithmic(quantity: TunedParameter) -> bool:
    if quantity.name in WEIGHTS:
        return True
    return quantity.lower > 0.0 and quantity.upper >= _LOG_SPAN * quantity.lower


def _start(quantity: TunedParameter, label: str, present: float) -> float:
    if quantity.start is not None:
        return quantity.start
    if quantity.name in WEIGHTS and present <= 0.0:
        if math.isfinite(quantity.upper):
            return math.sqrt(quantity.lower * quantity.upper)
        return DEFAULT_WEIGHT_START
    if not quantity.lower <= present <= quantity.upper:
        raise InvalidInputError(
            f"start of {label}",
            present,
            f"[{quantity.lower:g}, {quantity.upper:g}], or another start by {label}@START",
        )
    return present
