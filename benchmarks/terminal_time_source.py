"""Cold starts with a free and with a predicted terminal time, with few iterations and with many."""

from __future__ import annotations

import numpy as np

from benchmarks.cases import Array, box_states
from benchmarks.report import Cell, Report, Table
from dscp_core import problems
from dscp_core.planning.plan import PlanOutcome, PlanStatus
from dscp_core.planning.planner import Planner, PlannerSettings, TerminalTime
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_core.problems.powered_descent.definition import NETWORK
from dscp_core.scp.scp import ScpOptions

LIMITS = (1, 2, 3, 20)
"""Iterations of one start; 20 is the node's limit."""
COST_TOLERANCE = 1e-6
"""The node's."""


def measure(*, quick: bool) -> Report:
    """Plan from every state with both sources and every limit."""
    report = Report("terminal_time_source")
    states = box_states(25 if quick else 200, seed=15)
    best = _costs(states)
    network = TerminalTimeNetwork.load(NETWORK)
    rows: list[tuple[Cell, ...]] = []
    for limit in LIMITS:
        for source in (TerminalTime.FREE, TerminalTime.PREDICTED):
            options = ScpOptions(cost_tolerance=COST_TOLERANCE, max_iterations=limit)
            settings = PlannerSettings(terminal_time=source, options=options)
            predictor = network if source is TerminalTime.PREDICTED else None
            planner = Planner(problems.get("powered_descent"), settings, predictor)
            rows.append(_row(f"{source.value}, {limit}", [planner.plan(s) for s in states], best))
    report.tables.append(
        Table(
            f"{len(states)} random states of the paper's box",
            (
                "source, iteration limit of a start",
                "certified",
                "mean iterations",
                "most",
                "median ms",
                "mean fuel above optimum, kg",
                "most, kg",
            ),
            rows,
        )
    )
    report.notes.append(
        "a state without a certified plan is started from again, by the network's source with a "
        "free terminal time; few iterations may end below the optimum, within the certificate"
    )
    return report


def _costs(states: Array) -> Array:
    """(n,) optima in kg."""
    planner = Planner(
        problems.get("powered_descent"), PlannerSettings(terminal_time=TerminalTime.FREE)
    )
    return np.array([planner.plan(state).cost for state in states])


def _row(label: str, outcomes: list[PlanOutcome], best: Array) -> tuple[Cell, ...]:
    good = np.array([outcome.status is PlanStatus.CERTIFIED for outcome in outcomes])
    iterations = [outcome.iterations for outcome in outcomes]
    lost = np.array([outcome.cost for outcome in outcomes])[good] - best[good]
    return (
        label,
        f"{np.count_nonzero(good)} of {good.size}",
        round(float(np.mean(iterations)), 2),
        max(iterations),
        round(1e3 * float(np.median([outcome.solve_time_s for outcome in outcomes])), 1),
        round(float(np.mean(lost)), 3) if good.any() else "-",
        round(float(np.max(lost)), 3) if good.any() else "-",
    )
