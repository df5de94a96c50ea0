"""Figures of training and evaluation. Matplotlib is imported when a figure is drawn."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.files import replace_file
from dscp_core.learning.evaluation import Measurement
from dscp_core.planning.panels import draw_panel_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_RATE = "#6b7280"
_SLOPE = "#c2410c"
_ERRORS = (
    ("validation_mean", "mean", "#1d4ed8"),
    ("validation_p99", "99th percentile", "#7c3aed"),
    ("validation_max", "maximum", "#c2410c"),
)
_PROGRESS = (
    ("mean_abs_slope", "mean |gradient| by the terminal time", _SLOPE),
    ("mean_abs_slope_kg_s", "mean |DSCP gradient| at the predictions [kg/s]", _SLOPE),
    ("rms_s", "misfit of the batch [s]", "#1d4ed8"),
)
_NAMES = {
    "supervised": "regression",
    "refinement_fit": "DSCP rounds",
    "stochastic": "stochastic steps",
}


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, complete or not at all.

    Raises:
        FileWriteError: It cannot be written.
    """
    content = io.BytesIO()
    figure.savefig(content, format="png")
    replace_file(path, content.getvalue())


def training_figure(history: Sequence[Mapping[str, Any]], title: str) -> Figure:
    """How a training went: gradient and learning rate, and validation error over wall time.

    On the left as in the paper: per epoch of stochastic steps. For the default recipe, whose fits
    are not by gradients, the misfit per look at the validation set, and the gradient per round.

    Args:
        history: Entries of the history file, at least one.
        title: Headline.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.8), dpi=120, layout="constrained")
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    left, right = figure.subplots(1, 2)
    _draw_gradients(left, history)
    _draw_errors(right, history)
    return figure


def profile_figure(
    measurement: Measurement, columns: tuple[int, int], labels: tuple[str, str], title: str
) -> Figure:
    """Predicted terminal times of a profile, and their relative errors.

    Args:
        measurement: Of the profile: states on a grid.
        columns: Indices of the two states that vary, first the horizontal axis.
        labels: Of the two axes.
        title: Headline.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.8), dpi=120, layout="constrained")
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    times, errors = figure.subplots(1, 2)
    x, y = (measurement.states[:, column] for column in columns)
    drawn = times.tripcolor(x, y, measurement.predicted_s, shading="gouraud", cmap="viridis")
    figure.colorbar(drawn, ax=times, label="s")
    times.set_title("predicted terminal time", fontsize=11, loc="left")
    limit = float(np.max(np.abs(measurement.relative_error)))
    drawn = errors.tripcolor(
        x,
        y,
        measurement.relative_error,
        shading="gouraud",
        cmap="RdBu_r",
        vmin=-limit,
        vmax=limit,
    )
    figure.colorbar(drawn, ax=errors, format="%.0e")
    errors.set_title(f"relative error, at most {limit:.1e}", fontsize=11, loc="left")
    for axes in (times, errors):
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
    return figure


def _draw_gradients(axes: Axes, history: Sequence[Mapping[str, Any]]) -> None:
    epochs = _column(history, "epoch")
    by_epoch = bool(np.any(np.isfinite(epochs)))
    x = epochs if by_epoch else np.arange(1.0, len(history) + 1.0)
    for key, label, color in _PROGRESS:
        values = _column(history, key)
        known = np.isfinite(values)
        if np.any(known):
            axes.semilogy(x[known], values[known], ".-", color=color, linewidth=1.0, label=label)
    axes.set_title("gradient and learning rate", fontsize=11, loc="left")
    axes.set_xlabel("epoch" if by_epoch else "tens of Gauss-Newton steps")
    axes.legend(frameon=False, fontsize=9)
    draw_panel_style(axes)
    rate = axes.twinx()
    rate.step(x, _column(history, "learning_rate"), color=_RATE, where="post", linewidth=1.2)
    rate.set_ylabel("learning rate" if by_epoch else "step length", color=_RATE)
    rate.set_ylim(bottom=0.0)


def _draw_errors(axes: Axes, history: Sequence[Mapping[str, Any]]) -> None:
    minutes = _column(history, "elapsed_s") / 60.0
    for key, label, color in _ERRORS:
        axes.semilogy(minutes, _column(history, key), color=color, linewidth=1.4, label=label)
    stages = [str(entry["stage"]) for entry in history]
    for number, name in enumerate(stages):
        if number == 0 or stages[number - 1] != name:
            axes.axvline(minutes[number], color=_RATE, linestyle=":", linewidth=1.0)
            axes.annotate(
                _NAMES.get(name, name),
                (minutes[number], 0.98),
                xycoords=("data", "axes fraction"),
                xytext=(3, 0),
                textcoords="offset points",
                va="top",
                fontsize=8,
                color=_RATE,
            )
    axes.set_xlabel("wall time [min]")
    axes.set_title("relative error on the validation set", fontsize=11, loc="left")
    axes.legend(frameon=False, fontsize=9)
    draw_panel_style(axes)


def _column(history: Sequence[Mapping[str, Any]], key: str) -> Array:
    values = [entry.get(key) for entry in history]
    return np.array([np.nan if value is None else float(value) for value in values])
