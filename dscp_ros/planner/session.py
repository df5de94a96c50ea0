"""The planner with its memory: the last certified plan starts the next one."""

from __future__ import annotations

from dataclasses import dataclass

from dscp_core.plan import Plan, PlanOutcome, PlanStatus
from dscp_core.planner import Planner, PlannerSettings
from msg_adapters.stamps import seconds_from_nanoseconds
from msg_adapters.state import StampedState


@dataclass(frozen=True)
class _Certified:
    """A certified plan and the stamp of the state that it starts from."""

    plan: Plan
    stamp_ns: int


class PlanningSession:
    """Plans from stamped states. For one thread at a time."""

    def __init__(self, settings: PlannerSettings) -> None:
        """Compile the problem.

        Raises:
            InvalidInputError: A setting is refused.
        """
        self._planner = Planner(settings)
        self._last: _Certified | None = None

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

    def rebuild(self, settings: PlannerSettings) -> None:
        """Replace the planner by one with other settings and forget the warm start.

        Raises:
            InvalidInputError: A setting is refused; the planner stays as it was.
        """
        self._planner = Planner(settings)
        self._last = None
