"""The timing of a replay as arithmetic: no clock, no sleep."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dscp_core.errors import InvalidInputError
from dscp_ros.replay.schedule import NANOSECONDS, PlaybackClock, Ticker, replay_window

BAG_NS = 1_700_000_000 * NANOSECONDS
rates = st.floats(0.01, 100.0)
times = st.integers(0, 3600 * NANOSECONDS)


@given(rates, times)
def test_due_time_and_bag_time_are_inverse(rate: float, elapsed_ns: int) -> None:
    clock = PlaybackClock(rate, BAG_NS, 77)
    reached = clock.bag_ns(77 + elapsed_ns)
    # Two roundings to whole nanoseconds, the first of which the rate stretches.
    assert abs(clock.due_ns(reached) - (77 + elapsed_ns)) <= 1 + 1 / rate


@given(rates, st.lists(st.tuples(times, times), max_size=8))
def test_pauses_shift_everything_by_their_length(
    rate: float, pauses: list[tuple[int, int]]
) -> None:
    clock = PlaybackClock(rate, BAG_NS, 0)
    undisturbed = PlaybackClock(rate, BAG_NS, 0)
    now_ns, paused_ns = 0, 0
    for run_ns, pause_ns in pauses:
        now_ns += run_ns
        clock.pause(now_ns)
        clock.pause(now_ns + pause_ns // 2)
        at_pause = clock.bag_ns(now_ns)
        now_ns += pause_ns
        assert clock.bag_ns(now_ns) == at_pause
        clock.resume(now_ns)
        clock.resume(now_ns)
        paused_ns += pause_ns
    target = BAG_NS + 3600 * NANOSECONDS
    # Each pause rounds the bag time to a nanosecond, which the rate stretches.
    tolerance_ns = (1 + 1 / rate) * (1 + len(pauses))
    assert abs(clock.due_ns(target) - undisturbed.due_ns(target) - paused_ns) <= tolerance_ns


def test_rate_scales_time() -> None:
    clock = PlaybackClock(4.0, BAG_NS, 1000)
    assert clock.due_ns(BAG_NS + 8 * NANOSECONDS) == 1000 + 2 * NANOSECONDS
    assert clock.bag_ns(1000 + NANOSECONDS) == BAG_NS + 4 * NANOSECONDS


def test_delays_do_not_add_up() -> None:
    # Whatever was late before, each deadline is counted from the anchor.
    clock = PlaybackClock(0.5, BAG_NS, 0)
    due = [clock.due_ns(BAG_NS + k * 10_000_000) for k in range(1000)]
    assert due == [k * 20_000_000 for k in range(1000)]


def test_a_restart_while_paused_stays_paused() -> None:
    clock = PlaybackClock(1.0, BAG_NS, 0, paused=True)
    assert clock.bag_ns(5) == BAG_NS
    clock.restart(BAG_NS + 7, 10)
    assert clock.paused
    assert clock.bag_ns(1000) == BAG_NS + 7
    clock.resume(1000)
    assert clock.due_ns(BAG_NS + 8) == 1001


def test_ticks_keep_to_their_grid() -> None:
    ticker = Ticker(10, 100)
    assert not ticker.due(99)
    assert ticker.due(103)
    assert not ticker.due(109)
    assert ticker.due(110)
    assert ticker.due(157)  # four ticks were missed
    assert not ticker.due(159)
    assert ticker.next_ns == 160


def test_window() -> None:
    first, last = BAG_NS, BAG_NS + 10 * NANOSECONDS
    whole = replay_window(first, last, 0.0, None)
    assert (whole.start_ns, whole.end_ns) == (first, last + 1)
    part = replay_window(first, last, 2.5, 3.0)
    assert part.start_ns == first + 5 * NANOSECONDS // 2
    assert part.length_s == 3.0
    assert replay_window(first, last, 9.0, 100.0).end_ns == last + 1
    assert replay_window(first, last, 10.0, None).start_ns == last
    with pytest.raises(InvalidInputError, match=r"--start-offset: got 10\.5, expected \[0, 10\]"):
        replay_window(first, last, 10.5, None)
