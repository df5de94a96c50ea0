"""Transcription of an optimal control problem to a cone program.

One compiled function maps (reference, parameters) to every value of the subproblem, and its
reverse-mode derivative is the vector-Jacobian product of eq. d3, second derivatives included.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.convexity import NotConvexError
from dscp_core.cone.program import ConePattern, ConeValues
from dscp_core.errors import InvalidInputError
from dscp_core.problem import checks
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem, named
from dscp_core.problem.flight import ControlHold, Discretisation
from dscp_core.problem.parameters import ParameterTable
from dscp_core.problem.tracing import Tracer
from dscp_core.transcription import faults
from dscp_core.transcription.analysis import CostAnalysis
from dscp_core.transcription.compiled import CompiledFunction
from dscp_core.transcription.layout import TrajectoryLayout
from dscp_core.transcription.scatter import ValueScatter
from dscp_core.transcription.stages import StageFunctions, build_stages

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Evaluation:
    """True (nonlinear) measures of a trajectory.

    Attributes:
        cost: Cost J of eq. 1, discretised, in its own units.
        defects: Residual of the discrete dynamics, eq. ch2-disdy, (N, nx), SI.
    """

    cost: float
    defects: Array


class Transcription:
    """An optimal control problem on N intervals, as a family of cone programs.

    Attributes:
        problem: The declaration.
        discretisation: Dynamics of the intervals.
        hold: How the controls are flown.
        layout: Where quantities stand in the decision vector.
        pattern: Fixed sparsity of every subproblem.
        costs: What the subproblems minimise of the true costs.
        cost_function: True cost of (scaled reference vector, packed parameters).
        table: Parameters, in the packing order of every ``parameters`` argument.
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        intervals: int,
        *,
        free_terminal_time: bool | None = None,
        discretisation: Discretisation = Discretisation.MIDPOINT,
        hold: ControlHold = ControlHold.MEAN,
    ) -> None:
        """Compile the problem's functions.

        Args:
            problem: The declaration.
            intervals: Number N of intervals.
            free_terminal_time: Make the terminal time a decision; the parameter
                ``terminal_time`` is then its first guess only. None for the problem's default.
            discretisation: Dynamics of the intervals.
            hold: How the controls are flown, which propagated dynamics follow.

        Raises:
            InvalidInputError: ``intervals`` below 2, or a function of the declaration is wrong.
        """
        checks.whole("intervals", intervals, 2)
        self.problem = problem
        self.table: ParameterTable = problem.table
        time_scale = float(np.ravel(self.table[TERMINAL_TIME].default)[0])
        self.layout = TrajectoryLayout(
            state_scale=np.array([s.scale for s in problem.states]),
            control_scale=np.array([c.scale for c in problem.controls]),
            time_scale=time_scale,
            intervals=int(intervals),
            free_terminal_time=(
                problem.free_terminal_time if free_terminal_time is None else free_terminal_time
            ),
            virtual_scale=np.array(problem.virtual_control_scale or (0.0,) * len(problem.states)),
        )
        self.discretisation = discretisation
        self.hold = hold
        stages = build_stages(problem, self.layout, discretisation, hold)
        scatter = ValueScatter(stages.problem, self.layout, stages)
        self.pattern: ConePattern = scatter.pattern
        self.costs: CostAnalysis = stages.costs
        self._stages = stages
        bounds = self.pattern.flat_offsets
        self._parts = {
            name: slice(bounds[i], bounds[i + 1]) for i, name in enumerate(ConeValues.FIELDS)
        }
        self._heads = np.arange(self.pattern.n_cone_rows) < self.pattern.n_nonnegative
        self._heads[self.pattern.soc_starts] = True
        self._compile(stages, scatter)
        self._bounded = self._has_every_bound()

    def __reduce__(self) -> tuple[Any, ...]:
        """By what it was made of; the copy compiles its own functions."""
        free = self.layout.free_terminal_time
        given = (self.problem, self.layout.intervals, free, self.discretisation, self.hold)
        return _transcribed, given

    def _compile(self, stages: StageFunctions, scatter: ValueScatter) -> None:
        layout = self.layout
        reference = ca.MX.sym("reference", layout.reference_size)
        parameters = ca.MX.sym("parameters", self.table.size)
        seed = ca.MX.sym("seed", scatter.n_values)
        values = ca.mtimes(scatter.matrix, stages.sources(reference, parameters))
        self._values = CompiledFunction("values", [reference, parameters], [values])
        both = ca.vertcat(reference, parameters)
        pullback = ca.jtimes(values, both, seed, True)
        self._pullback = CompiledFunction(
            "values_pullback",
            [reference, parameters, seed],
            [pullback[: layout.reference_size], pullback[layout.reference_size :]],
        )
        direction = ca.MX.sym("direction", both.numel())
        self._pushforward = CompiledFunction(
            "values_pushforward",
            [reference, parameters, direction],
            [ca.jtimes(values, both, direction)],
        )
        cost, defects = stages.evaluation(reference, parameters)
        self._evaluation = CompiledFunction("evaluation", [reference, parameters], [cost, defects])
        self.cost_function = ca.Function("true_cost", [reference, parameters], [cost])
        cost_gradient = ca.gradient(cost, both)
        self._cost_gradient = CompiledFunction(
            "cost_gradient",
            [reference, parameters],
            [cost_gradient[: layout.reference_size], cost_gradient[layout.reference_size :]],
        )
        packed = ca.SX.sym("p", self.table.size)
        start = Tracer(self.table, packed)(
            "initial_state",
            self.problem.initial_state,
            named(self.problem, packed),
            rows=layout.nx,
        )
        self._initial_state = CompiledFunction("initial_state", [packed], [start])
        guess = stages.initial_guess(parameters)
        guess_seed = ca.MX.sym("guess_seed", layout.reference_size)
        guess_direction = ca.MX.sym("guess_direction", self.table.size)
        self._guess = CompiledFunction("initial_guess", [parameters], [guess])
        self._guess_pullback = CompiledFunction(
            "initial_guess_pullback",
            [parameters, guess_seed],
            [ca.jtimes(guess, parameters, guess_seed, True)],
        )
        self._guess_pushforward = CompiledFunction(
            "initial_guess_pushforward",
            [parameters, guess_direction],
            [ca.jtimes(guess, parameters, guess_direction)],
        )

    def values(self, reference: Array, parameters: Array) -> ConeValues:
        """Values of the subproblem at a reference (the set B of section 3.2.1).

        Rows of constraints that are not imposed, their bounds being infinite, are empty and hold.

        Raises:
            InvalidInputError: A value is not finite; the message names function, place and time.
        """
        flat = self._values(reference, parameters)[0]
        if not np.isfinite(flat).all():
            absent = self._absent(flat)
            self._clear(flat, absent)
            if not np.isfinite(flat).all():
                raise faults.not_finite(self._stages, reference, parameters)
            heads = self._heads & absent
            flat[self._parts["h"]][heads] = 1.0
        return ConeValues.from_flat(self.pattern, flat)

    def largest_entry(self, vector: Array) -> str:
        """Which quantity is largest in a reference vector, and at which node."""
        return faults.describe_entry(self.problem, self.layout, int(np.argmax(np.abs(vector))))

    def require_finite(self, reference: Array, what: str) -> None:
        """Refuse a reference vector, called ``what``, with entries that are not finite.

        Raises:
            InvalidInputError: With the first such entry.
        """
        wrong = np.flatnonzero(~np.isfinite(reference))
        if wrong.size:
            entry = faults.describe_entry(self.problem, self.layout, int(wrong[0]))
            raise InvalidInputError(f"{entry} of {what}", float(reference[wrong[0]]), "finite")

    def not_convex(self, reference: Array, parameters: Array) -> NotConvexError:
        """The error that names the cost for which a subproblem is not convex."""
        return faults.not_convex(self._stages, reference, parameters)

    def values_pullback(
        self, reference: Array, parameters: Array, cotangent: ConeValues
    ) -> tuple[Array, Array]:
        """Eq. d3: gradient with respect to (reference, parameters) from that of the values."""
        flat = cotangent.to_flat()
        if not self._bounded:
            self._clear(flat, self._absent(self._values(reference, parameters)[0]))
        pulled = self._pullback(reference, parameters, flat)
        return pulled[0], np.where(np.isinf(parameters), 0.0, pulled[1])

    def values_pushforward(
        self, reference: Array, parameters: Array, d_reference: Array, d_parameters: Array
    ) -> ConeValues:
        """Change of the values along a direction of (reference, parameters)."""
        direction = np.concatenate([d_reference, d_parameters])
        pushed = self._pushforward(reference, parameters, direction)[0]
        if not self._bounded or not np.isfinite(pushed).all():
            self._clear(pushed, self._absent(self._values(reference, parameters)[0]))
        return ConeValues.from_flat(self.pattern, pushed)

    def evaluate(self, reference: Array, parameters: Array) -> Evaluation:
        """True cost and defects of a trajectory."""
        cost, defects = self._evaluation(reference, parameters)
        return Evaluation(float(cost[0]), defects.reshape(self.layout.intervals, self.layout.nx))

    def cost_gradient(self, reference: Array, parameters: Array) -> tuple[Array, Array]:
        """Gradient of the true cost with respect to (scaled reference, parameters)."""
        gradient = self._cost_gradient(reference, parameters)
        return gradient[0], gradient[1]

    def initial_state(self, parameters: Array) -> Array:
        """State (nx,) at the start, SI."""
        return self._initial_state(parameters)[0]

    def initial_guess(self, parameters: Array) -> Array:
        """Reference vector of the first iteration."""
        return self._guess(parameters)[0]

    def initial_guess_pullback(self, parameters: Array, seed: Array) -> Array:
        """Gradient with respect to the parameters through the initial guess."""
        return self._guess_pullback(parameters, seed)[0]

    def initial_guess_pushforward(self, parameters: Array, direction: Array) -> Array:
        """Change of the initial guess along a direction of the parameters."""
        return self._guess_pushforward(parameters, direction)[0]

    def terminal_time(self, reference: Array, parameters: Array) -> float:
        """Terminal time of a trajectory in seconds, decided or given."""
        decided = self.layout.terminal_time(reference)
        if decided is not None:
            return decided
        return float(parameters[self.table.slice(TERMINAL_TIME)][0])

    def _has_every_bound(self) -> bool:
        """Whether no parameter can be infinite and no bound is as declared."""
        if any(parameter.infinite for parameter in self.table.parameters):
            return False
        defaults = self.problem.pack()
        flat = self._values(self.initial_guess(defaults), defaults)[0]
        return not self._absent(flat).any()

    def _absent(self, flat: Array) -> NDArray[np.bool_]:
        """(m,) rows of G of constraints that are not imposed: whose h is plus infinity.

        A cone is not when its first row's is.
        """
        pattern = self.pattern
        infinite = flat[self._parts["h"]] == np.inf
        sizes = np.array(pattern.soc_dims, dtype=np.intp)
        infinite[pattern.n_nonnegative :] = np.repeat(infinite[pattern.soc_starts], sizes)
        return np.asarray(infinite)

    def _clear(self, flat: Array, absent: NDArray[np.bool_]) -> None:
        """Set the values of these rows of G and h to zero, in place."""
        flat[self._parts["g"]][absent[self.pattern.g.indices]] = 0.0
        flat[self._parts["h"]][absent] = 0.0


def _transcribed(
    problem: OptimalControlProblem,
    intervals: int,
    free_terminal_time: bool,
    discretisation: Discretisation,
    hold: ControlHold,
) -> Transcription:
    return Transcription(
        problem,
        intervals,
        free_terminal_time=free_terminal_time,
        discretisation=discretisation,
        hold=hold,
    )
