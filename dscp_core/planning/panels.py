"""The panels that figures of plans share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dscp_core.planning.certificate import PlanCertificate
from dscp_core.planning.plan import Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

PLANNED = "#c2410c"
FLOWN = "#1d4ed8"
LIMIT = "#6b7280"


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
    """A panel of one quantity over time: planned at the nodes, and as flown."""
    style = "steps-post" if stepped else "default"
    axes.plot(
        certificate.times_s, flown, color=FLOWN, linewidth=1.6, drawstyle=style, label="integrated"
    )
    axes.plot(plan.times_s, planned, ".", color=PLANNED, markersize=5, label="planned (nodes)")
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
