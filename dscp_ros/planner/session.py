"""The planner with its memory: the last certified plan starts the next one."""

from __future__ import annotations

from dataclasses import dataclass

from dscp_core.planning.plan import PlanOutcome, PlanStatus
from dscp_core.planning.planner import Planner, PlannerSettings, TerminalTimePredictor
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.trajectory import Plan
from msg_adapters.stamps import seconds_from_nanoseconds
from msg_adapters.state import StampedState


@dataclass(frozen=True)
class PlannerSetup:
    """What a planner is made of.

    Attributes:
        problem: What to plan.
        settings: How to plan it.
        predictor: For a predicted terminal time.
        parameter_set: Names the parameter sets that all this comes from, for reports.
    """

    problem: OptimalControlProblem
    settings: PlannerSettings
    predictor: TerminalTimePredictor | None
    parameter_set: str

    def planner(self) -> Planner:
        """Compile the problem.

        Raises:
            InvalidInputError: A setting is refused.
        """
        return Planner(self.problem, self.settings, self.predictor)

    def plans_like(self, other: PlannerSetup) -> bool:
        """Whether another one makes the same plans."""
        return (self.settings, self.predictor) == (other.settings, other.predictor)


@dataclass(frozen=True)
class _Certified:
    """A certified plan and the stamp of the state that it starts from."""

    plan: Plan
    stamp_ns: int


class PlanningSession:
    """Plans from stamped states. For one thread at a time."""

    def __init__(self, setup: PlannerSetup) -> None:
        """Compile the problem.

        Raises:
            InvalidInputError: A setting is refused.
        """
        self._planner = setup.planner()
        self._setup = setup
        self._last: _Certified | None = None

    @property
    def parameter_set(self) -> str:
        """Names the parameter sets that plans are made with."""
        return self._setup.parameter_set

    @property
    def least_time_s(self) -> float:
        """Shortest terminal time of a plan that is free to choose it."""
        return self._planner.time_bounds_s[0]

    def plan(self, state: StampedState, deadline_s: float) -> PlanOutcome:
        """Plan from a state, warm if an earlier plan covers it."""
        last = self._last
        if last is None or state.stamp_ns < last.stamp_ns:
            outcome = self._planner.plan(state.values, deadline_s=deadline_s)
        else:
            outcome = self._planner.plan(
                state.values,
                deadline_s=deadline_s,
                warm_start=last.plan,
                elapsed_s=seconds_from_nanoseconds(state.stamp_ns - last.stamp_ns),
            )
        if outcome.status is PlanStatus.CERTIFIED and outcome.plan is not None:
            self._last = _Certified(outcome.plan, state.stamp_ns)
        return outcome

    def forget(self) -> None:
        """Forget the warm start."""
        self._last = None

    def install(self, setup: PlannerSetup, planner: Planner) -> None:
        """Plan with another planner, made of this setup, from now on; forget the warm start."""
        self._planner, self._setup, self._last = planner, setup, None

    def change(self, setup: PlannerSetup) -> bool:
        """Plan with another setup from now on.

        Returns:
            Whether that took another planner: then the warm start is forgotten.

        Raises:
            InvalidInputError: A setting is refused; everything stays as it was.
        """
        if setup.plans_like(self._setup):
            self._setup = setup
            return False
        self.install(setup, setup.planner())
        return True
