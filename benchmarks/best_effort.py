"""Best efforts of random infeasible landings against IPOPT: errors reached, and time."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import Cell, Report, Table
from benchmarks.timing import clocked
from dscp_core import problems
from dscp_core.planning.plan import PlanOutcome
from dscp_core.planning.planner import Planner
from dscp_core.problem.flight import Discretisation
from tests.oracles.powered_descent_best_effort import LeastError, LeastErrorDescent

VEHICLES = Path(__file__).parent.parent / "config" / "vehicles"
KINDS = ("low", "fast", "weak", "short of fuel", "beside", "low and fast")
SPEED_M_S, POSITION_M = 1e-3, 1e-2
"""What later steps may add to either error, here and there, besides a thousandth of it."""


def measure(*, quick: bool) -> Report:
    """Random cases until as many as wanted have no certified plan."""
    report = Report("best_effort")
    problem = problems.get("powered_descent")
    vehicles: list[dict[str, Any]] = [{"dry_mass": 0.0}]
    for path in sorted(VEHICLES.glob("*.yaml")):
        if "entry" not in path.stem:
            vehicles.append(dict(problem.read_vehicle(path)))
    # The oracle knows the midpoint rule.
    planner = Planner(
        problem,
        terminal_time="free",
        best_effort=True,
        discretisation=Discretisation.MIDPOINT,
    )
    wanted, rng = (12 if quick else 300), np.random.default_rng(20261125)
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
    seconds: list[float] = []
    while len(seconds) < wanted:
        kind = KINDS[int(rng.integers(len(KINDS)))]
        changes = _case(problem.table.unpack(problem.pack(_one(vehicles, rng))), kind, rng)
        planner.parameters = problem.pack(changes)
        planned, _, cpu = clocked(planner.plan)
        if planned.certified:
            continue
        seconds.append(cpu)
        counts[kind][_verdict(planner, planned)] += 1
    total = sum(counts.values(), Counter[str]())
    both = wanted - total["neither"]
    report.add("infeasible cases", wanted, "")
    report.add("with a best effort that IPOPT confirms to exist", both, "")
    reached = total["speed and position"] + total["speed"]
    report.add("of these, least speed reached", reached / max(both, 1), "1", (">=", 0.97))
    report.add("of these, least distance too", total["speed and position"] / max(both, 1), "1")
    report.add("CPU time of the whole plan, median", float(np.median(seconds)), "s")
    report.add("CPU time of the whole plan, p90", float(np.percentile(seconds, 90)), "s")
    verdicts = sorted(total)
    rows: list[tuple[Cell, ...]] = [(k, *(counts[k][v] for v in verdicts)) for k in KINDS]
    report.tables.append(Table("What was reached", ("case", *verdicts), rows))
    report.notes.append("IPOPT from three first terminal times; it too may miss an optimum")
    return report


def _one(vehicles: list[dict[str, Any]], rng: np.random.Generator) -> dict[str, Any]:
    """The paper's vehicle half of the time."""
    return vehicles[0 if rng.random() < 0.5 else int(rng.integers(len(vehicles)))]


def _case(values: dict[str, Any], kind: str, rng: np.random.Generator) -> dict[str, Any]:
    """A vehicle's values, changed so that a landing is hard or impossible."""
    case = {k: v for k, v in values.items() if not k.startswith(("trust_region", "virtual"))}
    position, velocity = np.array(values["initial_position"]), np.array(values["initial_velocity"])
    if kind in ("low", "low and fast"):
        position[0] *= rng.uniform(0.05, 0.6)
        position[1:] *= rng.uniform(0.0, 1.0)
    if kind in ("fast", "low and fast"):
        velocity *= rng.uniform(1.2, 2.5) if kind == "fast" else rng.uniform(0.8, 1.5)
    if kind == "weak":
        weaker = float(values["thrust_max"]) * rng.uniform(0.35, 0.8)
        case["thrust_max"] = max(weaker, 1.05 * float(values["thrust_min"]))
    if kind == "short of fuel":
        case["dry_mass"] = float(values["initial_mass"]) * rng.uniform(0.8, 0.97)
    if kind == "beside":
        position[1:] += 2.0 * position[0] * rng.normal(size=2)
        velocity[1:] += 60.0 * np.sqrt(position[0] / 5000.0) * rng.normal(size=2)
    # Tilt at contact is no matter of the oracle's.
    return case | {
        "initial_position": position,
        "initial_velocity": velocity,
        "contact_tilt_max": 1.55,
    }


def _verdict(planner: Planner, outcome: PlanOutcome) -> str:
    """What a best effort reached of what IPOPT finds."""
    table, packed = planner.problem.table, planner.parameters
    values = table.unpack(packed)
    effort = outcome.best_effort
    if effort is not None:
        for line in effort.violations:
            if line.startswith("glideslope_angle_max"):
                values["glideslope_angle_max"] = float(line.split(" to ")[1].split()[0])
    guess = planner.problem.terminal_time_guess
    assert guess is not None
    first = float(guess(planner.initial_state, values))
    solve = partial(LeastErrorDescent(values).solve, (first, 0.5 * first, 2.0 * first))
    least: LeastError | None = solve(SPEED_M_S, POSITION_M)
    if effort is None:
        return "neither" if least is None else "IPOPT alone"
    end = effort.plan.states[-1]
    speed = float(np.linalg.norm(end[3:6] - np.asarray(values["final_velocity"])))
    away = float(np.linalg.norm(end[1:3] - np.asarray(values["final_position"])[1:]))
    if least is None:
        return "this alone"
    if speed > 1.0021 * least.contact_speed_m_s + 2.5 * SPEED_M_S:
        return "not even speed"
    if least.solved > 1 and away > 1.005 * least.contact_position_m + 3.0 * POSITION_M:
        return "speed"
    return "speed and position"
