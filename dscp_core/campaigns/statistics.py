"""What a campaign says: shares, quantiles and classes of failures, with confidence intervals.

The flights are taken for independent draws from one distribution. Intervals of shares are exact
(Clopper and Pearson 1934), those of quantiles come from order statistics (Conover, Practical
Nonparametric Statistics, section 3.2) and those of means from the bias-corrected bootstrap (Efron
1987).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from dscp_core.problem.simulation import FlightFigure, FlightSummary, Simulation, exceeded

Array = NDArray[np.float64]

ERROR = "error"
"""Class of a flight whose simulation raised an exception, or told what is no number."""

CONFIDENCE = 0.95
_RESAMPLES = 2000
_MOST_CORRECTED = 2000
"""Values up to which the bootstrap is corrected for bias: that costs their square, and changes less
the more they are."""
_MOST_AT_ONCE = 4_000_000
_ROUNDING = 1e-12
"""Spread, relative to the mean, that is rounding and no distribution."""


@dataclass(frozen=True)
class Estimate:
    """A number, and the interval that holds the true one with `CONFIDENCE`.

    Attributes:
        value: The estimate.
        low: Lower end; None where the flights are too few to tell.
        high: Upper end, likewise.
    """

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class FigureStatistics:
    """One figure over the flights that have it.

    Attributes:
        figure: What it is.
        count: Number of flights that have it; the others are in none of these numbers.
        mean: Mean.
        median: Median.
        p90: Ninetieth percentile.
        p99: Ninety-ninth percentile.
        greatest: Greatest value.
        greatest_seed: Its flight.
    """

    figure: FlightFigure
    count: int
    mean: Estimate
    median: Estimate
    p90: Estimate
    p99: Estimate
    greatest: float
    greatest_seed: int


@dataclass(frozen=True)
class FailedFlight:
    """A flight that did not succeed.

    Attributes:
        seed: Of the flight.
        classes: What went wrong, in short words, the gravest first.
        figures: Judged figures that are exceeded, by name.
        story: The flight's own line.
    """

    seed: int
    classes: tuple[str, ...]
    figures: dict[str, float]
    story: str


@dataclass(frozen=True)
class Footprint:
    """Where flights end, in the plane of a simulation's footprint.

    Attributes:
        names: Of the two figures.
        count: Number of flights that have both.
        centre_m: (2,) mean.
        covariance_m2: (2, 2).
        inside: Share of the flights within the ellipses of 1, 2 and 3 standard deviations; of a
            normal distribution 39.3, 86.5 and 98.9 %.
    """

    names: tuple[str, str]
    count: int
    centre_m: Array
    covariance_m2: Array
    inside: tuple[float, float, float]


@dataclass(frozen=True)
class CampaignStatistics:
    """The numbers of a campaign.

    Attributes:
        flights: How many.
        successes: How many ended as they should, with every judged figure within its bound.
        success: Their share.
        figures: In the simulation's order, those that any flight has.
        failed: Flights that did not succeed, in the order of the seeds.
        classes: Number of flights per class, the most frequent first; a flight may be in several.
        footprint: None for fewer than three flights.
    """

    flights: int
    successes: int
    success: Estimate
    figures: tuple[FigureStatistics, ...]
    failed: tuple[FailedFlight, ...]
    classes: dict[str, int]
    footprint: Footprint | None


def statistics(simulation: Simulation, flights: Sequence[FlightSummary]) -> CampaignStatistics:
    """Sum up flights; the same in whichever order they come.

    Args:
        simulation: What flew.
        flights: At least one, each seed once.
    """
    flights = sorted(flights, key=lambda flight: flight.seed)
    failed = [f for f in (judge(simulation.figures, flight) for flight in flights) if f]
    classes = Counter(name for flight in failed for name in flight.classes)
    successes = len(flights) - len(failed)
    return CampaignStatistics(
        flights=len(flights),
        successes=successes,
        success=share(successes, len(flights)),
        figures=tuple(
            _figure_statistics(figure, having)
            for figure in simulation.figures
            if (having := [f for f in flights if figure.name in f.figures])
        ),
        failed=tuple(failed),
        classes=dict(sorted(classes.items(), key=lambda item: (-item[1], item[0]))),
        footprint=_footprint(simulation.footprint, flights),
    )


def judge(figures: Sequence[FlightFigure], flight: FlightSummary) -> FailedFlight | None:
    """What went wrong; None for a success.

    A flight succeeds where nothing failed and every judged figure is there and within its bound.
    """
    judged = [figure for figure in figures if figure.judged]
    over = exceeded(judged, flight.figures)
    by_name = {figure.name: flight.figures[figure.name] for figure in over}
    if flight.failure:
        return FailedFlight(flight.seed, (flight.failure,), by_name, flight.story)
    missing = [f"no {figure.name}" for figure in judged if figure.name not in flight.figures]
    classes = [figure.excess or f"{figure.name} > {figure.most:g}" for figure in over] + missing
    if not classes:
        return None
    return FailedFlight(flight.seed, tuple(dict.fromkeys(classes)), by_name, flight.story)


def share(successes: int, flights: int) -> Estimate:
    """A share with its exact interval."""
    interval = scipy.stats.binomtest(successes, flights).proportion_ci(CONFIDENCE, "exact")
    return Estimate(successes / flights, float(interval.low), float(interval.high))


def quantile(values: Array, level: float) -> Estimate:
    """A quantile with its interval.

    An end of the interval is None where even the extreme of so few values does not bound it: the
    99th percentile has no upper bound below 368 of them.
    """
    # The stubs tell of a float, where there are two.
    found: Any = scipy.stats.quantile_test(values, p=level).confidence_interval(CONFIDENCE)
    return Estimate(
        float(np.quantile(values, level)), _number(float(found.low)), _number(float(found.high))
    )


def mean(values: Array) -> Estimate:
    """A mean with its interval; none of fewer than three values."""
    centre = float(np.mean(values))
    if values.size < 3:
        return Estimate(centre, None, None)
    if np.ptp(values) <= _ROUNDING * abs(centre):
        return Estimate(centre, centre, centre)
    # Of the same values the same interval: the draws are seeded.
    found = scipy.stats.bootstrap(
        (values,),
        np.mean,
        n_resamples=_RESAMPLES,
        batch=max(1, _MOST_AT_ONCE // values.size),
        method="BCa" if values.size <= _MOST_CORRECTED else "percentile",
        confidence_level=CONFIDENCE,
        random_state=np.random.default_rng(0),
    ).confidence_interval
    return Estimate(centre, _number(float(found.low)), _number(float(found.high)))


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _figure_statistics(figure: FlightFigure, flights: Sequence[FlightSummary]) -> FigureStatistics:
    values = np.array([flight.figures[figure.name] for flight in flights])
    greatest = int(np.argmax(values))
    return FigureStatistics(
        figure=figure,
        count=values.size,
        mean=mean(values),
        median=quantile(values, 0.5),
        p90=quantile(values, 0.9),
        p99=quantile(values, 0.99),
        greatest=float(values[greatest]),
        greatest_seed=flights[greatest].seed,
    )


def _footprint(names: tuple[str, str], flights: Sequence[FlightSummary]) -> Footprint | None:
    points = np.array(
        [[f.figures[n] for n in names] for f in flights if all(n in f.figures for n in names)]
    )
    if len(points) < 3:
        return None
    centre, covariance = points.mean(axis=0), np.cov(points.T)
    offsets = points - centre
    # The pseudo-inverse: where all flights end on a line, the ellipse is that line.
    distances = np.einsum("ni,ij,nj->n", offsets, np.linalg.pinv(covariance), offsets)
    one, two, three = (float(np.mean(distances <= n**2)) for n in (1, 2, 3))
    return Footprint(names, len(points), centre, covariance, (one, two, three))
