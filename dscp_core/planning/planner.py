"""From a state to a certified plan: terminal time, warm start, SCP, certificate."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.gradient import Gradient, Method
from dscp_core.gradients.losses import Loss
from dscp_core.gradients.quantities import quantity
from dscp_core.planning.attempt import Attempt, Start
from dscp_core.planning.certificate import PlanVerifier
from dscp_core.planning.differentiation import (
    Certifier,
    differentiable,
    plan_gradient,
    suited_method,
)
from dscp_core.planning.fallback import Fallback
from dscp_core.planning.least_time import fastest
from dscp_core.planning.plan import PlanOutcome, PlanStatus, TerminalTime
from dscp_core.planning.remainder import Remainder
from dscp_core.planning.settings import PlannerSettings, TerminalTimePredictor
from dscp_core.problem import checks
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.problem.parameters import Value
from dscp_core.problem.tracing import Tracer, numeric
from dscp_core.problem.trajectory import Plan
from dscp_core.scp.scp import Scp, ScpStatus
from dscp_core.transcription.stages import terminal_time_bounds
from dscp_core.transcription.transcription import Transcription

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dscp_core.gradients.plan_layer import PlanLayer

__all__ = ["Planner", "PlannerSettings", "TerminalTime", "TerminalTimePredictor"]

Array = NDArray[np.float64]

_FINAL = (PlanStatus.CERTIFIED, PlanStatus.DEADLINE)
"""After these there is no reason, or no time, for another start."""


class Planner:
    """Makes plans for one problem; keeps all symbolic work between plans.

    Not safe for plans from several threads at once.

    Example:
        >>> from dscp_core import Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> planner.plan().headline
        'certified, converged: terminal time 32.81 s (fixed), cost -31760.37 kg,
        at most 0... kg to gain'
        >>> planner.state_names
        ('x', 'y', 'z', 'vx', 'vy', 'vz', 'mass')
        >>> planner.plan([4000.0, 400.0, 400.0, -90.0, 30.0, -30.0, 38000.0]).certified
        True
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        settings: PlannerSettings | None = None,
        predictor: TerminalTimePredictor | None = None,
        *,
        vehicle: str | Path | None = None,
        parameters: Mapping[str, Value] | None = None,
        clock: Callable[[], float] = time.perf_counter,
        **changes: Any,
    ) -> None:
        """Compile the problem.

        Args:
            problem: The declaration, for example from `dscp_core.problems.get`.
            settings: How to plan; None for what suits the problem.
            predictor: Needed for, and only for, `TerminalTime.PREDICTED`.
            vehicle: YAML file of parameter names and SI values, which win over the settings'.
            parameters: Values by name, SI, which win over both.
            clock: Seconds, by which deadlines and times are told.
            **changes: Other settings by name, such as ``intervals=20``, which win.

        Raises:
            InvalidInputError: Unknown parameter or value, a file that cannot be used, a missing
                predictor, or no problem.
        """
        if not isinstance(problem, OptimalControlProblem):
            raise InvalidInputError(
                "problem", problem, "an OptimalControlProblem; problems.get(NAME) gives one"
            )
        settings = PlannerSettings.suited(problem) if settings is None else settings
        known = settings.parameters
        changed = {} if vehicle is None else problem.read_vehicle(vehicle, known)
        changed |= parameters or {}
        settings = replace(settings, **changes, parameters={**settings.parameters, **changed})
        if (settings.terminal_time is TerminalTime.PREDICTED) != (predictor is not None):
            raise InvalidInputError(
                "predictor",
                type(predictor).__name__,
                f"given exactly when terminal_time ({settings.terminal_time.value}) is predicted",
            )
        self.settings = settings
        self._predictor = predictor
        self._clock = clock
        self.problem = problem
        self.parameters = self.problem.pack(settings.parameters)
        self.scp = self._loop(free=settings.terminal_time is TerminalTime.FREE)
        self.transcription = self.scp.transcription
        # Where the predictor does not help; compiled now, as no deadline has time for it.
        self._free = self.scp if predictor is None else self._loop(free=True)
        self._verifier = PlanVerifier(self.problem, settings.intervals, hold=settings.hold)
        self._verifier.require_checkable(self.parameters)
        self._time = self.problem.table.slice(TERMINAL_TIME)
        self.time_bounds_s = self._bounds_of_time()
        self._fallback: Fallback | None = None
        if settings.best_effort:
            self._fallback = Fallback(self._loop(free=True), self._verifier, self.time_bounds_s)

    def __reduce__(self) -> tuple[Any, ...]:
        """By what it was made of; the copy compiles its own functions, and has the usual clock."""
        return Planner, (self.problem, self.settings, self._predictor)

    def _loop(self, *, free: bool) -> Scp:
        transcription = Transcription(
            self.problem,
            self.settings.intervals,
            free_terminal_time=free,
            discretisation=self.settings.discretisation,
            hold=self.settings.hold,
        )
        return Scp(transcription, self.settings.options, self._clock)

    def _bounds_of_time(self) -> tuple[float, float]:
        """Least and greatest terminal time where it is free, in seconds.

        Raises:
            InvalidInputError: They are in the wrong order, or not positive.
        """
        table = self.problem.table
        values = {n: ca.SX(v) for n, v in table.unpack(self.parameters).items()}
        pair = terminal_time_bounds(self.problem, Tracer(table), values)
        low, high = (float(bound) for bound in pair)
        if not 0.0 < low <= high:
            raise InvalidInputError(
                "terminal_time_bounds", (low, high), "0 < least <= greatest, in seconds"
            )
        return low, high

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in the order of every state vector."""
        return tuple(s.name for s in self.problem.states)

    @property
    def initial_state(self) -> Array:
        """Initial state of the settings' parameters, (nx,), SI."""
        return self.transcription.initial_state(self.parameters)

    def check_state(self, state: Array | Sequence[float]) -> Array:
        """Packed parameters with this initial state.

        Args:
            state: (nx,), SI, in the order of `state_names`.

        Raises:
            InvalidInputError: Wrong length, not finite, out of bounds, refused by the problem, or
                another than the problem's own where no parameters hold it.
        """
        try:
            state = np.asarray(state, dtype=np.float64)
        except (TypeError, ValueError):
            raise InvalidInputError("state", state, "numbers") from None
        if state.shape != (len(self.problem.states),):
            raise InvalidInputError(
                "state", f"shape {state.shape}", f"shape ({len(self.problem.states)},)"
            )
        for name, value in zip(self.state_names, state, strict=True):
            if not math.isfinite(value):
                raise InvalidInputError(name, float(value), "finite")
        table = self.problem.table
        packed = table.pack(self.problem.initial_state_values(state), base=self.parameters)
        given = self.transcription.initial_state(packed)
        if np.any(np.abs(given - state) > 1e-9 * self.transcription.layout.state_scale):
            raise InvalidInputError(
                "state", state.tolist(), f"{given.tolist()}: no initial_state_parameters hold it"
            )
        self.problem.require_start(state, packed)
        return packed

    def plan(
        self,
        state: Array | Sequence[float] | None = None,
        *,
        deadline_s: float | None = None,
        warm_start: Plan | None = None,
        elapsed_s: float = 0.0,
    ) -> PlanOutcome:
        """Plan from a state.

        A warm start that does not lead to a certified plan is followed by a cold one, and with a
        free terminal time by another from the problem's own guess of it, as far as the deadline
        allows. So is a prediction: all that follows it, and all for a state that the predictor
        does not know, has a free terminal time. Where nothing leads to a certified plan, a best
        effort follows if the settings ask for it, in what is left of the deadline.

        Args:
            state: (nx,), SI, in the order of `state_names`; None for `initial_state`.
            deadline_s: Wall time for the SCP iterations, or None.
            warm_start: A plan of the same vehicle to start from, if the state is near it.
            elapsed_s: Flight time between that plan's start and this state.
        """
        state = self.initial_state if state is None else state
        attempt = Attempt(self.problem, self._verifier, self._clock, deadline_s)
        source = self.settings.terminal_time
        try:
            packed = self.check_state(state)
        except InvalidInputError as error:
            return attempt.invalid(str(error), self.parameters, source)
        state = np.asarray(state, dtype=np.float64)
        layout = self.transcription.layout
        left = Remainder.of(warm_start, self.problem.name, elapsed_s, state, layout)
        outcome = self._attempted(attempt, state, packed, left)
        if outcome.certified or self._fallback is None:
            return outcome
        return self._fallback.of(attempt, outcome, state, packed, left, source)

    def _attempted(
        self, attempt: Attempt, state: Array, packed: Array, left: Remainder | None
    ) -> PlanOutcome:
        """Outcome of the runs that the settings ask for."""
        source = self.settings.terminal_time
        if self._predictor is not None:
            try:
                attempt.predicted_s = self._predict(self._predictor, state)
            except InvalidInputError as error:
                attempt.reason = str(error)
            else:
                outcome = attempt.run(self._predicted(state, packed, attempt.predicted_s, left))
                if outcome.status in _FINAL:
                    return outcome
                attempt.reason = (
                    f"no plan in the predicted {attempt.predicted_s:.3f} s: {outcome.message}"
                )
            source = TerminalTime.FREE
        return self._first_certified(attempt, self._starts(state, packed, left, source))

    def _first_certified(self, attempt: Attempt, starts: Iterator[Start]) -> PlanOutcome:
        """Outcome of the first start that leads to a certified plan.

        Without any, that of the last, unless an earlier one converged and says more.
        """
        uncertified: PlanOutcome | None = None
        for start in starts:
            outcome = attempt.run(start)
            if outcome.status is PlanStatus.CERTIFIED:
                return outcome
            if outcome.status is PlanStatus.NOT_CERTIFIED:
                uncertified = outcome
            if outcome.status is PlanStatus.DEADLINE:
                break
        return outcome if uncertified is None else attempt.with_all_runs(uncertified)

    def _predict(self, predictor: TerminalTimePredictor, state: Array) -> float:
        """Prediction within the bounds of a free terminal time.

        Raises:
            InvalidInputError: The predictor does not know the state, or is out of bounds.
        """
        declared = self.problem.table[TERMINAL_TIME]
        seconds = float(declared.validate(predictor.predict(state))[0])
        low, high = self.time_bounds_s
        if not low <= seconds <= high:
            raise InvalidInputError("predicted terminal time", seconds, f"{low:g} to {high:g} s")
        return seconds

    def _predicted(
        self, state: Array, packed: Array, predicted_s: float, left: Remainder | None
    ) -> Start:
        """Start with the predicted terminal time: from a plan that is near, else cold."""
        packed = self._with_time(packed, predicted_s)
        reference = None
        if left is not None and left.helps(TerminalTime.PREDICTED):
            reference = left.reference(state, self.transcription.layout, predicted_s)
        return Start(self.scp, packed, reference, TerminalTime.PREDICTED)

    def _starts(
        self, state: Array, packed: Array, left: Remainder | None, source: TerminalTime
    ) -> Iterator[Start]:
        """What to start from with a fixed or free terminal time, the most promising first."""
        free = source is TerminalTime.FREE
        scp = self._free if free else self.scp
        if left is not None and left.helps(source):
            packed = self._with_time(packed, left.seconds)
            reference = left.reference(state, scp.transcription.layout, left.seconds)
            yield Start(scp, packed, reference, source)
        yield Start(scp, packed, None, source)
        guess = self.problem.terminal_time_guess
        if free and guess is not None:
            seconds = numeric("terminal_time_guess", self.problem.table, guess, packed, state)
            checks.positive("terminal_time_guess", seconds)
            yield Start(scp, self._with_time(packed, seconds), None, source)

    def gradient(
        self, of: str | Loss, *, at: PlanOutcome | None = None, method: Method | None = None
    ) -> Gradient:
        """Gradient of a plan by every parameter that it was made with.

        The implicit method, which is the default, iterates from the plan's own trajectory until it
        stands still, with polished and tightly solved subproblems, and differentiates that fixed
        point: the optimum of the discretised problem, whatever the way there. It is zero for
        parameters of the algorithm. The unrolled method, the default for ``"convergence"``, runs
        again from the problem's guess and differentiates these K iterations. A terminal time that
        is fixed or predicted is held fixed but for its own derivative; a free one moves along with
        the optimum. The number of intervals is fixed. The gradient is not trusted where no feasible
        plan is there, where what is differentiated is not the plan any more, or at a saddle of a
        cost whose expansion is convexified.

        Args:
            of: ``"cost"``; a state's name, for its final value; ``"convergence"``, the sum of
                ``|J_k - J_K|`` over the iterations; or any loss.
            at: Outcome of `plan`, whose state, terminal time and vehicle count, not this
                planner's; None for a plan from `initial_state`.
            method: How to differentiate; None for the default.

        Raises:
            DifferentiationError: There is no plan, or its run has no gradient.
            InvalidInputError: A plan of another problem or with other intervals, no outcome, an
                unknown quantity, or one that the method cannot differentiate.
        """
        outcome = self.plan() if at is None else at
        if not isinstance(outcome, PlanOutcome):
            raise InvalidInputError("at", f"a {type(outcome).__name__}", "an outcome of plan()")
        free = outcome.terminal_time_source is TerminalTime.FREE
        return plan_gradient(self._free if free else self.scp, outcome, of, method)

    def layer(
        self, of: str | Loss, inputs: Sequence[str], *, method: Method | None = None
    ) -> PlanLayer:
        """A PyTorch module from named tensors to a scalar of the plans, one per sample.

        Args:
            of: See `gradient`.
            inputs: Names of parameters that vary; ``"initial_state"`` for all that hold it.
            method: See `gradient`.

        Raises:
            InvalidInputError: An unknown name.
        """
        from dscp_core.gradients.plan_layer import PlanLayer

        loss = quantity(self.problem, of).loss
        scp = differentiable(self.scp)
        certify = Certifier(scp, self.settings.hold)
        chosen = suited_method(loss, method)
        return PlanLayer(scp, inputs, loss, self.parameters, chosen, certify)

    def figure(self, outcome: PlanOutcome, title: str | None = None) -> Figure:
        """The plan of an outcome, or its best effort, as made and as it went when it was flown.

        Args:
            outcome: With a plan.
            title: Headline; by default the problem and the outcome's headline.

        Raises:
            InvalidInputError: There is no plan.
        """
        from dscp_core.planning.histories import outcome_figure

        return outcome_figure(self.problem, outcome, title)

    def least_terminal_time(self, state: Array) -> float | None:
        """Least feasible terminal time of a state in seconds, or None when none was found.

        Raises:
            InvalidInputError: Invalid state.
        """
        if not self.problem.least_time_parameters:
            return None
        search = Planner(self.problem, fastest(self.settings, self.problem.least_time_parameters))
        result = search.scp.run(search.check_state(state))
        if result.status is not ScpStatus.CONVERGED:
            return None
        return search.transcription.terminal_time(result.final_reference, result.parameters)

    def _with_time(self, packed: Array, seconds: float) -> Array:
        changed = packed.copy()
        changed[self._time] = seconds
        return changed
