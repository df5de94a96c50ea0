"""Certificates of random landings against an independent flight, and what a certificate costs."""

from __future__ import annotations

from collections import Counter

import numpy as np

from benchmarks.report import Cell, Report, Table
from benchmarks.timing import clocked, median_ms
from dscp_core import problems
from dscp_core.planning.certificate import PlanVerifier
from dscp_core.planning.planner import Planner
from dscp_core.problem.flight import ControlHold
from tests.oracles.landing_flight import land
from tests.oracles.powered_descent_physics import ThrustLaw
from tests.oracles.random_landings import random_landing

INTERVALS = 12
HOLDS = {ThrustLaw.INTERVAL_MEAN: ControlHold.MEAN, ThrustLaw.LINEAR: ControlHold.LINEAR}
ROUNDING = 1e-5
"""Of what is accepted: how exactly both flights know how far a limit is passed."""


def measure(*, quick: bool) -> Report:
    """Random landings near their bounds, then the time of a certificate."""
    report = Report("certificates")
    problem = problems.get("powered_descent")
    verifiers = {law: PlanVerifier(problem, INTERVALS, hold=hold) for law, hold in HOLDS.items()}
    rng = np.random.default_rng(20261125)
    count = 500 if quick else 10_000
    certified, wrong, refused = 0, 0, Counter[str]()
    nearest = dict[str, float]()
    for _ in range(count):
        one = random_landing(rng, INTERVALS)
        packed = problem.table.pack(one.values)
        verifier = verifiers[one.law]
        certificate = verifier.certify(one.times_s, one.states, one.controls, packed)
        if not certificate.passed:
            refused.update({reason.split()[0] for reason in certificate.reasons})
            continue
        certified += 1
        landing = land(
            one.times_s, one.controls, one.states[0], problem.table.unpack(packed), one.law
        )
        passed = {name: v for name, v in landing.excess.items() if v > 1.0 + ROUNDING}
        wrong += bool(passed) or landing.contact_s is None
        for name, value in landing.excess.items():
            nearest[name] = max(nearest.get(name, -np.inf), value)
    report.add("random landings", count, "")
    report.add("certified", certified, "")
    report.add("certified, and not within every limit", wrong, "", ("<=", 0))
    rows: list[tuple[Cell, ...]] = [
        (name, refused.get(name, 0), nearest.get(name, float("nan")))
        for name in sorted({*refused, *nearest})
    ]
    header = ("limit", "refused for it", "largest of the certified, of what is accepted")
    report.tables.append(Table("Limits", header, rows))
    for name, intervals in (("powered_descent", 50), ("entry", 100)):
        report.add(f"certificate of {name}, N = {intervals}", _median_ms(name, intervals), "ms")
    return report


def _median_ms(name: str, intervals: int) -> float:
    planner = Planner(problems.get(name), intervals=intervals)
    outcome = planner.plan()
    assert outcome.plan is not None
    plan, verifier = outcome.plan, PlanVerifier(planner.problem, intervals)
    arguments = (plan.times_s, plan.states, plan.controls, planner.parameters)
    return median_ms([clocked(lambda: verifier.certify(*arguments))[1] for _ in range(200)])
