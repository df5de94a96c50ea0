"""What the node says of events: throttled log lines, and reports of all that is no attempt."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable

from msg_adapters.errors import RejectedInputError
from msg_adapters.report import NodeCode, PlanReport, rejection_from_error


class ThrottledLog:
    """One log line per cause and period, with the number of those left out."""

    def __init__(self, write: Callable[[str], None]) -> None:
        """Log through ``write``, for example a logger's ``warning``."""
        self._write = write
        self._lock = threading.Lock()
        self._next: dict[Hashable, float] = {}
        self._hidden: dict[Hashable, int] = {}

    def write(self, cause: Hashable, text: str, period_s: float) -> None:
        """Write a line, unless this cause had one less than a period ago."""
        now_s = time.monotonic()
        with self._lock:
            if now_s < self._next.get(cause, 0.0):
                self._hidden[cause] = self._hidden.get(cause, 0) + 1
                return
            self._next[cause] = now_s + period_s
            hidden = self._hidden.pop(cause, 0)
        self._write(f"{text} ({hidden} more since the last line)" if hidden else text)


def refusal_report(
    error: RejectedInputError,
    *,
    stamp_ns: int,
    source: str,
    problem: str,
    drops: int,
    rejected: int,
    input_stamp_ns: int | None,
) -> PlanReport:
    """Report of a refused input."""
    return PlanReport(
        stamp_ns=stamp_ns,
        source=source,
        code=int(error.code),
        code_name=error.code.name,
        message=str(error),
        problem=problem,
        drops=drops,
        rejected=rejected,
        input_stamp_ns=input_stamp_ns,
        rejection=rejection_from_error(error),
    )


def event_report(
    code: NodeCode, message: str, *, stamp_ns: int, source: str, problem: str
) -> PlanReport:
    """Report of an event of the node itself."""
    return PlanReport(
        stamp_ns=stamp_ns,
        source=source,
        code=int(code),
        code_name=code.name,
        message=message,
        problem=problem,
    )
