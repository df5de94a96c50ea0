"""What a worker does with a batch of initial states: solve for the best time, or at given times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dscp_core.gradients.envelope import envelope_slope
from dscp_core.gradients.losses import FinalStateLoss
from dscp_core.gradients.run import DifferentiationError, unrolled
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.problem.parameters import Value
from dscp_core.scp.scp import Scp, ScpOptions
from dscp_core.scp.trace import ScpResult, ScpStatus
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

_INFEASIBLE = (ScpStatus.INFEASIBLE, ScpStatus.SUBPROBLEM_INFEASIBLE)


class GradientMethod(Enum):
    """How to differentiate the cost by the terminal time.

    NONE: not. ENVELOPE: partial derivative of the Lagrangian at the converged point, which is the
    derivative of the optimal cost. UNROLLED: through all iterations (section 3.2.2).
    """

    NONE = "none"
    ENVELOPE = "envelope"
    UNROLLED = "unrolled"


@dataclass(frozen=True)
class OptimumModel:
    """The problem whose optimum is learnt. Calling it makes a worker's evaluator.

    Attributes:
        problem: The declaration; its cost is minus the final mass, its last state.
        parameters: Vehicle, mission and algorithm parameters that differ from the defaults, SI.
        intervals: Number of intervals.
    """

    problem: OptimalControlProblem
    parameters: Mapping[str, Value] = field(default_factory=dict)
    intervals: int = 50

    def __call__(self) -> OptimumEvaluator:
        """Compile the problem."""
        return OptimumEvaluator(self)


class Job(Protocol):
    """One item for a worker."""

    def run(self, evaluator: OptimumEvaluator) -> Outcome:
        """Do it."""
        ...


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of a batch of n states.

    Attributes:
        converged: (n,) whether there is a feasible, converged trajectory.
        infeasible: (n,) whether virtual control is left, or a subproblem has no solution.
        terminal_time_s: (n,).
        final_mass_kg: (n,).
        slope_kg_s: (n,) derivative of the cost (minus the final mass, and while infeasible the
            penalty) by the terminal time; NaN where there is none.
        iterations: (n,).
        references: (n, R) scaled reference vectors after the last iteration; without the terminal
            time.
        trusted: (n,) whether the slope can be relied upon.
    """

    converged: NDArray[np.bool_]
    infeasible: NDArray[np.bool_]
    terminal_time_s: Array
    final_mass_kg: Array
    slope_kg_s: Array
    iterations: NDArray[np.intp]
    references: Array
    trusted: NDArray[np.bool_]

    @staticmethod
    def empty(count: int, reference_size: int) -> Outcome:
        """Everything failed so far."""
        return Outcome(
            converged=np.zeros(count, dtype=bool),
            infeasible=np.zeros(count, dtype=bool),
            terminal_time_s=np.full(count, np.nan),
            final_mass_kg=np.full(count, np.nan),
            slope_kg_s=np.full(count, np.nan),
            iterations=np.zeros(count, dtype=np.intp),
            references=np.full((count, reference_size), np.nan),
            trusted=np.zeros(count, dtype=bool),
        )

    @staticmethod
    def join(parts: list[Outcome]) -> Outcome:
        """One outcome of several, in their order."""
        names = Outcome.__dataclass_fields__
        return Outcome(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, eq=False)
class BestTimeJob:
    """Trajectory and terminal time together: the optimum.

    Attributes:
        states: (n, 7).
        options: How to iterate.
        references: (n, R) to start from, as in an outcome, or None.
        times_s: (n,) first guesses, or None.
    """

    states: Array
    options: ScpOptions
    references: Array | None = None
    times_s: Array | None = None

    def run(self, evaluator: OptimumEvaluator) -> Outcome:
        """See `Job.run`."""
        return evaluator.evaluate(self, free=True, method=GradientMethod.NONE)


@dataclass(frozen=True, eq=False)
class GivenTimeJob:
    """Trajectories at given terminal times, and how their cost changes with them.

    Attributes:
        states: (n, 7).
        options: How to iterate.
        times_s: (n,).
        method: How to differentiate.
        references: (n, R) to start from, or None; rows of NaN: the problem's own guess.
    """

    states: Array
    options: ScpOptions
    times_s: Array
    method: GradientMethod = GradientMethod.NONE
    references: Array | None = None

    def run(self, evaluator: OptimumEvaluator) -> Outcome:
        """See `Job.run`."""
        return evaluator.evaluate(self, free=False, method=self.method)


class OptimumEvaluator:
    """Evaluates jobs; keeps the compiled problem between them."""

    def __init__(self, model: OptimumModel) -> None:
        self._model = model
        self._problem = model.problem
        self._base = self._problem.table.pack(model.parameters)
        self._transcriptions: dict[bool, Transcription] = {}

    def __call__(self, job: Job) -> Outcome:
        """Do a job."""
        return job.run(self)

    def evaluate(
        self, job: BestTimeJob | GivenTimeJob, *, free: bool, method: GradientMethod
    ) -> Outcome:
        """Run every state of a job.

        Args:
            job: States and options.
            free: Whether the terminal time is a decision.
            method: How to differentiate.
        """
        if free not in self._transcriptions:
            self._transcriptions[free] = Transcription(
                self._problem, self._model.intervals, free_terminal_time=free
            )
        transcription = self._transcriptions[free]
        # A solver keeps some state between runs. With a fresh one, the result depends on the job
        # alone, and not on what the worker did before.
        scp = Scp(transcription, job.options)
        layout = transcription.layout
        outcome = Outcome.empty(len(job.states), layout.reference_size - layout.offset)
        for row, state in enumerate(job.states):
            packed = self._pack(state, None if job.times_s is None else job.times_s[row])
            start = None
            if job.references is not None and np.all(np.isfinite(job.references[row])):
                start = job.references[row]
                if free:
                    guess = packed[transcription.table.slice(TERMINAL_TIME)] / layout.time_scale
                    start = np.concatenate([guess, start])
            trace = scp.run(packed, start)
            self._store(outcome, row, scp, trace, method)
        return outcome

    def _pack(self, state: Array, time_s: float | None) -> Array:
        changes: dict[str, Value] = {**self._problem.initial_state_values(state)}
        if time_s is not None:
            changes[TERMINAL_TIME] = time_s
        return self._problem.table.pack(changes, base=self._base)

    def _store(
        self, outcome: Outcome, row: int, scp: Scp, trace: ScpResult, method: GradientMethod
    ) -> None:
        transcription, layout = scp.transcription, scp.transcription.layout
        reference = trace.final_reference
        outcome.iterations[row] = len(trace.iterations)
        outcome.terminal_time_s[row] = transcription.terminal_time(reference, trace.parameters)
        outcome.infeasible[row] = trace.status in _INFEASIBLE
        if trace.failed is not None or not trace.iterations:
            return
        last = trace.iterations[-1]
        virtual = layout.relative(last.virtual_control)
        reached = virtual <= scp.virtual_control_tolerance
        done = trace.status in (ScpStatus.CONVERGED, ScpStatus.FIXED_ITERATIONS)
        outcome.converged[row] = done and reached
        outcome.infeasible[row] = not reached
        outcome.final_mass_kg[row] = layout.states(reference)[-1, -1]
        outcome.references[row] = reference[layout.offset :]
        if method is GradientMethod.ENVELOPE:
            outcome.slope_kg_s[row] = envelope_slope(scp, trace)
            outcome.trusted[row] = True
        elif method is GradientMethod.UNROLLED:
            try:
                gradient = unrolled(scp, trace, FinalStateLoss("mass", -1.0))
            except DifferentiationError:
                return
            outcome.slope_kg_s[row] = gradient.parameters[transcription.table.slice(TERMINAL_TIME)][
                0
            ]
            outcome.trusted[row] = gradient.trusted
