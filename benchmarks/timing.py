"""Repeated timing with `time.perf_counter`, reduced by medians."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Result = TypeVar("Result")


def clocked(call: Callable[[], Result]) -> tuple[Result, float, float]:
    """Result, wall time and the thread's CPU time of one call, in seconds.

    On a machine that others use too, CPU time is nearer to what a core of one's own would take.
    """
    wall, cpu = time.perf_counter(), time.thread_time()
    result = call()
    return result, time.perf_counter() - wall, time.thread_time() - cpu


def alternated(calls: Sequence[Callable[[], object]], rounds: int) -> Array:
    """(rounds, calls) wall times of calls that take turns.

    Others on the machine then disturb all of them alike, and the median of the quotients of two
    columns is steadier than the quotient of two medians.
    """
    for call in calls:
        call()  # first calls set up buffers
    return np.array([[clocked(call)[1] for call in calls] for _ in range(rounds)])


def median_ms(seconds: Sequence[float] | Array) -> float:
    """Median in milliseconds; NaN of nothing."""
    return 1e3 * float(np.median(seconds)) if len(seconds) else float("nan")


def p99_ms(seconds: Sequence[float] | Array) -> float:
    """99th percentile in milliseconds; NaN of nothing."""
    return 1e3 * float(np.percentile(seconds, 99.0)) if len(seconds) else float("nan")
