"""Random states of the paper's box: share of certified plans, iterations, latency."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.cases import Array, box_states
from benchmarks.report import Cell, Report, Table
from benchmarks.timing import clocked, median_ms, p99_ms
from dscp_core import problems
from dscp_core.planning.plan import PlanOutcome, PlanStatus
from dscp_core.planning.planner import Planner, PlannerSettings, TerminalTime
from dscp_core.problem.declaration import TERMINAL_TIME
from dscp_core.scp.scp import ScpOptions

SOLVERS = ("clarabel", "qoco,clarabel")
MARGIN_S = 1.0
"""Fixed terminal times are the optimal one plus up to this much."""


@dataclass(frozen=True)
class Attempt:
    """A plan with its wall and CPU time in seconds."""

    outcome: PlanOutcome
    wall: float
    cpu: float


def measure(*, quick: bool) -> Report:
    """Plan from every state with free and with fixed terminal time, with every solver."""
    report = Report("random_states")
    count = 25 if quick else 1000
    states = box_states(count, seed=1)
    margins = np.random.default_rng(2).uniform(0.0, MARGIN_S, count)
    rows: list[tuple[Cell, ...]] = []
    failures: list[tuple[Cell, ...]] = []
    optimal: Array | None = None
    for solver in SOLVERS:
        for mode in (TerminalTime.FREE, TerminalTime.FIXED):
            planner = Planner(
                problems.get("powered_descent"),
                PlannerSettings(terminal_time=mode, options=ScpOptions(solver=solver)),
            )
            times = None if mode is TerminalTime.FREE or optimal is None else optimal + margins
            attempts = _plan(planner, states, times)
            outcomes = [attempt.outcome for attempt in attempts]
            if optimal is None:
                optimal = np.array([outcome.terminal_time_used_s for outcome in outcomes])
            label = f"{solver}, {mode.value} t_f"
            _summarise(report, label, outcomes)
            rows.append(_row(label, attempts))
            failures += _unusual(label, outcomes)
    report.tables.append(
        Table(
            "plans, certificate included (milliseconds)",
            (
                "solver, terminal time",
                "iterations",
                "most",
                "median",
                "p99",
                "CPU median",
                "CPU p99",
                "solver's own",
            ),
            rows,
        )
    )
    if failures:
        report.tables.append(
            Table("states without a certified plan", ("solver, terminal time", "why"), failures)
        )
    report.notes.append(
        f"{count} states, uniform in r = (5200+-200, +-600, +-600) m, v = (-135+-15, +-30, +-30) "
        f"m/s, m = 38 t; a fixed terminal time is the first solver's free optimum plus up to "
        f"{MARGIN_S:g} s"
    )
    report.notes.append(
        "first subproblem failed: a failure of the solver, or no feasible point in the subproblem"
    )
    return report


def _plan(planner: Planner, states: Array, times_s: Array | None) -> list[Attempt]:
    place = planner.problem.table.slice(TERMINAL_TIME)
    planner.plan(planner.initial_state)  # the first plan pays for the solver's set-up
    attempts = []
    for number, state in enumerate(states):
        if times_s is not None:
            planner.parameters[place] = times_s[number]
        attempts.append(Attempt(*clocked(partial(planner.plan, state))))
    return attempts


def _summarise(report: Report, label: str, outcomes: list[PlanOutcome]) -> None:
    certified = sum(outcome.status is PlanStatus.CERTIFIED for outcome in outcomes)
    first = sum(outcome.iterations == 0 for outcome in outcomes)
    share = 100.0 * certified / len(outcomes)
    report.add(f"certified, {label}", share, "%", (">=", 99.5))
    report.add(f"first subproblem failed, {label}", first, "states", ("<=", 0))


def _row(label: str, attempts: list[Attempt]) -> tuple[Cell, ...]:
    iterations = np.array([attempt.outcome.iterations for attempt in attempts])
    wall, cpu = [attempt.wall for attempt in attempts], [attempt.cpu for attempt in attempts]
    own = [attempt.outcome.solver_time_s for attempt in attempts]
    times = (f(seconds) for seconds in (wall, cpu) for f in (median_ms, p99_ms))
    return label, float(iterations.mean()), int(iterations.max()), *times, median_ms(own)


def _unusual(label: str, outcomes: list[PlanOutcome]) -> list[tuple[Cell, ...]]:
    """One row per status and failed checks, with the count and one message."""
    examples: dict[tuple[str, ...], str] = {}
    counts: Counter[tuple[str, ...]] = Counter()
    for outcome in outcomes:
        if outcome.status is PlanStatus.CERTIFIED:
            continue
        failed: tuple[str, ...] = ()
        if outcome.certificate is not None:
            failed = tuple(check.name for check in outcome.certificate.checks if not check.passed)
        cause = (outcome.status.name, *failed)
        counts[cause] += 1
        examples.setdefault(cause, outcome.message)
    return [
        (label, f"{number} x {' '.join(cause)}, for example: {examples[cause]}")
        for cause, number in counts.most_common()
    ]
