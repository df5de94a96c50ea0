"""Whether the last published trajectory may still be followed, and who is told."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

from dscp_core.planning.plan import PlanOutcome, PlanStatus
from dscp_core.problem.trajectory import Plan
from msg_adapters.report import NodeCode
from msg_adapters.stamps import nanoseconds_from_seconds, seconds_from_nanoseconds
from msg_adapters.validity import Validity

_REVOKING = (PlanStatus.INFEASIBLE, PlanStatus.NOT_CERTIFIED)
"""Findings about a newer state. That there was no time, or that a solver failed, is none."""


@dataclass(frozen=True)
class _Followed:
    """The last published trajectory."""

    stamp_ns: int
    end_ns: int


class ValidityKeeper:
    """Memory of the last trajectory; safe for calls from several threads."""

    def __init__(self, publish: Callable[[Validity], None], now_ns: Callable[[], int]) -> None:
        """Tell that there is no trajectory yet.

        Args:
            publish: Sends a validity; called with a lock held, so that none overtakes another.
            now_ns: ROS time.
        """
        self._publish = publish
        self._now_ns = now_ns
        self._lock = threading.Lock()
        self._trajectory: _Followed | None = None
        self._heard_ns = now_ns()
        code = NodeCode.NO_TRAJECTORY
        self._last = Validity(now_ns(), False, int(code), code.name, "no trajectory yet")
        publish(self._last)

    def note_state(self) -> None:
        """A state was accepted just now."""
        self._heard_ns = self._now_ns()

    def note_trajectory(self, plan: Plan, stamp_ns: int) -> None:
        """A certified plan from a state of this stamp was published."""
        end_ns = stamp_ns + nanoseconds_from_seconds(plan.terminal_time_s)
        code = PlanStatus.CERTIFIED
        with self._lock:
            self._trajectory = _Followed(stamp_ns, end_ns)
            self._tell(
                Validity(self._now_ns(), True, int(code), code.name, "certified", stamp_ns, end_ns)
            )

    def note_outcome(
        self,
        outcome: PlanOutcome,
        stamp_ns: int,
        least_time_s: float,
        best_effort: bool,
    ) -> None:
        """An attempt from a state of this stamp came to no certified plan.

        Args:
            outcome: What became of it.
            stamp_ns: Of its state.
            least_time_s: Shortest plan that is made. Where less is left of the trajectory, that
                there is no plan says nothing about it.
            best_effort: Whether a best effort was published, with this stamp.
        """
        with self._lock:
            trajectory, status = self._trajectory, outcome.status
            if trajectory is not None and self._last.valid:
                left_s = seconds_from_nanoseconds(trajectory.end_ns - stamp_ns)
                older = stamp_ns < trajectory.stamp_ns
                if older or status not in _REVOKING or left_s < least_time_s:
                    return
                self._revoke(status, outcome.message)
            if best_effort:
                now_ns = self._now_ns()
                self._tell(replace(self._last, stamp_ns=now_ns, best_effort_stamp_ns=stamp_ns))

    def revoke(self, code: NodeCode, reason: str) -> None:
        """The last trajectory may not be followed any more; nothing if that is known."""
        with self._lock:
            self._revoke(code, reason)

    def check_time(self, silence_s: float) -> None:
        """Revoke a trajectory whose time has run out, or without a state for this long."""
        now_ns = self._now_ns()
        with self._lock:
            if self._trajectory is not None and now_ns > self._trajectory.end_ns:
                self._revoke(NodeCode.PLAN_ENDED, "the trajectory's own time has run out")
            silent_s = seconds_from_nanoseconds(now_ns - self._heard_ns)
            if silent_s > silence_s:
                reason = f"no state accepted for {silent_s:.2f} s, more than {silence_s:g} s"
                self._revoke(NodeCode.STATES_STALE, reason)

    def _revoke(self, code: PlanStatus | NodeCode, reason: str) -> None:
        if self._last.valid:
            told = replace(self._last, stamp_ns=self._now_ns(), valid=False)
            self._tell(replace(told, code=int(code), code_name=code.name, reason=reason))

    def _tell(self, validity: Validity) -> None:
        self._last = validity
        self._publish(validity)
