"""Exceptions of the bag package."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from dscp_core.errors import DscpError

if TYPE_CHECKING:
    from dscp_ros.bag.recovery import Damage


class BagError(DscpError):
    """Base class of everything that can be wrong with a bag."""


class BagNotFoundError(BagError):
    """The path does not exist, or is a directory without a bag in it."""


class BagFormatError(BagError):
    """The file is no MCAP file, or a kind of bag that this package does not read."""


class BagExistsError(BagError):
    """The path to write to is taken."""


class BagWriteError(BagError):
    """Writing failed, for example because the disk is full.

    Attributes:
        path: The bag that was to be written.
        partial_path: What was written so far, or None when nothing is left.
    """

    def __init__(self, path: Path, reason: str, partial_path: Path | None) -> None:
        rest = (
            "nothing was kept" if partial_path is None else f"partial data left in {partial_path}"
        )
        super().__init__(f"cannot write {path}: {reason} ({rest})")
        self.path = path
        self.partial_path = partial_path


class BagDamagedError(BagError):
    """Damage was found while reading strictly.

    Attributes:
        damage: The first damage found.
    """

    def __init__(self, damage: Damage) -> None:
        super().__init__(str(damage))
        self.damage = damage


class TopicNotFoundError(BagError):
    """A topic was asked for that the bag does not have.

    Attributes:
        missing: The topics asked for and not found.
        available: The topics that the bag has.
    """

    def __init__(self, missing: Iterable[str], available: Iterable[str]) -> None:
        self.missing = tuple(missing)
        self.available = tuple(available)
        super().__init__(
            f"no topic {', '.join(self.missing)} in the bag; "
            f"it has: {', '.join(self.available) or 'no topics'}"
        )


class UnknownMessageTypeError(BagError):
    """A message type that is not installed here, or that is defined differently in the bag.

    Attributes:
        type_name: The type, such as `nav_msgs/msg/Odometry`.
        topic: The topic it came from, or None.
        reason: What is wrong with it.
    """

    def __init__(self, type_name: str, reason: str, topic: str | None = None) -> None:
        where = "" if topic is None else f" on topic {topic}"
        super().__init__(f"message type {type_name}{where}: {reason}")
        self.type_name = type_name
        self.topic = topic
        self.reason = reason


class MessageDecodeError(BagError):
    """The bytes of a message are not a message of its type.

    Attributes:
        topic: The topic of the message.
        type_name: The type that its topic has in the bag.
        log_time_ns: When the message was recorded.
    """

    def __init__(self, topic: str, type_name: str, log_time_ns: int, reason: str) -> None:
        super().__init__(
            f"cannot decode the {type_name} on topic {topic} at log time {log_time_ns} ns: {reason}"
        )
        self.topic = topic
        self.type_name = type_name
        self.log_time_ns = log_time_ns
