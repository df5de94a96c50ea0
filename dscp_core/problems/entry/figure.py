"""Figure of an entry plan. Matplotlib is imported when it is drawn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
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
from dscp_core.problems.entry.physics import (
    ALPHA,
    BANK,
    GAMMA,
    HEADING,
    LATITUDE,
    LONGITUDE,
    RADIUS,
    SPEED,
    dynamic_pressure,
    heat_rate,
    load_factor,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dscp_core.planning.certificate import PlanCertificate

Array = NDArray[np.float64]

_LIMITED = (
    ("dynamic pressure", "dynamic_pressure_max", dynamic_pressure, "#047857"),
    ("heat rate", "heat_rate_max", heat_rate, "#b91c1c"),
    ("load", "load_factor_max", load_factor, "#6d28d9"),
)


def entry_figure(
    plan: Plan,
    certificate: PlanCertificate,
    parameters: Mapping[str, Any],
    title: str | None = None,
) -> Figure:
    """An entry as planned, and as it went when the plan was flown.

    Args:
        plan: The plan.
        certificate: Its certificate, with the flight.
        parameters: Vehicle and mission by name, SI, as `ParameterTable.unpack` gives them.
        title: Headline; by default verdict, terminal time, speed at the end and miss.

    Raises:
        InvalidInputError: A plan of another problem.
    """
    if plan.problem != "entry":
        raise InvalidInputError("problem", plan.problem, "entry")
    figure = new_figure((13.5, 8.0), title or _headline(plan, certificate))
    panels = figure.subplots(2, 3)
    _draw_track(panels[0, 0], plan, certificate, parameters)
    _draw_corridor(panels[0, 1], plan, certificate, parameters)
    _draw_loads(panels[0, 2], certificate, parameters)
    for axes, index, label in (
        (panels[1, 0], GAMMA, "flight-path angle [deg]"),
        (panels[1, 1], ALPHA, "angle of attack [deg]"),
        (panels[1, 2], BANK, "bank angle [deg], positive to the right"),
    ):
        planned, flown = (np.degrees(s[:, index]) for s in (plan.states, certificate.states))
        draw_history(axes, plan, certificate, planned, flown, label)
    for axes, name in ((panels[1, 1], "angle_of_attack"), (panels[1, 2], "bank_angle")):
        for end, above in (("min", False), ("max", True)):
            limit = float(np.degrees(parameters[f"{name}_{end}"]))
            draw_limit(axes, limit, "limit", above=above)
    add_legend(figure, panels[1, 0])
    return figure


def _headline(plan: Plan, certificate: PlanCertificate) -> str:
    missed = {c.name: c.worst_value for c in certificate.checks}.get("miss_position")
    text = f"Entry, {verdict(certificate)}: {plan.terminal_time_s:.1f} s, "
    text += f"{plan.states[-1, SPEED]:.0f} m/s at the end"
    return text if missed is None else f"{text}, miss {missed:.0f} m"


def _draw_track(
    axes: Axes, plan: Plan, certificate: PlanCertificate, parameters: Mapping[str, Any]
) -> None:
    """Ground track and target, in degrees."""
    for states, style in ((certificate.states, FLOWN_STYLE), (plan.states, PLANNED_STYLE)):
        longitude, latitude = np.degrees(states[:, [LONGITUDE, LATITUDE]]).T
        axes.plot(longitude, latitude, **style)
    target = float(np.degrees(parameters["final_latitude"]))
    axes.plot([longitude[-1]], [target], "x", color="black", markersize=8)
    axes.annotate(
        f"heading {np.degrees(plan.states[0, HEADING]):.1f} deg",
        (float(longitude[0]), float(latitude[0])),
        xytext=(0, 8),
        textcoords="offset points",
        fontsize=8,
        color=LIMIT,
    )
    axes.set_xlabel("longitude [deg]")
    axes.set_title("ground track: latitude [deg], target x", fontsize=11, loc="left")
    draw_panel_style(axes)


def _draw_corridor(
    axes: Axes, plan: Plan, certificate: PlanCertificate, parameters: Mapping[str, Any]
) -> None:
    """Altitude over speed, with the limits that depend on nothing else."""
    ground = float(parameters["planet_radius"])
    flown, planned = ((s[:, RADIUS] - ground) / 1e3 for s in (certificate.states, plan.states))
    axes.plot(certificate.states[:, SPEED] / 1e3, flown, color=FLOWN, linewidth=1.6)
    axes.plot(plan.states[:, SPEED] / 1e3, planned, ".", color=PLANNED, markersize=5)
    speed = np.linspace(plan.states[:, SPEED].min(), plan.states[:, SPEED].max(), 200)
    density = {
        "dynamic pressure limit": 2.0 * parameters["dynamic_pressure_max"] / speed**2,
        "heat rate limit": (
            parameters["heat_rate_max"] / (parameters["heat_rate_constant"] * speed**3.15)
        )
        ** 2,
    }
    for (name, least), style in zip(density.items(), ("--", ":"), strict=True):
        lowest = parameters["scale_height"] * np.log(parameters["sea_level_density"] / least)
        axes.plot(speed / 1e3, lowest / 1e3, style, color=LIMIT, linewidth=1.1, label=name)
    axes.legend(fontsize=8, frameon=False)
    axes.set_ylim(bottom=max(0.0, float(planned.min()) - 10.0))
    axes.set_xlabel("speed [km/s]")
    axes.set_title("altitude [km]", fontsize=11, loc="left")
    draw_panel_style(axes)


def _draw_loads(axes: Axes, certificate: PlanCertificate, parameters: Mapping[str, Any]) -> None:
    """What is limited along the flight, as parts of the limits."""
    x = ca.SX.sym("x", certificate.states.shape[1])
    quantities = ca.vertcat(*(value(x, parameters) / parameters[m] for _, m, value, _ in _LIMITED))
    shares = np.array(ca.Function("shares", [x], [quantities])(certificate.states.T))
    for (name, _, _, colour), share in zip(_LIMITED, shares, strict=True):
        axes.plot(certificate.times_s, share, color=colour, linewidth=1.4, label=name)
    draw_limit(axes, 1.0, "limit", above=True)
    axes.set_ylim(bottom=0.0)
    axes.set_xlim(0.0, certificate.times_s[-1])
    axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(0.0, 0.9))
    axes.set_xlabel("time [s]")
    axes.set_title("integrated, parts of the limits", fontsize=11, loc="left")
    draw_panel_style(axes)
