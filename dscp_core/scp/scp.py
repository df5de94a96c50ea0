"""Sequential convex programming: the forward pass (section 3.2.1)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.convexity import NotConvexError
from dscp_core.cone.derivative.sensitivity import KktSystem
from dscp_core.cone.program import ConePattern, ConeSolution, ConeValues, SolveStatus
from dscp_core.cone.solvers import SolverSettings, make_solver
from dscp_core.errors import InvalidInputError
from dscp_core.problem import checks
from dscp_core.scp.stopping import StoppingRule, StoppingTest
from dscp_core.scp.trace import Iteration, ScpResult, ScpStatus
from dscp_core.transcription.transcription import Evaluation, Transcription

__all__ = [
    "Iteration",
    "Scp",
    "ScpOptions",
    "ScpResult",
    "ScpStatus",
    "StoppingRule",
    "objective",
]

Array = NDArray[np.float64]

DEFAULT_SOLVER = "clarabel"
GRADIENT_TOLERANCE = 1e-12
"""Interior-point tolerance at which weakly active constraints are told from inactive ones."""


_SATISFIED = 10.0
"""Tolerances of the defects up to which a trajectory is said to satisfy the dynamics."""


@dataclass(frozen=True)
class ScpOptions:
    """How to iterate.

    Attributes:
        max_iterations: Iteration limit.
        fixed_iterations: Run exactly this many iterations without testing, or None.
        stopping: Which tests end the iterations.
        cost_tolerance: Bound on the relative change of the penalised cost (eq. for epsilon_J) and
            on the change that the subproblem predicted, or None for the problem's own.
        defect_tolerance: Bound on the defects, relative to the states' scales, or None for the
            problem's own.
        virtual_control_tolerance: Bound on the virtual control, relative to the states' scales, or
            None for the problem's own.
        polish: Refine each subproblem's solution on its active set, for differentiation.
        deadline_s: Wall time for all iterations, or None.
        solver: Backend, or backends to try in order, separated by commas.
        solver_settings: Accuracy and limits of the backend.

    Example:
        >>> from dscp_core import Planner, PlannerSettings, ScpOptions, problems
        >>> settings = PlannerSettings(options=ScpOptions(max_iterations=5, solver="clarabel"))
        >>> Planner(problems.get("powered_descent"), settings).plan().iterations
        5
    """

    max_iterations: int = 20
    fixed_iterations: int | None = None
    stopping: StoppingRule = StoppingRule.GUARDED
    cost_tolerance: float | None = None
    defect_tolerance: float | None = None
    virtual_control_tolerance: float | None = None
    polish: bool = False
    deadline_s: float | None = None
    solver: str = DEFAULT_SOLVER
    solver_settings: SolverSettings = field(default_factory=SolverSettings)

    def __post_init__(self) -> None:
        for name in ("cost_tolerance", "defect_tolerance", "virtual_control_tolerance"):
            value = getattr(self, name)
            if value is not None:
                checks.positive(name, value)
        checks.whole("max_iterations", self.max_iterations, 1)
        if self.fixed_iterations is not None:
            checks.whole("fixed_iterations", self.fixed_iterations, 1)
        object.__setattr__(self, "stopping", checks.choice("stopping", self.stopping, StoppingRule))
        if self.deadline_s is not None and not self.deadline_s > 0.0:
            raise InvalidInputError("deadline_s", self.deadline_s, "> 0")

    @staticmethod
    def for_gradients(**changes: Any) -> ScpOptions:
        """Options for runs that will be differentiated: polished, tightly solved subproblems."""
        settings = SolverSettings(tolerance=GRADIENT_TOLERANCE)
        return replace(ScpOptions(polish=True, solver_settings=settings), **changes)

    @property
    def iteration_limit(self) -> int:
        """Most iterations that a run does."""
        return self.fixed_iterations or self.max_iterations


class Scp:
    """The SCP loop of one transcription; keeps solver and symbolic work between runs.

    Not safe for runs from several threads at once.
    """

    def __init__(
        self,
        transcription: Transcription,
        options: ScpOptions | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Compile nothing yet, but bind the solver.

        Args:
            transcription: What is solved.
            options: How to iterate.
            clock: Seconds, by which deadlines and times are told.
        """
        self.transcription = transcription
        self.options = options or ScpOptions()
        self.clock = clock
        self.kkt = KktSystem(transcription.pattern)
        self._solver = make_solver(
            self.options.solver, transcription.pattern, self.options.solver_settings
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """By what it was made of; the copy has a solver and symbolic work of its own."""
        return Scp, (self.transcription, self.options, self.clock)

    @property
    def cost_tolerance(self) -> float:
        """Bound on the relative change of the cost: of the options, or else of the problem."""
        given = self.options.cost_tolerance
        return self.transcription.problem.cost_tolerance if given is None else given

    @property
    def defect_tolerance(self) -> float:
        """Bound on the defects: of the options, or else of the problem."""
        given = self.options.defect_tolerance
        return self.transcription.problem.defect_tolerance if given is None else given

    @property
    def virtual_control_tolerance(self) -> float:
        """Bound on the virtual control: of the options, or else of the problem."""
        given = self.options.virtual_control_tolerance
        return self.transcription.problem.virtual_control_tolerance if given is None else given

    def satisfies_dynamics(self, iteration: Iteration) -> bool:
        """Whether the defects of an iteration's trajectory are those of a run that has ended."""
        defect = self.transcription.layout.relative(iteration.defects)
        return defect <= _SATISFIED * self.defect_tolerance

    def with_options(self, **changes: Any) -> Scp:
        """A loop with changed options that shares this one's symbolic work."""
        options = replace(self.options, **changes)
        copy = object.__new__(Scp)
        copy.transcription, copy.options, copy.kkt = self.transcription, options, self.kkt
        copy.clock = self.clock
        same = (options.solver, options.solver_settings) == (
            self.options.solver,
            self.options.solver_settings,
        )
        copy._solver = (
            self._solver
            if same
            else make_solver(options.solver, self.transcription.pattern, options.solver_settings)
        )
        return copy

    def run(self, parameters: Array, initial_reference: Array | None = None) -> ScpResult:
        """Iterate to convergence, or for a fixed number of iterations.

        Args:
            parameters: Packed parameters, SI.
            initial_reference: Scaled reference vector to start from; None for the problem's
                initial guess.
        """
        return _Run(self, parameters, initial_reference).execute()

    def solve(self, values: ConeValues, time_limit_s: float | None) -> ConeSolution:
        """Solve one subproblem."""
        return self._solver.solve(values, time_limit_s=time_limit_s)


class _Run:
    """State of one run."""

    def __init__(self, scp: Scp, parameters: Array, initial_reference: Array | None) -> None:
        self._clock = scp.clock
        self._start = self._clock()
        self._scp = scp
        self._options = scp.options
        self._transcription = scp.transcription
        self._parameters = np.array(parameters, dtype=np.float64)
        self._warm = initial_reference is not None
        self._initial = (
            self._transcription.initial_guess(self._parameters)
            if initial_reference is None
            else np.array(initial_reference, dtype=np.float64)
        )
        expected = self._transcription.layout.reference_size
        if self._initial.shape != (expected,):
            raise InvalidInputError(
                "initial_reference", f"shape {self._initial.shape}", f"shape ({expected},)"
            )
        what = "initial_reference" if self._warm else "the problem's initial guess"
        self._transcription.require_finite(self._initial, what)
        problem = self._transcription.problem
        self._test = StoppingTest(
            rule=self._options.stopping,
            layout=self._transcription.layout,
            cost_tolerance=scp.cost_tolerance,
            defect_tolerance=scp.defect_tolerance,
            virtual_control_tolerance=scp.virtual_control_tolerance,
            least_cost=(problem.cost_magnitude or problem.cost_scale) / problem.cost_scale,
            warm=self._warm,
        )
        self._iterations: list[Iteration] = []
        self._first_cost = math.nan

    def execute(self) -> ScpResult:
        reference = self._initial
        evaluation = self._transcription.evaluate(reference, self._parameters)
        self._first_cost = evaluation.cost
        for _ in range(self._options.iteration_limit):
            remaining = self._remaining()
            if remaining is not None and remaining <= 0.0:
                return self._finish(ScpStatus.DEADLINE, "no time for another iteration")
            try:
                iteration, evaluation = self._iterate(reference, evaluation, remaining)
            except InvalidInputError as error:  # not finite, or not convex
                return self._finish(ScpStatus.DIVERGED, f"{self._progress()}; {error}")
            if isinstance(iteration, ConeSolution):
                return self._failure(iteration, reference)
            self._iterations.append(iteration)
            reference = iteration.solution.z[: reference.size]
            if self._options.fixed_iterations is None:
                if self._test.stationary(self._iterations, self._first_cost):
                    return self._converged()
                if self._test.infeasible(self._iterations):
                    return self._finish(ScpStatus.INFEASIBLE, self._progress())
        if self._options.fixed_iterations is not None:
            return self._finish(ScpStatus.FIXED_ITERATIONS, f"{len(self._iterations)} done")
        return self._finish(ScpStatus.ITERATION_LIMIT, self._progress())

    def _remaining(self) -> float | None:
        if self._options.deadline_s is None:
            return None
        return self._options.deadline_s - (self._clock() - self._start)

    def _iterate(
        self, reference: Array, before: Evaluation, time_limit_s: float | None
    ) -> tuple[Iteration | ConeSolution, Evaluation]:
        transcription, layout = self._transcription, self._transcription.layout
        started = self._clock()
        values = transcription.values(reference, self._parameters)
        assembled = self._clock()
        try:
            solution = self._scp.solve(values, time_limit_s)
        except NotConvexError:
            raise transcription.not_convex(reference, self._parameters) from None
        solved = self._clock()
        if solution.status is not SolveStatus.SOLVED:
            return solution, before
        linearisation = None
        if self._options.polish:
            linearisation = self._scp.kkt.linearise(values, solution)
            solution = linearisation.solution
        polished = self._clock()
        evaluation = transcription.evaluate(solution.z[: reference.size], self._parameters)
        iteration = Iteration(
            reference=reference,
            values=values,
            solution=solution,
            linearisation=linearisation,
            cost=evaluation.cost,
            penalised_cost=evaluation.cost / transcription.problem.cost_scale
            + _virtual_penalty(layout.reference_size, transcription.pattern, values, solution.z),
            predicted_change=self._predicted_change(values, reference, before, solution.z),
            defects=evaluation.defects,
            virtual_control=layout.virtual_control(solution.z),
            assembly_seconds=assembled - started + self._clock() - polished,
            solve_seconds=solved - assembled,
            polish_seconds=polished - solved,
        )
        return iteration, evaluation

    def _predicted_change(
        self, values: ConeValues, reference: Array, before: Evaluation, z: Array
    ) -> float:
        layout, pattern = self._transcription.layout, self._transcription.pattern
        start = np.concatenate([reference, layout.virtual_part(before.defects)])
        return objective(pattern, values, z) - objective(pattern, values, start)

    def _converged(self) -> ScpResult:
        last = self._iterations[-1]
        virtual = self._transcription.layout.relative(last.virtual_control)
        if virtual > self._test.virtual_control_tolerance:
            return self._finish(ScpStatus.INFEASIBLE, self._progress())
        return self._finish(ScpStatus.CONVERGED, self._progress())

    def _progress(self) -> str:
        if not self._iterations:
            return "no iteration done"
        last, layout = self._iterations[-1], self._transcription.layout
        return (
            f"{len(self._iterations)} iterations, predicted change {last.predicted_change:.1e}, "
            f"defect {layout.relative(last.defects):.1e}, "
            f"virtual control {layout.relative(last.virtual_control):.1e} (scaled)"
        )

    def _failure(self, solution: ConeSolution, reference: Array) -> ScpResult:
        number = len(self._iterations) + 1
        message = f"iteration {number}: {solution.solver}: {solution.status.value}"
        if solution.message:
            message += f" ({solution.message})"
        left = self._remaining()
        # A solver that runs out of time may call it something else.
        if solution.status is SolveStatus.TIME_LIMIT or (left is not None and left <= 0.0):
            return self._finish(ScpStatus.DEADLINE, message, solution)
        if solution.status is SolveStatus.INFEASIBLE:
            return self._finish(ScpStatus.SUBPROBLEM_INFEASIBLE, message, solution)
        if solution.status is SolveStatus.UNBOUNDED:
            along = self._transcription.largest_entry(solution.z[: reference.size])
            message += f"; it lacks a bound or a trust-region weight, above all for {along}"
            return self._finish(ScpStatus.SOLVER_FAILURE, message, solution)
        status, reason = self._diagnose(reference)
        return self._finish(status, f"{message}; {reason}", solution)

    def _diagnose(self, reference: Array) -> tuple[ScpStatus, str]:
        """Tell an infeasible subproblem from a failing solver, by its least virtual control.

        Where even that is large, the penalty's multipliers are what the solver failed on.
        """
        layout, pattern = self._transcription.layout, self._transcription.pattern
        values = self._transcription.values(reference, self._parameters).copy()
        virtual = int(pattern.q.indptr[layout.reference_size])
        values.q[:virtual] = 0.0
        values.q[virtual:] = 1.0
        values.c[:] = 0.0
        least = self._scp.solve(values, self._remaining())
        if least.status is SolveStatus.INFEASIBLE:
            if layout.virtual_states.size:
                return ScpStatus.SUBPROBLEM_INFEASIBLE, "infeasible even with free virtual control"
            return ScpStatus.SUBPROBLEM_INFEASIBLE, "infeasible whatever the cost"
        if least.status is SolveStatus.SOLVED:
            size = self._transcription.layout.relative(layout.virtual_control(least.z))
            if size > self._test.virtual_control_tolerance:
                found = f"the subproblem needs a virtual control of {size:.1e} (scaled)"
                return ScpStatus.INFEASIBLE, found
        return ScpStatus.SOLVER_FAILURE, "not infeasible as far as can be told"

    def _finish(
        self, status: ScpStatus, message: str, failed: ConeSolution | None = None
    ) -> ScpResult:
        return ScpResult(
            status=status,
            message=message,
            iterations=tuple(self._iterations),
            parameters=self._parameters,
            initial_reference=self._initial,
            warm_started=self._warm,
            seconds=self._clock() - self._start,
            failed=failed,
        )


def objective(pattern: ConePattern, values: ConeValues, z: Array) -> float:
    """Objective 1/2 z'Qz + c'z of a subproblem."""
    rows, columns = pattern.q.indices, pattern.q.columns
    weight = np.where(rows == columns, 0.5, 1.0)
    return float(np.dot(weight * values.q, z[rows] * z[columns]) + np.dot(values.c, z))


def _virtual_penalty(start: int, pattern: ConePattern, values: ConeValues, z: Array) -> float:
    """Penalty of the virtual control, whose part of Q is diagonal and comes last."""
    first = int(pattern.q.indptr[start])
    return float(0.5 * np.dot(values.q[first:], z[start:] ** 2)) if first < values.q.size else 0.0
