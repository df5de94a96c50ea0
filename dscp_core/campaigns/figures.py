"""Figures of campaigns and of single flights. Matplotlib is imported when they are drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dscp_core.campaigns.statistics import ERROR, CampaignStatistics, Footprint, judge
from dscp_core.planning.panels import FLOWN, LIMIT, PLANNED, draw_panel_style, new_figure
from dscp_core.problem.simulation import FlightFigure, FlightRecord, FlightSummary, Simulation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

WORST = 3
"""Flights whose histories a campaign's figure shows."""

_COLUMNS = 4
_MOST_DISTRIBUTIONS = 7
_MOST_HISTORIES = 4
_PANEL_INCHES = (4.3, 3.3)
_BEYOND = 4.0
"""A distribution is drawn up to so many times its 90th percentile; the rest is counted."""
_FLIGHT_COLOURS = ("#b91c1c", "#7c3aed", "#0f766e")


def worst_seeds(simulation: Simulation, flights: Sequence[FlightSummary]) -> tuple[int, ...]:
    """The flights that went worst: failed ones first, then by the first judged figure.

    Those that raised are left out: there is nothing to show of them.
    """
    judged = [figure.name for figure in simulation.figures if figure.judged]
    first = judged[0] if judged else simulation.figures[0].name

    def badness(flight: FlightSummary) -> tuple[bool, float, int]:
        failed = judge(simulation.figures, flight)
        # A flight without the figure has not got so far as to have one.
        return failed is not None, flight.figures.get(first, math.inf), -flight.seed

    flown = [flight for flight in flights if flight.failure != ERROR]
    ordered = sorted(flown, key=badness, reverse=True)
    return tuple(flight.seed for flight in ordered[:WORST])


def campaign_figure(
    simulation: Simulation,
    flights: Sequence[FlightSummary],
    statistics: CampaignStatistics,
    worst: Sequence[FlightRecord],
    title: str,
) -> Figure:
    """Footprint, distributions of figures, and the histories of the worst flights.

    Args:
        simulation: What flew.
        flights: Every flight.
        statistics: Of them.
        worst: Records of those of `worst_seeds`.
        title: Headline.
    """
    there = {f.figure.name for f in statistics.figures} - set(simulation.footprint)
    shown = [figure for figure in simulation.figures if figure.name in there]
    shown.sort(key=lambda figure: not figure.judged)
    shown = shown[:_MOST_DISTRIBUTIONS]
    footprint = statistics.footprint
    first = len(shown) + (footprint is not None)
    histories = list(worst[0].histories)[:_MOST_HISTORIES] if worst else []
    rows = max(1, math.ceil(first / _COLUMNS) + math.ceil(len(histories) / _COLUMNS))
    width, height = _PANEL_INCHES
    figure = new_figure((_COLUMNS * width, rows * height + 0.6), title)
    grid = figure.add_gridspec(rows, _COLUMNS)
    places = iter([(row, column) for row in range(rows) for column in range(_COLUMNS)])
    if footprint is not None:
        draw_footprint(figure.add_subplot(grid[next(places)]), simulation, flights, footprint)
    for figure_shown in shown:
        _draw_distribution(figure.add_subplot(grid[next(places)]), figure_shown, flights)
    row = math.ceil(first / _COLUMNS)
    for number, name in enumerate(histories):
        axes = figure.add_subplot(grid[row + number // _COLUMNS, number % _COLUMNS])
        for record, colour in zip(worst, _FLIGHT_COLOURS, strict=False):
            label = f"seed {record.summary.seed}"
            axes.plot(record.times_s, record.histories[name], color=colour, lw=1.2, label=label)
        _label(axes, f"worst flights: {name}", "time [s]")
        if number == 0:
            axes.legend(frameon=False, fontsize=8)
    return figure


def flight_figure(record: FlightRecord, title: str) -> Figure:
    """Histories of one flight, with what happened in it."""
    columns = min(3, len(record.histories))
    rows = math.ceil(len(record.histories) / columns)
    width, height = _PANEL_INCHES
    figure = new_figure((columns * width, rows * height + 0.8), title)
    for number, (name, values) in enumerate(record.histories.items()):
        axes = figure.add_subplot(rows, columns, number + 1)
        axes.plot(record.times_s, values, color=FLOWN, lw=1.4)
        for time_s, _ in record.events:
            axes.axvline(time_s, color=LIMIT, lw=0.5, alpha=0.5)
        _label(axes, name, "time [s]")
    return figure


def draw_footprint(
    axes: Axes, simulation: Simulation, flights: Sequence[FlightSummary], footprint: Footprint
) -> None:
    """Where flights ended, with the ellipses of 1, 2 and 3 standard deviations."""
    from matplotlib.patches import Circle, Ellipse

    names = footprint.names
    there = [f for f in flights if all(name in f.figures for name in names)]
    points = np.array([[flight.figures[name] for name in names] for flight in there])
    failed = np.array([judge(simulation.figures, flight) is not None for flight in there])
    axes.plot(*points[~failed].T, ".", color=FLOWN, ms=3, label="success")
    if failed.any():
        axes.plot(*points[failed].T, "x", color=PLANNED, ms=5, label="failed")
    sizes, directions = np.linalg.eigh(footprint.covariance_m2)
    angle = math.degrees(math.atan2(directions[1, 1], directions[0, 1]))
    semi = np.sqrt(np.maximum(sizes, 0.0))
    for times in (1, 2, 3):
        axes.add_patch(
            Ellipse(
                (float(footprint.centre_m[0]), float(footprint.centre_m[1])),
                2.0 * times * float(semi[1]),
                2.0 * times * float(semi[0]),
                angle=angle,
                fill=False,
                color="#111827",
                lw=0.8,
            )
        )
    radius_m = _bound_of_distance(simulation, there, points)
    if radius_m is not None:
        axes.add_patch(Circle((0.0, 0.0), radius_m, fill=False, color=LIMIT, ls="--"))
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    shares = ", ".join(f"{100.0 * part:.0f}" for part in footprint.inside)
    _label(axes, f"end of flight; within 1, 2, 3 sigma: {shares} %", names[0])
    axes.set_ylabel(names[1])
    axes.legend(frameon=False, fontsize=8)


def _bound_of_distance(
    simulation: Simulation, flights: Sequence[FlightSummary], points: Array
) -> float | None:
    """Bound of the judged figure that is the distance from the target, if one is."""
    distances = np.hypot(*points.T)
    for figure in simulation.figures:
        if figure.judged and all(figure.name in flight.figures for flight in flights):
            values = np.array([flight.figures[figure.name] for flight in flights])
            if np.allclose(values, distances, rtol=1e-6, atol=1e-9):
                return figure.most
    return None


def _draw_distribution(axes: Axes, figure: FlightFigure, flights: Sequence[FlightSummary]) -> None:
    """Histogram and cumulative share of a figure, with its bound."""
    values = np.sort([f.figures[figure.name] for f in flights if figure.name in f.figures])
    most = max(_BEYOND * float(np.quantile(values, 0.9)), figure.most if figure.judged else 0.0)
    seen = values[values <= most] if values[0] >= 0.0 else values
    beyond = values.size - seen.size
    if np.ptp(seen) > 1e-9 * max(1.0, float(np.abs(seen).max())):
        axes.hist(seen, bins="auto" if seen.size < 10_000 else 100, color="#bfdbfe")
    axes.set_ylabel("flights")
    cumulative = axes.twinx()
    shares = np.arange(1, values.size + 1) / values.size
    cumulative.step(seen, shares[: seen.size], where="post", color=FLOWN, lw=1.4)
    cumulative.set_ylim(0.0, 1.02)
    cumulative.spines[["top"]].set_visible(False)
    if figure.judged:
        axes.axvline(figure.most, color=LIMIT, ls="--", lw=1.1, label="bound")
        axes.legend(frameon=False, fontsize=8, loc="center right")
    note = f" ({beyond} beyond)" if beyond else ""
    _label(axes, f"{figure.name}{note}", f"{figure.description.rstrip('.')} [{figure.unit}]")


def _label(axes: Axes, title: str, across: str) -> None:
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlabel(across, fontsize=9)
    draw_panel_style(axes)
