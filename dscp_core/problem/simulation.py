"""Closed-loop flights of a problem, as a campaign sees them: figures, summaries, records."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dscp_core.problem import checks
from dscp_core.problem.parameters import Parameter

Array = NDArray[np.float64]

DISPERSION = "dispersion"
"""Option of truth that many simulations have: a factor on all random errors."""


@dataclass(frozen=True)
class FlightFigure:
    """One number of a flight.

    Attributes:
        name: With its unit as a suffix, such as ``"contact_speed_m_s"``.
        unit: SI unit; ``"1"`` for a pure number.
        description: What it is.
        most: A flight succeeds only with at most this; infinite where it is not judged.
        excess: What a flight above that is called, such as ``hard``.
    """

    name: str
    unit: str
    description: str
    most: float = math.inf
    excess: str = ""

    def __post_init__(self) -> None:
        checks.named("name of a figure", self.name)

    @property
    def judged(self) -> bool:
        """Whether success depends on it."""
        return math.isfinite(self.most)

    def excess_of(self, value: float) -> float:
        """How many times what it may be a value is; infinite where that is zero."""
        return value / self.most if self.most > 0.0 else math.inf


@dataclass(frozen=True)
class FlightSummary:
    """What a campaign keeps of a flight: numbers and texts.

    Attributes:
        seed: Seed of all random numbers.
        figures: Finite values by the name of their `FlightFigure`; those that the flight has.
        failure: Why it did not end as it should, in a few words; empty if it did.
        worst: Name of the figure furthest above what it may be; empty without one.
        story: One line for a reader.
    """

    seed: int
    figures: Mapping[str, float]
    failure: str = ""
    worst: str = ""
    story: str = ""

    @property
    def success(self) -> bool:
        """Whether the flight ended as it should, with every judged figure within its bound."""
        return not self.failure and not self.worst


def exceeded(figures: Iterable[FlightFigure], values: Mapping[str, float]) -> list[FlightFigure]:
    """Figures above what they may be, the furthest above first, relative to that."""
    above = [f for f in figures if f.name in values and values[f.name] > f.most]
    return sorted(above, key=lambda figure: -figure.excess_of(values[figure.name]))


def worst_of(figures: Iterable[FlightFigure], values: Mapping[str, float]) -> str:
    """Name of the figure furthest above what it may be, relative to that; empty without one."""
    return next((figure.name for figure in exceeded(figures, values)), "")


@dataclass(frozen=True)
class FlightRecord:
    """One flight in full. Rows are ticks; the last row is the end of the flight.

    Attributes:
        summary: Its figures.
        times_s: (M,) from the start.
        states: (M, nx) true states, SI, in the problem's order.
        measured: (M, nx) what navigation told then.
        measured_at_s: (M,) when that was true.
        commanded: (M, nu) from each tick on; the last row repeats the one before it.
        controls: (M, nu) what the actuators were doing at that time.
        phases: (M,) of guidance.
        events: Time in s, and what happened then.
        histories: (M,) each: one to six that show how it went, by name with unit.
    """

    summary: FlightSummary
    times_s: Array
    states: Array
    measured: Array
    measured_at_s: Array
    commanded: Array
    controls: Array
    phases: tuple[str, ...]
    events: tuple[tuple[float, str], ...]
    histories: Mapping[str, Array]


class Simulation(Protocol):
    """Closed-loop flights of one vehicle, mission, guidance and truth.

    Can be pickled; not safe for several threads. Flights are functions of their seed alone.
    """

    @property
    def figures(self) -> tuple[FlightFigure, ...]:
        """What a flight is described and judged by, in the order of a table."""
        ...

    @property
    def footprint(self) -> tuple[str, str]:
        """Names of the two figures that a dispersion ellipse shows."""
        ...

    @property
    def settings(self) -> Mapping[str, Any]:
        """Everything that decides a flight but its seed, for a file."""
        ...

    def fly(self, seed: int) -> FlightSummary:
        """Fly once."""
        ...

    def record(self, seed: int) -> FlightRecord:
        """The same flight in full."""
        ...


class Simulated(Protocol):
    """Makes the simulations of a problem."""

    @property
    def truth(self) -> tuple[Parameter, ...]:
        """What can be chosen of the world; a default of NaN stands for what suits the vehicle."""
        ...

    @property
    def guidance(self) -> tuple[Parameter, ...]:
        """Of guidance, likewise. No name is in two of the three."""
        ...

    @property
    def bounds(self) -> tuple[Parameter, ...]:
        """Of success, likewise."""
        ...

    def __call__(self, planner: Any, options: Mapping[str, Any]) -> Simulation:
        """A simulation.

        Args:
            planner: A `dscp_core.planning.planner.Planner`: vehicle, mission and how to plan.
            options: Of all three by name, SI.

        Raises:
            InvalidInputError: An unknown option or a bad value.
            DscpError: There is nothing to fly, as no plan leads to the target.
        """
        ...
