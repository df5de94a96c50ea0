"""Figures of the trust-region study. Matplotlib is imported when they are drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.planning.panels import LIMIT, PLANNED, draw_panel_style
from dscp_core.studies.trust_region import BASIN, converged, false_stop, fastest_step
from dscp_core.studies.trust_region_cases import CASES, MOST_ITERATIONS
from dscp_core.workers.grid import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

CASE_COLOURS = {
    "case1": "#6b7280",
    "case2": "#d97706",
    "case3": "#1d4ed8",
    "case4": "#047857",
}
_DESCENT = "#dc2626"
_X_LABEL = r"$\log_{10}\,\omega_\gamma$"
_Y_LABEL = r"$\log_{10}\,\omega_u$"


def iteration_map(points: Sequence[Row]) -> Figure:
    """Iterations until the cost has settled; 20 stands for never."""
    figure, axes = _figure("Iterations until the cost settles")
    values = _table(points, lambda row: row["iterations"] if converged(row) else MOST_ITERATIONS)
    _draw_map(figure, axes, points, values, "iterations (20: not settled)", "viridis_r")
    _draw_false_stops(axes, points)
    _draw_cases(axes)
    axes.legend(loc="upper left", fontsize=8)
    return figure


def loss_map(points: Sequence[Row], steps: Sequence[Row]) -> Figure:
    """The convergence metric, and the descent on it.

    Args:
        points: The grid.
        steps: Of the descent, in order.
    """
    figure, axes = _figure("Convergence metric and descent")
    values = _table(points, lambda row: None if false_stop(row) else _log(row["loss"]))
    _draw_map(figure, axes, points, values, r"$\log_{10}\,\mathcal{L}$", "magma_r")
    _draw_false_stops(axes, points)
    best = fastest_step(steps)
    if best is not None:
        _draw_descent(axes, steps, best)
    axes.legend(loc="upper left", fontsize=8)
    return figure


def gradient_field(points: Sequence[Row]) -> Figure:
    """Direction and size of the metric's gradient by the logarithms of the weights."""
    figure, axes = _figure("Gradient of the convergence metric")
    sizes = _table(points, lambda row: _log(_size(row["gradient"])))
    _draw_map(figure, axes, points, sizes, r"$\log_{10}\,|\nabla\mathcal{L}|$", "cividis")
    arrows = _thinned([row for row in points if row["gradient"] is not None])
    places = np.array([row["log_weights"] for row in arrows])
    field = np.array([row["gradient"] for row in arrows])
    if len(field):
        # The axes have different scales: directions are those of the picture.
        field = field / np.array([_span(points, 0), _span(points, 1)])
        field = field / np.maximum(np.hypot(*field.T), 1e-300)[:, None]
        axes.quiver(*places.T, *field.T, color="black", scale=32.0, width=0.0025, pivot="mid")
    return figure


def evolution_figure(cases: Mapping[str, Row]) -> Figure:
    """Cost over the iterations, and the limited quantities of the last trajectories."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(12.0, 7.0), dpi=130, layout="constrained")
    (cost, pressure), (heat, load) = figure.subplots(2, 2)
    for name, row in cases.items():
        style = {"color": CASE_COLOURS[name], "linewidth": 1.5}
        iterations = range(1, len(row["costs"]) + 1)
        cost.plot(iterations, row["costs"], ".-", label=_label(name, row), **style)
        for axes, quantity, unit in (
            (pressure, "dynamic_pressure", 1e3),
            (heat, "heat_rate", 1e6),
            (load, "load_factor", 1.0),
        ):
            axes.plot(row["times_s"], np.array(row["limited"][quantity]) / unit, **style)
    limits = next(iter(cases.values()))["limits"]
    for axes, quantity, unit, title in (
        (pressure, "dynamic_pressure", 1e3, "dynamic pressure [kPa]"),
        (heat, "heat_rate", 1e6, "heat rate [MW/m$^2$]"),
        (load, "load_factor", 1.0, "load factor [g]"),
    ):
        axes.axhline(limits[quantity] / unit, color=LIMIT, linestyle="--", label="limit")
        axes.set_title(title, loc="left", fontsize=11)
        axes.set_xlabel("time [s]")
        axes.legend(fontsize=8, loc="best")
        draw_panel_style(axes)
    settled = [value for row in cases.values() for value in row["costs"][2:]]
    margin = 0.1 * (max(settled) - min(settled)) if settled else 0.0
    if margin > 0.0:
        cost.set_ylim(min(settled) - margin, max(settled) + margin)
    cost.set_title("performance index over the iterations", loc="left", fontsize=11)
    cost.set_xlabel("iteration")
    cost.xaxis.set_major_locator(MaxNLocator(integer=True))
    cost.legend(fontsize=8)
    draw_panel_style(cost)
    return figure


def state_figure(cases: Mapping[str, Row]) -> Figure:
    """Angles of the last trajectories."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 7.0), dpi=130, layout="constrained")
    panels = figure.subplots(2, 2)
    shown = ("flight_path_angle", "heading", "angle_of_attack", "bank_angle")
    for axes, name in zip(panels.flat, shown, strict=True):
        for case, row in cases.items():
            angle = np.degrees(row["states"][name])
            axes.plot(
                row["times_s"],
                angle,
                color=CASE_COLOURS[case],
                linewidth=1.5,
                label=_label(case, row),
            )
        axes.set_title(f"{name.replace('_', ' ')} [deg]", loc="left", fontsize=11)
        axes.set_xlabel("time [s]")
        draw_panel_style(axes)
    panels[0, 0].legend(fontsize=8)
    return figure


def altitude_speed_figure(cases: Mapping[str, Row]) -> Figure:
    """Altitude over speed after every iteration, one panel per case."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 8.0), dpi=130, layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    for axes, (case, row) in zip(panels.flat, cases.items(), strict=True):
        count = len(row["altitudes_m"])
        pairs = zip(row["speeds_m_s"], row["altitudes_m"], strict=True)
        for number, (speed, altitude) in enumerate(pairs):
            last = number == count - 1
            axes.plot(
                np.array(speed) / 1e3,
                np.array(altitude) / 1e3,
                color=PLANNED if last else colormaps["Blues"](0.3 + 0.6 * number / count),
                linewidth=1.8 if last else 0.9,
                label="last" if last else ("first" if number == 0 else None),
            )
        axes.set_title(_label(case, row), loc="left", fontsize=11)
        axes.legend(fontsize=8, loc="lower right")
        draw_panel_style(axes)
    for axes in panels[1]:
        axes.set_xlabel("speed [km/s]")
    for axes in panels[:, 0]:
        axes.set_ylabel("altitude [km]")
    return figure


def _figure(title: str) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 6.5), dpi=130, layout="constrained")
    axes = figure.subplots()
    axes.set_title(title, loc="left", fontsize=12)
    axes.set_xlabel(_X_LABEL)
    axes.set_ylabel(_Y_LABEL)
    return figure, axes


def _axis(points: Sequence[Row], number: int) -> list[float]:
    return sorted({row["log_weights"][number] for row in points})


def _span(points: Sequence[Row], number: int) -> float:
    values = _axis(points, number)
    return values[-1] - values[0]


def _table(points: Sequence[Row], value: Callable[[Row], float | None]) -> Array:
    """(log w_u, log w_gamma); NaN where there is no value."""
    columns, lines = _axis(points, 0), _axis(points, 1)
    table = np.full((len(lines), len(columns)), np.nan)
    for row in points:
        found = value(row)
        line, column = lines.index(row["log_weights"][1]), columns.index(row["log_weights"][0])
        table[line, column] = np.nan if found is None else found
    return table


def _draw_map(
    figure: Figure, axes: Axes, points: Sequence[Row], table: Array, label: str, colours: str
) -> None:
    # Divergence spans decades that nobody needs to tell apart.
    settled = table[np.isfinite(table) & (_table(points, converged) > 0.0)]
    high = float(np.max(settled)) if settled.size else None
    axes.set_facecolor("#e5e7eb")
    shown = axes.pcolormesh(
        _axis(points, 0),
        _axis(points, 1),
        np.ma.masked_invalid(table),
        cmap=colours,
        vmax=high,
        shading="nearest",
    )
    figure.colorbar(shown, ax=axes, label=label)
    (left, right), (bottom, top) = BASIN
    axes.plot(
        [left, right, right, left, left],
        [bottom, bottom, top, top, bottom],
        color="black",
        linewidth=1.1,
        linestyle="--",
        label="the paper's basin",
    )


def _draw_false_stops(axes: Axes, points: Sequence[Row]) -> None:
    stops = np.array([row["log_weights"] for row in points if false_stop(row)])
    if len(stops):
        axes.plot(
            *stops.T, "x", color=_DESCENT, markersize=4, label="stopped far from the dynamics"
        )


def _draw_cases(axes: Axes) -> None:
    for case in CASES:
        axes.plot(*case.log_weights, "o", color="white", markeredgecolor="black", markersize=7)
        axes.annotate(
            case.name,
            case.log_weights,
            xytext=(7, -3),
            textcoords="offset points",
            fontsize=8,
            color="white",
        )


def _draw_descent(axes: Axes, steps: Sequence[Row], best: Row) -> None:
    from matplotlib.patheffects import withStroke

    path = np.array([step["log_weights"] for step in steps])
    axes.plot(path[:, 0], path[:, 1], "-", color=_DESCENT, linewidth=1.6, zorder=4)
    axes.plot(path[:, 0], path[:, 1], "o", color=_DESCENT, markersize=4, zorder=4, label="descent")
    axes.plot(
        *best["log_weights"],
        "*",
        color=_DESCENT,
        markeredgecolor="white",
        markersize=16,
        zorder=5,
        label=f"{best['iterations'] or 'more than 20'} iterations",
    )
    for step in steps:
        axes.annotate(
            str(step["iterations"] or ">20"),
            step["log_weights"],
            xytext=(5, 3),
            textcoords="offset points",
            fontsize=7,
            color=_DESCENT,
            path_effects=[withStroke(linewidth=2.0, foreground="white")],
        )


def _thinned(rows: list[Row]) -> list[Row]:
    """About 400 arrows, evenly over both axes."""
    columns, lines = _axis(rows, 0), _axis(rows, 1)
    across, down = max(1, len(columns) // 20), max(1, len(lines) // 20)
    kept = set(columns[::across]), set(lines[::down])
    return [
        row for row in rows if all(v in k for v, k in zip(row["log_weights"], kept, strict=True))
    ]


def _log(value: float | None) -> float | None:
    return None if value is None or not value > 0.0 else float(np.log10(value))


def _size(gradient: Any) -> float | None:
    return None if gradient is None else float(np.hypot(*gradient))


def _label(case: str, row: Row) -> str:
    count = row["iterations"] if converged(row) else f"more than {MOST_ITERATIONS}"
    return f"{case}, {count} iterations"
