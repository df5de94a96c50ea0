"""One attempt at a plan: SCP runs under a common deadline, each judged by its certificate."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.planning.certificate import PlanVerifier
from dscp_core.planning.plan import PlanOutcome, PlanStatus, TerminalTime
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.problem.trajectory import Plan
from dscp_core.scp.gain import cost_to_gain
from dscp_core.scp.restoration import flyable
from dscp_core.scp.scp import Iteration, Scp, ScpResult, ScpStatus

Array = NDArray[np.float64]

_STATUS = {
    ScpStatus.INFEASIBLE: PlanStatus.INFEASIBLE,
    ScpStatus.SUBPROBLEM_INFEASIBLE: PlanStatus.INFEASIBLE,
    ScpStatus.ITERATION_LIMIT: PlanStatus.ITERATION_LIMIT,
    ScpStatus.DEADLINE: PlanStatus.DEADLINE,
    ScpStatus.SOLVER_FAILURE: PlanStatus.SOLVER_FAILURE,
    ScpStatus.DIVERGED: PlanStatus.SOLVER_FAILURE,
}

_NO_PLAN = (PlanStatus.INFEASIBLE, PlanStatus.ITERATION_LIMIT, PlanStatus.SOLVER_FAILURE)


@dataclass(frozen=True)
class Start:
    """Where a run starts from.

    Attributes:
        scp: Loop that runs.
        parameters: Packed parameters, SI.
        reference: Scaled reference vector, or None for the problem's initial guess.
        source: Where the terminal time comes from.
    """

    scp: Scp
    parameters: Array
    reference: Array | None
    source: TerminalTime


class Attempt:
    """The runs of one call of `dscp_core.planning.planner.Planner.plan`."""

    def __init__(
        self,
        problem: OptimalControlProblem,
        verifier: PlanVerifier,
        clock: Callable[[], float],
        deadline_s: float | None,
    ) -> None:
        """Begin.

        Args:
            problem: What is planned.
            verifier: Certifies the plans.
            clock: Seconds; the call came now.
            deadline_s: Wall time from now on for the iterations of all runs, or None.
        """
        self._problem = problem
        self._verifier = verifier
        self._clock = clock
        self._started = clock()
        self._deadline_s = deadline_s
        self._iterations = 0
        self._solver_time = 0.0
        self.predicted_s: float | None = None
        self.reason = ""

    def invalid(self, message: str, packed: Array, source: TerminalTime) -> PlanOutcome:
        """Outcome for a state that was refused."""
        return self._outcome(PlanStatus.INVALID_STATE, message, packed, source)

    def with_all_runs(self, outcome: PlanOutcome) -> PlanOutcome:
        """An earlier run's outcome, with the iterations and times of all of them."""
        return replace(
            outcome,
            iterations=self._iterations,
            solve_time_s=self._elapsed(),
            solver_time_s=self._solver_time,
        )

    def count(self, result: ScpResult) -> None:
        """Count the iterations and the solver's time of a run."""
        self._iterations += len(result.iterations)
        self._solver_time += sum(i.solve_seconds for i in result.iterations)
        if result.failed is not None:
            self._solver_time += result.failed.seconds

    def left_s(self) -> float | None:
        """Wall time that is left, not below zero; None without a deadline."""
        if self._deadline_s is None:
            return None
        return max(self._deadline_s - self._elapsed(), 0.0)

    def run(self, start: Start) -> PlanOutcome:
        """Iterate, choose an iterate, certify it."""
        scp = start.scp
        left = self.left_s()
        if left == 0.0:
            late, message = ScpStatus.DEADLINE, "deadline: no time left to start"
            packed, source = start.parameters, start.source
            return self._outcome(PlanStatus.DEADLINE, message, packed, source, stopped=late)
        if left is not None:
            scp = scp.with_options(deadline_s=left)
        try:
            result = scp.run(start.parameters, start.reference)
        except InvalidInputError as error:  # a guess that is not finite
            message = f"no first iteration: {error}"
            return self._outcome(PlanStatus.SOLVER_FAILURE, message, start.parameters, start.source)
        self.count(result)
        status = _STATUS.get(result.status, PlanStatus.CERTIFIED)
        message = f"{result.status.value}: {result.message}"
        last = result.failed or (result.iterations[-1].solution if result.iterations else None)
        found: dict[str, Any] = {
            "stopped": result.status,
            "terminal_time_used_s": scp.transcription.terminal_time(
                result.final_reference, result.parameters
            ),
            "warm_started": result.warm_started,
            "solver": "" if last is None else last.solver,
        }
        chosen = _chosen(scp, result)
        if chosen is not None:
            layout = scp.transcription.layout
            trajectory = _flyable(scp, chosen, result.parameters)
            plan = self.plan_of(
                layout.states(trajectory),
                layout.controls(trajectory),
                scp.transcription.terminal_time(trajectory, result.parameters),
                result.parameters,
            )
            evaluation = scp.transcription.evaluate(trajectory, result.parameters)
            certificate = self._verifier.certify(
                plan.times_s, plan.states, plan.controls, result.parameters
            )
            if status in (PlanStatus.CERTIFIED, PlanStatus.ITERATION_LIMIT, PlanStatus.DEADLINE):
                if certificate.passed:
                    status = PlanStatus.CERTIFIED
                elif status is PlanStatus.CERTIFIED:
                    status = PlanStatus.NOT_CERTIFIED
            if not certificate.passed:
                message += "; certificate: " + "; ".join(certificate.reasons)
            found |= {
                "converged": result.status is ScpStatus.CONVERGED
                and chosen is result.iterations[-1]
                and scp.satisfies_dynamics(chosen),
                "cost_to_gain": cost_to_gain(scp, chosen),
                "plan": plan,
                "certificate": certificate,
                "terminal_time_used_s": plan.terminal_time_s,
                "virtual_control": layout.relative(chosen.virtual_control),
                "max_defect": layout.relative(evaluation.defects),
                "cost": evaluation.cost,
            }
        if status in _NO_PLAN:
            state = scp.transcription.initial_state(result.parameters)
            refused = self._verifier.refused_at(state, result.parameters)
            if refused:
                status = PlanStatus.INFEASIBLE
                message = f"the start is out of bounds: {'; '.join(refused)}; {message}"
        return self._outcome(status, message, start.parameters, start.source, **found)

    def _outcome(
        self,
        status: PlanStatus,
        message: str,
        packed: Array,
        source: TerminalTime,
        **found: Any,
    ) -> PlanOutcome:
        """Outcome with what was found, and the values of nothing for the rest."""
        parameters = self._problem.table.unpack(packed)
        values: dict[str, Any] = {
            "stopped": None,
            "converged": False,
            "cost_to_gain": None,
            "plan": None,
            "certificate": None,
            "virtual_control": math.inf,
            "max_defect": math.inf,
            "cost": math.inf,
            "terminal_time_used_s": parameters[TERMINAL_TIME],
            "warm_started": False,
            "solver": "",
        }
        return PlanOutcome(
            status=status,
            message=message,
            iterations=self._iterations,
            solve_time_s=self._elapsed(),
            solver_time_s=self._solver_time,
            cost_unit=self._problem.cost_unit,
            terminal_time_predicted_s=self.predicted_s,
            terminal_time_source=source,
            terminal_time_reason=self.reason,
            parameters=parameters,
            **(values | found),
        )

    def _elapsed(self) -> float:
        return self._clock() - self._started

    def plan_of(
        self, states: Array, controls: Array, terminal_time_s: float, parameters: Array
    ) -> Plan:
        """Plan of a trajectory, SI, whose nodes are equally far apart in time."""
        problem = self._problem
        return Plan(
            problem=problem.name,
            state_names=tuple(s.name for s in problem.states),
            control_names=tuple(c.name for c in problem.controls),
            control_states=problem.control_states,
            times_s=np.linspace(0.0, terminal_time_s, len(states)),
            states=states,
            controls=controls,
            state_rates=self._verifier.rates(states, controls, parameters),
            terminal_time_s=terminal_time_s,
        )


def _chosen(scp: Scp, result: ScpResult) -> Iteration | None:
    """The last iterate that satisfies the dynamics, else the last one."""
    for iteration in reversed(result.iterations):
        if scp.satisfies_dynamics(iteration):
            return iteration
    return result.iterations[-1] if result.iterations else None


def _flyable(scp: Scp, iteration: Iteration, parameters: Array) -> Array:
    """The iterate's trajectory, without its last defects where the dynamics are the flown ones."""
    trajectory = iteration.solution.z[: iteration.reference.size]
    if scp.satisfies_dynamics(iteration):
        return flyable(scp.transcription, trajectory, parameters)
    return trajectory
