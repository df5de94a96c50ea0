"""What a guidance node tells: commanded forces, and how it is.

A status has the keys ``phase``, ``commanding``, ``ticks``, ``received``, ``rejected``,
``plans_flown``, ``plans_refused``; and where they exist ``state_age_s``, ``plan_stamp``
(of the plan that is flown) and ``asked_stamp`` (of the plan that is waited for), both
seconds.nanoseconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped

from msg_adapters.checks import require_finite
from msg_adapters.frames import Array
from msg_adapters.key_values import KeyValueReader, message_of_status, only_status
from msg_adapters.layout import StateLayout
from msg_adapters.stamps import nanoseconds_from_stamp, stamp_from_nanoseconds, stamp_text


@dataclass(frozen=True)
class GuidanceStatus:
    """How a guidance node is.

    Attributes:
        stamp_ns: When, ROS time.
        level: 0 OK, 1 WARN, 2 ERROR, as in diagnostic_msgs/DiagnosticStatus.
        message: One line for people; where nothing is commanded, why.
        phase: What guidance does.
        commanding: Whether a force is commanded.
        ticks: Ticks of the node so far.
        received: States received.
        rejected: States refused.
        plans_flown: Plans that were taken over.
        plans_refused: Answers of the planner that were not.
        state_age_s: Age of the last accepted state; None before the first.
        plan_stamp_ns: Start of the last plan that was taken over; None before the first.
        asked_stamp_ns: Start of the plan that is waited for; None if none is.
    """

    stamp_ns: int
    level: int
    message: str
    phase: str
    commanding: bool
    ticks: int
    received: int
    rejected: int
    plans_flown: int
    plans_refused: int
    state_age_s: float | None = None
    plan_stamp_ns: int | None = None
    asked_stamp_ns: int | None = None


_COUNTS = ("ticks", "received", "rejected", "plans_flown", "plans_refused")
_STAMPS = ("plan_stamp", "asked_stamp")


def message_from_guidance_status(
    status: GuidanceStatus, *, node: str, problem: str
) -> DiagnosticArray:
    """Message of a status; it is called ``NODE: status``."""
    stamps = {key: getattr(status, f"{key}_ns") for key in _STAMPS}
    pairs = [
        ("phase", status.phase),
        ("commanding", status.commanding),
        *((key, getattr(status, key)) for key in _COUNTS),
        ("state_age_s", status.state_age_s),
        *((key, None if ns is None else stamp_text(ns)) for key, ns in stamps.items()),
    ]
    return message_of_status(
        pairs,
        stamp_ns=status.stamp_ns,
        level=bytes([status.level]),
        name=f"{node}: status",
        message=status.message,
        problem=problem,
    )


def guidance_status_from_message(message: DiagnosticArray) -> GuidanceStatus:
    """Status of a message.

    Raises:
        RejectedInputError: WRONG_ARRAY_LENGTH, INVALID_STAMP, REPORT_MISSING_KEY or
            REPORT_BAD_VALUE.
    """
    status = only_status(message)
    reader = KeyValueReader(status)
    counts = {key: reader.integer(key) for key in _COUNTS}
    stamps: dict[str, Any] = {f"{key}_ns": reader.optional_stamp_ns(key) for key in _STAMPS}
    return GuidanceStatus(
        stamp_ns=nanoseconds_from_stamp(message.header.stamp),
        level=int.from_bytes(status.level, "little"),
        message=status.message,
        phase=reader.text("phase"),
        commanding=reader.boolean("commanding"),
        state_age_s=reader.optional_number("state_age_s"),
        **counts,
        **stamps,
    )


def wrench_from_force(
    force: Array, stamp_ns: int, layout: StateLayout, *, frame: str | None = None
) -> WrenchStamped:
    """Message of a force (3,) in N, core axes; its torque is zero, and means nothing.

    Raises:
        RejectedInputError: NOT_FINITE.
    """
    components = [float(part) for part in layout.to_message_axes(force)]
    require_finite((f"force.{name}", part) for name, part in zip("xyz", components, strict=True))
    message = WrenchStamped()
    message.header.stamp = stamp_from_nanoseconds(stamp_ns)
    message.header.frame_id = frame or layout.frame
    message.wrench.force.x, message.wrench.force.y, message.wrench.force.z = components
    return message
