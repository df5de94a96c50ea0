"""What the planner node says about each attempt, whether or not a plan came out of it."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING

from msg_adapters.errors import RejectedInputError

if TYPE_CHECKING:
    from dscp_core.planning.certificate import PlanCertificate
    from dscp_core.planning.plan import PlanOutcome


class NodeCode(IntEnum):
    """Events of the node itself; see `msg_adapters.errors.InputCode` for those of inputs."""

    INTERNAL_ERROR = 901
    """The planner raised an exception; the node lives on."""
    CLOCK_JUMPED_BACK = 902
    """The ROS clock jumped back: memory of stamps and warm start are gone."""
    SUPERSEDED = 903
    """A reset or a clock jump came during the attempt: its plan is not published."""
    BEST_EFFORT = 904
    """There is no certified plan; the one that violates least was published as a best effort."""
    NO_TRAJECTORY = 905
    """Validity: nothing has been published yet."""
    RESET = 906
    """Validity: the node was reset."""
    RELOADED = 907
    """Validity: the planner was rebuilt with other parameters, or its files were read again."""
    STATES_STALE = 908
    """Validity: no state was accepted for too long."""
    PLAN_ENDED = 909
    """Validity: the trajectory's own time has run out."""


@dataclass(frozen=True)
class CheckFigures:
    """One constraint of a certificate.

    Attributes:
        name: Name of the constraint or miss.
        worst_value: Worst value along the integrated trajectory, in ``unit``.
        bound: Value that it must not pass.
        unit: Unit of both.
        time_s: When the worst value occurs, from the start of the plan.
        passed: Whether it held.
    """

    name: str
    worst_value: float | None
    bound: float | None
    unit: str
    time_s: float | None
    passed: bool

    @property
    def margin(self) -> float | None:
        """What is left between value and bound, in ``unit``; negative beyond it."""
        if self.worst_value is None or self.bound is None:
            return None
        return _known(self.bound - self.worst_value)


@dataclass(frozen=True)
class CertificateFigures:
    """Verdict of the independent check of a plan.

    Attributes:
        passed: Whether the plan may be flown.
        reasons: Why not; empty if it passed.
        values: What a flight comes to, by name and unit: the misses of this problem, for example
            ``miss_position_m``, and whatever else the certificate knows, such as ``mass_used_kg``.
        checks: Every constraint.
        unchecked: Names of those that are not imposed, their bound being unknown or infinite.
    """

    passed: bool
    reasons: tuple[str, ...]
    values: Mapping[str, float] = field(default_factory=dict)
    checks: tuple[CheckFigures, ...] = ()
    unchecked: tuple[str, ...] = ()


@dataclass(frozen=True)
class AttemptFigures:
    """Figures of one planning attempt; None where a number does not exist.

    Attributes:
        iterations: SCP iterations.
        solve_time_ms: Wall time of the attempt.
        solver_time_ms: Part of it spent in the cone solver.
        deadline_ms: Wall time it was given.
        virtual_control: Size of the virtual control left in the plan.
        max_defect: Largest defect of the discretised dynamics.
        cost: Cost of the plan.
        terminal_time_predicted_s: Terminal time that a predictor proposed.
        terminal_time_used_s: Terminal time of the plan.
        warm_started: Whether it started from the last certified plan.
        solver: Backend that answered last.
        terminal_time_source: Where the terminal time comes from.
        terminal_time_reason: Why from there, where the node's settings name another source.
        converged: Whether the iterations had settled; None in reports of before 2026-11.
        stopped: Why the iterations stopped; None if they never started, and in reports of before
            2026-12.
        cost_to_gain: What the plan costs more than a local optimum, at most (an estimate); None if
            unknown.
        cost_unit: Unit of both; None in reports of before 2026-12.
    """

    iterations: int
    solve_time_ms: float | None
    solver_time_ms: float | None
    deadline_ms: float | None
    virtual_control: float | None
    max_defect: float | None
    cost: float | None
    terminal_time_predicted_s: float | None
    terminal_time_used_s: float | None
    warm_started: bool
    solver: str | None = None
    terminal_time_source: str | None = None
    terminal_time_reason: str | None = None
    converged: bool | None = None
    stopped: str | None = None
    cost_to_gain: float | None = None
    cost_unit: str | None = None


@dataclass(frozen=True)
class Rejection:
    """Why an input was refused.

    Attributes:
        field: Offending field.
        value: Its value, as text.
        bound: What was expected.
    """

    field: str
    value: str
    bound: str


@dataclass(frozen=True)
class BestEffortFigures:
    """What a best effort is worth.

    Attributes:
        violations: What it violates and by how much, the gravest first.
        steps: What was made least, in this order.
    """

    violations: tuple[str, ...]
    steps: tuple[str, ...]


@dataclass(frozen=True)
class PlanReport:
    """One attempt, refused input or event of the node.

    Attributes:
        stamp_ns: When the report was made, ROS time.
        source: Input it belongs to, for example ``state`` or ``vehicle_state``.
        code: A `PlanStatus` (0 to 99), an `InputCode` (100 to 899) or a `NodeCode` (900 and more).
        code_name: Name of the code.
        message: One line for people.
        problem: Name of the problem.
        published: Whether a plan was published.
        drops: States that a newer one replaced before they were planned from, since the start.
        rejected: Inputs refused since the start.
        input_stamp_ns: Stamp of the input; None if it has none.
        latency_ms: From the arrival of the input to the publication of the plan, or to the end of
            the attempt.
        mass_source: ``message`` or ``parameter`` where the input itself holds no mass.
        parameter_set: Parameter sets that an attempt was made with, or ``none``.
        state: State planned from, by the names that messages use.
        attempt: Figures of the attempt, if there was one.
        certificate: The certificate, if there is one.
        rejection: Cause, if the input was refused.
        best_effort: What the best effort is worth, if one was published.
    """

    stamp_ns: int
    source: str
    code: int
    code_name: str
    message: str
    problem: str
    published: bool = False
    drops: int = 0
    rejected: int = 0
    input_stamp_ns: int | None = None
    latency_ms: float | None = None
    mass_source: str | None = None
    parameter_set: str | None = None
    state: Mapping[str, float] = field(default_factory=dict)
    attempt: AttemptFigures | None = None
    certificate: CertificateFigures | None = None
    rejection: Rejection | None = None
    best_effort: BestEffortFigures | None = None


def rejection_from_error(error: RejectedInputError) -> Rejection:
    """Figures of a refused input."""
    return Rejection(error.field, str(error.value), error.bound)


def attempt_from_outcome(outcome: PlanOutcome, deadline_s: float | None) -> AttemptFigures:
    """Figures of a planning outcome."""
    return AttemptFigures(
        iterations=int(outcome.iterations),
        solve_time_ms=_known(outcome.solve_time_s, 1e3),
        solver_time_ms=_known(outcome.solver_time_s, 1e3),
        deadline_ms=_known(deadline_s, 1e3),
        virtual_control=_known(outcome.virtual_control),
        max_defect=_known(outcome.max_defect),
        cost=_known(outcome.cost),
        terminal_time_predicted_s=_known(outcome.terminal_time_predicted_s),
        terminal_time_used_s=_known(outcome.terminal_time_used_s),
        warm_started=bool(outcome.warm_started),
        solver=outcome.solver or None,
        terminal_time_source=outcome.terminal_time_source.value,
        terminal_time_reason=outcome.terminal_time_reason or None,
        converged=bool(outcome.converged),
        stopped=None if outcome.stopped is None else outcome.stopped.value,
        cost_to_gain=_known(outcome.cost_to_gain),
        cost_unit=outcome.cost_unit,
    )


def figures_from_certificate(
    certificate: PlanCertificate | None, misses: Collection[str] = ()
) -> CertificateFigures | None:
    """Figures of a certificate.

    Args:
        certificate: The certificate, or None.
        misses: Names of the checks that are misses.
    """
    if certificate is None:
        return None
    return CertificateFigures(
        passed=bool(certificate.passed),
        reasons=tuple(certificate.reasons),
        values=_values(certificate, misses),
        checks=tuple(
            CheckFigures(
                name=check.name,
                worst_value=_known(check.worst_value),
                bound=_known(check.bound),
                unit=check.unit,
                time_s=_known(check.time_s),
                passed=bool(check.passed),
            )
            for check in certificate.checks
        ),
        unchecked=tuple(certificate.unchecked),
    )


def _values(certificate: PlanCertificate, misses: Collection[str]) -> dict[str, float]:
    """Misses and other figures of the flight by name and unit; those that are known."""
    from dscp_core.planning.plan import flight_figures

    found = {
        key_of(check.name, check.unit): _known(check.worst_value)
        for check in certificate.checks
        if check.name in misses
    }
    for name, value in flight_figures(certificate).items():
        found[name] = _known(value)
    return {key: value for key, value in found.items() if value is not None}


def key_of(name: str, unit: str) -> str:
    """Name with its unit, for example ``miss_speed_m_s``; a pure number has none."""
    words = re.findall(r"[A-Za-z0-9]+", "" if unit == "1" else unit)
    return "_".join([name, *words])


def _known(value: float | None, factor: float = 1.0) -> float | None:
    """Value times factor as a plain float; None if there is none or it is not finite."""
    if value is None:
        return None
    scaled = float(value) * factor
    return scaled if math.isfinite(scaled) else None
