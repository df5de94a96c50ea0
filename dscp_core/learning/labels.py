"""Optimal terminal times of many states, by making the terminal time a decision."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.solvers import SolverSettings
from dscp_core.errors import DscpError
from dscp_core.learning.evaluator import (
    BestTimeJob,
    GivenTimeJob,
    GradientMethod,
    Job,
    Outcome,
)
from dscp_core.scp.scp import ScpOptions
from dscp_core.workers.engine import Engine

Array = NDArray[np.float64]
Progress = Callable[[int], object]

CHUNK = 16
"""States per item: long enough to hide the hand-over, short enough to share out evenly."""


LABELLING = ScpOptions(
    cost_tolerance=1e-9,
    max_iterations=60,
    solver="qoco,clarabel",
    solver_settings=SolverSettings(tolerance=1e-9),
)
"""Iterations for labels: terminal times are good to about 7e-6, relative."""

TRUTH = ScpOptions(
    cost_tolerance=1e-10, max_iterations=120, solver_settings=SolverSettings(tolerance=1e-12)
)
"""Iterations for reference solutions: terminal times are good to about 2e-6, relative."""

MOST_FAILURES = 0.02
"""Share of states whose optimum may be missing."""


class LabelError(DscpError):
    """No optimum was found for some states that need one."""


@dataclass(frozen=True, eq=False)
class Labels:
    """Optimal terminal times.

    Attributes:
        states: (n, 7).
        terminal_time_s: (n,).
        final_mass_kg: (n,).
        references: (n, R) scaled reference vectors of the optimal trajectories.
    """

    states: Array
    terminal_time_s: Array
    final_mass_kg: Array
    references: Array


def run_jobs(
    engine: Engine[Job, Outcome], jobs: Sequence[Job], progress: Progress | None = None
) -> Iterator[Outcome]:
    """Outcomes in the order of the jobs.

    Args:
        engine: Evaluates.
        jobs: What.
        progress: Told the number of states of every finished job.
    """
    for outcome in engine.map(jobs):
        if progress is not None:
            progress(len(outcome.converged))
        yield outcome


def best_time_jobs(states: Array, options: ScpOptions) -> list[BestTimeJob]:
    """Jobs that find the optimum of states (n, 7)."""
    return [BestTimeJob(part, options) for part in _chunks(states)]


def best_times(
    engine: Engine[Job, Outcome],
    states: Array,
    options: ScpOptions,
    progress: Progress | None = None,
    *,
    most_failures: float = MOST_FAILURES,
) -> Labels:
    """Optimal terminal times of states (n, 7), but for those that do not converge.

    Args:
        engine: Evaluates.
        states: (n, 7).
        options: How to iterate.
        progress: Told the number of states of every finished job.
        most_failures: Share of the states that may not converge.

    Raises:
        LabelError: More do not.
    """
    jobs = best_time_jobs(states, options)
    outcome = Outcome.join(list(run_jobs(engine, jobs, progress)))
    check_failures(states, outcome.converged, most_failures)
    found = outcome.converged
    return Labels(
        states[found],
        outcome.terminal_time_s[found],
        outcome.final_mass_kg[found],
        outcome.references[found],
    )


def check_failures(
    states: Array, found: NDArray[np.bool_], most_failures: float = MOST_FAILURES
) -> None:
    """Refuse to go on without the optimum of more than a share of states (n, 7).

    Raises:
        LabelError: They are too many.
    """
    if np.count_nonzero(~found) > most_failures * len(states):
        row = int(np.flatnonzero(~found)[0])
        raise LabelError(
            f"{np.count_nonzero(~found)} of {len(states)} states have no optimum that converges, "
            f"among them {np.round(states[row], 3).tolist()}"
        )


def given_times(
    engine: Engine[Job, Outcome],
    states: Array,
    times_s: Array,
    options: ScpOptions,
    *,
    method: GradientMethod = GradientMethod.NONE,
    references: Array | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Trajectories at given terminal times.

    Args:
        engine: Evaluates.
        states: (n, 7).
        times_s: (n,).
        options: How to iterate.
        method: How to differentiate.
        references: (n, R) to start from; None, or rows of NaN: the problem's own guess.
        progress: Told the number of states of every finished job.
    """
    parts = _chunks(np.arange(len(states)))
    jobs = [
        GivenTimeJob(
            states[part],
            options,
            times_s[part],
            method,
            None if references is None else references[part],
        )
        for part in parts
    ]
    return Outcome.join(list(run_jobs(engine, jobs, progress)))


def _chunks(array: NDArray[Any]) -> list[NDArray[Any]]:
    return [array[start : start + CHUNK] for start in range(0, len(array), CHUNK)]
