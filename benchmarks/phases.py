"""Where the time of a forward run goes, and what a backward run costs beside it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.report import Cell, Report, Table
from benchmarks.timing import Array, alternated, median_ms
from dscp_core import problems
from dscp_core.gradients.losses import FinalStateLoss
from dscp_core.gradients.run import implicit, unrolled
from dscp_core.planning.planner import Planner, PlannerSettings
from dscp_core.scp.scp import Scp, ScpOptions, ScpResult

SOLVERS = {"clarabel": 1.0, "qoco": 1.0, "ecos": 0.2}
"""Solvers, and the share of the rounds that each takes part in: ECOS takes half a minute else."""

LOSS = FinalStateLoss("mass", -1.0)
OVERHEAD_TARGET = 15.0
BACKWARD_TARGET = 0.15
_PARTS = ("solver's own", "solver's wrapper", "assembly", "polish", "rest")


def measure(*, quick: bool) -> Report:
    """Forward and backward runs of the paper's case, taking turns."""
    report = Report("phases")
    most = 4 if quick else 30
    planner = Planner(problems.get("powered_descent"), PlannerSettings())
    forward_rows: list[tuple[Cell, ...]] = []
    backward_rows: list[tuple[Cell, ...]] = []
    for solver, share in SOLVERS.items():
        rounds = max(1, round(share * most))
        plain = Scp(planner.transcription, ScpOptions(solver=solver))
        polished = Scp(planner.transcription, ScpOptions.for_gradients(solver=solver))
        unpolished = polished.with_options(polish=False)
        loops = {"planning": plain, "gradients": polished}
        for label, scp in loops.items():
            parts = np.median([_parts(scp.run(planner.parameters)) for _ in range(rounds)], axis=0)
            overhead = 100.0 * (1.0 - (parts[0] + parts[3]) / parts.sum())
            if label == "planning":
                report.add(
                    f"assembly + bookkeeping, {solver}", overhead, "%", ("<=", OVERHEAD_TARGET)
                )
            shares = (f"{100.0 * part / parts.sum():.1f} %" for part in parts)
            forward_rows.append((f"{solver}, {label}", 1e3 * float(parts.sum()), *shares))
        backward_rows += _backward(report, planner, solver, (plain, polished, unpolished), rounds)
    report.tables += [
        Table(
            "forward run of the paper's case (milliseconds) and where its time goes",
            ("solver, options", "run", *_PARTS),
            forward_rows,
        ),
        Table(
            "backward run, milliseconds per iteration, and over a forward iteration with ...",
            ("method", "per iteration", "planning", "gradients", "gradients, no polish"),
            backward_rows,
        ),
    ]
    report.notes += [
        "options: planning is the default, gradients is ScpOptions.for_gradients (tolerance 1e-12, "
        "polished); K is the same in all runs that are compared",
        "wrapper: checks of data and answer around the backend; rest: convergence tests, trace",
        f"medians of {most} rounds (ECOS: fewer); forward and backward runs take turns, and ratios "
        "are medians of ratios within a round",
    ]
    return report


def _parts(result: ScpResult) -> Array:
    """Seconds of a run by part, in the order of `_PARTS`."""
    iterations = result.iterations
    own = sum(i.solution.seconds + i.solution.setup_seconds for i in iterations)
    solve = sum(i.solve_seconds for i in iterations)
    assembly = sum(i.assembly_seconds for i in iterations)
    polish = sum(i.polish_seconds for i in iterations)
    return np.array(
        [own, solve - own, assembly, polish, result.seconds - solve - assembly - polish]
    )


def _backward(
    report: Report, planner: Planner, solver: str, loops: tuple[Scp, ...], rounds: int
) -> list[tuple[Cell, ...]]:
    """Rows of the backward table; runs have as many iterations as the polished one needs."""
    polished = loops[1]
    count = len(polished.run(planner.parameters).iterations)
    plain, polished, unpolished = (loop.with_options(fixed_iterations=count) for loop in loops)
    traces = {
        "after polished forward": polished.run(planner.parameters),
        "after forward without polish": unpolished.run(planner.parameters),
    }
    calls: list[Callable[[], object]] = [
        *(partial(loop.run, planner.parameters) for loop in (plain, polished, unpolished)),
        *(partial(unrolled, polished, trace, LOSS) for trace in traces.values()),
        partial(implicit, polished, traces["after polished forward"], LOSS),
    ]
    times = alternated(calls, rounds)
    rows: list[tuple[Cell, ...]] = []
    labels = [*(f"unrolled, {name}" for name in traces), "implicit (whole run / K)"]
    for column, label in enumerate(labels, start=3):
        ratios = [float(np.median(times[:, column] / times[:, i])) for i in range(3)]
        rows.append((f"{solver}, {label}", median_ms(times[:, column]) / count, *ratios))
        if label == "unrolled, after polished forward":
            report.add(
                f"backward / forward per iteration, {solver}",
                ratios[1],
                "1",
                ("<=", BACKWARD_TARGET),
            )
            report.add(f"the same over planning, {solver}", ratios[0])
    return rows
