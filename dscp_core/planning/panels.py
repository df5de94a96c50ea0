"""The panels that figures of plans share."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.trajectory import Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dscp_core.planning.certificate import PlanCertificate

Array = NDArray[np.float64]

_LEGEND_INCHES, _LETTERS_PER_INCH = 3.8, 10

PLANNED = "#c2410c"
FLOWN = "#1d4ed8"
LIMIT = "#6b7280"

FLOWN_STYLE: dict[str, Any] = {"color": FLOWN, "linewidth": 1.6}
PLANNED_STYLE: dict[str, Any] = {
    "color": PLANNED,
    "linestyle": "",
    "marker": ".",
    "markersize": 5,
}


def wrapped(headline: str, width_inches: float) -> str:
    """A headline in lines that leave the legend beside them its place."""
    return textwrap.fill(headline, int((width_inches - _LEGEND_INCHES) * _LETTERS_PER_INCH))


def new_figure(size_inches: tuple[float, float], headline: str) -> Figure:
    """An empty figure under a headline."""
    from matplotlib.figure import Figure

    headline = wrapped(headline, size_inches[0])
    figure = Figure(figsize=size_inches, dpi=120, layout="constrained")
    figure.suptitle(headline, fontsize=13, x=0.01, ha="left")
    return figure


def add_legend(figure: Figure, axes: Axes) -> None:
    """The legend of one history, for all."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=2, frameon=False)


def verdict(certificate: PlanCertificate) -> str:
    """What a headline says of the certificate."""
    return "certified" if certificate.passed else "NOT certified"


def draw_panel_style(axes: Axes) -> None:
    """The look that all panels share."""
    axes.grid(True, color="#e5e7eb", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def draw_history(
    axes: Axes,
    plan: Plan,
    certificate: PlanCertificate,
    planned: Array,
    flown: Array,
    label: str,
    *,
    stepped: bool = False,
) -> None:
    """A panel of one quantity over time: planned at the nodes, and as flown.

    What is flown after the plan, until a contact for which it waits, is no control of it.
    """
    end_s = plan.times_s[-1] * (1.0 + 1e-9)
    if stepped and certificate.times_s[-1] > end_s:
        before = int(np.searchsorted(certificate.times_s, plan.times_s[-1] * (1.0 - 1e-9)))
        flown = np.where(np.arange(flown.size) < before, flown, flown[before - 1])
    style = "steps-post" if stepped else "default"
    axes.plot(certificate.times_s, flown, drawstyle=style, label="integrated", **FLOWN_STYLE)
    axes.plot(plan.times_s, planned, label="planned (nodes)", **PLANNED_STYLE)
    axes.set_xlabel("time [s]")
    axes.set_title(label, fontsize=11, loc="left")
    axes.set_xlim(0.0, plan.terminal_time_s)
    draw_panel_style(axes)


def draw_limit(axes: Axes, value: float, name: str, *, above: bool) -> None:
    """A limit across a panel, named above or below its line."""
    axes.axhline(value, color=LIMIT, linestyle="--", linewidth=1.1)
    axes.annotate(
        name,
        (0.5, value),
        xycoords=("axes fraction", "data"),
        xytext=(0, 3 if above else -3),
        textcoords="offset points",
        ha="center",
        va="bottom" if above else "top",
        fontsize=8,
        color=LIMIT,
    )
    low, high = axes.get_ylim()
    margin = 0.1 * (high - low)
    axes.set_ylim(min(low, value - margin), max(high, value + margin))
