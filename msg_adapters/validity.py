"""diagnostic_msgs/DiagnosticArray: whether the last trajectory may be followed, both ways.

One status per message; its level is OK while the trajectory is valid, else WARN, its message the
reason. Keys: ``valid``, ``code``, ``code_name``; and where they exist ``trajectory_stamp`` and
``trajectory_end`` (seconds.nanoseconds, of the last published trajectory), and
``best_effort_stamp`` (of the best effort that may stand in for it).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from msg_adapters.key_values import KeyValueReader, Value, message_of_status, only_status
from msg_adapters.stamps import nanoseconds_from_stamp, stamp_text


@dataclass(frozen=True)
class Validity:
    """What a tracker has to know of the last published trajectory.

    Attributes:
        stamp_ns: When this was found, ROS time.
        valid: Whether that trajectory may be followed.
        code: 0 while it is valid, else why it is not: a `PlanStatus` or a `NodeCode`.
        code_name: Name of the code.
        reason: The same for people.
        trajectory_stamp_ns: Stamp of the trajectory; None before the first.
        trajectory_end_ns: When its own time runs out; None before the first.
        best_effort_stamp_ns: Stamp of the best effort published when it was found not to be valid.
    """

    stamp_ns: int
    valid: bool
    code: int
    code_name: str
    reason: str
    trajectory_stamp_ns: int | None = None
    trajectory_end_ns: int | None = None
    best_effort_stamp_ns: int | None = None

    def allows(self, stamp_ns: int, now_ns: int) -> bool:
        """Whether the trajectory with this stamp may be followed at a time, both ROS time."""
        end = self.trajectory_end_ns
        if not self.valid or end is None:
            return False
        return stamp_ns == self.trajectory_stamp_ns and stamp_ns <= now_ns <= end


def message_from_validity(validity: Validity, *, node: str, problem: str) -> DiagnosticArray:
    """Message of a validity.

    Args:
        validity: What is known.
        node: Name of the node; the status is called ``NODE: validity``.
        problem: Name of the problem.
    """
    level = DiagnosticStatus.OK if validity.valid else DiagnosticStatus.WARN
    return message_of_status(
        _pairs(validity),
        stamp_ns=validity.stamp_ns,
        level=bytes(level),
        name=f"{node}: validity",
        message=validity.reason,
        problem=problem,
    )


def _pairs(validity: Validity) -> Iterator[tuple[str, Value]]:
    yield "valid", validity.valid
    yield "code", validity.code
    yield "code_name", validity.code_name
    for key in _STAMPS:
        stamp_ns = getattr(validity, f"{key}_ns")
        yield key, None if stamp_ns is None else stamp_text(stamp_ns)


_STAMPS = ("trajectory_stamp", "trajectory_end", "best_effort_stamp")


def validity_from_message(message: DiagnosticArray) -> Validity:
    """Validity of a message.

    Raises:
        RejectedInputError: WRONG_ARRAY_LENGTH, INVALID_STAMP, REPORT_MISSING_KEY or
            REPORT_BAD_VALUE.
    """
    reader = KeyValueReader(only_status(message))
    return Validity(
        stamp_ns=nanoseconds_from_stamp(message.header.stamp),
        valid=reader.boolean("valid"),
        code=reader.integer("code"),
        code_name=reader.text("code_name"),
        reason=message.status[0].message,
        **{f"{key}_ns": reader.optional_stamp_ns(key) for key in _STAMPS},
    )
