"""What a planner returns with an outcome that is not certified: a best effort, in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.planning.attempt import Attempt, Start
from dscp_core.planning.best_effort import LeastViolation, Reached
from dscp_core.planning.certificate import PlanCertificate, PlanVerifier
from dscp_core.planning.plan import BestEffort, PlanOutcome, TerminalTime
from dscp_core.planning.relaxation import Relaxation
from dscp_core.planning.remainder import Remainder
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.problem.tracing import numeric
from dscp_core.scp.scp import Scp

Array = NDArray[np.float64]

_FACTORS = (1.0, 0.5, 2.0)
"""First guesses of the terminal time, in units of the problem's own."""
_SOONER = (0.25, 0.125, 0.0625)
"""Where those lead nowhere, as where what the problem guesses is kept above a least time."""
_SAME_TIME = 1e-6
"""What solvers leave, relative."""


class Fallback:
    """Makes best efforts for one planner; compiled when it is made.

    Attributes:
        least: Finds them.
    """

    def __init__(
        self, free: Scp, verifier: PlanVerifier, time_bounds_s: tuple[float, float]
    ) -> None:
        """Compile the relaxed problem.

        Args:
            free: Loop of the problem with a free terminal time.
            verifier: Flies and checks plans.
            time_bounds_s: Least and greatest terminal time where it is free.

        Raises:
            InvalidInputError: The problem declares no concessions.
        """
        self._free, self._verifier, self._time_bounds_s = free, verifier, time_bounds_s
        self._problem = free.transcription.problem
        relaxation = Relaxation.of(self._problem, free.transcription.costs.models)
        if relaxation is None:
            raise InvalidInputError(
                "best_effort", True, f"false: {_called(self._problem)} declares no concessions"
            )
        self._relaxation = relaxation
        self.least = LeastViolation(relaxation, free)

    def of(
        self,
        attempt: Attempt,
        outcome: PlanOutcome,
        state: Array,
        packed: Array,
        left: Remainder | None,
        source: TerminalTime,
    ) -> PlanOutcome:
        """The outcome with the best effort, or that of a feasible plan which it led to.

        Args:
            attempt: In which the outcome was found; its deadline holds on.
            outcome: Not certified.
            state: (nx,) planned from, SI.
            packed: Packed parameters of the attempt.
            left: Of a plan to start from, or None.
            source: Where the terminal time is to come from; FIXED makes another one a violation.
        """
        widened = self.least.widened(state, packed)
        values = {**self._problem.table.unpack(packed), **widened}
        changed = self._problem.table.pack(values)
        reached = self.least.find(
            changed,
            self._starts(state, packed, left),
            attempt.left_s,
            attempt.count,
            self._sooner(state, packed),
        )
        if reached is None:
            words = "deadline" if attempt.left_s() == 0.0 else self._nothing()
            message = f"{outcome.message}; no best effort: {words}"
            return attempt.with_all_runs(replace(outcome, message=message))
        if (
            source is not TerminalTime.FIXED
            and not widened
            and not self.least.short(reached, packed)
        ):
            reference = self._free.transcription.layout.reference(
                reached.states, reached.controls, reached.terminal_time_s
            )
            again = attempt.run(Start(self._free, packed, reference, TerminalTime.FREE))
            if again.certified:
                return again
        plan = attempt.plan_of(reached.states, reached.controls, reached.terminal_time_s, packed)
        certificate = self._verifier.certify(plan.times_s, plan.states, plan.controls, packed)
        effort = BestEffort(
            plan=plan,
            certificate=certificate,
            violations=self._violations(outcome, certificate, reached, packed, widened, source),
            steps=self._steps(reached),
        )
        return attempt.with_all_runs(replace(outcome, best_effort=effort))

    def _starts(
        self, state: Array, packed: Array, left: Remainder | None
    ) -> Iterator[tuple[float, Array | None]]:
        """First terminal times and references, the most promising first."""
        if left is not None and left.helps(TerminalTime.FREE):
            layout = self._free.transcription.layout
            reference = left.reference(state, layout, left.seconds)
            extended = self._relaxation.extended(
                layout.states(reference), layout.controls(reference)
            )
            yield left.seconds, self.least.layout.reference(*extended, left.seconds)
        guessed, given = self._guess(state, packed), self._given(packed)
        for factor in _FACTORS:
            yield factor * guessed, None
        if given != guessed:
            yield given, None

    def _sooner(self, state: Array, packed: Array) -> Iterator[tuple[float, Array | None]]:
        """Where those lead nowhere: an end that comes far sooner than is allowed or asked for."""
        guessed = self._guess(state, packed)
        for factor in _SOONER:
            yield factor * guessed, None

    def _guess(self, state: Array, packed: Array) -> float:
        """The problem's guess of the terminal time, or else the parameter, in seconds."""
        problem, guess = self._problem, self._problem.terminal_time_guess
        if guess is None:
            return self._given(packed)
        return float(numeric("terminal_time_guess", problem.table, guess, packed, state))

    def _given(self, packed: Array) -> float:
        return float(packed[self._problem.table.slice(TERMINAL_TIME)][0])

    def _nothing(self) -> str:
        """Why there is none, as far as can be told."""
        freed = self._relaxation.concessions.freed
        pinned = [name for name in self._problem.final_state if name not in freed]
        ends = f" to the final {', '.join(pinned)}" if pinned else ""
        return f"no iterations led{ends} within the limits that do not give way"

    def _violations(
        self,
        outcome: PlanOutcome,
        certificate: PlanCertificate,
        reached: Reached,
        packed: Array,
        widened: Mapping[str, float],
        source: TerminalTime,
    ) -> tuple[str, ...]:
        """What the plan violates and by how much, one line each, the gravest first."""
        lines = [
            f"{shortfall.name} {error:.4g} {shortfall.unit}"
            for shortfall, error in zip(
                self._relaxation.concessions.shortfalls, reached.errors, strict=True
            )
            # What the bound of later steps allows is no shortfall.
            if error > 2.0 * shortfall.tolerance
        ]
        lines += certificate.reasons
        values = self._problem.table.unpack(packed)
        lines += self._of_time(reached.terminal_time_s, float(values[TERMINAL_TIME]), source)
        for name, value in widened.items():
            unit = self._problem.table[name].unit
            lines.append(
                f"{name} {values[name]:.4g} {unit} was widened to {value:.4g} for this start"
            )
        # Else nothing says why this is no plan.
        return tuple(lines) or (outcome.message,)

    def _of_time(self, seconds: float, asked_s: float, source: TerminalTime) -> list[str]:
        """In which way the terminal time is not what was asked for."""
        fixed = source is TerminalTime.FIXED
        low, high = (asked_s, asked_s) if fixed else self._time_bounds_s
        if (1.0 - _SAME_TIME) * low <= seconds <= (1.0 + _SAME_TIME) * high:
            return []
        if fixed:
            return [f"{TERMINAL_TIME} {seconds:.5g} s is not the {asked_s:.5g} s asked for"]
        return [f"{TERMINAL_TIME} {seconds:.5g} s is not within {low:.5g} to {high:.5g} s"]

    def _steps(self, reached: Reached) -> tuple[str, ...]:
        """What was made least, with what it came to."""
        found = [
            f"{shortfall.name} {error:.4g} {shortfall.unit}"
            for shortfall, error in zip(
                self._relaxation.concessions.shortfalls, reached.errors, strict=True
            )
        ]
        unit = "" if self._problem.cost_unit == "1" else f" {self._problem.cost_unit}"
        found.append(f"cost {reached.cost:.7g}{unit}")
        done = [*reached.converged, *(None,) * (len(found) - len(reached.converged))]
        return tuple(_step(text, state) for text, state in zip(found, done, strict=True))


def _step(text: str, converged: bool | None) -> str:
    if converged is None:
        return f"{text} (not made least: no time left, or no convergence)"
    return text if converged else f"{text} (NOT CONVERGED)"


def _called(problem: OptimalControlProblem) -> str:
    form = f" ({problem.formulation})" if problem.formulation else ""
    return f"{problem.name}{form}"
