"""Optimal control problems, declared once in CasADi symbols and SI units."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import casadi as ca
import cloudpickle
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem.extras import Extras
from dscp_core.problem.parameters import Parameter, ParameterTable, Value, load_parameter_file

Symbol = TypeVar("Symbol", ca.SX, ca.MX)

TERMINAL_TIME = "terminal_time"
VIRTUAL_CONTROL_WEIGHT = "virtual_control_weight"
TRUST_REGION_STATE = "trust_region_state"
TRUST_REGION_CONTROL = "trust_region_control"
TRUST_REGION_STEP = "trust_region_step"


@dataclass(frozen=True)
class Variable:
    """A state or control component.

    Attributes:
        name: Unique name.
        unit: SI unit.
        scale: SI value of one scaled unit; the subproblems are solved in scaled units.
        description: What it is.
    """

    name: str
    unit: str
    scale: float
    description: str

    def __post_init__(self) -> None:
        if not self.scale > 0.0:
            raise InvalidInputError(f"scale of {self.name}", self.scale, "> 0")


class Where(Enum):
    """Where along the trajectory an expression is imposed."""

    NODE = "node"
    MEAN = "interval mean"


@dataclass(frozen=True)
class StagePoint:
    """Symbols at one node or interval mean; all are CasADi SX in SI units.

    Attributes:
        x: State, (nx, 1).
        u: Control, (nu, 1).
        step: Interval length T in seconds.
    """

    x: ca.SX
    u: ca.SX
    step: ca.SX


Parameters = Mapping[str, ca.SX]


@dataclass(frozen=True)
class Constraint:
    """What path and cone constraints have in common.

    Attributes:
        name: Name in reports.
        expression: Of a point and the parameters, SI; what it returns is the subclass's matter.
        scale: SI magnitude by which the rows are divided.
        unit: Unit of the expression.
        where: Node or interval mean.
        skip_first: Leave out the first node or interval (its state is pinned).
        skip_last: Leave out the last node or interval.
        tolerance: Violation of the flown trajectory that a certificate accepts, in ``unit``; a
            function of the parameters' values where it grows with the vehicle.
    """

    name: str
    expression: Callable[[StagePoint, Parameters], ca.SX]
    scale: float
    unit: str
    where: Where = Where.NODE
    skip_first: bool = False
    skip_last: bool = False
    tolerance: float | Callable[[Mapping[str, Any]], float] = 0.0

    def accepted(self, values: Mapping[str, Any]) -> float:
        """The tolerance for a vehicle's values by name."""
        return self.tolerance(values) if callable(self.tolerance) else self.tolerance


class PathConstraint(Constraint):
    """``g(x, u, p) <= 0`` with the scalar g as the expression, linearised (eq. 7)."""


class ConeConstraint(Constraint):
    """``|g1(x, u, p)|_2 <= g0(x, u, p)``, affine in (x, u); the expression is [g0; g1]."""


@dataclass(frozen=True)
class Miss:
    """A distance from the target at the end of the flown trajectory.

    Attributes:
        name: Name in reports.
        expression: ``(x(t_f), p)`` to a nonnegative scalar, SI.
        unit: Its unit.
        tolerance: Largest value that a certificate accepts.
    """

    name: str
    expression: Callable[[ca.SX, Parameters], ca.SX]
    unit: str
    tolerance: float


@dataclass(frozen=True)
class CostTerm:
    """A cost of the subproblem, summed over nodes or interval means.

    Attributes:
        name: Name in reports.
        expression: Returns a scalar, at most quadratic and convex in the decision; arguments are
            the decision's point, the reference's point and the parameters. Units of the cost.
        where: Node or interval mean.
    """

    name: str
    expression: Callable[[StagePoint, StagePoint, Parameters], ca.SX]
    where: Where = Where.MEAN


@dataclass(frozen=True)
class InitialGuess:
    """Reference trajectory of the first iteration, as CasADi expressions of the parameters.

    Attributes:
        states: (nx, N+1), SI.
        controls: (nu, N+1), SI.
    """

    states: ca.MX
    controls: ca.MX


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
        final_state: Pinned states at the end by name.
        terminal_cost: Mayer term Phi(x(t_f), t_f, p); linearised.
        running_cost: Lagrange term Theta(x, u, p) of the true cost, summed as
            ``T * sum over nodes``, or None; what a subproblem minimises of it stands in
            ``cost_terms``.
        cost_unit: Unit of the cost; "1" for a pure number.
        cost_scale: Cost of one scaled unit.
        cost_magnitude: Cost below which its changes are judged in units of this instead of
            relative to it; None for `cost_scale`.
        cost_tolerance: Default bound on the relative change of the cost at convergence.
        defect_tolerance: Default bound on the defects there, relative to the states' scales.
        cost_terms: Further subproblem costs (curvature, prox, quadratic running cost).
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
        free_terminal_time: Whether the terminal time is a decision unless asked otherwise.
        terminal_time_bounds: Least and greatest terminal time when it is free, or None.
        initial_state_parameters: Names of the parameters that hold the initial state; their
            values, one after the other, are the states in order.
        vehicle_tables: What a vehicle file may name besides parameters: name to a function that
            reads the file it points to and returns parameter values.
        check_parameters: Raises `InvalidInputError` for values by name that contradict each other.
        check_state: Raises `InvalidInputError` for an initial state that no plan can start from;
            arguments are the states (nx,) and the parameters' values by name.
        terminal_time_guess: First guess of a free terminal time in seconds, where the parameter's
            leads nowhere; same arguments.
        least_time_parameters: Parameter values that make the terminal time the cost; empty where
            none do.
        misses: Distances from the target that a certificate checks.
        control_states: Index of the state that each control acts on (for named-vector messages).
        formulation: Which of several forms of the problem this is; empty where there is one.
        extras: What it brings along, such as a figure of its own.
    """

    name: str
    states: tuple[Variable, ...]
    controls: tuple[Variable, ...]
    parameters: tuple[Parameter, ...]
    dynamics: Callable[[ca.SX, ca.SX, Parameters], ca.SX]
    initial_state: Callable[[Parameters], ca.SX]
    final_state: Mapping[str, Callable[[Parameters], ca.SX]]
    terminal_cost: Callable[[ca.SX, ca.SX, Parameters], ca.SX]
    cost_scale: float
    initial_guess: Callable[[Mapping[str, ca.MX], int], InitialGuess]
    default_intervals: int = 50
    free_terminal_time: bool = False
    terminal_time_bounds: Callable[[Parameters], tuple[ca.SX, ca.SX]] | None = None
    running_cost: Callable[[ca.SX, ca.SX, Parameters], ca.SX] | None = None
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
    vehicle_tables: Mapping[str, Callable[[Path], Mapping[str, Value]]] = field(
        default_factory=dict
    )
    check_parameters: Callable[[Mapping[str, Any]], None] | None = None
    check_state: Callable[[NDArray[np.float64], Mapping[str, Any]], None] | None = None
    terminal_time_guess: Callable[[NDArray[np.float64], Mapping[str, Any]], float] | None = None
    least_time_parameters: Mapping[str, float] = field(default_factory=dict)
    misses: tuple[Miss, ...] = ()
    control_states: tuple[int, ...] = ()
    formulation: str = ""
    extras: Extras = field(default_factory=Extras)
    table: ParameterTable = field(init=False)

    def __post_init__(self) -> None:
        nx, nu = len(self.states), len(self.controls)
        for label, values, size in (
            ("virtual_control_scale", self.virtual_control_scale, nx),
            ("trust_region_state", self.trust_region_state, nx),
            ("trust_region_control", self.trust_region_control, nu),
            ("control_states", self.control_states, nu),
        ):
            if values and len(values) != size:
                raise InvalidInputError(label, values, f"length {size}")
        unknown = sorted(set(self.final_state) - {s.name for s in self.states})
        if unknown:
            raise InvalidInputError("final_state", unknown, "names of states")
        table = ParameterTable((*self.parameters, *self._scp_parameters()))
        table[TERMINAL_TIME]
        object.__setattr__(self, "table", table)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle with lambdas and closures, which plain pickle refuses."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if f.init}
        return _restored, (cloudpickle.dumps(given),)

    def pack(self, values: Mapping[str, Value] | None = None) -> NDArray[np.float64]:
        """Packed parameters, SI: the defaults overridden by ``values``.

        Raises:
            InvalidInputError: An unknown name, an invalid value, or values that contradict each
                other.
        """
        packed = self.table.pack(values)
        if self.check_parameters is not None:
            self.check_parameters(self.table.unpack(packed))
        return packed

    def read_vehicle(self, path: str | Path) -> dict[str, Value]:
        """Values of a vehicle file, those of the tables that it points to included.

        Raises:
            InvalidInputError: The file or a table cannot be used, or both give a value.
        """
        values: dict[str, Any] = dict(load_parameter_file(path))
        for name, read in self.vehicle_tables.items():
            if name not in values:
                continue
            table = values.pop(name)
            if not isinstance(table, str):
                raise InvalidInputError(name, table, "the name of a file beside the vehicle's")
            found = read(Path(path).parent / table)
            twice = sorted(set(found) & set(values))
            if twice:
                raise InvalidInputError(name, table, f"no {', '.join(twice)} beside it")
            values.update(found)
        return values

    def initial_state_values(self, state: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Values, by name, of the parameters that hold an initial state (nx,), SI."""
        values, start = {}, 0
        for name in self.initial_state_parameters:
            values[name] = state[start : start + self.table[name].size]
            start += self.table[name].size
        return values

    def vehicle_of(self, values: Mapping[str, Any]) -> dict[str, float | list[float]]:
        """The parameters that fix the optimum from a state, as JSON holds them.

        Args:
            values: Every parameter by name, SI.
        """
        others = {TERMINAL_TIME, *self.initial_state_parameters}
        return {
            p.name: np.asarray(values[p.name], dtype=np.float64).tolist()
            for p in self.table.parameters
            if p.fixes_optimum and p.name not in others
        }

    def _scp_parameters(self) -> Sequence[Parameter]:
        """Parameters of the algorithm (theta_SCP), appended to those of the problem."""
        nx, nu = len(self.states), len(self.controls)
        unit = "1/s" if self.trust_region_per_second else "1"
        parameters = [
            Parameter(
                TRUST_REGION_STATE,
                self.trust_region_state or (0.0,) * nx,
                unit,
                "Trust-region penalty per state, scaled cost per squared scaled state.",
                lower=0.0,
                fixes_optimum=False,
            ),
            Parameter(
                TRUST_REGION_CONTROL,
                self.trust_region_control or (0.0,) * nu,
                unit,
                "Trust-region penalty per control, scaled cost per squared scaled control.",
                lower=0.0,
                fixes_optimum=False,
            ),
            Parameter(
                TRUST_REGION_STEP,
                self.trust_region_step,
                "1",
                "Trust-region penalty on the terminal time, when it is free, scaled cost per "
                "squared relative change.",
                lower=0.0,
                fixes_optimum=False,
            ),
        ]
        if any(self.virtual_control_scale):
            parameters.append(
                Parameter(
                    VIRTUAL_CONTROL_WEIGHT,
                    self.virtual_control_weight,
                    "1",
                    "Penalty of the squared virtual control, in units of the cost.",
                    lower=0.0,
                    fixes_optimum=False,
                )
            )
        return parameters


def named(problem: OptimalControlProblem, packed: Symbol) -> dict[str, Symbol]:
    """Parameters by name from their packed symbol."""
    return {name: packed[problem.table.slice(name)] for name in problem.table.names}


def _restored(pickled: bytes) -> OptimalControlProblem:
    return OptimalControlProblem(**cloudpickle.loads(pickled))
