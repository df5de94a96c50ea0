"""Counts what happens and says how the node is."""

from __future__ import annotations

import time
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticStatus

from dscp_core.planning.plan import PlanStatus
from msg_adapters.diagnostics import Health
from msg_adapters.errors import InputCode
from msg_adapters.report import NodeCode, PlanReport

OK, WARN, ERROR = (
    int.from_bytes(level, "little")
    for level in (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR)
)

_FAILURES = (int(PlanStatus.SOLVER_FAILURE), int(NodeCode.INTERNAL_ERROR))


class HealthMonitor:
    """Memory of attempts.

    Attempts are noted by one thread and read by another; every attribute is replaced as a whole.
    """

    def __init__(self) -> None:
        """Start with nothing seen."""
        self._attempts = 0
        self._certified = 0
        self._internal_errors = 0
        self._last: PlanReport | None = None
        self._last_input_s: float | None = None
        self._rejected_before = 0
        self._configuration_error: str | None = None

    def note_attempt(self, report: PlanReport) -> None:
        """Note an attempt's report."""
        self._attempts += 1
        self._certified += report.code == PlanStatus.CERTIFIED
        self._internal_errors += report.code == NodeCode.INTERNAL_ERROR
        self._last = report

    def note_input(self) -> None:
        """Note that a state was accepted."""
        self._last_input_s = time.monotonic()

    def note_configuration(self, error: str | None) -> None:
        """Note that new settings were refused by the planner, or, with None, taken over."""
        self._configuration_error = error

    def health(
        self,
        *,
        received: int,
        rejected: Mapping[InputCode, int],
        drops: int,
        worker_alive: bool,
        max_age_s: float,
    ) -> Health:
        """Health since the last call.

        Args:
            received: Inputs received.
            rejected: Inputs refused, by cause.
            drops: States replaced before they were planned from.
            worker_alive: Whether the planning thread runs.
            max_age_s: Largest age of a state; after twice that without one, inputs are missed.
        """
        total = sum(rejected.values())
        new, self._rejected_before = total - self._rejected_before, total
        last = self._last
        age_s = None if self._last_input_s is None else time.monotonic() - self._last_input_s
        level, message = self._verdict(worker_alive, new, age_s, 2.0 * max_age_s)
        attempt = last.attempt if last is not None else None
        return Health(
            level=level,
            message=message,
            received=received,
            attempts=self._attempts,
            certified=self._certified,
            drops=drops,
            internal_errors=self._internal_errors,
            rejected={code.name: count for code, count in sorted(rejected.items())},
            solve_time_ms=attempt.solve_time_ms if attempt is not None else None,
            latency_ms=last.latency_ms if last is not None else None,
            input_age_s=age_s,
        )

    def _verdict(
        self, worker_alive: bool, rejected: int, age_s: float | None, silence_s: float
    ) -> tuple[int, str]:
        last = self._last
        if not worker_alive:
            return ERROR, "the planning thread has ended"
        if last is not None and last.code in _FAILURES:
            return ERROR, f"last attempt: {last.code_name}: {last.message}"
        if self._configuration_error is not None:
            return WARN, f"new settings refused, the old ones stay: {self._configuration_error}"
        if rejected:
            return WARN, f"{rejected} inputs refused since the last message"
        if age_s is None:
            return WARN, "no state accepted yet"
        if age_s > silence_s:
            return WARN, f"no state accepted for {age_s:.1f} s"
        if last is not None and last.code != PlanStatus.CERTIFIED:
            return WARN, f"last attempt: {last.code_name}: {last.message}"
        return OK, "planning"
