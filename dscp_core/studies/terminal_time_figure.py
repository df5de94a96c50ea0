"""Figure of the sweep over the terminal time. Matplotlib is imported when it is drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from dscp_core.planning.panels import FLOWN, LIMIT, PLANNED, draw_panel_style
from dscp_core.studies.terminal_time import SweepPoint, SweepSummary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INFEASIBLE = "#fecaca"
_FEASIBLE = "#f0fdf4"
_FLAGGED = "#d97706"
_LEAST_ERROR_SHOWN = 1e-13


def sweep_figure(points: Sequence[SweepPoint], summary: SweepSummary) -> Figure:
    """Final mass, its gradient, and the gradient's error over the terminal time.

    Args:
        points: The sweep, in order.
        summary: Its numbers.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 9.5), dpi=130, layout="constrained")
    mass, gradient, error = figure.subplots(3, 1, sharex=True, height_ratios=(1.0, 1.0, 0.75))
    for axes in (mass, gradient, error):
        _shade(axes, points, summary)
        draw_panel_style(axes)
    _draw_mass(mass, points, summary)
    _draw_gradient(gradient, points, summary)
    _draw_error(error, points)
    error.set_xlabel("terminal time [s]")
    error.set_xlim(points[0].terminal_time_s, points[-1].terminal_time_s)
    return figure


def _shade(axes: Axes, points: Sequence[SweepPoint], summary: SweepSummary) -> None:
    first, last = points[0].terminal_time_s, points[-1].terminal_time_s
    least = first if summary.least_feasible_s is None else summary.least_feasible_s
    edge = min(max(least, first), last)
    axes.axvspan(first, edge, color=_INFEASIBLE, linewidth=0, zorder=0)
    axes.axvspan(edge, last, color=_FEASIBLE, linewidth=0, zorder=0)


def _draw_mass(axes: Axes, points: Sequence[SweepPoint], summary: SweepSummary) -> None:
    feasible = [p for p in points if p.feasible]
    axes.plot(
        [p.terminal_time_s for p in feasible],
        [p.final_mass_kg for p in feasible],
        color=FLOWN,
        linewidth=1.8,
        label="final mass, converged",
    )
    if summary.free_optimum_s is not None and summary.free_final_mass_kg is not None:
        axes.plot(
            summary.free_optimum_s,
            summary.free_final_mass_kg,
            "*",
            color=PLANNED,
            markersize=13,
            label=f"free terminal time: {summary.free_optimum_s:.4f} s, "
            f"{summary.free_final_mass_kg:.2f} kg",
        )
    axes.axvline(
        summary.paper_optimum_s,
        color=LIMIT,
        linestyle="--",
        linewidth=1.1,
        label=f"paper: {summary.paper_optimum_s:.2f} s",
    )
    axes.set_title("final mass [kg]", loc="left", fontsize=11)
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.legend(loc="lower center", fontsize=9)
    least = summary.least_feasible_s
    if least is not None and points[0].terminal_time_s <= least <= points[-1].terminal_time_s:
        axes.annotate(
            f"feasible from {least:.4f} s",
            (least, 0.03),
            xycoords=("data", "axes fraction"),
            xytext=(4, 0),
            textcoords="offset points",
            fontsize=9,
            color="#991b1b",
        )


def _draw_gradient(axes: Axes, points: Sequence[SweepPoint], summary: SweepSummary) -> None:
    feasible = [p for p in points if p.feasible]
    times = [p.terminal_time_s for p in feasible]
    slopes = [p.gradient_kg_s for p in feasible]
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.plot(times, slopes, color=FLOWN, linewidth=1.8, label="DSCP, unrolled")
    sparse = feasible[:: max(1, len(feasible) // 50)]
    axes.plot(
        [p.terminal_time_s for p in sparse],
        [p.central_difference_kg_s for p in sparse],
        "o",
        color=PLANNED,
        markersize=5,
        markerfacecolor="none",
        label="central differences of the whole SCP, same K",
    )
    if summary.gradient_zero_s is not None:
        axes.axvline(
            summary.gradient_zero_s,
            color=LIMIT,
            linestyle=":",
            linewidth=1.3,
            label=f"zero at {summary.gradient_zero_s:.4f} s",
        )
    if slopes:
        # At the edge of feasibility the slope is vertical; the rest is what there is to see.
        low, high = np.percentile(slopes, (0.0, 97.0))
        margin = 0.12 * max(high - low, 1.0)
        axes.set_ylim(low - margin, high + margin)
    axes.set_title("gradient of the final mass [kg/s]", loc="left", fontsize=11)
    axes.legend(loc="upper right", fontsize=9)


def _draw_error(axes: Axes, points: Sequence[SweepPoint]) -> None:
    regular = [p for p in points if p.trusted and p.compared]
    flagged = [p for p in points if p.feasible and not p.trusted and p.compared]
    kinks = [p for p in points if p.feasible and p.across_kink]
    for chosen, colour, marker, label in (
        (regular, FLOWN, ".", "regular"),
        (flagged, _FLAGGED, "x", "flagged by the verdict"),
        (kinks, LIMIT, "+", "difference across a kink"),
    ):
        known = [p for p in chosen if math.isfinite(p.relative_error)]
        if known:
            axes.plot(
                [p.terminal_time_s for p in known],
                [max(p.relative_error, _LEAST_ERROR_SHOWN) for p in known],
                marker,
                color=colour,
                markersize=5,
                label=label,
            )
    axes.set_yscale("log")
    axes.set_ylim(top=max(axes.get_ylim()[1], 1e-5))  # room for the legend
    axes.axhline(1e-6, color=LIMIT, linestyle="--", linewidth=1.0)
    axes.set_title(
        "relative error of the gradient against central differences", loc="left", fontsize=11
    )
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper right", fontsize=9, ncols=3)
