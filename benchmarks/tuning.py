"""How the tuner's gradients scale: with the number of states, and with the workers."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cases import box_states
from benchmarks.report import Cell, Report, Table
from benchmarks.timing import clocked
from dscp_core import problems
from dscp_core.planning.planner import PlannerSettings, TerminalTime
from dscp_core.tuning.choice import LossChoice
from dscp_core.tuning.evaluator import TuningModel
from dscp_core.tuning.objective import Objective
from dscp_core.tuning.quantities import parse_tuned
from dscp_core.tuning.samples import StateSet
from dscp_core.tuning.space import SearchSpace
from dscp_core.workers.choice import available_cores
from dscp_core.workers.processes import ProcessEngine

INTERVALS = 20
"""Few, so that ten thousand states take minutes."""

TIME_S = 40.0
"""Enough for every state of the box."""

TUNED = "thrust_max=7e5:9e5,trust_region_control,virtual_control_weight"
FLAT_TARGET = 1.1
MEMORY_TARGET_MIB = 32.0
SPEED_UP_TARGET = 1.8


def measure(*, quick: bool) -> Report:
    """Mean loss and gradient over many states, as in one epoch of a tuning."""
    report = Report("tuning")
    _measure_scaling(report, (50, 200) if quick else (100, 1000, 10000))
    _measure_workers(report, 64 if quick else 128, 2 if quick else 5)
    report.notes += [
        f"an evaluation is the mean loss (fuel) and its gradient over all states, N = {INTERVALS}, "
        f"t_f = {TIME_S:g} s, tuned: {TUNED}",
        "memory: high-water mark of this process and the greatest of a worker's, so that growth is "
        "what more states have taken at any time",
        f"this machine gives {available_cores()} cores; two workers against one take turns on the "
        "same states",
    ]
    return report


def _measure_scaling(report: Report, counts: tuple[int, ...]) -> None:
    rows: list[tuple[Cell, ...]] = []
    with _objective(min(2, available_cores())) as objective:
        _evaluate(objective, counts[0])  # workers start, and allocate what they keep
        for count in counts:
            found, wall, _ = clocked(partial(_evaluate, objective, count))
            rows.append(
                (count, 1e3 * wall / count, found.iterations, found.untrusted, *_peaks_mib())
            )
    times = [float(row[1]) for row in rows]
    report.add(
        f"time per state, {counts[-1]} against {counts[0]}",
        times[-1] / times[0],
        target=("<=", FLAT_TARGET),
    )
    for column, name in ((4, "main process"), (5, "worker")):
        report.add(
            f"memory, {counts[-1]} against {counts[0]}, {name}",
            float(rows[-1][column]) - float(rows[0][column]),
            "MiB",
            ("<=", MEMORY_TARGET_MIB),
        )
    report.tables.append(
        Table(
            "one evaluation, two workers",
            ("states", "ms per state", "iterations", "untrusted", "main MiB", "worker MiB"),
            rows,
        )
    )


def _measure_workers(report: Report, count: int, rounds: int) -> None:
    with _objective(1) as one, _objective(2) as two:
        for objective in (one, two):
            _evaluate(objective, 16)
        seconds = np.array(
            [
                [clocked(partial(_evaluate, objective, count))[1] for objective in (one, two)]
                for _ in range(rounds)
            ]
        )
    ratios = seconds[:, 0] / seconds[:, 1]
    report.add("2 workers against 1", float(np.median(ratios)), target=(">=", SPEED_UP_TARGET))
    report.tables.append(
        Table(
            f"{count} states, milliseconds per state",
            ("round", "1 worker", "2 workers", "ratio"),
            [
                (number, *(1e3 * row / count), ratio)
                for number, (row, ratio) in enumerate(zip(seconds, ratios, strict=True), start=1)
            ],
        )
    )


@contextmanager
def _objective(workers: int) -> Iterator[Objective]:
    planner = PlannerSettings(
        intervals=INTERVALS,
        parameters={"terminal_time": TIME_S},
        terminal_time=TerminalTime.FIXED,
    )
    problem = problems.get("powered_descent")
    space = SearchSpace(problem, parse_tuned(problem, TUNED), problem.pack(planner.parameters))
    engine: Any = ProcessEngine(TuningModel(problem, planner, LossChoice.parse("fuel")), workers)
    try:
        yield Objective(problem, engine, space, None, tunes_network=False)
    finally:
        engine.close()


def _evaluate(objective: Objective, count: int) -> Any:
    states = StateSet(
        box_states(count, seed=3), np.full(count, np.nan), ("",) * count, np.arange(count)
    )
    return objective.evaluate(objective.space.start(), states)


def _peaks_mib() -> tuple[float, float]:
    """High-water marks of this process and of the greatest of its workers."""
    workers = [_peak_mib(child.pid) for child in multiprocessing.active_children()]
    return _peak_mib("self"), max(workers, default=float("nan"))


def _peak_mib(process: int | str | None) -> float:
    for line in Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmHWM:"):
            return float(line.split()[1]) / 1024.0
    return float("nan")
