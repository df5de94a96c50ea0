"""diagnostic_msgs/DiagnosticArray: the planner node's report, both ways.

One status per message. Keys without a known value are left out. Keys:

- always: ``code``, ``code_name``, ``source``, ``published``, ``drops``, ``rejected``
- if known: ``input_stamp`` (seconds.nanoseconds), ``latency_ms``, ``mass_source``,
  ``parameter_set``, ``state.NAME``
- after an attempt: ``iterations``, ``converged``, ``stopped`` (why the iterations did),
  ``solve_time_ms``, ``solver_time_ms``, ``deadline_ms``, ``virtual_control``, ``max_defect``,
  ``cost``, ``cost_to_gain``, ``cost_unit`` (of both), ``terminal_time_predicted_s``,
  ``terminal_time_used_s``, ``terminal_time_source``, ``terminal_time_reason``, ``warm_started``,
  ``solver``
- with a certificate: ``certificate.passed``, ``certificate.reason.K``, ``certificate.NAME_UNIT``
  of each miss of the problem (for a landing ``certificate.miss_position_m`` and
  ``certificate.miss_speed_m_s``) and of whatever else the certificate knows
  (``certificate.mass_used_kg``), ``certificate.check.K.FIELD`` with the fields of
  `report.CheckFigures` and their ``margin``, ``certificate.unchecked.K``
- after a refusal: ``field``, ``value``, ``bound``
- with a best effort: ``best_effort.violation.K``, ``best_effort.step.K``; the certificate is its
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import count

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from msg_adapters.key_values import KeyValueReader, Value, message_of_status, only_status
from msg_adapters.report import (
    AttemptFigures,
    BestEffortFigures,
    CertificateFigures,
    CheckFigures,
    NodeCode,
    PlanReport,
    Rejection,
)
from msg_adapters.stamps import (
    nanoseconds_from_stamp,
    stamp_text,
)

_CERTIFIED = 0
_SOLVER_FAILURE = 5
_STATE = "state."
_CERTIFICATE = "certificate."
_PASSED = "certificate.passed"
_REASON = "certificate.reason."
_CHECK = "certificate.check."
_UNCHECKED = "certificate.unchecked."
_VIOLATION = "best_effort.violation."
_STEP = "best_effort.step."
_NUMBERS = (
    "solve_time_ms",
    "solver_time_ms",
    "deadline_ms",
    "virtual_control",
    "max_defect",
    "cost",
    "cost_to_gain",
    "terminal_time_predicted_s",
    "terminal_time_used_s",
)
_CHECK_NUMBERS = ("worst_value", "bound", "time_s")


def level_of(code: int) -> bytes:
    """Diagnostic level of a code: OK for a certified plan, ERROR for failures of the software."""
    level = DiagnosticStatus.WARN
    if code == _CERTIFIED:
        level = DiagnosticStatus.OK
    elif code in (_SOLVER_FAILURE, NodeCode.INTERNAL_ERROR):
        level = DiagnosticStatus.ERROR
    return bytes(level)


def message_from_report(report: PlanReport, *, node: str, frame: str) -> DiagnosticArray:
    """Message of a report.

    Args:
        report: The report.
        node: Name of the node; the status is called ``NODE: report``.
        frame: ``header.frame_id``, that of states and plans.
    """
    return message_of_status(
        _pairs(report),
        stamp_ns=report.stamp_ns,
        level=level_of(report.code),
        name=f"{node}: report",
        message=report.message,
        problem=report.problem,
        frame=frame,
    )


def _pairs(report: PlanReport) -> Iterator[tuple[str, Value]]:
    yield "code", report.code
    yield "code_name", report.code_name
    yield "source", report.source
    yield "published", report.published
    yield "drops", report.drops
    yield "rejected", report.rejected
    if report.input_stamp_ns is not None:
        yield "input_stamp", stamp_text(report.input_stamp_ns)
    yield "latency_ms", report.latency_ms
    yield "mass_source", report.mass_source
    yield "parameter_set", report.parameter_set
    for name, value in report.state.items():
        yield _STATE + name, float(value)
    if report.attempt is not None:
        yield "iterations", report.attempt.iterations
        yield "converged", report.attempt.converged
        yield "stopped", report.attempt.stopped
        for key in _NUMBERS:
            yield key, getattr(report.attempt, key)
        yield "cost_unit", report.attempt.cost_unit
        yield "warm_started", report.attempt.warm_started
        yield "solver", report.attempt.solver
        yield "terminal_time_source", report.attempt.terminal_time_source
        yield "terminal_time_reason", report.attempt.terminal_time_reason
    if report.certificate is not None:
        yield from _certificate_pairs(report.certificate)
    if report.best_effort is not None:
        for k, violation in enumerate(report.best_effort.violations):
            yield f"{_VIOLATION}{k}", violation
        for k, step in enumerate(report.best_effort.steps):
            yield f"{_STEP}{k}", step
    if report.rejection is not None:
        yield "field", report.rejection.field
        yield "value", report.rejection.value
        yield "bound", report.rejection.bound


def _certificate_pairs(certificate: CertificateFigures) -> Iterator[tuple[str, Value]]:
    yield _PASSED, certificate.passed
    for k, reason in enumerate(certificate.reasons):
        yield f"{_REASON}{k}", reason
    for key, value in certificate.values.items():
        if not _is_of_certificate_itself(_CERTIFICATE + key):  # else it is among the checks only
            yield _CERTIFICATE + key, float(value)
    for k, check in enumerate(certificate.checks):
        prefix = f"{_CHECK}{k}."
        yield prefix + "name", check.name
        for key in _CHECK_NUMBERS:
            yield prefix + key, getattr(check, key)
        yield prefix + "margin", check.margin
        yield prefix + "unit", check.unit
        yield prefix + "passed", check.passed
    for k, name in enumerate(certificate.unchecked):
        yield f"{_UNCHECKED}{k}", name


def report_from_message(message: DiagnosticArray) -> PlanReport:
    """Report of a message.

    Raises:
        RejectedInputError: WRONG_ARRAY_LENGTH, INVALID_STAMP, REPORT_MISSING_KEY or
            REPORT_BAD_VALUE.
    """
    status = only_status(message)
    reader = KeyValueReader(status)
    return PlanReport(
        stamp_ns=nanoseconds_from_stamp(message.header.stamp),
        source=reader.text("source"),
        code=reader.integer("code"),
        code_name=reader.text("code_name"),
        message=status.message,
        problem=status.hardware_id,
        published=reader.boolean("published"),
        drops=reader.integer("drops"),
        rejected=reader.integer("rejected"),
        input_stamp_ns=reader.optional_stamp_ns("input_stamp"),
        latency_ms=reader.optional_number("latency_ms"),
        mass_source=reader.optional_text("mass_source"),
        parameter_set=reader.optional_text("parameter_set"),
        state=_named_numbers(reader, _STATE, reader.texts),
        attempt=_attempt(reader),
        certificate=_certificate(reader),
        rejection=_rejection(reader),
        best_effort=_best_effort(reader),
    )


def _named_numbers(reader: KeyValueReader, prefix: str, keys: Iterable[str]) -> dict[str, float]:
    """Numbers of those of the keys that begin so, by what follows."""
    numbers = {}
    for key in keys:
        value = reader.optional_number(key) if key.startswith(prefix) else None
        if value is not None:
            numbers[key.removeprefix(prefix)] = value
    return numbers


def _attempt(reader: KeyValueReader) -> AttemptFigures | None:
    if reader.optional_text("iterations") is None:
        return None
    return AttemptFigures(
        iterations=reader.integer("iterations"),
        warm_started=reader.boolean("warm_started"),
        converged=reader.boolean("converged") if "converged" in reader.texts else None,
        stopped=reader.optional_text("stopped"),
        cost_unit=reader.optional_text("cost_unit"),
        solver=reader.optional_text("solver"),
        terminal_time_source=reader.optional_text("terminal_time_source"),
        terminal_time_reason=reader.optional_text("terminal_time_reason"),
        **{key: reader.optional_number(key) for key in _NUMBERS},
    )


def _certificate(reader: KeyValueReader) -> CertificateFigures | None:
    if reader.optional_text(_PASSED) is None:
        return None
    return CertificateFigures(
        passed=reader.boolean(_PASSED),
        reasons=_listed(reader, _REASON),
        values=_named_numbers(
            reader,
            _CERTIFICATE,
            [key for key in reader.texts if not _is_of_certificate_itself(key)],
        ),
        checks=tuple(_checks(reader)),
        unchecked=_listed(reader, _UNCHECKED),
    )


def _listed(reader: KeyValueReader, prefix: str) -> tuple[str, ...]:
    """Texts of the keys that are numbered from 0."""
    texts: list[str] = []
    while (text := reader.optional_text(f"{prefix}{len(texts)}")) is not None:
        texts.append(text)
    return tuple(texts)


def _best_effort(reader: KeyValueReader) -> BestEffortFigures | None:
    violations, steps = _listed(reader, _VIOLATION), _listed(reader, _STEP)
    return BestEffortFigures(violations, steps) if violations or steps else None


def _is_of_certificate_itself(key: str) -> bool:
    return key == _PASSED or key.startswith((_REASON, _CHECK, _UNCHECKED))


def _checks(reader: KeyValueReader) -> Iterator[CheckFigures]:
    for k in count():
        prefix = f"{_CHECK}{k}."
        if reader.optional_text(prefix + "name") is None:
            return
        yield CheckFigures(
            name=reader.text(prefix + "name"),
            unit=reader.text(prefix + "unit"),
            passed=reader.boolean(prefix + "passed"),
            **{key: reader.optional_number(prefix + key) for key in _CHECK_NUMBERS},
        )


def _rejection(reader: KeyValueReader) -> Rejection | None:
    if reader.optional_text("field") is None:
        return None
    return Rejection(reader.text("field"), reader.text("value"), reader.text("bound"))
