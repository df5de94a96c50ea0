"""What a replay did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Lateness:
    """Delays between the time a message was due and its publishing, in nanoseconds."""

    count: int = 0
    sum_ns: int = 0
    max_ns: int = 0

    def add(self, delay_ns: int) -> None:
        """Counts one message."""
        self.count += 1
        self.sum_ns += delay_ns
        self.max_ns = max(self.max_ns, delay_ns)

    @property
    def mean_ns(self) -> float:
        """Mean delay; 0 without messages."""
        return self.sum_ns / self.count if self.count else 0.0


@dataclass(frozen=True)
class ReplayResult:
    """What a replay did.

    Attributes:
        published: Messages sent, by recorded topic name.
        passes: How often the bag was begun.
        seconds: How long it took, waiting for subscribers included.
        interrupted: Whether it was stopped before its end.
        lateness_max_s: Largest delay between the time a message was due and its publishing.
        lateness_mean_s: Mean of that delay.
        unacknowledged: Topics whose subscribers did not confirm in time that they have everything;
            only looked at when the bag's timing is ignored.
        skipped: Topics that were left out although nobody excluded them, with the reason.
    """

    published: Mapping[str, int]
    passes: int
    seconds: float
    interrupted: bool
    lateness_max_s: float
    lateness_mean_s: float
    unacknowledged: tuple[str, ...] = ()
    skipped: Mapping[str, str] = field(default_factory=dict)

    @property
    def message_count(self) -> int:
        """Messages sent in all."""
        return sum(self.published.values())

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values for JSON."""
        return {
            "message_count": self.message_count,
            "published": dict(self.published),
            "passes": self.passes,
            "seconds": self.seconds,
            "interrupted": self.interrupted,
            "lateness_max_s": self.lateness_max_s,
            "lateness_mean_s": self.lateness_mean_s,
            "unacknowledged": list(self.unacknowledged),
            "skipped": dict(self.skipped),
        }
