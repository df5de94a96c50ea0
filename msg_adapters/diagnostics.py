"""diagnostic_msgs/DiagnosticArray on /diagnostics: the planner node's health, both ways."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray

from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.key_values import KeyValueReader, message_of_status
from msg_adapters.stamps import nanoseconds_from_stamp

_REJECTED = "rejected."


@dataclass(frozen=True)
class Health:
    """State of the planner node.

    Attributes:
        level: 0 OK, 1 WARN, 2 ERROR, 3 STALE, as in diagnostic_msgs/DiagnosticStatus.
        message: One line for people.
        received: Inputs received.
        attempts: Planning attempts.
        certified: Attempts that gave a certified plan.
        drops: States that a newer one replaced before they were planned from.
        internal_errors: Exceptions that the planner raised.
        rejected: Refused inputs by the name of their code; only codes that occurred.
        solve_time_ms: Wall time of the last attempt.
        latency_ms: From the arrival of the last planned state to its plan.
        input_age_s: Time since the last accepted state arrived.
    """

    level: int
    message: str
    received: int = 0
    attempts: int = 0
    certified: int = 0
    drops: int = 0
    internal_errors: int = 0
    rejected: Mapping[str, int] = field(default_factory=dict)
    solve_time_ms: float | None = None
    latency_ms: float | None = None
    input_age_s: float | None = None


_COUNTS = ("received", "attempts", "certified", "drops", "internal_errors")
_NUMBERS = ("solve_time_ms", "latency_ms", "input_age_s")


def message_from_health(
    health: Health, stamp_ns: int, *, node: str, problem: str
) -> DiagnosticArray:
    """Message of a node's health; the status is called ``NODE: health``."""
    pairs = [
        *((key, getattr(health, key)) for key in _COUNTS),
        *((_REJECTED + name, count) for name, count in health.rejected.items()),
        *((key, getattr(health, key)) for key in _NUMBERS),
    ]
    return message_of_status(
        pairs,
        stamp_ns=stamp_ns,
        level=bytes([health.level]),
        name=f"{node}: health",
        message=health.message,
        problem=problem,
    )


def health_from_message(message: DiagnosticArray, *, node: str) -> tuple[Health, int]:
    """Health of one node and its stamp in ns; other nodes' statuses are skipped.

    Raises:
        RejectedInputError: MISSING_NAME if the node is not in the message, INVALID_STAMP,
            REPORT_MISSING_KEY or REPORT_BAD_VALUE.
    """
    name = f"{node}: health"
    status = next((s for s in message.status if s.name == name), None)
    if status is None:
        names = [s.name for s in message.status]
        raise RejectedInputError(InputCode.MISSING_NAME, "status", names, f"a status '{name}'")
    reader = KeyValueReader(status)
    health = Health(
        level=int.from_bytes(status.level, "little"),
        message=status.message,
        rejected={
            key.removeprefix(_REJECTED): reader.integer(key)
            for key in reader.texts
            if key.startswith(_REJECTED)
        },
        received=reader.integer("received"),
        attempts=reader.integer("attempts"),
        certified=reader.integer("certified"),
        drops=reader.integer("drops"),
        internal_errors=reader.integer("internal_errors"),
        solve_time_ms=reader.optional_number("solve_time_ms"),
        latency_ms=reader.optional_number("latency_ms"),
        input_age_s=reader.optional_number("input_age_s"),
    )
    return health, nanoseconds_from_stamp(message.header.stamp)
