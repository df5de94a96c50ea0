"""What became of an attempt to make a plan."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import Enum, IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.planning.certificate import PlanCertificate
from dscp_core.problem.trajectory import Plan
from dscp_core.scp.trace import ScpStatus

Array = NDArray[np.float64]


class PlanStatus(IntEnum):
    """Outcome of an attempt; the numbers are stable and appear in reports and logs.

    Example:
        >>> from dscp_core import PlanStatus
        >>> PlanStatus(0).name
        'CERTIFIED'
    """

    CERTIFIED = 0
    NOT_CERTIFIED = 1
    INFEASIBLE = 2
    ITERATION_LIMIT = 3
    DEADLINE = 4
    SOLVER_FAILURE = 5
    INVALID_STATE = 6


class TerminalTime(Enum):
    """Where the terminal time comes from.

    FIXED: the parameter ``terminal_time``, and after the first plan what is left of it. FREE: a
    decision of the subproblems. PREDICTED: a predictor's, where it knows the state, else FREE.

    Example:
        >>> from dscp_core import Planner, PlannerSettings, TerminalTime, problems
        >>> free = PlannerSettings(terminal_time=TerminalTime.FREE)
        >>> round(Planner(problems.get("powered_descent"), free).plan().terminal_time_used_s, 1)
        32.8
    """

    FIXED = "fixed"
    FREE = "free"
    PREDICTED = "predicted"


@dataclass(frozen=True)
class BestEffort:
    """What to fly where no feasible plan was found: the plan that violates least.

    Never called certified, whatever its certificate says.

    Attributes:
        plan: The trajectory; it starts from the state that was planned from.
        certificate: Its check; it passes only where nothing but the terminal time is another than
            asked for.
        violations: What it violates and by how much, one line each, the gravest first.
        steps: What was made least, in this order, each with what it came to.

    Example:
        >>> from dscp_core import BestEffort, Planner, problems
        >>> isinstance(Planner(problems.get("powered_descent")).plan().best_effort, BestEffort)
        False
    """

    plan: Plan
    certificate: PlanCertificate
    violations: tuple[str, ...]
    steps: tuple[str, ...]


@dataclass(frozen=True)
class PlanOutcome:
    """Everything about one attempt.

    Three words say three things: a plan is *certified* if it can be flown (`certificate` has every
    check with its margin), *converged* if its cost is that of a local optimum (`cost_to_gain` has
    what may be missing), and `stopped` says why the iterations stopped.

    Attributes:
        status: What became of it.
        stopped: Why the iterations stopped; None when they never started.
        converged: Whether they stopped because nothing changed any more, and the plan is where
            they did, satisfying the dynamics: only then is its cost that of a local optimum.
        cost_to_gain: Estimate, from above, of what the plan costs more than a local optimum, in
            ``cost_unit``, converged or not; see `dscp_core.scp.gain.cost_to_gain`. None if it is
            unknown: without a plan, or with one that keeps virtual control.
        message: In words, with numbers.
        plan: The trajectory, also of an attempt that was not certified; None without any.
        certificate: Its check, or None.
        iterations: SCP iterations, those of a failed warm start included.
        solve_time_s: Wall time of the whole attempt.
        solver_time_s: Part of it spent in the cone solver.
        virtual_control: Largest virtual control, relative to the states' scales.
        max_defect: Largest defect of the discrete dynamics, relative to the states' scales.
        cost: Cost of the plan in the problem's unit.
        cost_unit: That unit; "1" for a pure number.
        terminal_time_predicted_s: Prediction of the terminal-time predictor, or None.
        terminal_time_used_s: Terminal time of the plan, or the one that was tried.
        terminal_time_source: Where that one comes from.
        terminal_time_reason: Why from there, where the settings name another source; else empty.
        warm_started: Whether the result came from the last plan.
        solver: Backend that answered last.
        parameters: What was planned with, by name, SI: initial state and terminal time included.
        best_effort: What to fly where nothing feasible was found; None with a certified plan, or
            where none was made.

    Example:
        >>> from dscp_core import Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> outcome = planner.plan()
        >>> outcome.certified, outcome.converged, outcome.cost_unit
        (True, True, 'kg')
        >>> outcome.certificate.value("miss_position") < 1.0
        True
    """

    status: PlanStatus
    stopped: ScpStatus | None
    converged: bool
    cost_to_gain: float | None
    message: str
    plan: Plan | None
    certificate: PlanCertificate | None
    iterations: int
    solve_time_s: float
    solver_time_s: float
    virtual_control: float
    max_defect: float
    cost: float
    cost_unit: str
    terminal_time_predicted_s: float | None
    terminal_time_used_s: float
    terminal_time_source: TerminalTime
    terminal_time_reason: str
    warm_started: bool
    solver: str
    parameters: Mapping[str, Any] = field(repr=False)
    best_effort: BestEffort | None = None

    @property
    def certified(self) -> bool:
        """Whether the plan, flown with the true dynamics, passed every check."""
        return self.status is PlanStatus.CERTIFIED

    @property
    def headline(self) -> str:
        """What this is worth, in one line: certified? converged, or why not? what is to gain?"""
        words, why = _WORDS[self.status], " ".join(self.message.split())
        if self.status not in (PlanStatus.CERTIFIED, PlanStatus.NOT_CERTIFIED):
            return f"{words}: {why}"
        if self.certificate is not None and self.certificate.reasons:
            words += f" ({self.certificate.reasons[0]})"
        unit = "" if self.cost_unit == "1" else f" {self.cost_unit}"
        source = self.terminal_time_source.value
        gain = "unknown how much to gain"
        if self.cost_to_gain is not None:
            gain = f"at most {_rounded_up(self.cost_to_gain)}{unit} to gain"
        return (
            f"{words}, {self._settled}: terminal time {self.terminal_time_used_s:.4g} s "
            f"({source}), cost {self.cost:.7g}{unit}, {gain}"
        )

    @property
    def _settled(self) -> str:
        """Whether the iterations converged, and why that cannot be said."""
        if self.converged:
            return "converged"
        if self.stopped is ScpStatus.FIXED_ITERATIONS:
            return f"convergence NOT TESTED ({self.stopped.value})"
        if self.stopped is ScpStatus.CONVERGED:
            return "NOT CONVERGED (where the iterations stopped, the dynamics do not hold)"
        return f"NOT CONVERGED ({'no iterations' if self.stopped is None else self.stopped.value})"


def flight_figures(certificate: PlanCertificate) -> dict[str, float]:
    """What the flight of a certificate comes to besides its checks: figures that it knows, by name.

    Example names: ``mass_used_kg``; the unit is part of each.
    """
    found = {f.name: getattr(certificate, f.name) for f in fields(certificate)}
    return {name: float(value) for name, value in found.items() if isinstance(value, float)}


def _rounded_up(value: float) -> str:
    """Two significant digits that are not below the value."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.ceil(value / unit) * unit:.7g}"


_WORDS = {
    PlanStatus.CERTIFIED: "certified",
    PlanStatus.NOT_CERTIFIED: "NOT CERTIFIED",
    PlanStatus.INFEASIBLE: "INFEASIBLE",
    PlanStatus.ITERATION_LIMIT: "NO PLAN (iteration limit)",
    PlanStatus.DEADLINE: "NO PLAN (deadline)",
    PlanStatus.SOLVER_FAILURE: "NO PLAN (solver failure)",
    PlanStatus.INVALID_STATE: "NO PLAN (invalid state)",
}
