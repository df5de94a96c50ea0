"""Report and health messages: exact round trips, no NaN, numbered errors."""

from __future__ import annotations

import contextlib
import math
import string
from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from dscp_core.planning.certificate import Check, ControlHold, PlanCertificate
from dscp_core.planning.plan import PlanOutcome, PlanStatus, TerminalTime
from dscp_core.scp.trace import ScpStatus
from msg_adapters.diagnostics import Health, health_from_message, message_from_health
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.report import (
    AttemptFigures,
    BestEffortFigures,
    CertificateFigures,
    CheckFigures,
    NodeCode,
    PlanReport,
    Rejection,
    attempt_from_outcome,
    figures_from_certificate,
    rejection_from_error,
)
from msg_adapters.report_message import level_of, message_from_report, report_from_message
from msg_adapters.validity import Validity, message_from_validity, validity_from_message

STAMPS = st.integers(0, 2**31 * 1_000_000_000 - 1)
TEXT = st.text(string.printable, max_size=20)
FINITE = st.floats(allow_nan=False, allow_infinity=False)
NUMBERS = st.none() | FINITE
COUNTS = st.integers(0, 2**63)

attempts = st.builds(
    AttemptFigures,
    iterations=COUNTS,
    warm_started=st.booleans(),
    converged=st.none() | st.booleans(),
    stopped=st.none() | TEXT,
    cost_unit=st.none() | TEXT,
    solver=st.none() | TEXT,
    terminal_time_source=st.none() | TEXT,
    terminal_time_reason=st.none() | TEXT,
    **dict.fromkeys(
        (
            "solve_time_ms",
            "solver_time_ms",
            "deadline_ms",
            "virtual_control",
            "max_defect",
            "cost",
            "cost_to_gain",
            "terminal_time_predicted_s",
            "terminal_time_used_s",
        ),
        NUMBERS,
    ),
)
checks = st.builds(
    CheckFigures,
    name=TEXT,
    worst_value=NUMBERS,
    bound=NUMBERS,
    unit=TEXT,
    time_s=NUMBERS,
    passed=st.booleans(),
)
certificates = st.builds(
    CertificateFigures,
    passed=st.booleans(),
    reasons=st.lists(TEXT, max_size=3).map(tuple),
    values=st.dictionaries(TEXT.map("miss_{}".format), FINITE, max_size=4),
    checks=st.lists(checks, max_size=3).map(tuple),
    unchecked=st.lists(TEXT, max_size=3).map(tuple),
)
reports = st.builds(
    PlanReport,
    stamp_ns=STAMPS,
    source=TEXT,
    code=st.integers(0, 999),
    code_name=TEXT,
    message=TEXT,
    problem=TEXT,
    published=st.booleans(),
    drops=COUNTS,
    rejected=COUNTS,
    input_stamp_ns=st.none() | STAMPS,
    latency_ms=NUMBERS,
    mass_source=st.none() | TEXT,
    parameter_set=st.none() | TEXT,
    state=st.dictionaries(TEXT, st.floats(allow_nan=False, allow_infinity=False), max_size=8),
    attempt=st.none() | attempts,
    certificate=st.none() | certificates,
    rejection=st.none() | st.builds(Rejection, field=TEXT, value=TEXT, bound=TEXT),
    best_effort=st.none()
    | st.builds(
        BestEffortFigures,
        violations=st.lists(TEXT, min_size=1, max_size=3).map(tuple),
        steps=st.lists(TEXT, max_size=3).map(tuple),
    ),
)


def through_the_wire(message: DiagnosticArray) -> DiagnosticArray:
    return deserialize_message(serialize_message(message), DiagnosticArray)


def encode(report: PlanReport) -> DiagnosticArray:
    return message_from_report(report, node="planner", frame="landing_site")


@given(reports)
def test_report_round_trip_is_exact(report):
    assert report_from_message(through_the_wire(encode(report))) == report


def test_a_report_of_before_2026_12_is_read():
    check = CheckFigures("glideslope", 0.1, 1.0, "m", 3.0, True)
    written = replace(FULL, certificate=CertificateFigures(True, (), {}, (check,)))
    message = encode(written)
    new = ("stopped", "cost_to_gain", "cost_unit", "certificate.check.0.margin")
    kept = [pair for pair in message.status[0].values if pair.key not in new]
    assert len(kept) == len(message.status[0].values) - len(new)
    message.status[0].values = kept
    old = replace(written.attempt, stopped=None, cost_to_gain=None, cost_unit=None)
    assert report_from_message(message) == replace(written, attempt=old)


def test_a_check_has_its_margin():
    checks = (
        CheckFigures("kept", 0.25, 1.0, "m", 3.0, True),
        CheckFigures("broken", 1.5, 1.0, "m", 3.0, False),
        CheckFigures("unknown", None, 1.0, "m", 3.0, False),
    )
    message = encode(replace(FULL, certificate=CertificateFigures(False, (), {}, checks)))
    pairs = {pair.key: pair.value for pair in message.status[0].values}
    assert pairs["certificate.check.0.margin"] == "0.75"
    assert pairs["certificate.check.1.margin"] == "-0.5"
    assert "certificate.check.2.margin" not in pairs


validities = st.builds(
    Validity,
    stamp_ns=STAMPS,
    valid=st.booleans(),
    code=st.integers(0, 999),
    code_name=TEXT,
    reason=TEXT,
    trajectory_stamp_ns=st.none() | STAMPS,
    trajectory_end_ns=st.none() | STAMPS,
    best_effort_stamp_ns=st.none() | STAMPS,
)


@given(validities)
def test_validity_round_trip_is_exact(validity):
    message = message_from_validity(validity, node="planner", problem="powered_descent")
    assert validity_from_message(through_the_wire(message)) == validity
    level = DiagnosticStatus.OK if validity.valid else DiagnosticStatus.WARN
    assert message.status[0].level == level


@given(validities, STAMPS, STAMPS)
def test_only_the_trajectory_in_question_is_allowed_in_its_own_time(validity, stamp_ns, now_ns):
    if validity.allows(stamp_ns, now_ns):
        assert validity.valid
        assert stamp_ns == validity.trajectory_stamp_ns
        assert stamp_ns <= now_ns <= validity.trajectory_end_ns


def test_a_validity_without_its_word_is_refused():
    message = message_from_validity(Validity(0, True, 0, "CERTIFIED", ""), node="n", problem="p")
    message.status[0].values = [pair for pair in message.status[0].values if pair.key != "valid"]
    with pytest.raises(RejectedInputError, match="'valid'") as caught:
        validity_from_message(message)
    assert caught.value.code is InputCode.REPORT_MISSING_KEY


def outcome(**changes) -> PlanOutcome:
    values = {
        "status": PlanStatus.CERTIFIED,
        "stopped": ScpStatus.CONVERGED,
        "converged": True,
        "cost_to_gain": 0.25,
        "message": "certified",
        "plan": None,
        "certificate": None,
        "iterations": 6,
        "solve_time_s": 0.02,
        "solver_time_s": 0.015,
        "virtual_control": 1e-9,
        "max_defect": 1e-8,
        "cost": -31760.0,
        "cost_unit": "kg",
        "terminal_time_predicted_s": None,
        "terminal_time_used_s": 32.81,
        "terminal_time_source": TerminalTime.FREE,
        "terminal_time_reason": "",
        "warm_started": True,
        "solver": "qoco",
        "parameters": {},
    }
    return PlanOutcome(**(values | changes))


def test_outcome_becomes_figures_in_milliseconds():
    attempt = attempt_from_outcome(outcome(), deadline_s=0.25)
    assert attempt.iterations == 6
    assert attempt.solve_time_ms == 20.0
    assert attempt.solver_time_ms == 15.0
    assert attempt.deadline_ms == 250.0
    assert attempt.terminal_time_used_s == 32.81
    assert attempt.terminal_time_predicted_s is None
    assert attempt.warm_started is True
    assert attempt.converged is True
    assert attempt_from_outcome(outcome(converged=False), 1.0).converged is False
    assert (attempt.stopped, attempt.cost_to_gain, attempt.cost_unit) == ("converged", 0.25, "kg")
    assert attempt_from_outcome(outcome(stopped=None, cost_to_gain=None), 1.0).stopped is None
    assert attempt.solver == "qoco"
    assert attempt.terminal_time_source == "free"
    assert attempt.terminal_time_reason is None


def test_the_source_of_the_terminal_time_comes_with_its_reason():
    reason = "mass: got 37000.0, expected 38000 kg"
    attempt = attempt_from_outcome(outcome(terminal_time_reason=reason), None)
    report = PlanReport(0, "state", 0, "CERTIFIED", "", "powered_descent", attempt=attempt)
    pairs = {pair.key: pair.value for pair in encode(report).status[0].values}
    assert pairs["terminal_time_source"] == "free"
    assert pairs["terminal_time_reason"] == reason


def test_numbers_that_do_not_exist_are_left_out_of_the_message():
    attempt = attempt_from_outcome(outcome(cost=math.nan, max_defect=math.inf), None)
    report = PlanReport(0, "state", 2, "INFEASIBLE", "no", "powered_descent", attempt=attempt)
    keys = {pair.key for pair in encode(report).status[0].values}
    assert "virtual_control" in keys
    assert not keys & {"cost", "max_defect", "deadline_ms", "terminal_time_predicted_s"}


def test_certificate_becomes_figures():
    miss = Check("miss_position", 0.5, 1.0, "m", 32.0, True)
    speed = Check("miss_speed", 0.25, 0.5, "m/s", 32.0, True)
    glideslope = Check("glideslope", math.nan, 0.0, "m", 3.0, False)
    certificate = PlanCertificate(
        passed=False,
        reasons=("glideslope",),
        checks=(miss, speed, glideslope),
        unchecked=("dry_mass",),
        times_s=np.zeros(1),
        states=np.zeros((1, 7)),
        controls=np.zeros((1, 3)),
        hold=ControlHold.MEAN,
        contact_time_s=32.0,
        mass_used_kg=6000.0,
        propellant_left_kg=None,
    )
    figures = figures_from_certificate(certificate, ("miss_position", "miss_speed"))
    assert figures == CertificateFigures(
        False,
        ("glideslope",),
        {
            "miss_position_m": 0.5,
            "miss_speed_m_s": 0.25,
            "contact_time_s": 32.0,
            "mass_used_kg": 6000.0,
        },
        (
            CheckFigures("miss_position", 0.5, 1.0, "m", 32.0, True),
            CheckFigures("miss_speed", 0.25, 0.5, "m/s", 32.0, True),
            CheckFigures("glideslope", None, 0.0, "m", 3.0, False),
        ),
        ("dry_mass",),
    )
    assert figures_from_certificate(None) is None


def test_refusal_becomes_field_value_and_bound():
    error = RejectedInputError(InputCode.NOT_FINITE, "position.x", math.nan, "finite")
    assert rejection_from_error(error) == Rejection("position.x", "nan", "finite")


@pytest.mark.parametrize(
    ("code", "level"),
    [
        (PlanStatus.CERTIFIED, DiagnosticStatus.OK),
        (PlanStatus.INFEASIBLE, DiagnosticStatus.WARN),
        (PlanStatus.SOLVER_FAILURE, DiagnosticStatus.ERROR),
        (InputCode.NOT_FINITE, DiagnosticStatus.WARN),
        (NodeCode.INTERNAL_ERROR, DiagnosticStatus.ERROR),
    ],
)
def test_level_of_a_code(code, level):
    assert level_of(code) == level


def test_codes_of_statuses_inputs_and_node_do_not_collide():
    codes = [*(int(c) for c in PlanStatus), *(int(c) for c in InputCode), *map(int, NodeCode)]
    assert len(set(codes)) == len(codes)
    assert max(PlanStatus) < 100 <= min(InputCode)


FULL = PlanReport(
    stamp_ns=1,
    source="state",
    code=0,
    code_name="CERTIFIED",
    message="",
    problem="powered_descent",
    input_stamp_ns=5,
    attempt=attempt_from_outcome(outcome(), 0.1),
    certificate=CertificateFigures(True, (), {"miss_position_m": 1.0}),
)


@pytest.mark.parametrize("key", ["code", "code_name", "source", "published", "drops", "rejected"])
def test_a_missing_key_is_named(key):
    message = encode(FULL)
    message.status[0].values = [pair for pair in message.status[0].values if pair.key != key]
    with pytest.raises(RejectedInputError, match=f"'{key}'") as caught:
        report_from_message(message)
    assert caught.value.code is InputCode.REPORT_MISSING_KEY


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("code", "seven"),
        ("published", "yes"),
        ("input_stamp", "12.5"),
        ("cost", "a lot"),
        ("solve_time_ms", "nan"),
        ("state.x", "inf"),
        ("iterations", "1.5"),
        ("certificate.passed", "maybe"),
    ],
)
def test_a_value_that_cannot_be_read_is_named(key, text):
    message = encode(FULL)
    message.status[0].values.append(KeyValue(key=key, value=text))
    with pytest.raises(RejectedInputError) as caught:
        report_from_message(message)
    assert caught.value.code is InputCode.REPORT_BAD_VALUE
    assert (caught.value.field, caught.value.value) == (key, text)


def test_a_report_has_one_status():
    with pytest.raises(RejectedInputError) as caught:
        report_from_message(DiagnosticArray())
    assert caught.value.code is InputCode.WRONG_ARRAY_LENGTH


@given(st.dictionaries(TEXT | st.sampled_from(["code", "cost", "iterations"]), TEXT))
def test_any_keys_give_a_report_or_a_numbered_error(texts):
    message = encode(FULL)
    message.status[0].values.extend(KeyValue(key=k, value=v) for k, v in texts.items())
    with contextlib.suppress(RejectedInputError):
        report_from_message(message)


healths = st.builds(
    Health,
    level=st.integers(0, 3),
    message=TEXT,
    received=COUNTS,
    attempts=COUNTS,
    certified=COUNTS,
    drops=COUNTS,
    internal_errors=COUNTS,
    rejected=st.dictionaries(st.sampled_from([code.name for code in InputCode]), COUNTS),
    solve_time_ms=NUMBERS,
    latency_ms=NUMBERS,
    input_age_s=NUMBERS,
)


@given(healths, STAMPS)
def test_health_round_trip_is_exact(health, stamp_ns):
    message = message_from_health(health, stamp_ns, node="planner", problem="powered_descent")
    message.status.insert(0, DiagnosticStatus(name="someone else: health"))
    assert health_from_message(through_the_wire(message), node="planner") == (health, stamp_ns)


def test_another_nodes_health_is_not_taken():
    message = message_from_health(Health(0, "ok"), 0, node="planner", problem="p")
    with pytest.raises(RejectedInputError, match="other: health") as caught:
        health_from_message(message, node="other")
    assert caught.value.code is InputCode.MISSING_NAME
