"""Figures of the surface-to-mass study. Matplotlib is imported when they are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from dscp_core.planning.panels import draw_panel_style
from dscp_core.studies.surface_to_mass import (
    PAPER,
    changes_count,
    false_stop,
    regular_difference,
    rows_of,
    solved_points,
    sweep_slopes,
)
from dscp_core.studies.trust_region_cases import CASES
from dscp_core.studies.trust_region_figures import CASE_COLOURS
from dscp_core.workers.grid import Item, Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CHANGED = "#dc2626"


def sweep_figure(items: Sequence[Item], rows: Sequence[Row], intervals: int) -> Figure:
    """Cost and iterations over the ratio, with both optima of every case.

    Args:
        items: Of the sweep.
        rows: Their results.
        intervals: Which number of intervals.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(9.0, 9.0), dpi=130, layout="constrained")
    cost, iterations = figure.subplots(2, 1, sharex=True, height_ratios=(1.4, 1.0))
    all_costs: list[float] = []
    for case in CASES:
        points, descent = rows_of(items, rows, case.name, intervals)
        solved = solved_points(points)
        points = [row for row in solved if not false_stop(row)]
        stops = [row for row in solved if false_stop(row)]
        ratios = np.array([row["ratio"] for row in points])
        costs = np.array([row["cost"] for row in points])
        colour = CASE_COLOURS[case.name]
        cost.plot(ratios, costs, ".-", color=colour, linewidth=1.3, markersize=4, label=case.name)
        changed = np.array(changes_count(points), dtype=bool)
        cost.plot(
            ratios[changed],
            costs[changed],
            "o",
            markerfacecolor="none",
            markeredgecolor=_CHANGED,
            markersize=6,
            label="number of iterations changes" if case is CASES[-1] else None,
        )
        if descent["ratio"] is not None:
            cost.plot(
                descent["ratio"],
                descent["cost"],
                "*",
                color=colour,
                markeredgecolor="black",
                markersize=13,
                zorder=5,
                label="by gradient descent" if case is CASES[-1] else None,
            )
        cost.axvline(PAPER[case.name, intervals].ratio, color=colour, linestyle=":", linewidth=1.0)
        all_costs += costs.tolist()
        cost.plot(
            [row["ratio"] for row in stops],
            [row["cost"] for row in stops],
            "x",
            color=colour,
            markersize=6,
            label="stopped far from the dynamics" if case is CASES[-1] else None,
        )
        iterations.step(
            [row["ratio"] for row in solved],
            [row["iterations"] for row in solved],
            where="mid",
            color=colour,
            linewidth=1.3,
        )
    if all_costs:
        # What is far off only is a stop after two or three iterations.
        margin = 0.1 * (max(all_costs) - min(all_costs))
        cost.set_ylim(min(all_costs) - margin, max(all_costs) + 2.0 * margin)
    cost.set_title(
        f"performance index, N = {intervals} (dotted: the paper's optima)", loc="left", fontsize=11
    )
    cost.legend(fontsize=8, ncols=2)
    iterations.set_title("iterations", loc="left", fontsize=11)
    iterations.yaxis.set_major_locator(MaxNLocator(integer=True))
    iterations.set_xlabel(r"$\omega_{S/m}$")
    for axes in (cost, iterations):
        draw_panel_style(axes)
    return figure


def gradient_figure(items: Sequence[Item], rows: Sequence[Row], intervals: int) -> Figure:
    """Gradients through the iterations against differences: the sweep's, and at equal K.

    The sweep is without its false stops.

    Args:
        items: Of the sweep.
        rows: Their results.
        intervals: Which number of intervals.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 6.0), dpi=130, layout="constrained")
    swept, equal = figure.subplots(1, 2)
    for case in CASES:
        solved = solved_points(rows_of(items, rows, case.name, intervals)[0])
        points = [row for row in solved if not false_stop(row)]
        gradients = np.array([row["gradient"] for row in points])
        slopes = np.array(sweep_slopes(points))
        changed = np.array(changes_count(points), dtype=bool)
        style = {"color": CASE_COLOURS[case.name], "markersize": 5}
        swept.plot(gradients[~changed], slopes[~changed], ".", label=case.name, **style)
        swept.plot(
            gradients[changed],
            slopes[changed],
            "x",
            label="number of iterations changes" if case is CASES[-1] else None,
            **style,
        )
        regular = [row for row in solved if regular_difference(row)]
        equal.plot(
            [row["gradient"] for row in regular],
            [row["difference"] for row in regular],
            ".",
            label=case.name,
            **style,
        )
    swept.set_title(f"slope of the sweep, N = {intervals}", loc="left", fontsize=11)
    equal.set_title("differences at the same number of iterations", loc="left", fontsize=11)
    for axes in (swept, equal):
        _draw_diagonal(axes)
        axes.set_xlabel(r"DSCP: $\mathrm{d}J/\mathrm{d}\omega_{S/m}$")
        axes.set_ylabel("differences")
        axes.legend(fontsize=8)
        draw_panel_style(axes)
    return figure


def _draw_diagonal(axes: Axes) -> None:
    low, high = min(*axes.get_xlim(), *axes.get_ylim()), max(*axes.get_xlim(), *axes.get_ylim())
    axes.plot([low, high], [low, high], color="black", linewidth=0.8, zorder=0, label="y = x")
