"""From a state to a certified plan: terminal time, warm start, SCP, certificate."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.ocp import TERMINAL_TIME
from dscp_core.parameters import Value
from dscp_core.plan import Plan, PlanOutcome, PlanStatus
from dscp_core.scp import Iteration, Scp, ScpOptions, ScpResult, ScpStatus
from dscp_core.transcription import Transcription
from dscp_core.verification import ControlHold, PlanVerifier

Array = NDArray[np.float64]

# Of a plan's flight time; with less than this left, its grid is too coarse to start from.
_LEAST_REMAINING = 0.05

_STATUS = {
    ScpStatus.INFEASIBLE: PlanStatus.INFEASIBLE,
    ScpStatus.SUBPROBLEM_INFEASIBLE: PlanStatus.INFEASIBLE,
    ScpStatus.ITERATION_LIMIT: PlanStatus.ITERATION_LIMIT,
    ScpStatus.DEADLINE: PlanStatus.DEADLINE,
    ScpStatus.SOLVER_FAILURE: PlanStatus.SOLVER_FAILURE,
    ScpStatus.DIVERGED: PlanStatus.SOLVER_FAILURE,
}


class TerminalTime(Enum):
    """Where the terminal time comes from.

    FIXED: the parameter ``terminal_time``, and after the first plan what is left of it. FREE: a
    decision of the subproblems. PREDICTED: a `TerminalTimePredictor`.
    """

    FIXED = "fixed"
    FREE = "free"
    PREDICTED = "predicted"


class TerminalTimePredictor(Protocol):
    """Predicts the optimal terminal time of a state."""

    def predict(self, state: Array) -> float:
        """Terminal time in seconds for a state (nx,), SI."""
        ...


@dataclass(frozen=True)
class PlannerSettings:
    """What to plan and how.

    Attributes:
        problem: Name of the problem.
        formulation: Its formulation, or None for the default.
        parameters: Vehicle, mission and algorithm parameters that differ from the defaults, SI.
        intervals: Number N of intervals.
        terminal_time: Where the terminal time comes from.
        hold: How the certificate flies the controls between the nodes.
        options: How to iterate; its deadline is set for every plan.
    """

    problem: str = "powered_descent"
    formulation: str | None = None
    parameters: Mapping[str, Value] = field(default_factory=dict)
    intervals: int = 50
    terminal_time: TerminalTime = TerminalTime.FIXED
    hold: ControlHold = ControlHold.MEAN
    options: ScpOptions = field(default_factory=ScpOptions)


class Planner:
    """Makes plans for one problem; keeps all symbolic work between plans.

    Not safe for plans from several threads at once.
    """

    def __init__(
        self, settings: PlannerSettings, predictor: TerminalTimePredictor | None = None
    ) -> None:
        """Compile the problem.

        Args:
            settings: What to plan and how.
            predictor: Needed for, and only for, `TerminalTime.PREDICTED`.

        Raises:
            InvalidInputError: Unknown problem, parameter or value, or a missing predictor.
        """
        if (settings.terminal_time is TerminalTime.PREDICTED) != (predictor is not None):
            raise InvalidInputError(
                "predictor",
                type(predictor).__name__,
                f"given exactly when terminal_time ({settings.terminal_time.value}) is predicted",
            )
        self.settings = settings
        self._predictor = predictor
        self.problem = problems.get(settings.problem, settings.formulation)
        self.transcription = Transcription(
            self.problem,
            settings.intervals,
            free_terminal_time=settings.terminal_time is TerminalTime.FREE,
        )
        self.parameters = self.problem.pack(settings.parameters)
        self.scp = Scp(self.transcription, settings.options)
        self._verifier = PlanVerifier(self.problem, settings.intervals, hold=settings.hold)
        self._time = self.problem.table.slice(TERMINAL_TIME)
        self._state_slices = [
            self.problem.table.slice(name) for name in self.problem.initial_state_parameters
        ]

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in the order of every state vector."""
        return tuple(s.name for s in self.problem.states)

    @property
    def initial_state(self) -> Array:
        """Initial state of the settings' parameters, (nx,), SI."""
        return np.concatenate([self.parameters[part] for part in self._state_slices])

    def check_state(self, state: Array) -> Array:
        """Packed parameters with this initial state.

        Args:
            state: (nx,), SI, in the order of `state_names`.

        Raises:
            InvalidInputError: Wrong length, not finite, out of bounds, or below ground.
        """
        state = np.asarray(state, dtype=np.float64)
        if state.shape != (len(self.problem.states),):
            raise InvalidInputError(
                "state", f"shape {state.shape}", f"shape ({len(self.problem.states)},)"
            )
        for name, value in zip(self.state_names, state, strict=True):
            if not math.isfinite(value):
                raise InvalidInputError(name, float(value), "finite")
        table, start = self.problem.table, 0
        changed: dict[str, Value] = {}
        for name in self.problem.initial_state_parameters:
            part = state[start : start + table[name].size]
            changed[name] = part
            start += part.size
        packed = table.pack(changed, base=self.parameters)
        if self.problem.check_state is not None:
            self.problem.check_state(state, table.unpack(packed))
        return packed

    def plan(
        self,
        state: Array,
        *,
        deadline_s: float | None = None,
        warm_start: Plan | None = None,
        elapsed_s: float = 0.0,
    ) -> PlanOutcome:
        """Plan from a state.

        A warm start that does not lead to a certified plan is followed by a cold one, and with a
        free terminal time by another from the problem's own guess of it, as far as the deadline
        allows.

        Args:
            state: (nx,), SI, in the order of `state_names`.
            deadline_s: Wall time for the SCP iterations, or None.
            warm_start: A plan of the same vehicle to start from.
            elapsed_s: Flight time between that plan's start and this state.
        """
        started = time.perf_counter()
        attempt = _Attempt(self, started, deadline_s)
        try:
            packed = self.check_state(state)
            predicted = self._predict(state)
        except InvalidInputError as error:
            return attempt.invalid(str(error), float(self._terminal_time(self.parameters)))
        if predicted is not None:
            packed[self._time] = predicted
        outcome: PlanOutcome | None = None
        for start in self._starts(state, packed, predicted, warm_start, elapsed_s):
            outcome = attempt.run(*start, predicted)
            if outcome.status in (PlanStatus.CERTIFIED, PlanStatus.DEADLINE):
                break
        assert outcome is not None  # there is always a cold start
        return outcome

    def _starts(
        self,
        state: Array,
        packed: Array,
        predicted: float | None,
        warm_start: Plan | None,
        elapsed_s: float,
    ) -> Iterator[tuple[Array, Array | None]]:
        """Parameters and reference to start from, the most promising first."""
        if warm_start is not None and warm_start.problem == self.problem.name:
            remaining = warm_start.terminal_time_s - elapsed_s
            if elapsed_s >= 0.0 and remaining > _LEAST_REMAINING * warm_start.terminal_time_s:
                packed = packed.copy()
                if predicted is None:
                    packed[self._time] = remaining
                yield packed, self._resample(warm_start, elapsed_s, state, packed)
        yield packed, None
        guess = self.problem.terminal_time_guess
        if self.settings.terminal_time is TerminalTime.FREE and guess is not None:
            packed = packed.copy()
            packed[self._time] = guess(state, self.problem.table.unpack(packed))
            yield packed, None

    def least_terminal_time(self, state: Array) -> float | None:
        """Least feasible terminal time of a state in seconds, or None when none was found.

        Raises:
            InvalidInputError: Invalid state.
        """
        if not self.problem.least_time_parameters:
            return None
        settings = replace(
            self.settings,
            terminal_time=TerminalTime.FREE,
            parameters={**self.settings.parameters, **self.problem.least_time_parameters},
            # The fastest descent converges slowly; 1e-4 s is enough.
            options=replace(
                self.settings.options,
                max_iterations=50,
                fixed_iterations=None,
                cost_tolerance=3e-6,
            ),
        )
        fastest = Planner(settings)
        result = fastest.scp.run(fastest.check_state(state))
        if result.status is not ScpStatus.CONVERGED:
            return None
        return fastest.transcription.terminal_time(result.final_reference, result.parameters)

    def _predict(self, state: Array) -> float | None:
        if self._predictor is None:
            return None
        declared = self.problem.table[TERMINAL_TIME]
        return float(declared.validate(self._predictor.predict(state))[0])

    def _terminal_time(self, packed: Array) -> float:
        return float(packed[self._time][0])

    def _resample(self, plan: Plan, elapsed_s: float, state: Array, packed: Array) -> Array:
        """Reference vector from what is left of a plan, stretched to the new terminal time."""
        moments = np.linspace(elapsed_s, plan.terminal_time_s, self.settings.intervals + 1)
        states, controls = (
            np.column_stack([np.interp(moments, plan.times_s, column) for column in table.T])
            for table in (plan.states, plan.controls)
        )
        states[0] = state
        layout = self.transcription.layout
        return layout.reference(states, controls, self._terminal_time(packed))


class _Attempt:
    """One call of `Planner.plan`: its runs share one deadline."""

    def __init__(self, planner: Planner, started: float, deadline_s: float | None) -> None:
        self._planner = planner
        self._started = started
        self._deadline_s = deadline_s
        self._iterations = 0
        self._solver_time = 0.0

    def invalid(self, message: str, terminal_time_s: float) -> PlanOutcome:
        """Outcome for a state that was refused."""
        return PlanOutcome(
            status=PlanStatus.INVALID_STATE,
            message=message,
            plan=None,
            certificate=None,
            iterations=0,
            solve_time_s=time.perf_counter() - self._started,
            solver_time_s=0.0,
            virtual_control=math.inf,
            max_defect=math.inf,
            cost=math.inf,
            terminal_time_predicted_s=None,
            terminal_time_used_s=terminal_time_s,
            warm_started=False,
            solver="",
        )

    def run(self, packed: Array, reference: Array | None, predicted: float | None) -> PlanOutcome:
        """Iterate, choose an iterate, certify it."""
        planner = self._planner
        scp = planner.scp
        if self._deadline_s is not None:
            left = self._deadline_s - (time.perf_counter() - self._started)
            scp = scp.with_options(deadline_s=max(left, 1e-6))
        result = scp.run(packed, reference)
        self._iterations += len(result.iterations)
        self._solver_time += sum(i.solve_seconds for i in result.iterations)
        if result.failed is not None:
            self._solver_time += result.failed.seconds
        chosen = self._choose(result)
        if chosen is None:
            return self._outcome(result, None, predicted)
        return self._outcome(result, chosen, predicted)

    def _choose(self, result: ScpResult) -> Iteration | None:
        """The last iterate that satisfies the dynamics, else the last one."""
        if not result.iterations:
            return None
        options = self._planner.settings.options
        for iteration in reversed(result.iterations):
            if self._relative(iteration.defects) <= 10.0 * options.defect_tolerance:
                return iteration
        return result.iterations[-1]

    def _relative(self, residual: Array) -> float:
        return float(np.max(np.abs(residual) / self._planner.transcription.layout.state_scale))

    def _outcome(
        self, result: ScpResult, chosen: Iteration | None, predicted: float | None
    ) -> PlanOutcome:
        planner, transcription = self._planner, self._planner.transcription
        status = _STATUS.get(result.status, PlanStatus.CERTIFIED)
        message = f"{result.status.value}: {result.message}"
        plan, certificate = None, None
        used = transcription.terminal_time(result.final_reference, result.parameters)
        if chosen is not None:
            plan = self._plan(chosen.solution.z, result.parameters)
            used = plan.terminal_time_s
            certificate = planner._verifier.certify(
                plan.times_s, plan.states, plan.controls, result.parameters
            )
            if status in (PlanStatus.CERTIFIED, PlanStatus.ITERATION_LIMIT, PlanStatus.DEADLINE):
                if certificate.passed:
                    status = PlanStatus.CERTIFIED
                elif status is PlanStatus.CERTIFIED:
                    status = PlanStatus.NOT_CERTIFIED
            if not certificate.passed:
                message += "; certificate: " + "; ".join(certificate.reasons)
        last = result.failed or (result.iterations[-1].solution if result.iterations else None)
        return PlanOutcome(
            status=status,
            message=message,
            plan=plan,
            certificate=certificate,
            iterations=self._iterations,
            solve_time_s=time.perf_counter() - self._started,
            solver_time_s=self._solver_time,
            virtual_control=math.inf if chosen is None else self._relative(chosen.virtual_control),
            max_defect=math.inf if chosen is None else self._relative(chosen.defects),
            cost=math.inf if chosen is None else chosen.cost,
            terminal_time_predicted_s=predicted,
            terminal_time_used_s=used,
            warm_started=result.warm_started,
            solver="" if last is None else last.solver,
        )

    def _plan(self, z: Array, packed: Array) -> Plan:
        planner, layout = self._planner, self._planner.transcription.layout
        terminal_time = planner.transcription.terminal_time(z, packed)
        states, controls = layout.states(z), layout.controls(z)
        return Plan(
            problem=planner.problem.name,
            state_names=planner.state_names,
            control_names=tuple(c.name for c in planner.problem.controls),
            control_states=planner.problem.control_states,
            times_s=np.linspace(0.0, terminal_time, layout.intervals + 1),
            states=states,
            controls=controls,
            state_rates=planner._verifier.rates(states, controls, packed),
            terminal_time_s=terminal_time,
        )
