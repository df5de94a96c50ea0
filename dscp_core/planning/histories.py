"""The figure of any plan: histories of every state and control, with their bounds.

Matplotlib is imported when it is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.planning.certificate import PlanCertificate
from dscp_core.planning.panels import (
    PLANNED,
    add_legend,
    draw_history,
    draw_limit,
    new_figure,
    verdict,
    wrapped,
)
from dscp_core.planning.plan import PlanOutcome
from dscp_core.problem.declaration import OptimalControlProblem, StagePoint, Where, named
from dscp_core.problem.trajectory import Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_COLUMNS = 3
_MOST_PANELS = 24
_PANEL_INCHES = (4.5, 3.2)
_LONGEST_NAME = 34
_LEAST_SPAN = 1e-3  # of the scale, from bottom to top of a panel


def outcome_figure(
    problem: OptimalControlProblem, outcome: PlanOutcome, title: str | None
) -> Figure:
    """The plan of an outcome, or its best effort; see `Planner.figure`."""
    effort, name = outcome.best_effort, problem.name.replace("_", " ")
    if effort is not None:
        plan, certificate = effort.plan, effort.certificate
        title = title or f"{name}: best effort, NOT CERTIFIED: {effort.violations[0]}"
    elif outcome.plan is not None and outcome.certificate is not None:
        plan, certificate = outcome.plan, outcome.certificate
        title = f"{name}: {outcome.headline}" if title is None else title
    else:
        raise InvalidInputError("outcome", outcome.headline, "one with a plan")
    return plan_figure(problem, plan, certificate, outcome.parameters, title)


def plan_figure(
    problem: OptimalControlProblem,
    plan: Plan,
    certificate: PlanCertificate,
    parameters: Mapping[str, Any],
    title: str | None = None,
) -> Figure:
    """A plan as it was made, and as it went when it was flown.

    In the figure that the problem brings, else as histories of its first states and controls, of
    which at most 24 fit.

    Args:
        problem: What was planned.
        plan: The plan.
        certificate: Its certificate, with the flight.
        parameters: Vehicle and mission by name, SI, as `ParameterTable.unpack` gives them.
        title: Headline; by default verdict, terminal time, and what else counts.
    """
    brought = problem.extras.figure
    if brought is not None:
        return brought(plan, certificate, parameters, title)
    variables = [*problem.controls, *problem.states][:_MOST_PANELS]
    columns = min(_COLUMNS, len(variables))
    rows = math.ceil(len(variables) / columns)
    width, height = _PANEL_INCHES
    headline = wrapped(title or _headline(problem, plan, certificate), columns * width)
    lines = headline.count("\n")
    size = (columns * width, rows * height + 0.8 + 0.2 * lines)
    figure = new_figure(size, headline)
    bounds = box_bounds(problem, parameters)
    planned = np.hstack([plan.controls, plan.states])
    flown = np.hstack([certificate.controls, certificate.states])
    pinned = _pinned(problem, parameters)
    for number, variable in enumerate(variables):
        axes = figure.add_subplot(rows, columns, number + 1)
        unit = f" [{variable.unit}]" if variable.unit not in ("", "1") else ""
        draw_history(
            axes,
            plan,
            certificate,
            planned[:, number],
            flown[:, number],
            f"{_cut(variable.name.replace('_', ' '))}{unit}",
            stepped=number < len(problem.controls),
        )
        if variable.name in pinned:
            axes.plot(
                plan.terminal_time_s, pinned[variable.name], "x", color=PLANNED, clip_on=False
            )
        _keep_rounding_small(axes, _LEAST_SPAN * variable.scale)
        low, high = bounds.get(variable.name, (-math.inf, math.inf))
        if math.isfinite(low):
            draw_limit(axes, low, "least", above=False)
        if math.isfinite(high):
            draw_limit(axes, high, "greatest", above=True)
    add_legend(figure, figure.axes[0])
    return figure


def box_bounds(
    problem: OptimalControlProblem, parameters: Mapping[str, Any]
) -> dict[str, tuple[float, float]]:
    """Least and greatest value of every state and control that a constraint at the nodes bounds.

    Found in the declaration: a path constraint that is affine in one variable alone.

    Args:
        problem: The declaration.
        parameters: Every parameter by name, SI.
    """
    names = [v.name for v in (*problem.states, *problem.controls)]
    nx = len(problem.states)
    at = ca.SX.sym("at", len(names))
    packed = ca.SX.sym("p", problem.table.size)
    step = ca.SX.sym("T")
    point = StagePoint(at[:nx], at[nx:], step)
    values = problem.table.pack({n: parameters[n] for n in problem.table.names})
    bounds = dict.fromkeys(names, (-math.inf, math.inf))
    for constraint in problem.path_constraints:
        if constraint.where is not Where.NODE:
            continue
        expression = ca.SX(constraint.expression(point, named(problem, packed)))
        slopes = ca.jacobian(expression, at)
        touched = set(slopes.sparsity().get_triplet()[1])
        if len(touched) != 1 or ca.depends_on(slopes, at) or ca.depends_on(expression, step):
            continue
        (index,) = touched
        both = ca.Function("box", [at, packed], [expression, slopes[index]])
        offset, slope = (float(v) for v in both(np.zeros(len(names)), values))
        if slope == 0.0:
            continue
        low, high = bounds[names[index]]
        edge = -offset / slope
        bounds[names[index]] = (low, min(high, edge)) if slope > 0.0 else (max(low, edge), high)
    return bounds


def _pinned(problem: OptimalControlProblem, parameters: Mapping[str, Any]) -> dict[str, float]:
    """Final values of the states that have one."""
    values = {name: ca.SX(value) for name, value in parameters.items()}
    return {name: float(value(values)) for name, value in problem.final_state.items()}


def _cut(name: str) -> str:
    return name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 3]}..."


def _keep_rounding_small(axes: Axes, span: float) -> None:
    """Widen a panel of next to nothing, so that rounding does not look like a difference."""
    low, high = axes.get_ylim()
    if high - low < span:
        axes.set_ylim((low + high - span) / 2, (low + high + span) / 2)


def _headline(problem: OptimalControlProblem, plan: Plan, certificate: PlanCertificate) -> str:
    text = f"{problem.name.replace('_', ' ')}, {verdict(certificate)}: {plan.terminal_time_s:.4g} s"
    missed = {miss.name for miss in problem.end_checks}
    for check in certificate.checks:
        if check.name in missed:
            text += f", {check.name.replace('_', ' ')} {check.worst_value:.3g} {check.unit}"
    return text
