"""State in to trajectory out: the planner alone, and the node over ROS topics."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import numpy as np

from benchmarks.cases import Array, box_states
from benchmarks.report import Cell, Report, Table
from benchmarks.timing import clocked, median_ms, p99_ms
from dscp_core import problems
from dscp_core.planning.certificate import PlanVerifier
from dscp_core.planning.plan import PlanStatus
from dscp_core.planning.planner import Planner, PlannerSettings, TerminalTime
from dscp_core.problem.trajectory import Plan
from dscp_core.problems.powered_descent.simulation import DescentRecord, DescentSimulation
from dscp_core.scp.scp import ScpOptions

SOLVERS = ("clarabel", "qoco,clarabel")
TARGET_MS = 50.0
LAST_PLAN_S = 2.0
"""With less flight time to go, nothing is planned any more."""


@dataclass(frozen=True)
class Sample:
    """One plan; times in seconds."""

    wall: float
    cpu: float
    solver: float
    certificate: float
    iterations: int
    fell_back: bool
    certified: bool


def measure(*, quick: bool) -> Report:
    """Cold plans of random states, warm plans along flights, then the node."""
    report = Report("latency")
    free = PlannerSettings(terminal_time=TerminalTime.FREE)
    simulation = DescentSimulation(Planner(problems.get("powered_descent"), free))
    flights = [simulation.record(seed) for seed in range(1 if quick else 8)]
    every = 5 if quick else 2  # ticks of 0.1 s
    rows: list[tuple[Cell, ...]] = []
    for solver in SOLVERS:
        planner = _TimedPlanner(solver)
        cold = [planner.plan(state)[0] for state in box_states(20 if quick else 300, seed=3)]
        warm = [sample for flight in flights for sample in _along(planner, flight, every)]
        rows += [_row(f"{solver}, cold", cold), _row(f"{solver}, warm", warm)]
        wall, cpu = ([s.wall for s in warm], [s.cpu for s in warm])
        report.add(f"warm plan, {solver}, median", median_ms(wall), "ms")
        report.add(f"warm plan, {solver}, p99", p99_ms(wall), "ms", ("<=", TARGET_MS))
        report.add(f"warm plan, {solver}, p99 of CPU time", p99_ms(cpu), "ms", ("<=", TARGET_MS))
    header = ("solver, start", "plans", "certified", "fallbacks", "iterations")
    times = ("median", "p99", "CPU median", "CPU p99", "solver", "certificate", "rest")
    report.tables.append(
        Table(
            "Planner.plan, free terminal time, 50 intervals (milliseconds; parts: medians)",
            (*header, *times),
            rows,
        )
    )
    report.notes += [
        "cold: random states of the paper's box; warm: measured states of closed-loop descents "
        f"with dispersions and navigation noise, every {0.1 * every:g} s, each plan started from "
        "the last one",
        "fallbacks: warm starts that failed and were followed by a cold start within the same plan",
        "the certificate is timed apart from the plan, directly after it",
    ]
    _over_topics(report, flights[0], every, quick)
    return report


class _TimedPlanner:
    """A planner with free terminal time whose plans are timed, and their certificates apart."""

    def __init__(self, solver: str) -> None:
        options = ScpOptions(solver=solver, cost_tolerance=1e-6)  # as the node's default
        self._planner = Planner(
            problems.get("powered_descent"),
            PlannerSettings(terminal_time=TerminalTime.FREE, options=options),
        )
        intervals = self._planner.settings.intervals
        self._verifier = PlanVerifier(self._planner.problem, intervals)
        self._planner.plan(self._planner.initial_state)  # pays for the solver's set-up

    def plan(
        self, state: Array, last: Plan | None = None, elapsed_s: float = 0.0
    ) -> tuple[Sample, Plan | None]:
        """Plan once; the plan is returned if it was certified."""
        outcome, wall, cpu = clocked(
            lambda: self._planner.plan(state, warm_start=last, elapsed_s=elapsed_s)
        )
        certificate, plan = 0.0, outcome.plan
        if plan is not None:
            arguments = (plan.times_s, plan.states, plan.controls, self._planner.parameters)
            certificate = clocked(lambda: self._verifier.certify(*arguments))[1]
        certified = outcome.status is PlanStatus.CERTIFIED
        sample = Sample(
            wall=wall,
            cpu=cpu,
            solver=outcome.solver_time_s,
            certificate=certificate,
            iterations=outcome.iterations,
            fell_back=last is not None and not outcome.warm_started,
            certified=certified,
        )
        return sample, plan if certified else None


def _along(planner: _TimedPlanner, flight: DescentRecord, every: int) -> list[Sample]:
    """Plans from the measured states of a flight, but for the first one, which starts cold."""
    moments, states = flight.times_s[::every], flight.measured[::every]
    last: Plan | None = None
    start_s, samples = 0.0, []
    for moment_s, state in zip(moments, states, strict=True):
        elapsed_s = float(moment_s) - start_s
        if last is not None and last.terminal_time_s - elapsed_s < LAST_PLAN_S:
            break
        sample, plan = planner.plan(state, last, elapsed_s)
        if last is not None:
            samples.append(sample)
        if plan is not None:
            last, start_s = plan, float(moment_s)
    return samples


def _row(label: str, samples: list[Sample]) -> tuple[Cell, ...]:
    wall, cpu = [s.wall for s in samples], [s.cpu for s in samples]
    return (
        label,
        len(samples),
        sum(s.certified for s in samples),
        sum(s.fell_back for s in samples),
        float(np.mean([s.iterations for s in samples])),
        median_ms(wall),
        p99_ms(wall),
        median_ms(cpu),
        p99_ms(cpu),
        median_ms([s.solver for s in samples]),
        median_ms([s.certificate for s in samples]),
        median_ms([s.wall - s.solver - s.certificate for s in samples]),
    )


def _over_topics(report: Report, flight: DescentRecord, every: int, quick: bool) -> None:
    """Measure the node, if ROS is there."""
    if importlib.util.find_spec("rclpy") is None:
        report.notes.append("ROS is not installed: the node was not measured")
        return
    from benchmarks.planner_process import fly_past

    ticks = np.flatnonzero(flight.times_s < flight.times_s[-1] - LAST_PLAN_S)[::every]
    ticks = ticks[: 20 if quick else None]
    node = fly_past(flight.measured[ticks], flight.times_s[ticks], starts=1 if quick else 5)
    whole = median_ms(node.latencies_s), p99_ms(node.latencies_s)
    report.add("node: state to trajectory, median", whole[0], "ms")
    report.add("node: state to trajectory, p99", whole[1], "ms", ("<=", TARGET_MS))
    rows: list[tuple[Cell, ...]] = [
        ("planner", median_ms(node.plan_s), p99_ms(node.plan_s)),
        ("arrival in the node to publication", median_ms(node.inside_s), p99_ms(node.inside_s)),
        ("state published to trajectory received", *whole),
    ]
    report.tables.append(Table("node (milliseconds)", ("from, to", "median", "p99"), rows))
    report.add("node: states without a trajectory", node.unanswered)
    report.add("node: memory (RSS) after the flight", node.resident_mb, "MB", ("<=", 200.0))
    report.add("node: start to first subscription", node.start_s, "s", ("<=", 2.0))
    report.notes.append(
        f"node: {len(ticks)} states of a flight, every {0.1 * every:g} s, on ~/vehicle_state, "
        "default parameters; from publishing a state to the callback of its trajectory in another "
        f"process; start: median of {node.starts}, from launch to discovery by that process"
    )
