"""The node's parameters: declared once, with type, range and unit, and turned into settings.

Vehicle and mission numbers come from the problem's own declarations, so a new problem needs no
code here, and another vehicle is a YAML file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dscp_core import problems
from dscp_core.cone.solvers import SOLVER_NAMES
from dscp_core.errors import InvalidInputError
from dscp_core.planning.planner import PlannerSettings, TerminalTime
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.flight import ControlHold, Discretisation
from dscp_core.scp.scp import ScpOptions
from dscp_ros.planner.declaration import VEHICLE_PREFIX, NodeParameter, Value
from dscp_ros.planner.input_checks import InputSettings
from dscp_ros.planner.interface import (
    drawing,
    input_settings,
    interface_parameters,
    node_parameter,
)
from msg_adapters.drawing import Drawing
from msg_adapters.layout import problem_layout
from msg_adapters.parameters import (
    follows_message_axes,
    parameter_to_core_axes,
    parameter_to_message_axes,
)

FORMULATION = "formulation"
NETWORK = "terminal_time_network"
RELIABLE = "reliable"
BEST_EFFORT = "best_effort"

_OPTIONS = ScpOptions()
_COST_TOLERANCE = 1e-6
"""Looser than the core's: 0.03 kg of the paper's rocket, for which a late plan is no fair price."""
_INPUTS = InputSettings()


@dataclass(frozen=True)
class NodeSettings:
    """Everything that the node reads from its parameters.

    Attributes:
        planner: Settings of the planner.
        inputs: What inputs have to satisfy.
        deadline_s: Wall time of one plan.
        state_reliability: Reliability that the state subscriptions ask for.
        silence_max_s: After this long without a state, the last trajectory is revoked.
        drawing: How plans are drawn; None if not at all.
        log_period_s: Least time between two log lines of the same cause.
    """

    planner: PlannerSettings
    inputs: InputSettings
    deadline_s: float
    state_reliability: str
    silence_max_s: float
    drawing: Drawing | None
    log_period_s: float


PROBLEM = NodeParameter(
    "problem",
    problems.DEFAULT,
    "Problem that is planned for: a known name, or FILE.py:NAME.",
    read_only=True,
)


def formulation_parameters(formulations: Sequence[str]) -> tuple[NodeParameter, ...]:
    """Parameter that chooses among formulations, the default first; none where there are none."""
    names = tuple(formulations)
    if not names:
        return ()
    return (
        NodeParameter(
            FORMULATION, names[0], "Form of the subproblem.", choices=names, read_only=True
        ),
    )


def parameter_table(problem: OptimalControlProblem) -> tuple[NodeParameter, ...]:
    """Every parameter but the problem and its formulation.

    Raises:
        InvalidInputError: A setting that the problem brings has a name that is taken, or a default
            is for a name that does not exist.
    """
    general = (*_NODE, *_PLANNING, *_terminal_time_parameters(problem))
    table = (*interface_parameters(problem), *general, *_vehicle_parameters(problem))
    own = problem.extras.messages.defaults
    names = [PROBLEM.name, FORMULATION, *(parameter.name for parameter in table)]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InvalidInputError(f"settings of {problem.name}", twice, "names that are not taken")
    if unknown := sorted(set(own) - set(names)):
        raise InvalidInputError(f"defaults of {problem.name}", unknown, "names of settings")
    defaults: dict[str, Value] = {
        "intervals": problem.default_intervals,
        "cost_tolerance": max(_COST_TOLERANCE, problem.cost_tolerance),
        "defect_tolerance": problem.defect_tolerance,
        **own,
    }
    return tuple(
        replace(parameter, default=defaults.get(parameter.name, parameter.default))
        for parameter in table
    )


def node_settings(problem: OptimalControlProblem, values: Mapping[str, Any]) -> NodeSettings:
    """Settings of parameter values, each of which has passed its own check.

    Raises:
        InvalidInputError: A solver is unknown, or a vehicle number is refused by the problem.
    """
    _check_solver(values["solver"])
    vehicle = _vehicle_values(problem, values)
    parameters = problem.table.unpack(problem.pack(vehicle))
    return NodeSettings(
        planner=PlannerSettings(
            parameters=vehicle,
            intervals=values["intervals"],
            terminal_time=TerminalTime(values["terminal_time_source"]),
            hold=ControlHold(values["control_hold"]),
            discretisation=Discretisation(values["discretisation"]),
            best_effort=values["best_effort"],
            options=ScpOptions(
                max_iterations=values["max_iterations"],
                cost_tolerance=values["cost_tolerance"],
                defect_tolerance=values["defect_tolerance"],
                virtual_control_tolerance=values["virtual_control_tolerance"] or None,
                solver=values["solver"],
            ),
        ),
        inputs=input_settings(problem, values, parameters),
        deadline_s=values["deadline_s"],
        state_reliability=values["state_reliability"],
        silence_max_s=values["silence_max_s"],
        drawing=drawing(problem, values, parameters),
        log_period_s=values["log_period_s"],
    )


_NODE = (
    NodeParameter(
        "state_reliability",
        RELIABLE,
        "Reliability that the input subscriptions ask for. best_effort also receives from "
        "best-effort publishers, as sensors often are; reliable does not.",
        choices=(RELIABLE, BEST_EFFORT),
        read_only=True,
    ),
    NodeParameter(
        "deadline_s",
        0.5,
        "Wall time of one plan; at its end the last iterate is taken if it passes its certificate.",
        "s",
        0.001,
        60.0,
    ),
    NodeParameter(
        "state_max_age_s", _INPUTS.state_max_age_s, "Largest age of a state.", "s", 0.0, 1e9
    ),
    NodeParameter(
        "future_tolerance_s",
        _INPUTS.future_tolerance_s,
        "How far a stamp may be ahead of the clock.",
        "s",
        0.0,
        1e9,
    ),
    NodeParameter(
        "silence_max_s",
        2.0,
        "Longest time without an accepted state before ~/validity revokes the last trajectory.",
        "s",
        0.01,
        1e9,
    ),
    NodeParameter(
        "log_period_s", 2.0, "Least time between two log lines of the same cause.", "s", 0.0, 3600.0
    ),
)

_PLANNING = (
    NodeParameter(
        "solver",
        _OPTIONS.solver,
        f"Cone solver, or several to try in order, separated by commas: {', '.join(SOLVER_NAMES)}.",
    ),
    NodeParameter("intervals", 50, "Number of intervals of a plan.", "", 5, 1000),
    NodeParameter("max_iterations", _OPTIONS.max_iterations, "Iteration limit.", "", 1, 1000),
    NodeParameter(
        "cost_tolerance",
        _COST_TOLERANCE,
        "Converged when the cost changes by less, relatively.",
        "1",
        1e-15,
        1.0,
    ),
    NodeParameter(
        "defect_tolerance",
        OptimalControlProblem.defect_tolerance,
        "Converged when the dynamics are violated by less, relative to the states' scales.",
        "1",
        1e-15,
        1.0,
    ),
    NodeParameter(
        "virtual_control_tolerance",
        0.0,
        "Feasible when the virtual control is less, relative to the states' scales; 0 for the "
        "problem's own.",
        "1",
        0.0,
        1.0,
    ),
    NodeParameter(
        "control_hold",
        ControlHold.MEAN.value,
        "How the controls are flown between nodes.",
        choices=tuple(hold.value for hold in ControlHold),
    ),
    NodeParameter(
        "discretisation",
        Discretisation.PROPAGATED.value,
        "Dynamics of the intervals: those that are flown, or the paper's midpoint rule.",
        choices=tuple(rule.value for rule in Discretisation),
    ),
    NodeParameter(
        "best_effort",
        False,
        "Whether to publish on ~/best_effort what violates least where no feasible plan is found.",
    ),
)


def _terminal_time_parameters(problem: OptimalControlProblem) -> list[NodeParameter]:
    """Where the terminal time comes from; networks exist for some problems only."""
    free_or_fixed = (TerminalTime.FREE.value, TerminalTime.FIXED.value)
    suited = TerminalTime.FREE if problem.free_terminal_time else TerminalTime.FIXED
    source = NodeParameter(
        "terminal_time_source",
        suited.value,
        "free: optimised with every plan. fixed: parameters.terminal_time after the first state, "
        "then what is left of it.",
        choices=free_or_fixed,
    )
    if problem.extras.network is None:
        return [source]
    return [
        replace(
            source,
            default=TerminalTime.PREDICTED.value,
            description=source.description
            + " predicted: by a network, and free where that is not valid.",
            choices=(TerminalTime.PREDICTED.value, *free_or_fixed),
        ),
        NodeParameter(
            NETWORK,
            "",
            "Network for terminal_time_source predicted: a file, relative to the parameter file "
            "that names it; empty for the one that DSCP ships.",
            may_be_empty=True,
        ),
    ]


def _vehicle_parameters(problem: OptimalControlProblem) -> list[NodeParameter]:
    """The problem's own parameters, but for those that every state sets."""
    layout = problem_layout(problem)
    table = []
    for declared in problem.table.parameters:
        if declared.name in problem.initial_state_parameters:
            continue
        parameter = node_parameter(declared)
        if isinstance(declared.default, tuple):
            default = parameter_to_message_axes(layout, declared.default)
            parameter = replace(parameter, default=default)
            if follows_message_axes(layout, declared.default):
                description = declared.description.replace(", x up", "")
                parameter = replace(
                    parameter, description=f"{description} Axes and order as in messages."
                )
        table.append(replace(parameter, name=VEHICLE_PREFIX + declared.name))
    return table


def _vehicle_values(
    problem: OptimalControlProblem, values: Mapping[str, Any]
) -> dict[str, float | list[float]]:
    """Values of the problem's parameters, in the core's axes and order."""
    layout = problem_layout(problem)
    chosen: dict[str, float | list[float]] = {}
    for name, value in values.items():
        if not name.startswith(VEHICLE_PREFIX):
            continue
        if isinstance(value, int | float):
            chosen[name.removeprefix(VEHICLE_PREFIX)] = float(value)
        else:
            chosen[name.removeprefix(VEHICLE_PREFIX)] = parameter_to_core_axes(layout, value)
    return chosen


def _check_solver(value: str) -> None:
    names = [part.strip() for part in value.split(",")]
    if any(name not in SOLVER_NAMES for name in names) or len(set(names)) != len(names):
        bound = f"names out of {', '.join(SOLVER_NAMES)}, each once, separated by commas"
        raise InvalidInputError("solver", value, bound)
