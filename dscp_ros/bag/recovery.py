"""What was found damaged in a bag, and how much of it is lost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any


class DamageKind(Enum):
    """What is wrong at one place of a bag."""

    TRUNCATED = "truncated"
    """The file ends before its end: a recorder that was killed, or a copy that broke off."""
    CORRUPT_CHUNK = "corrupt chunk"
    """A chunk whose checksum or compression is wrong: all of its messages are dropped."""
    UNREADABLE_BYTES = "unreadable bytes"
    """Bytes that are no record; reading went on at the next chunk."""
    CORRUPT_MESSAGE = "corrupt message"
    """Messages that no channel describes, or that are too short for a payload."""
    CORRUPT_SUMMARY = "corrupt summary"
    """The index at the end of the file; no message is lost, reading is slower."""
    CORRUPT_INDEX = "corrupt index"
    """A record between the chunks; no message is lost."""
    CORRUPT_METADATA = "corrupt metadata"
    """metadata.yaml, or the same record in the file; no message is lost."""
    MISSING_FILE = "missing file"
    """A file that metadata.yaml names does not exist or cannot be read at all."""
    COUNT_MISMATCH = "count mismatch"
    """The bag holds another number of messages than its index says."""


@dataclass(frozen=True)
class Damage:
    """One damaged place.

    Attributes:
        kind: What is wrong.
        file: The damaged file.
        detail: What was found, in words.
        start_offset: First damaged byte, or None when the place has no offset.
        end_offset: First byte after the damage, or None.
        messages_lost: How many messages are lost here, or None when that cannot be known.
        lost_by_topic: The same by topic, as far as an index tells.
        start_time_ns: Earliest log time of the lost messages, or None.
        end_time_ns: Latest log time of the lost messages, or None.
    """

    kind: DamageKind
    file: Path
    detail: str
    start_offset: int | None = None
    end_offset: int | None = None
    messages_lost: int | None = 0
    lost_by_topic: Mapping[str, int] = field(default_factory=dict)
    start_time_ns: int | None = None
    end_time_ns: int | None = None

    def __str__(self) -> str:
        place = str(self.file)
        if self.start_offset is not None:
            end = "" if self.end_offset is None else f" to {self.end_offset}"
            place += f", byte {self.start_offset}{end}"
        lost = "?" if self.messages_lost is None else str(self.messages_lost)
        text = f"{self.kind.value} ({place}): {self.detail}; messages lost: {lost}"
        if self.start_time_ns is not None and self.end_time_ns is not None:
            text += f", log time {self.start_time_ns} to {self.end_time_ns} ns"
        if self.lost_by_topic:
            text += " (" + ", ".join(f"{t}: {n}" for t, n in self.lost_by_topic.items()) + ")"
        return text

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values for JSON."""
        return {
            "kind": self.kind.value,
            "file": str(self.file),
            "detail": self.detail,
            "start_offset": self.start_offset,
            "end_offset": self.end_offset,
            "messages_lost": self.messages_lost,
            "lost_by_topic": dict(self.lost_by_topic),
            "start_time_ns": self.start_time_ns,
            "end_time_ns": self.end_time_ns,
        }


@dataclass(frozen=True)
class RecoveryReport:
    """State of a bag as far as it has been read.

    Attributes:
        damages: The damaged places, in the order in which they were found.
        messages_read: Readable messages, or None before the bag was read to its end.
        messages_expected: Messages that the bag's own counts promise, or None without counts.
    """

    damages: tuple[Damage, ...] = ()
    messages_read: int | None = None
    messages_expected: int | None = None

    @property
    def intact(self) -> bool:
        """Whether no damage was found."""
        return not self.damages

    @property
    def messages_lost(self) -> int | None:
        """Lost messages in all, or None when that cannot be known."""
        if self.messages_expected is not None and self.messages_read is not None:
            return max(0, self.messages_expected - self.messages_read)
        losses = [damage.messages_lost for damage in self.damages]
        if any(lost is None for lost in losses):
            return None
        return self.messages_lost_at_least

    @property
    def messages_lost_at_least(self) -> int:
        """Sum of the losses that are known."""
        return sum(damage.messages_lost or 0 for damage in self.damages)

    def lines(self) -> list[str]:
        """Returns the report as text, one line per damage and one for the total."""
        if self.intact:
            return ["no damage found"]
        total = self.messages_lost
        known = f"at least {self.messages_lost_at_least}, how many is unknown"
        return [
            *(str(damage) for damage in self.damages),
            f"messages lost in all: {known if total is None else total}",
        ]

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values for JSON."""
        return {
            "intact": self.intact,
            "messages_read": self.messages_read,
            "messages_expected": self.messages_expected,
            "messages_lost": self.messages_lost,
            "messages_lost_at_least": self.messages_lost_at_least,
            "damages": [damage.to_dict() for damage in self.damages],
        }
