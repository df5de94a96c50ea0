"""What a worker does with logged states: gradients for the search, plans for the judgement."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.solvers import SolverSettings
from dscp_core.gradients.envelope import envelope_gradient, envelope_slope
from dscp_core.gradients.run import DifferentiationError, unrolled
from dscp_core.planning.certificate import PlanVerifier
from dscp_core.planning.planner import PlannerSettings, TerminalTime
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.problem.tracing import numeric
from dscp_core.scp.scp import GRADIENT_TOLERANCE, Scp, ScpOptions, ScpResult, ScpStatus
from dscp_core.transcription.transcription import Transcription
from dscp_core.tuning.choice import LossChoice

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

CHUNK = 8
"""States per item: long enough to hide the hand-over, short enough to share out evenly."""


@dataclass(frozen=True)
class TuningModel:
    """What is evaluated. Calling it makes a worker's evaluator.

    Attributes:
        problem: What to plan.
        planner: How to plan it.
        loss: What is minimised.
        fixed_iterations: Iterations of every differentiated run, or None: until it has converged.
        envelope: Differentiate by the multipliers of the converged run instead of through its
            iterations; for a loss that is the cost, and quantities that move the optimum. Runs may
            then start from a trajectory of an earlier one.
    """

    problem: OptimalControlProblem
    planner: PlannerSettings
    loss: LossChoice
    fixed_iterations: int | None = None
    envelope: bool = False

    def __call__(self) -> StateEvaluator:
        """Compile the problem."""
        return StateEvaluator(self)

    @property
    def gradient_options(self) -> ScpOptions:
        """How differentiated runs iterate."""
        options = replace(self.planner.options, deadline_s=None)
        if self.envelope:
            return options
        return replace(
            options,
            polish=True,
            fixed_iterations=self.fixed_iterations or options.fixed_iterations,
            solver_settings=SolverSettings(tolerance=GRADIENT_TOLERANCE),
        )


@dataclass(frozen=True, eq=False)
class Gradients:
    """Losses and gradients of n states.

    Attributes:
        loss: (n,); NaN where there is none.
        gradient: (n, P) by the packed parameters, per SI unit; NaN where it is left out.
        time_slope: (n,) where a given terminal time is infeasible, the derivative of the cost with
            the penalty of the virtual control by it; else NaN.
        iterations: (n,).
        failed: (n,) without a converged, feasible trajectory.
        untrusted: (n,) with a gradient that cannot be relied upon.
        message: Why the first failed one failed, or "".
        references: (n, R) scaled reference vectors of the converged runs, NaN for others; None
            where runs may not start from them.
    """

    loss: Array
    gradient: Array
    time_slope: Array
    iterations: NDArray[np.intp]
    failed: Flags
    untrusted: Flags
    message: str
    references: Array | None


@dataclass(frozen=True, eq=False)
class Plans:
    """Plans of n states, made and certified as the planner does.

    Attributes:
        loss: (n,); NaN where there is none.
        iterations: (n,).
        failed: (n,) without a certified plan.
        untrusted: (n,) with a gradient that cannot be relied upon; false where none was asked for.
        seconds: (n,) wall time of the iterations.
    """

    loss: Array
    iterations: NDArray[np.intp]
    failed: Flags
    untrusted: Flags
    seconds: Array


class Job(Protocol):
    """One item for a worker."""

    def run(self, evaluator: StateEvaluator) -> Gradients | Plans:
        """Do it."""
        ...


@dataclass(frozen=True, eq=False)
class _States:
    """States to evaluate at one set of parameters.

    Attributes:
        states: (n, nx), SI.
        parameters: (P,) packed, SI; their initial state does not count.
        times_s: (n,) terminal times; NaN for that of the parameters.
    """

    states: Array
    parameters: Array
    times_s: Array


@dataclass(frozen=True, eq=False)
class GradientJob(_States):
    """Losses and gradients.

    Attributes:
        references: (n, R) to start from; rows of NaN, and None: the problem's own guess.
    """

    references: Array | None = None

    def run(self, evaluator: StateEvaluator) -> Gradients:
        """See `Job.run`."""
        return evaluator.gradients(self)


@dataclass(frozen=True, eq=False)
class PlanJob(_States):
    """Plans.

    Attributes:
        differentiate: Whether to find out also if the gradients can be trusted.
    """

    differentiate: bool = False

    def run(self, evaluator: StateEvaluator) -> Plans:
        """See `Job.run`."""
        return evaluator.plans(self)


class StateEvaluator:
    """Evaluates jobs; keeps the compiled problem between them."""

    def __init__(self, model: TuningModel) -> None:
        self._model = model
        planner = model.planner
        self._problem = model.problem
        self._transcription = Transcription(
            self._problem,
            planner.intervals,
            free_terminal_time=planner.terminal_time is TerminalTime.FREE,
            discretisation=planner.discretisation,
            hold=planner.hold,
        )
        self._loss = model.loss.make(self._transcription, planner)
        self._verifier = PlanVerifier(self._problem, planner.intervals, hold=planner.hold)

    def __call__(self, job: Job) -> Gradients | Plans:
        """Do a job."""
        return job.run(self)

    def gradients(self, job: GradientJob) -> Gradients:
        """Losses and gradients of the states of a job."""
        count = len(job.states)
        loss, time_slope = np.full(count, math.nan), np.full(count, math.nan)
        gradient = np.full((count, self._problem.table.size), math.nan)
        iterations = np.zeros(count, dtype=np.intp)
        failed, untrusted = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        references = np.full((count, self._transcription.layout.reference_size), math.nan)
        message = ""
        # A solver keeps some state between runs. With a fresh one, the result depends on the job
        # alone, and not on what the worker did before.
        scp = Scp(self._transcription, self._model.gradient_options)
        for row, packed in enumerate(self._packed(job)):
            trace = None
            start = None if job.references is None else job.references[row]
            for trace in self._attempts(scp, packed, start):
                iterations[row] += len(trace.iterations)
                if self._has_loss(scp, trace):
                    break
            failed[row] = trace is None or not self._feasible(scp, trace)
            if trace is None:
                message = message or "the problem's guess from this state is not finite"
            elif failed[row]:
                message = message or f"{trace.status.value}: {trace.message}"
            if trace is not None and self._has_loss(scp, trace):
                loss[row] = self._loss.value(self._transcription, trace)
                references[row] = trace.final_reference
                found = self._differentiate(scp, trace)
                untrusted[row] = found is None
                if found is not None:
                    gradient[row] = found
            elif trace is not None:
                time_slope[row] = self._time_slope(scp, trace)
        kept = references if self._model.envelope else None
        return Gradients(loss, gradient, time_slope, iterations, failed, untrusted, message, kept)

    def plans(self, job: PlanJob) -> Plans:
        """Plans of the states of a job."""
        count = len(job.states)
        loss, seconds = np.full(count, math.nan), np.zeros(count)
        iterations = np.zeros(count, dtype=np.intp)
        failed, untrusted = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        scp = Scp(self._transcription, replace(self._model.planner.options, deadline_s=None))
        for row, packed in enumerate(self._packed(job)):
            failed[row] = True
            for trace in self._attempts(scp, packed):
                iterations[row] += len(trace.iterations)
                seconds[row] += trace.seconds
                failed[row] = not (self._feasible(scp, trace) and self._certified(trace))
                # That of the first run that has one, which is also the one to be differentiated.
                if math.isnan(loss[row]) and self._has_loss(scp, trace):
                    loss[row] = self._loss.value(self._transcription, trace)
                if not failed[row]:
                    break
        if job.differentiate:
            untrusted = self.gradients(
                GradientJob(job.states, job.parameters, job.times_s)
            ).untrusted
        return Plans(loss, iterations, failed, untrusted, seconds)

    def _packed(self, job: _States) -> list[Array]:
        """Packed parameters of every state."""
        time = self._problem.table.slice(TERMINAL_TIME)
        rows = []
        for state, time_s in zip(job.states, job.times_s, strict=True):
            packed = with_initial_state(self._problem, job.parameters, state)
            if math.isfinite(time_s):
                packed[time] = time_s
            rows.append(packed)
        return rows

    def _attempts(
        self, scp: Scp, packed: Array, reference: Array | None = None
    ) -> Iterator[ScpResult]:
        """Runs from a reference, if there is one, and from the problem's guess.

        The latter has the parameters' terminal time and, where it is free, then the problem's own
        guess of it.
        """
        if reference is not None and np.all(np.isfinite(reference)):
            yield scp.run(packed, reference)
        starts = [packed]
        guess = self._problem.terminal_time_guess
        if self._model.planner.terminal_time is TerminalTime.FREE and guess is not None:
            table, state = self._problem.table, self._transcription.initial_state(packed)
            starts.append(packed.copy())
            seconds = numeric("terminal_time_guess", table, guess, packed, state)
            starts[-1][table.slice(TERMINAL_TIME)] = seconds
        for start in starts:
            # A guess that leaves the model, as a flight of an unfit duration may, is no start.
            if np.all(np.isfinite(self._transcription.initial_guess(start))):
                yield scp.run(start)

    def _feasible(self, scp: Scp, trace: ScpResult) -> bool:
        """Whether there is a converged trajectory without virtual control."""
        return trace.succeeded and self._virtual_control(trace) <= scp.virtual_control_tolerance

    def _virtual_control(self, trace: ScpResult) -> float:
        return self._transcription.layout.relative(trace.iterations[-1].virtual_control)

    def _has_loss(self, scp: Scp, trace: ScpResult) -> bool:
        """Whether the loss means something: of the path also where it did not arrive."""
        if self._model.loss.of_the_path:
            return trace.succeeded or trace.status is ScpStatus.ITERATION_LIMIT
        return self._feasible(scp, trace)

    def _differentiate(self, scp: Scp, trace: ScpResult) -> Array | None:
        """Gradient by the packed parameters, or None where it cannot be relied upon."""
        if self._model.envelope:
            return envelope_gradient(scp, trace)
        try:
            gradient = unrolled(scp, trace, self._loss)
        except DifferentiationError:
            return None
        return gradient.parameters if gradient.trusted else None

    def _time_slope(self, scp: Scp, trace: ScpResult) -> float:
        """See `Gradients.time_slope`."""
        given = self._model.planner.terminal_time is not TerminalTime.FREE
        # After a failed subproblem there is no solution with multipliers of the last parameters.
        if not given or trace.failed is not None or not trace.iterations:
            return math.nan
        if self._virtual_control(trace) <= scp.virtual_control_tolerance:
            return math.nan
        return envelope_slope(scp, trace)

    def _certified(self, trace: ScpResult) -> bool:
        layout, final = self._transcription.layout, trace.final_reference
        time = self._transcription.terminal_time(final, trace.parameters)
        times = np.linspace(0.0, time, layout.intervals + 1)
        return self._verifier.certify(
            times, layout.states(final), layout.controls(final), trace.parameters
        ).passed


def with_initial_state(problem: OptimalControlProblem, packed: Array, state: Array) -> Array:
    """Packed parameters with another initial state.

    Args:
        problem: Whose parameters they are.
        packed: (P,), SI.
        state: (nx,), SI.
    """
    changed = packed.copy()
    for name, value in problem.initial_state_values(state).items():
        changed[problem.table.slice(name)] = value
    return changed
