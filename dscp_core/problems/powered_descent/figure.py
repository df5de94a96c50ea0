"""Figure of a powered descent. Matplotlib is imported when it is drawn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.planning.panels import (
    FLOWN,
    FLOWN_STYLE,
    LIMIT,
    PLANNED,
    PLANNED_STYLE,
    add_legend,
    draw_history,
    draw_limit,
    draw_panel_style,
    new_figure,
    verdict,
)
from dscp_core.problem.trajectory import Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dscp_core.planning.certificate import PlanCertificate

Array = NDArray[np.float64]


def descent_figure(
    plan: Plan,
    certificate: PlanCertificate,
    parameters: Mapping[str, Any],
    title: str | None = None,
) -> Figure:
    """A powered descent as planned, and as it went when the plan was flown.

    Args:
        plan: The plan.
        certificate: Its certificate, with the flight.
        parameters: Vehicle and mission by name, SI.
        title: Headline; by default verdict, terminal time, and mass and misses as flown.
    """
    figure = new_figure((13.5, 8.0), title or _headline(plan, certificate))
    grid = figure.add_gridspec(2, 3)
    space = figure.add_subplot(grid[0, 0], projection="3d")
    _draw_space(space, plan, certificate, parameters)
    _draw_descent(figure.add_subplot(grid[0, 1]), plan, certificate, parameters)

    speed = figure.add_subplot(grid[0, 2])
    draw_history(
        speed, plan, certificate, _speed(plan.states), _speed(certificate.states), "speed [m/s]"
    )
    thrust = figure.add_subplot(grid[1, 0])
    planned, flown = (
        np.linalg.norm(c, axis=1) / 1e3 for c in (plan.controls, certificate.controls)
    )
    draw_history(thrust, plan, certificate, planned, flown, "thrust [kN]", stepped=True)
    draw_limit(thrust, parameters["thrust_min"] / 1e3, "least thrust", above=False)
    draw_limit(thrust, parameters["thrust_max"] / 1e3, "greatest thrust", above=True)

    mass = figure.add_subplot(grid[1, 1])
    planned, flown = (states[:, 6] / 1e3 for states in (plan.states, certificate.states))
    draw_history(mass, plan, certificate, planned, flown, "mass [t]")
    pointing = figure.add_subplot(grid[1, 2])
    planned, flown = _tilt(plan.controls), _tilt(certificate.controls)
    draw_history(
        pointing, plan, certificate, planned, flown, "thrust off vertical [deg]", stepped=True
    )
    limit = float(np.degrees(parameters["pointing_angle_max"]))
    draw_limit(pointing, limit, "pointing limit", above=True)
    pointing.set_ylim(bottom=0.0)
    add_legend(figure, mass)
    return figure


def _headline(plan: Plan, certificate: PlanCertificate) -> str:
    worst = {c.name: c.worst_value for c in certificate.checks}
    text = f"Powered descent, {verdict(certificate)}: {plan.terminal_time_s:.2f} s, "
    text += f"{certificate.states[-1, 6]:.1f} kg at the end"
    if "miss_position" not in worst:  # the flight has no end
        return text
    ended = "" if certificate.contact_time_s is None else "contact "
    return f"{text}, {ended}{worst['miss_position']:.2f} m and {worst['miss_speed']:.2f} m/s off"


def _draw_descent(
    axes: Axes, plan: Plan, certificate: PlanCertificate, parameters: Mapping[str, Any]
) -> None:
    target = np.asarray(parameters["final_position"])
    for states, style in ((certificate.states, FLOWN_STYLE), (plan.states, PLANNED_STYLE)):
        offset = states[:, :3] - target
        axes.plot(np.hypot(offset[:, 1], offset[:, 2]), offset[:, 0], **style)
    reach = axes.get_xlim()[1]
    edge = reach / np.tan(parameters["glideslope_angle_max"])
    axes.plot([0.0, reach], [0.0, edge], color=LIMIT, linestyle="--", linewidth=1.1)
    axes.fill_between([0.0, reach], [0.0, edge], color=LIMIT, alpha=0.15, linewidth=0)
    axes.annotate(
        "glideslope limit",
        (0.98 * reach, edge),
        xytext=(0, 3),
        textcoords="offset points",
        ha="right",
        va="bottom",
        fontsize=8,
        color=LIMIT,
    )
    axes.set_xlim(0.0, reach)
    axes.set_xlabel("horizontal distance to the target [m]")
    axes.set_title("altitude [m]", fontsize=11, loc="left")
    draw_panel_style(axes)


def _draw_space(
    axes: Any, plan: Plan, certificate: PlanCertificate, parameters: Mapping[str, Any]
) -> None:
    from matplotlib.ticker import MaxNLocator

    target = np.asarray(parameters["final_position"])
    flown, planned = certificate.states[:, :3] - target, plan.states[:, :3] - target
    radius = 1.1 * max(float(np.max(np.hypot(flown[:, 1], flown[:, 2]))), 1.0)
    angle, distance = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 49), np.linspace(0.0, radius, 9))
    axes.plot_surface(
        distance * np.cos(angle),
        distance * np.sin(angle),
        distance / np.tan(parameters["glideslope_angle_max"]),
        color=LIMIT,
        alpha=0.18,
        linewidth=0,
    )
    axes.plot(flown[:, 1], flown[:, 2], flown[:, 0], color=FLOWN, linewidth=1.6)
    axes.scatter(planned[:, 1], planned[:, 2], planned[:, 0], color=PLANNED, s=5, depthshade=False)
    axes.plot([0.0], [0.0], [0.0], marker="x", color="black", markersize=7)
    axes.set_xlabel("y [m]", fontsize=9)
    axes.set_ylabel("z [m]", fontsize=9)
    axes.set_zlabel("altitude [m]", fontsize=9)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(4))
    axes.tick_params(labelsize=8)
    axes.set_title("trajectory and glideslope cone", fontsize=11, loc="left")
    axes.view_init(elev=20.0, azim=-60.0)
    axes.set_box_aspect((1.0, 1.0, 1.1), zoom=1.1)


def _size(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=1))


def _speed(states: Array) -> Array:
    return _size(states[:, 3:6])


def _tilt(thrust: Array) -> Array:
    """Angle between thrust and vertical in degrees, (M,)."""
    return np.asarray(np.degrees(np.arctan2(np.hypot(thrust[:, 1], thrust[:, 2]), thrust[:, 0])))
