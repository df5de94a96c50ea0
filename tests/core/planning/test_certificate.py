from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from core.toy_problems import cart
from numpy.typing import NDArray
from oracles.powered_descent_physics import (
    PAPER_INITIAL_STATE,
    PAPER_PARAMETERS,
    ThrustLaw,
    fly,
    state_rate,
)

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.planning.certificate import Check, PlanCertificate, PlanVerifier
from dscp_core.planning.plan import PlanStatus
from dscp_core.planning.planner import Planner
from dscp_core.problem.declaration import PathConstraint
from dscp_core.problem.flight import ControlHold
from dscp_core.scp.scp import Scp
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

INTERVALS = 50
LAWS = {ControlHold.MEAN: ThrustLaw.INTERVAL_MEAN, ControlHold.LINEAR: ThrustLaw.LINEAR}


@dataclass(frozen=True)
class Solved:
    times_s: Array
    states: Array
    controls: Array
    parameters: Array


@pytest.fixture(scope="module")
def plan() -> Solved:
    planner = Planner(problems.get("powered_descent"))
    found = planner.plan().plan
    assert found is not None
    return Solved(found.times_s, found.states, found.controls, planner.parameters)


def to_gate(plan: Solved) -> Solved:
    """The same plan where the ground is 100 m lower: no flight of it comes into contact."""
    table = problems.get("powered_descent").table
    lower = {"gate_height": 100.0, "final_position": [-100.0, 0.0, 0.0]}
    return replace(plan, parameters=table.pack(lower, base=plan.parameters))


@pytest.fixture(scope="module")
def verifier() -> PlanVerifier:
    return PlanVerifier(problems.get("powered_descent"), INTERVALS)


def certify(verifier: PlanVerifier, plan: Solved, controls: Array) -> PlanCertificate:
    return verifier.certify(plan.times_s, plan.states, controls, plan.parameters)


def check(certificate: PlanCertificate, name: str) -> Check:
    return next(c for c in certificate.checks if c.name == name)


@pytest.mark.parametrize("hold", ControlHold)
def test_flight_agrees_with_an_independent_one(plan: Solved, hold: ControlHold) -> None:
    verifier = PlanVerifier(problems.get("powered_descent"), INTERVALS, hold=hold)
    certificate = certify(verifier, to_gate(plan), plan.controls)
    flight = fly(plan.times_s, plan.controls, plan.states[0], law=LAWS[hold])
    # Both integrate with 1e-10 or better of 5 km and 38 t per interval.
    np.testing.assert_allclose(certificate.states[-1], flight.final_state, rtol=0.0, atol=1e-5)
    assert certificate.miss_position_m == pytest.approx(flight.miss_position_m, abs=1e-5)
    assert certificate.miss_speed_m_s == pytest.approx(flight.miss_speed_m_s, abs=1e-6)
    assert certificate.mass_used_kg == pytest.approx(38000.0 - flight.final_mass_kg, abs=1e-5)
    assert certificate.hold is hold


def test_good_plan_passes(plan: Solved, verifier: PlanVerifier) -> None:
    certificate = certify(verifier, plan, plan.controls)
    assert certificate.passed
    assert certificate.reasons == ()
    names = [c.name for c in certificate.checks]
    assert names == [
        "miss_position",
        "miss_speed",
        "contact_vertical_speed",
        "contact_lateral_speed",
        "contact_tilt",
        "dry_mass",
        "contact_pointing",
        "altitude_floor",
        "thrust_min",
        "thrust_max",
        "pointing",
        "glideslope",
        "mean_thrust_min",
    ]
    assert certificate.unchecked == ("thrust_rate_max",)
    assert all(c.passed for c in certificate.checks)
    # What propagated intervals leave, and the fall from there.
    assert certificate.miss_position_m < 1e-5
    assert certificate.miss_speed_m_s < 5e-3
    assert certificate.contact_time_s == pytest.approx(32.81, abs=1e-3)
    assert certificate.times_s[-1] == certificate.contact_time_s
    assert certificate.value("thrust_max") == check(certificate, "thrust_max").worst_value


def test_grid_and_controls_as_flown(plan: Solved, verifier: PlanVerifier) -> None:
    plan = to_gate(plan)
    certificate = certify(verifier, plan, plan.controls)
    np.testing.assert_allclose(certificate.times_s, np.linspace(0.0, 32.81, 4 * INTERVALS + 1))
    assert certificate.states.shape == (4 * INTERVALS + 1, 7)
    means = (plan.controls[1:] + plan.controls[:-1]) / 2
    np.testing.assert_allclose(certificate.controls[:-1], np.repeat(means, 4, axis=0))
    np.testing.assert_allclose(certificate.controls[-1], means[-1])
    linear = PlanVerifier(
        problems.get("powered_descent"), INTERVALS, hold=ControlHold.LINEAR, substeps=2
    )
    flown = certify(linear, plan, plan.controls)
    # From below at the nodes: the controls are continuous.
    np.testing.assert_allclose(flown.controls[::2], plan.controls, rtol=1e-12)
    np.testing.assert_allclose(flown.controls[1::2], means, rtol=1e-12)


def test_worst_values_are_those_of_the_flown_grid(plan: Solved, verifier: PlanVerifier) -> None:
    plan = to_gate(plan)
    certificate = certify(verifier, plan, plan.controls)
    thrust = np.linalg.norm(certificate.controls, axis=1)
    lateral = np.linalg.norm(certificate.controls[:, 1:], axis=1)
    offset = np.linalg.norm(certificate.states[:, 1:3], axis=1)
    tilt, slope = PAPER_PARAMETERS.pointing_max_rad, PAPER_PARAMETERS.glideslope_max_rad
    violations = {
        "thrust_min": PAPER_PARAMETERS.thrust_min_n - thrust,
        "thrust_max": thrust - PAPER_PARAMETERS.thrust_max_n,
        # Distances to the cones.
        "pointing": np.cos(tilt) * lateral - np.sin(tilt) * certificate.controls[:, 0],
        "glideslope": np.cos(slope) * offset - np.sin(slope) * (certificate.states[:, 0] + 100.0),
    }
    for name, values in violations.items():
        # Rounding of newtons of size 1e5 and metres of size 1e4.
        assert certificate.value(name) == pytest.approx(values.max(), abs=1e-6)
        moment = certificate.times_s[np.argmax(values)]
        assert check(certificate, name).time_s == pytest.approx(moment)


def test_flight_starts_where_it_is_told(plan: Solved, verifier: PlanVerifier) -> None:
    states = plan.states.copy()
    states[0, 1] += 5.0
    certificate = verifier.certify(plan.times_s, states, plan.controls, plan.parameters)
    assert not certificate.passed
    assert certificate.miss_position_m == pytest.approx(5.0, abs=0.2)  # the plan's own 0.12 m


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("miss_position", lambda u: u * 1.005),
        ("miss_speed", lambda u: u * 1.005),
        ("thrust_max", lambda u: np.where(np.arange(51)[:, None] == 45, u * 1.5, u)),
        ("thrust_min", lambda u: np.where(np.arange(51)[:, None] < 3, u * 0.5, u)),
        ("pointing", lambda u: u * np.where(np.arange(51)[:, None] < 9, [1.0, 2.0, 2.0], 1.0)),
    ],
)
def test_bad_plan_fails_for_the_right_reason(
    plan: Solved, verifier: PlanVerifier, name: str, spoil: object
) -> None:
    assert callable(spoil)
    certificate = certify(verifier, plan, spoil(plan.controls))
    assert not certificate.passed
    failed = check(certificate, name)
    assert not failed.passed
    assert failed.worst_value > failed.bound
    reason = next(r for r in certificate.reasons if r.startswith(name))
    numbers = [float(n) for n in re.findall(r"-?\d+\.?\d*(?:e[+-]?\d+)?", reason)]
    assert numbers[0] == pytest.approx(failed.worst_value, rel=1e-3)
    assert numbers[-1] == pytest.approx(failed.bound, rel=1e-3)
    assert failed.unit in reason
    assert len(certificate.reasons) == sum(not c.passed for c in certificate.checks)


def test_flight_below_the_glideslope(plan: Solved, verifier: PlanVerifier) -> None:
    states = plan.states.copy()
    states[0, :3] = (300.0, 3000.0, 0.0)
    certificate = verifier.certify(plan.times_s, states, plan.controls, plan.parameters)
    assert not check(certificate, "glideslope").passed
    assert any(reason.startswith("glideslope") for reason in certificate.reasons)


def test_alternating_thrust_is_seen_through(plan: Solved, verifier: PlanVerifier) -> None:
    # Every node has the least thrust, every mean only 0.87 of it.
    tilt, least = np.radians(30.0), PAPER_PARAMETERS.thrust_min_n
    controls = least * np.tile([np.cos(tilt), np.sin(tilt), 0.0], (INTERVALS + 1, 1))
    controls[::2, 1] *= -1.0
    certificate = certify(verifier, plan, controls)
    assert certificate.value("thrust_min") == pytest.approx(least * (1 - np.cos(tilt)), rel=1e-9)
    assert not check(certificate, "thrust_min").passed


def test_exhausted_vehicle(plan: Solved, verifier: PlanVerifier) -> None:
    times = np.linspace(0.0, 150.0, INTERVALS + 1)
    controls = np.tile([PAPER_PARAMETERS.thrust_max_n, 0.0, 0.0], (INTERVALS + 1, 1))
    certificate = verifier.certify(times, plan.states, controls, plan.parameters)
    assert not certificate.passed
    # 38 t burn up in 124 s.
    assert re.match(r"integration ended before 12\d\.\d* s", certificate.reasons[0])
    assert np.isfinite(certificate.states).all()
    with pytest.raises(InvalidInputError, match="miss_position"):
        _ = certificate.miss_position_m


def test_plan_that_is_no_number(plan: Solved, verifier: PlanVerifier) -> None:
    controls = plan.controls.copy()
    controls[20, 1] = np.nan
    certificate = certify(verifier, plan, controls)
    assert not certificate.passed
    assert certificate.reasons


def test_rates_are_those_of_the_dynamics(plan: Solved, verifier: PlanVerifier) -> None:
    rates = verifier.rates(plan.states, plan.controls, plan.parameters)
    expected = [
        state_rate(x, u, PAPER_PARAMETERS) for x, u in zip(plan.states, plan.controls, strict=True)
    ]
    np.testing.assert_allclose(rates, expected, rtol=1e-12)


def test_unknown_check(plan: Solved, verifier: PlanVerifier) -> None:
    certificate = certify(verifier, plan, plan.controls)
    with pytest.raises(InvalidInputError, match="one of miss_position"):
        certificate.value("fuel")


def test_problem_without_misses_or_mass() -> None:
    transcription = Transcription(cart(), 10)
    result = Scp(transcription).run(transcription.table.pack())
    layout = transcription.layout
    certificate = PlanVerifier(cart(), 10).certify(
        np.linspace(0.0, 2.0, 11),
        layout.states(result.final_reference),
        layout.controls(result.final_reference),
        result.parameters,
    )
    names = [c.name for c in certificate.checks]
    assert names == ["miss_position", "miss_speed", "force_max", "force_min"]
    assert certificate.mass_used_kg is None
    # The midpoint rule's error with ten intervals.
    np.testing.assert_allclose(certificate.states[-1], [1.0, 0.0], atol=5e-3)


def test_start_of_the_paper_is_flown(plan: Solved, verifier: PlanVerifier) -> None:
    certificate = certify(verifier, plan, plan.controls)
    # Scaling and back.
    np.testing.assert_allclose(certificate.states[0], PAPER_INITIAL_STATE, rtol=1e-9)


def test_without_misses_every_pinned_state_is_checked() -> None:
    problem = replace(cart(), initial_state_parameters=("start",))
    outcome = Planner(problem).plan()
    assert outcome.certificate is not None
    bounds = {check.name: check.bound for check in outcome.certificate.checks}
    assert (bounds["miss_position"], bounds["miss_speed"]) == (0.02, 0.005)
    assert outcome.status is PlanStatus.CERTIFIED
    # The same controls, flown for another mass, end elsewhere: that is no certified plan.
    plan = outcome.plan
    assert plan is not None
    heavier = problem.pack({"mass": 1.6})
    certificate = PlanVerifier(problem, 50).certify(
        plan.times_s, plan.states, plan.controls, heavier
    )
    assert not certificate.passed
    assert "miss_position" in certificate.reasons[0]


def test_a_constraint_without_a_tolerance_accepts_a_thousandth_of_its_scale() -> None:
    outcome = Planner(replace(cart(), initial_state_parameters=("start",))).plan()
    assert outcome.certificate is not None
    bounds = {check.name: check.bound for check in outcome.certificate.checks}
    assert bounds["force_max"] == bounds["force_min"] == pytest.approx(3e-3)


def test_a_constraint_may_not_have_the_name_of_an_end_check() -> None:
    clash = PathConstraint("miss_speed", lambda at, p: at.x[1] - 1.0, 1.0, "m/s")
    with pytest.raises(InvalidInputError, match="miss_speed"):
        replace(cart(), path_constraints=(clash,))
