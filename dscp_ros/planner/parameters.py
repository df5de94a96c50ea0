"""The node's parameters: declared once, with type, range and unit, and turned into settings.

Vehicle and mission numbers come from the problem's own declarations, so a new problem needs no
code here, and another vehicle is a YAML file.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.ocp import OptimalControlProblem
from dscp_core.planner import PlannerSettings, TerminalTime
from dscp_core.scp import ScpOptions
from dscp_core.solvers import SOLVER_NAMES
from dscp_core.verification import ControlHold
from dscp_ros.planner.input_checks import InputSettings
from msg_adapters.frames import LANDING_FRAME, StateLayout, state_layout
from msg_adapters.parameters import parameter_to_core_axes, parameter_to_message_axes
from msg_adapters.state import InputLimits
from msg_adapters.visualisation import MarkerStyle

Value = bool | int | float | str | Sequence[float]

VEHICLE_PREFIX = "parameters."
RELIABLE = "reliable"
BEST_EFFORT = "best_effort"

_OPTIONS = ScpOptions()
_COST_TOLERANCE = 1e-6
"""Looser than the core's: 0.03 kg of the paper's rocket, for which a late plan is no fair price."""
_INPUTS = InputSettings()
_LIMITS = InputLimits()


@dataclass(frozen=True)
class NodeParameter:
    """Declaration of one parameter.

    Attributes:
        name: Name.
        default: Default value, which also fixes the type and, of a list, the length.
        description: What it is.
        unit: SI unit, or empty.
        lower: Least value of a number, or of every component of a list.
        upper: Greatest value.
        choices: Permitted texts; empty for any.
        read_only: Whether it can be set at the start only.
    """

    name: str
    default: Value
    description: str
    unit: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    choices: tuple[str, ...] = ()
    read_only: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """Descriptor with range and constraints."""
        unit = f" [{self.unit}]" if self.unit else ""
        descriptor = ParameterDescriptor(
            description=self.description + unit, read_only=self.read_only
        )
        if self.choices:
            descriptor.additional_constraints = f"one of {', '.join(self.choices)}"
        elif isinstance(self.default, int):
            descriptor.integer_range = [
                IntegerRange(from_value=int(self.lower), to_value=int(self.upper), step=0)
            ]
        elif isinstance(self.default, float):
            largest = sys.float_info.max
            descriptor.floating_point_range = [
                FloatingPointRange(
                    from_value=max(self.lower, -largest), to_value=min(self.upper, largest)
                )
            ]
        elif not isinstance(self.default, str):
            descriptor.additional_constraints = (
                f"{len(self.default)} numbers in [{self.lower:g}, {self.upper:g}]"
            )
        return descriptor

    def check(self, value: Any) -> None:
        """Check a value beyond what a descriptor can say: NaN, list length, choices.

        Raises:
            InvalidInputError: The value is out of bounds.
        """
        if self.choices:
            if value not in self.choices:
                raise InvalidInputError(self.name, value, f"one of {', '.join(self.choices)}")
            return
        if isinstance(self.default, str):
            if not value:
                raise InvalidInputError(self.name, value, "a text that is not empty")
            return
        if isinstance(self.default, int | float):
            components = [value]
        else:
            components = [] if value is None else list(value)
            if len(components) != len(self.default):
                raise InvalidInputError(
                    self.name, components, f"{len(self.default)} numbers, each with a point"
                )
        for component in components:
            if not math.isfinite(component):
                raise InvalidInputError(self.name, value, "finite")
            if not self.lower <= component <= self.upper:
                bound = f"[{self.lower:g}, {self.upper:g}] {self.unit}".rstrip()
                raise InvalidInputError(self.name, value, bound)


@dataclass(frozen=True)
class NodeSettings:
    """Everything that the node reads from its parameters.

    Attributes:
        planner: Settings of the planner.
        inputs: What inputs have to satisfy.
        deadline_s: Wall time of one plan.
        state_reliability: Reliability that the state subscriptions ask for.
        markers: Sizes of the markers.
        log_period_s: Least time between two log lines of the same cause.
    """

    planner: PlannerSettings
    inputs: InputSettings
    deadline_s: float
    state_reliability: str
    markers: MarkerStyle
    log_period_s: float


PROBLEM = NodeParameter(
    "problem",
    "powered_descent",
    "Problem that is planned for.",
    choices=problems.names(),
    read_only=True,
)


def formulation_parameter(problem: str) -> NodeParameter:
    """Parameter that chooses among a problem's formulations."""
    names = problems.formulations(problem)
    return NodeParameter(
        "formulation", names[0], "Form of the subproblem.", choices=names, read_only=True
    )


def problem_layout(problem: OptimalControlProblem) -> StateLayout:
    """Order of the problem's state in messages."""
    return state_layout(problem.name, [state.name for state in problem.states])


def parameter_table(problem: OptimalControlProblem) -> tuple[NodeParameter, ...]:
    """Every parameter but the problem and its formulation."""
    return (*_NODE, *_PLANNING, *_vehicle_parameters(problem))


def node_settings(
    problem: OptimalControlProblem, formulation: str, values: Mapping[str, Any]
) -> NodeSettings:
    """Settings of parameter values, each of which has passed its own check.

    Raises:
        InvalidInputError: A solver is unknown, or a vehicle number is refused by the problem.
    """
    _check_solver(values["solver"])
    vehicle = _vehicle_values(problem, values)
    problem.pack(vehicle)
    return NodeSettings(
        planner=PlannerSettings(
            problem=problem.name,
            formulation=formulation,
            parameters=vehicle,
            intervals=values["intervals"],
            terminal_time=TerminalTime(values["terminal_time_source"]),
            hold=ControlHold(values["certificate_hold"]),
            options=ScpOptions(
                max_iterations=values["max_iterations"],
                cost_tolerance=values["cost_tolerance"],
                defect_tolerance=values["defect_tolerance"],
                virtual_control_tolerance=values["virtual_control_tolerance"] or None,
                solver=values["solver"],
            ),
        ),
        inputs=InputSettings(
            frame=values["landing_frame"],
            state_max_age_s=values["state_max_age_s"],
            mass_max_age_s=values["mass_max_age_s"],
            future_tolerance_s=values["future_tolerance_s"],
            mass_fallback_kg=values["mass_fallback_kg"],
            limits=InputLimits(
                position_max_m=values["position_max_m"],
                speed_max_m_s=values["speed_max_m_s"],
                ground_tolerance_m=values["ground_tolerance_m"],
            ),
        ),
        deadline_s=values["deadline_s"],
        state_reliability=values["state_reliability"],
        markers=MarkerStyle(
            thrust_arrow_m=values["thrust_arrow_m"],
            glideslope_angle_rad=values.get(VEHICLE_PREFIX + "glideslope_angle_max"),
            apex_m=tuple(values.get(VEHICLE_PREFIX + "final_position", (0.0, 0.0, 0.0))),
        ),
        log_period_s=values["log_period_s"],
    )


_NODE = (
    NodeParameter(
        "landing_frame",
        LANDING_FRAME,
        "Frame of states and plans: z up, origin at the ground point that targets refer to.",
        read_only=True,
    ),
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
        "mass_max_age_s",
        _INPUTS.mass_max_age_s,
        "Largest age of a mass message, at its arrival and against the state that it completes.",
        "s",
        0.0,
        1e9,
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
        "mass_fallback_kg",
        _INPUTS.mass_fallback_kg,
        "Mass for states without a fresh mass message; 0 to refuse such states.",
        "kg",
        0.0,
        1e7,
    ),
    NodeParameter(
        "position_max_m",
        _LIMITS.position_max_m,
        "Distance from the landing site beyond which a state is refused.",
        "m",
        1.0,
        1e9,
    ),
    NodeParameter(
        "speed_max_m_s",
        _LIMITS.speed_max_m_s,
        "Speed beyond which a state is refused.",
        "m/s",
        1.0,
        1e6,
    ),
    NodeParameter(
        "ground_tolerance_m",
        _LIMITS.ground_tolerance_m,
        "How far below the landing site a state may be, for sensor noise.",
        "m",
        0.0,
        1e4,
    ),
    NodeParameter(
        "thrust_arrow_m", 500.0, "Marker length of a plan's largest thrust.", "m", 0.0, 1e5
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
    NodeParameter(
        "terminal_time_source",
        TerminalTime.FREE.value,
        "free: optimised with every plan. fixed: parameters.terminal_time after the first state, "
        "then what is left of it.",
        choices=(TerminalTime.FREE.value, TerminalTime.FIXED.value),
    ),
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
        _OPTIONS.defect_tolerance,
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
        "certificate_hold",
        ControlHold.MEAN.value,
        "How the certificate flies the controls between nodes.",
        choices=tuple(hold.value for hold in ControlHold),
    ),
)


def _vehicle_parameters(problem: OptimalControlProblem) -> list[NodeParameter]:
    """The problem's own parameters, but for those that every state sets."""
    layout = problem_layout(problem)
    table = []
    for declared in problem.table.parameters:
        if declared.name in problem.initial_state_parameters:
            continue
        default: Value
        if isinstance(declared.default, tuple):
            default = parameter_to_message_axes(layout, declared.default)
            description = declared.description.replace(", x up", "")
            description += " Axes and order as in messages."
        else:
            default, description = float(declared.default), declared.description
        table.append(
            NodeParameter(
                VEHICLE_PREFIX + declared.name,
                default,
                description,
                declared.unit,
                declared.lower,
                declared.upper,
            )
        )
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
