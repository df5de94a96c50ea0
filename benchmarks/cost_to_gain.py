"""What plans are said to cost above a local optimum, against what they do, wherever runs stop."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.cases import Array, box_states
from benchmarks.report import Cell, Report, Table
from dscp_core import Planner, ScpOptions, problems
from dscp_core.errors import InvalidInputError
from dscp_core.scp.gain import cost_to_gain
from dscp_core.scp.scp import ScpResult

TO_THE_END = 150
STOPS = 30
REAL = 1e-9
"""Gaps below this, relative to the cost, are not counted: they are rounding."""


@dataclass(frozen=True)
class Family:
    """Planners of one kind, and the states that each plans from.

    Attributes:
        name: For the table.
        planner: What plans.
        states: (n, nx), SI.
        times_s: Fixed terminal times, or None.
    """

    name: str
    planner: Planner
    states: Array
    times_s: Array | None = None


def measure(*, quick: bool) -> Report:
    """Stop runs after each number of iterations; compare with where they stand still."""
    report = Report("cost_to_gain")
    rows: list[tuple[Cell, ...]] = []
    below = stops = 0
    for family in _families(8 if quick else 40):
        gaps, claims, costs = _of(family)
        real = gaps > REAL * costs
        missed = int(np.count_nonzero(gaps[real] > claims[real]))
        below, stops = below + missed, stops + gaps.size
        ratio = gaps[real] / claims[real] if real.any() else np.zeros(1)
        rows.append(
            (
                family.name,
                gaps.size,
                int(real.sum()),
                missed,
                float(ratio.max()),
                float(np.median(ratio)),
                float(np.median(claims / costs)) if claims.size else float("nan"),
            )
        )
    report.add("stops", stops)
    report.add("stops whose figure is below the true gap", below, target=("<=", 0))
    header = ("family", "stops", "with a gap", "below", "gap/figure, most", "median", "figure/J")
    report.tables.append(Table("true gap against cost_to_gain", header, rows))
    report.notes.append(
        f"each run is stopped after 1 to {STOPS} iterations, also where its trajectory does not "
        f"satisfy the dynamics yet; the optimum is what it costs after {TO_THE_END}"
    )
    return report


def _families(count: int) -> Iterator[Family]:
    descent = problems.get("powered_descent")
    box = box_states(count, seed=21)
    times = np.random.default_rng(22).uniform(33.0, 45.0, count)
    yield Family("descent, free", Planner(descent, terminal_time="free"), box)
    for weight in (0.0, 1e-3, 0.1, 1.0, 10.0):
        parameters = {"trust_region_control": [weight] * 3}
        planner = Planner(descent, parameters=parameters)
        yield Family(f"descent, fixed, control weight {weight:g}", planner, box, times)
    for solver in ("ecos", "qoco"):
        planner = Planner(descent, terminal_time="free", options=ScpOptions(solver=solver))
        yield Family(f"descent, free, {solver}", planner, box[: count // 2])
    printed = Planner(problems.get("powered_descent", "printed"))
    yield Family("descent, printed, fixed", printed, box, times)
    for name, vehicle in _VEHICLES.items():
        planner = Planner(descent, terminal_time="free", parameters=vehicle)
        yield Family(name, planner, _around(planner.initial_state, 0.08, count // 4))
    entry = Planner(problems.get("entry"), intervals=60)
    scatter = np.array([5e3, 0.05, 0.05, 200.0, 0.01, 0.2, 0.0, 0.0])
    draws = np.random.default_rng(23).uniform(-1.0, 1.0, (count, scatter.size))
    yield Family("entry", entry, entry.initial_state + scatter * draws)


def _around(state: Array, share: float, count: int) -> Array:
    draws = np.random.default_rng(24).uniform(-share, share, (count, state.size))
    return np.asarray(state * (1.0 + draws))


def _of(family: Family) -> tuple[Array, Array, Array]:
    """Gaps, claims and magnitudes of the cost, at every stop with a claim."""
    planner = family.planner
    found: list[tuple[float, float, float]] = []
    scp = planner.scp.with_options(fixed_iterations=TO_THE_END)
    for row, state in enumerate(family.states):
        try:
            packed = planner.check_state(state)
        except InvalidInputError:
            continue
        if family.times_s is not None:
            packed[planner.problem.table.slice("terminal_time")] = family.times_s[row]
        trace: ScpResult = scp.run(packed)
        claims = [cost_to_gain(scp, iteration) for iteration in trace.iterations]
        if len(claims) < TO_THE_END or claims[-1] is None:
            continue  # no feasible trajectory
        best = min(iteration.cost for iteration in trace.iterations[-10:])
        for iteration, claim in zip(trace.iterations[:STOPS], claims, strict=False):
            if claim is not None:
                found.append((iteration.cost - best, claim, abs(best)))
    gaps, claims_made, costs = np.array(found).reshape(-1, 3).T
    return gaps, claims_made, costs


# Public sizes: three engines of a first stage near their least thrust, and a large booster.
_VEHICLES: dict[str, dict[str, float | list[float]]] = {
    "three engines": {
        "initial_position": [2400.0, 20.0, 50.0],
        "initial_velocity": [-80.0, 3.0, 1.0],
        "initial_mass": 35600.0,
        "thrust_min": 1014000.0,
        "thrust_max": 2535000.0,
        "pointing_angle_max": 1.55,
        "glideslope_angle_max": 1.5533430342749532,
        "terminal_time": 20.0,
    },
    "booster of 1000 t": {
        "initial_position": [5000.0, 300.0, 200.0],
        "initial_velocity": [-200.0, 10.0, -10.0],
        "initial_mass": 1e6,
        "thrust_min": 5.28e6,
        "thrust_max": 28.6e6,
        "specific_impulse": 327.0,
        "pointing_angle_max": 0.349,
        "terminal_time": 30.0,
    },
}
