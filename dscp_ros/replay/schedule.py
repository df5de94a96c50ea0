"""When what is due: pure arithmetic on nanoseconds, without clocks, threads or ROS."""

from __future__ import annotations

from dataclasses import dataclass

from dscp_core.errors import InvalidInputError

NANOSECONDS = 10**9


@dataclass(frozen=True)
class Window:
    """The part of a bag that is replayed: log times in [start_ns, end_ns)."""

    start_ns: int
    end_ns: int

    @property
    def length_s(self) -> float:
        """Length in seconds of the bag."""
        return (self.end_ns - self.start_ns) / NANOSECONDS


def replay_window(
    first_ns: int, last_ns: int, start_offset_s: float, duration_s: float | None
) -> Window:
    """Cuts the window out of a bag.

    Args:
        first_ns: First log time of the bag.
        last_ns: Last log time of the bag.
        start_offset_s: Seconds after the first log time.
        duration_s: Length in seconds, or None to the end.

    Raises:
        InvalidInputError: If the start lies behind the end.
    """
    start_ns = first_ns + round(start_offset_s * NANOSECONDS)
    if start_ns > last_ns:
        length_s = (last_ns - first_ns) / NANOSECONDS
        raise InvalidInputError(
            "--start-offset", start_offset_s, f"[0, {length_s:g}], the bag's length in seconds"
        )
    end_ns = last_ns + 1  # the last message belongs to it
    if duration_s is not None:
        end_ns = min(end_ns, start_ns + max(1, round(duration_s * NANOSECONDS)))
    return Window(start_ns, end_ns)


class PlaybackClock:
    """Maps bag time to real time by one anchor, so that delays never add up.

    Real times are those of any clock that runs forward; each call is told the time.

    Args:
        rate: How many seconds of the bag pass in one second.
        bag_ns: Bag time to start at.
        now_ns: Real time of the start.
        paused: Whether bag time stands still at first.
    """

    def __init__(self, rate: float, bag_ns: int, now_ns: int, *, paused: bool = False) -> None:
        self._rate = rate
        self._paused = paused
        self._anchor_bag_ns = bag_ns
        self._anchor_real_ns = now_ns

    @property
    def paused(self) -> bool:
        """Whether bag time stands still."""
        return self._paused

    def due_ns(self, bag_ns: int) -> int:
        """Returns the real time at which a bag time is reached, if there is no (further) pause."""
        return self._anchor_real_ns + round((bag_ns - self._anchor_bag_ns) / self._rate)

    def bag_ns(self, now_ns: int) -> int:
        """Returns the bag time at a real time."""
        if self._paused:
            return self._anchor_bag_ns
        return self._anchor_bag_ns + round((now_ns - self._anchor_real_ns) * self._rate)

    def pause(self, now_ns: int) -> None:
        """Stops bag time; does nothing when it stands still already."""
        if not self._paused:
            self._anchor_bag_ns = self.bag_ns(now_ns)
            self._anchor_real_ns = now_ns
            self._paused = True

    def resume(self, now_ns: int) -> None:
        """Lets bag time go on from where it stands."""
        if self._paused:
            self._anchor_real_ns = now_ns
            self._paused = False

    def restart(self, bag_ns: int, at_ns: int) -> None:
        """Jumps to a bag time, to be reached at a real time; a pause stays in force."""
        self._anchor_bag_ns = bag_ns
        self._anchor_real_ns = at_ns


class Ticker:
    """A periodic deadline on a fixed grid: what comes too late is left out, not made up for.

    Args:
        period_ns: Time between two ticks.
        now_ns: Real time of the first tick.
    """

    def __init__(self, period_ns: int, now_ns: int) -> None:
        self._period_ns = period_ns
        self.next_ns = now_ns

    def due(self, now_ns: int) -> bool:
        """Returns whether a tick is due, and moves on to the next one if so."""
        if now_ns < self.next_ns:
            return False
        missed = (now_ns - self.next_ns) // self._period_ns
        self.next_ns += (missed + 1) * self._period_ns
        return True
