"""Which states are tuned on, and which are held out to judge the result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dscp_core.errors import InvalidInputError
from dscp_ros.tuning.logs import LogContent, LoggedState

NANOSECONDS_PER_SECOND = 1e9


@dataclass(frozen=True)
class LogSplit:
    """What becomes of the states of one log.

    Attributes:
        log: The log.
        training: States to tune on.
        held_out: States to judge by.
    """

    log: LogContent
    training: Sequence[LoggedState]
    held_out: Sequence[LoggedState]


@dataclass(frozen=True)
class Split:
    """What becomes of all states.

    Attributes:
        logs: In the order of the logs.
        rule: How it was decided, in words.
    """

    logs: tuple[LogSplit, ...]
    rule: str


def split_given(training: Sequence[LogContent], held_out: Sequence[LogContent]) -> Split:
    """Hold out the logs that were named for it."""
    logs = [LogSplit(log, log.states, ()) for log in training]
    logs += [LogSplit(log, (), log.states) for log in held_out]
    return Split(tuple(logs), "held out: the logs given for it")


def split_by_share(logs: Sequence[LogContent], share: float, seed: int) -> Split:
    """Hold out a share: whole logs drawn at random, or the last part of a single log.

    Raises:
        InvalidInputError: The share is not between 0 and 1, or a single log is too short.
    """
    if not (math.isfinite(share) and 0.0 < share < 1.0):
        raise InvalidInputError("--held-out-share", share, "above 0 and below 1")
    if len(logs) == 1:
        return _split_by_time(logs[0], share)
    count = min(max(1, round(share * len(logs))), len(logs) - 1)
    drawn = set(np.random.default_rng(seed).permutation(len(logs))[:count].tolist())
    parts = [
        LogSplit(log, (), log.states) if number in drawn else LogSplit(log, log.states, ())
        for number, log in enumerate(logs)
    ]
    return Split(tuple(parts), f"held out: {count} of {len(logs)} logs, drawn with seed {seed}")


def _split_by_time(log: LogContent, share: float) -> Split:
    first, last = log.states[0].log_time_ns, log.states[-1].log_time_ns
    border = last - share * (last - first)
    training = [state for state in log.states if state.log_time_ns < border]
    held_out = log.states[len(training) :]
    if not training or not held_out:
        bound = f"states on both sides of {1.0 - share:g} of its time; give a second log"
        raise InvalidInputError("log", f"{log.path}: {len(log.states)} states", bound)
    seconds = (last - border) / NANOSECONDS_PER_SECOND
    rule = (
        f"held out: the last {share:.0%} of the only log's time ({seconds:.1f} s); states of one "
        "log resemble each other, so give a second log for a fair judgement"
    )
    return Split((LogSplit(log, training, held_out),), rule)


def thin(log: LogContent, most: int) -> None:
    """Keep at most so many states of a log, evenly spread over them."""
    if len(log.states) > most:
        chosen = np.linspace(0, len(log.states) - 1, most).round().astype(int)
        log.states = [log.states[number] for number in chosen]
