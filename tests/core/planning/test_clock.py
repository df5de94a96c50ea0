"""Deadlines by a clock that the test moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core import Planner, PlanStatus, ScpOptions, problems
from dscp_core.scp.trace import ScpStatus

Array = NDArray[np.float64]

DESCENT = problems.get("powered_descent")
DEADLINE_S = 5.0


class Clock:
    """Stands still until it is moved."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def between_two_starts(passes_s: float) -> Planner:
    """Time passes after the first start, while the guess of the second is worked out.

    One iteration is not enough for either.
    """
    clock = Clock()

    def slow_guess(state: Array, values: Mapping[str, Any]) -> float:
        clock.now_s += passes_s
        guess = DESCENT.terminal_time_guess
        assert guess is not None
        return guess(state, values)

    problem = replace(DESCENT, terminal_time_guess=slow_guess)
    options = ScpOptions(max_iterations=1)
    return Planner(problem, clock=clock, terminal_time="free", options=options)


def test_a_deadline_that_expires_between_two_starts_ends_the_attempt() -> None:
    outcome = between_two_starts(DEADLINE_S + 1.0).plan(deadline_s=DEADLINE_S)
    assert (outcome.status, outcome.stopped) == (PlanStatus.DEADLINE, ScpStatus.DEADLINE)
    assert outcome.iterations == 1
    assert outcome.solve_time_s == DEADLINE_S + 1.0
    assert outcome.headline == "NO PLAN (deadline): deadline: no time left to start"


def test_a_deadline_that_has_not_expired_leaves_time_for_the_second_start() -> None:
    outcome = between_two_starts(DEADLINE_S - 1.0).plan(deadline_s=DEADLINE_S)
    assert outcome.status is PlanStatus.ITERATION_LIMIT
    assert outcome.iterations == 2
    assert outcome.solve_time_s == DEADLINE_S - 1.0


def test_without_a_deadline_time_does_not_count() -> None:
    outcome = between_two_starts(1e6).plan()
    assert outcome.status is PlanStatus.ITERATION_LIMIT
    assert outcome.iterations == 2
