"""Optimal control problems, declared once in CasADi symbols and SI units."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem import checks
from dscp_core.problem.algorithm import (
    DERIVED_COSTS,
    TRUST_REGION_CONTROL,
    TRUST_REGION_STATE,
    TRUST_REGION_STEP,
    VIRTUAL_CONTROL_WEIGHT,
    algorithm_parameters,
)
from dscp_core.problem.concessions import Concessions
from dscp_core.problem.elements import (
    ConeConstraint,
    Constraint,
    CostTerm,
    InitialGuess,
    Miss,
    Parameters,
    PathConstraint,
    Quadrature,
    StagePoint,
    Variable,
    Where,
    pinned_miss,
)
from dscp_core.problem.ending import EndEvent, EventLimit, Propellant
from dscp_core.problem.extras import Extras
from dscp_core.problem.parameters import Parameter, ParameterTable, Value
from dscp_core.problem.tracing import KnownParameters, numeric
from dscp_core.problem.vehicles import Reader, as_vehicle, vehicle_values

Symbol = TypeVar("Symbol", ca.SX, ca.MX)

__all__ = [
    "DERIVED_COSTS",
    "TERMINAL_TIME",
    "TRUST_REGION_CONTROL",
    "TRUST_REGION_STATE",
    "TRUST_REGION_STEP",
    "VIRTUAL_CONTROL_WEIGHT",
    "ConeConstraint",
    "Constraint",
    "CostTerm",
    "EndEvent",
    "EventLimit",
    "InitialGuess",
    "Miss",
    "OptimalControlProblem",
    "Parameters",
    "PathConstraint",
    "Propellant",
    "Quadrature",
    "StagePoint",
    "Variable",
    "Where",
    "named",
]

TERMINAL_TIME = "terminal_time"


@dataclass(frozen=True)
class OptimalControlProblem:
    """Problem of eq. 1 with what its subproblems need.

    Attributes:
        name: Name of the problem.
        states: State components, in order.
        controls: Control components, in order.
        parameters: Every parameter of the problem, ``terminal_time`` among them.
        dynamics: ``f(x, u, p)``, (nx, 1), SI (eq. 1).
        initial_state: Value of every state at the start, (nx, 1).
        free_initial_states: States whose value at the start is decided instead.
        final_state: Pinned states at the end by name.
        cost_unit: Unit of the cost; "1" for a pure number.
        cost_scale: Cost of one scaled unit.
        cost_magnitude: Cost below which its changes are judged in units of this instead of
            relative to it; None for `cost_scale`.
        cost_tolerance: Default bound on the relative change of the cost at convergence.
        defect_tolerance: Default bound on the defects there, relative to the states' scales.
        cost_terms: Further subproblem costs: curvature, proximal terms, or a model of the running
            cost in place of the derived one.
        path_constraints: Linearised constraints.
        cone_constraints: Second-order cones.
        virtual_control_scale: SI size of one unit of virtual control per state, 0 for a state
            without it; empty for a problem without any.
        virtual_control_weight: Default of the penalty, cost units per squared unit.
        virtual_control_tolerance: Largest virtual control of a feasible trajectory, relative to the
            states' scales; above what the penalty leaves where nothing is infeasible.
        trust_region_state: Default weights per state, scaled cost per scaled square.
        trust_region_control: Default weights per control, likewise.
        trust_region_step: Default weight on the interval length T, per (T_ref)^2 relative square.
        trust_region_per_second: Multiply the weights of states and controls by the reference's T,
            so that their sum over the nodes approximates an integral, whatever N.
        default_intervals: Number N of intervals that suits the problem.
        initial_guess: Builds the first reference for N intervals, as CasADi MX of the parameters.
        terminal_cost: Mayer term Phi(x(t_f), t_f, p), or None. A subproblem minimises it as it is
            where it is quadratic and convex, else its convexified second-order expansion.
        running_cost: Lagrange term Theta(x, u, p) of the true cost, or None. A subproblem
            minimises what ``cost_terms`` make of it, else the same as of the terminal cost, the
            product of the changes of Theta and T left out.
        quadrature: How the running cost is summed over the nodes.
        free_terminal_time: Whether the terminal time is a decision unless asked otherwise.
        terminal_time_bounds: Least and greatest free terminal time; None for the parameter's own.
        initial_state_parameters: Names of the parameters that hold the initial state; their
            values, one after the other, are the states in order.
        vehicle_tables: What a vehicle file may name besides parameters: name to a function that
            reads the file it points to and returns parameter values.
        file_defaults: Values of parameters that a vehicle file does not give: where the defaults
            are facts about another vehicle.
        check_parameters: Raises `InvalidInputError` for values by name that contradict each other.
        check_state: Raises `InvalidInputError` for an initial state that no plan can start from;
            arguments are the states (nx,) and the parameters' values by name.
        terminal_time_guess: First guess of a free terminal time in seconds, where the parameter's
            leads nowhere; same arguments.
        least_time_parameters: Parameter values that make the terminal time the cost; empty where
            none do.
        misses: Distances from the target that a certificate checks; empty for those of every
            pinned state, see `end_checks`.
        end_event: What ends a flight whatever the plan says, such as contact with the ground.
        propellant: What a flight burns.
        control_states: Index of the state that each control acts on (for named-vector messages).
        formulation: Which of several forms of the problem this is; empty where there is one.
        concessions: What gives way, in which order, where nothing is feasible; None: nothing.
        extras: What it brings along, such as a figure of its own.

    Example:
        >>> import casadi as ca
        >>> from dscp_core import InitialGuess, OptimalControlProblem, Parameter, Planner, Variable
        >>> problem = OptimalControlProblem(
        ...     name="cart",
        ...     states=(Variable("place", "m", 1.0, ""), Variable("speed", "m/s", 1.0, "")),
        ...     controls=(Variable("force", "N/kg", 1.0, "Per mass."),),
        ...     parameters=(
        ...         Parameter("terminal_time", 2.0, "s", "Duration."),
        ...         Parameter("start", (0.0, 0.0), "1", "State at the start."),
        ...     ),
        ...     dynamics=lambda x, u, p: ca.vertcat(x[1], u[0]),
        ...     initial_state=lambda p: p["start"],
        ...     initial_state_parameters=("start",),
        ...     final_state={"place": lambda p: 1.0, "speed": lambda p: 0.0},
        ...     terminal_cost=lambda x, time, p: 0.0 * time,
        ...     running_cost=lambda x, u, p: u[0] ** 2,
        ...     cost_scale=1.0,
        ...     initial_guess=lambda p, n: InitialGuess(ca.MX(2, n + 1), ca.MX(1, n + 1)),
        ... )
        >>> Planner(problem).plan().converged
        True
    """

    name: str
    states: tuple[Variable, ...]
    controls: tuple[Variable, ...]
    parameters: tuple[Parameter, ...]
    dynamics: Callable[[ca.SX, ca.SX, Parameters], ca.SX]
    initial_state: Callable[[Parameters], ca.SX]
    final_state: Mapping[str, Callable[[Parameters], ca.SX]]
    cost_scale: float
    initial_guess: Callable[[Mapping[str, ca.MX], int], InitialGuess]
    free_initial_states: tuple[str, ...] = ()
    default_intervals: int = 50
    free_terminal_time: bool = False
    terminal_time_bounds: Callable[[Parameters], tuple[ca.SX, ca.SX]] | None = None
    terminal_cost: Callable[[ca.SX, ca.SX, Parameters], ca.SX] | None = None
    running_cost: Callable[[ca.SX, ca.SX, Parameters], ca.SX] | None = None
    quadrature: Quadrature = Quadrature.TRAPEZOID
    cost_unit: str = "1"
    cost_magnitude: float | None = None
    cost_tolerance: float = 1e-8
    defect_tolerance: float = 1e-6
    cost_terms: tuple[CostTerm, ...] = ()
    path_constraints: tuple[PathConstraint, ...] = ()
    cone_constraints: tuple[ConeConstraint, ...] = ()
    virtual_control_scale: tuple[float, ...] = ()
    virtual_control_weight: float = 0.0
    virtual_control_tolerance: float = 1e-6
    trust_region_state: tuple[float, ...] = ()
    trust_region_control: tuple[float, ...] = ()
    trust_region_step: float = 0.0
    trust_region_per_second: bool = False
    initial_state_parameters: tuple[str, ...] = ()
    vehicle_tables: Mapping[str, Reader] = field(default_factory=dict)
    file_defaults: Mapping[str, Value] = field(default_factory=dict)
    check_parameters: Callable[[Mapping[str, Any]], None] | None = None
    check_state: Callable[[NDArray[np.float64], Mapping[str, Any]], None] | None = None
    terminal_time_guess: Callable[[NDArray[np.float64], Mapping[str, Any]], float] | None = None
    least_time_parameters: Mapping[str, float] = field(default_factory=dict)
    misses: tuple[Miss, ...] = ()
    end_event: EndEvent | None = None
    propellant: Propellant | None = None
    control_states: tuple[int, ...] = ()
    formulation: str = ""
    concessions: Concessions | None = None
    extras: Extras = field(default_factory=Extras)
    table: ParameterTable = field(init=False)

    def __post_init__(self) -> None:
        checks.plain("", self, Quadrature=Quadrature, Extras=Extras)
        for label, one in _PARTS.items():
            checks.optional(label, getattr(self, label), one)
        checks.named("name", self.name)
        for label, kind in _MEMBERS.items():
            object.__setattr__(self, label, checks.members(label, getattr(self, label), kind))
        nx, nu = len(self.states), len(self.controls)
        if not nx or not nu:
            raise InvalidInputError("controls" if nx else "states", (), "at least one Variable")
        for label, size in (
            ("virtual_control_scale", nx),
            ("trust_region_state", nx),
            ("trust_region_control", nu),
            ("control_states", nu),
        ):
            object.__setattr__(self, label, checks.numbers(label, getattr(self, label), size))
        for label in _POSITIVE:
            checks.positive(label, getattr(self, label))
        if self.cost_magnitude is not None:
            checks.positive("cost_magnitude", self.cost_magnitude)
        if any(self.virtual_control_scale):
            checks.positive("virtual_control_weight", self.virtual_control_weight)
        self._check_functions()
        self._check_names()
        table = ParameterTable(
            (
                *self.parameters,
                *algorithm_parameters(
                    self.trust_region_state or (0.0,) * nx,
                    self.trust_region_control or (0.0,) * nu,
                    self.trust_region_step,
                    self.virtual_control_weight if any(self.virtual_control_scale) else None,
                    "1/s" if self.trust_region_per_second else "1",
                ),
            )
        )
        object.__setattr__(self, "table", table)
        self._check_parameters()

    def _check_names(self) -> None:
        limits = [c.name for c in (*self.path_constraints, *self.cone_constraints)]
        states = [s.name for s in self.states]
        checks.distinct("states and controls", [*states, *(c.name for c in self.controls)])
        ends = [m.name for m in self.end_checks]
        if self.end_event is not None:
            ends += [self.end_event.floor, *(limit.name for limit in self.end_event.limits)]
        checks.distinct("constraints and misses", [*limits, *ends])
        checks.distinct("constraints", limits, reserved=(TERMINAL_TIME,))
        checks.distinct("cost_terms", (t.name for t in self.cost_terms), reserved=DERIVED_COSTS)
        checks.among("final_state", self.final_state, states, "names of states")
        checks.among("free_initial_states", self.free_initial_states, states, "names of states")
        known = range(len(self.states))
        acted_on = [i for i in self.control_states if not (isinstance(i, int) and i in known)]
        if acted_on:
            raise InvalidInputError("control_states", acted_on, f"[0, {len(known) - 1}]")

    def _check_functions(self) -> None:
        for label in ("final_state", "vehicle_tables", "file_defaults", "least_time_parameters"):
            checks.mapping(label, getattr(self, label))
        given = {name: getattr(self, name) for name in (*_FUNCTIONS, *_OPTIONAL_FUNCTIONS)}
        given |= {f"final_state {name}": value for name, value in self.final_state.items()}
        given |= {f"vehicle_tables {name}": read for name, read in self.vehicle_tables.items()}
        for name, value in given.items():
            if value is not None or name not in _OPTIONAL_FUNCTIONS:
                checks.function(name, value)
        if not (isinstance(self.default_intervals, int) and self.default_intervals >= 2):
            raise InvalidInputError("default_intervals", self.default_intervals, ">= 2")

    def _check_parameters(self) -> None:
        """Defaults, the terminal time, and the parameters that are named elsewhere."""
        for parameter in self.table.parameters:
            parameter.validate(parameter.default)
        if self.table[TERMINAL_TIME].is_vector:
            raise InvalidInputError(TERMINAL_TIME, self.table[TERMINAL_TIME].default, "a number")
        checks.positive(TERMINAL_TIME, self.table[TERMINAL_TIME].default)
        checks.distinct("initial_state_parameters", self.initial_state_parameters)
        size = sum(self.table[name].size for name in self.initial_state_parameters)
        if self.initial_state_parameters and size != len(self.states):
            bound = f"{len(self.states)} components, one per state, not {size}"
            given = self.initial_state_parameters
            raise InvalidInputError("initial_state_parameters", given, bound)
        for name, value in (*self.least_time_parameters.items(), *self.file_defaults.items()):
            self.table[name].validate(value)
        if self.propellant is not None:
            self.propellant.require_known([s.name for s in self.states], self.table)

    def __reduce__(self) -> tuple[Any, ...]:
        """By value, lambdas and closures included: workers get the problem itself."""
        from dscp_core.problem import pickling

        declared = {f.name: getattr(self, f.name) for f in fields(self) if f.init}
        return _restored, pickling.to_bytes(declared)

    def pack(self, values: Mapping[str, Value] | None = None) -> NDArray[np.float64]:
        """Packed parameters, SI: the defaults overridden by ``values``.

        Raises:
            InvalidInputError: An unknown name, an invalid value, or values that contradict.
        """
        packed = self.table.pack(values)
        self.require_consistent(packed)
        return packed

    def require_consistent(self, packed: NDArray[np.float64]) -> None:
        """Raise `InvalidInputError` for packed parameters that contradict each other."""
        if self.check_parameters is not None:
            numeric("check_parameters", self.table, self.check_parameters, packed)

    def require_start(self, state: NDArray[np.float64], packed: NDArray[np.float64]) -> None:
        """Raise `InvalidInputError` for a state (nx,), SI, that no plan can start from."""
        if self.check_state is not None:
            numeric("check_state", self.table, self.check_state, packed, state)

    def read_vehicle(self, path: str | Path, given: Collection[str] = ()) -> dict[str, Value]:
        """Values of a vehicle file and its tables, else `file_defaults` of what is not ``given``.

        Raises:
            InvalidInputError: The file or a table cannot be used, or both give a value.
        """
        return vehicle_values(path, self.vehicle_tables, self.file_defaults, given)

    def initial_state_values(self, state: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Values, by name, of the parameters that hold an initial state (nx,), SI."""
        values, start = {}, 0
        for name in self.initial_state_parameters:
            values[name] = state[start : start + self.table[name].size]
            start += self.table[name].size
        return values

    @property
    def end_checks(self) -> tuple[Miss, ...]:
        """What a certificate checks at the end: the misses, or else every pinned state.

        A pinned state may then be off by a hundredth of its scale.
        """
        if self.misses:
            return self.misses
        return tuple(
            pinned_miss(index, state, self.final_state[state.name])
            for index, state in enumerate(self.states)
            if state.name in self.final_state
        )

    def vehicle_of(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters that fix the optimum from a state, as JSON holds them.

        A number, or a list of them; None stands for an infinite bound, which is none.

        Args:
            values: Every parameter by name, SI.
        """
        others = {TERMINAL_TIME, *self.initial_state_parameters}
        return as_vehicle(self.table, others, values)


_MEMBERS: Mapping[str, type] = {
    "states": Variable,
    "controls": Variable,
    "parameters": Parameter,
    "cost_terms": CostTerm,
    "path_constraints": PathConstraint,
    "cone_constraints": ConeConstraint,
    "misses": Miss,
    "initial_state_parameters": str,
    "free_initial_states": str,
}
_PARTS = {"end_event": EndEvent, "propellant": Propellant, "concessions": Concessions}
_POSITIVE = ("cost_scale", "cost_tolerance", "defect_tolerance", "virtual_control_tolerance")
_FUNCTIONS = ("dynamics", "initial_state", "initial_guess")
_OPTIONAL_FUNCTIONS = (
    "terminal_cost",
    "running_cost",
    "terminal_time_bounds",
    "check_parameters",
    "check_state",
    "terminal_time_guess",
)


def _restored(pickled: bytes, count: int, expressions: str) -> OptimalControlProblem:
    from dscp_core.problem import pickling

    return OptimalControlProblem(**pickling.from_bytes(pickled, count, expressions))


def named(problem: OptimalControlProblem, packed: Symbol) -> dict[str, Symbol]:
    """Parameters by name from their packed symbol."""
    return KnownParameters(
        (name, packed[problem.table.slice(name)]) for name in problem.table.names
    )
