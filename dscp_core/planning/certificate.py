"""Independent check of a plan: the true dynamics flown under the planned controls.

The plan satisfies the *discrete* dynamics at the nodes; whether it can be flown is decided here,
by a variable-order integration (scipy's LSODA, up to order 12) with an error control far below
what is certified, and by the constraints between the nodes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import scipy.integrate
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem.checks import not_negative
from dscp_core.problem.declaration import (
    Constraint,
    OptimalControlProblem,
    PathConstraint,
    StagePoint,
    Where,
    named,
)
from dscp_core.problem.flight import ControlHold
from dscp_core.problem.tracing import Tracer
from dscp_core.transcription.compiled import CompiledFunction
from dscp_core.transcription.stages import constraints

Array = NDArray[np.float64]

_INTEGRATED = "Integration successful."  # odeint's word; it has no status code


@dataclass(frozen=True)
class Check:
    """One number against its bound.

    Attributes:
        name: Constraint or miss.
        worst_value: Largest violation along the flight (negative: margin), or the miss.
        bound: Largest accepted value.
        unit: Unit of both.
        time_s: When the worst value occurs, seconds from the start.
        passed: Whether worst_value <= bound, and for a miss, which is a distance, >= 0.
    """

    name: str
    worst_value: float
    bound: float
    unit: str
    time_s: float
    passed: bool


@dataclass(frozen=True)
class PlanCertificate:
    """Outcome of flying a plan.

    Attributes:
        passed: Whether every check passed.
        reasons: What failed, with value and bound; empty when passed.
        checks: Every check, misses first.
        times_s: (M,) fine grid.
        states: (M, nx) integrated states, SI.
        controls: (M, nu) controls as flown, SI.
        hold: How the controls were flown.
        mass_used_kg: Mass lost in flight, or None for a vehicle whose mass is no state.
    """

    passed: bool
    reasons: tuple[str, ...]
    checks: tuple[Check, ...]
    times_s: Array
    states: Array
    controls: Array
    hold: ControlHold
    mass_used_kg: float | None

    def value(self, name: str) -> float:
        """Worst value of a check by name.

        Raises:
            InvalidInputError: No such check.
        """
        for check in self.checks:
            if check.name == name:
                return check.worst_value
        raise InvalidInputError("check", name, f"one of {', '.join(c.name for c in self.checks)}")

    @property
    def miss_position_m(self) -> float:
        """Distance from the target at the end."""
        return self.value("miss_position")

    @property
    def miss_speed_m_s(self) -> float:
        """Speed error at the end."""
        return self.value("miss_speed")


class PlanVerifier:
    """Flies plans of one problem on N intervals.

    Not safe for calls from several threads at once.
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        intervals: int,
        *,
        substeps: int = 4,
        hold: ControlHold = ControlHold.MEAN,
        relative_tolerance: float = 1e-12,
    ) -> None:
        """Compile dynamics and constraints.

        Args:
            problem: The declaration.
            intervals: Number N of intervals of the plans.
            substeps: Points of the fine grid per interval.
            hold: How the controls are flown.
            relative_tolerance: Of the integrator.
        """
        self._problem = problem
        self._intervals = intervals
        self._substeps = substeps
        self._hold = hold
        self._relative_tolerance = relative_tolerance
        nx, nu = len(problem.states), len(problem.controls)
        x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
        packed = ca.SX.sym("p", problem.table.size)
        parameters = named(problem, packed)
        trace = Tracer(problem.table, x, u, packed)
        self._scale = np.array([s.scale for s in problem.states])
        # Scaled, so that one tolerance suits every state.
        state = x * ca.DM(self._scale)
        rates = trace("dynamics", problem.dynamics, state, u, parameters, rows=nx)
        scaled_rates = rates / ca.DM(self._scale)
        self._rates = CompiledFunction("rates", [x, u, packed], [scaled_rates])
        # Along the flight there is no difference between nodes and interval means.
        self._checked = tuple(c for where in Where for c in constraints(problem, where))
        step = ca.SX.sym("T")
        point = StagePoint(x, u, step)
        trace = Tracer(problem.table, x, u, step, packed)
        limits = ca.Function(
            "limits",
            [x, u, ca.vertcat(step, packed)],
            [_stack(_violation(c, trace, point, parameters) for c in self._checked)],
        )
        self._points = intervals * substeps + 1
        grid = [ca.MX.sym("x", nx, self._points), ca.MX.sym("u", nu, self._points)]
        grid.append(ca.MX.sym("T_p", 1 + problem.table.size))
        mapped = limits.map("limits_on_grid", "serial", self._points, [2], [])
        self._limits = CompiledFunction("limits_on_grid", grid, [mapped(*grid)])
        self._misses = CompiledFunction(
            "misses",
            [x, packed],
            [
                _stack(
                    trace(f"miss {m.name}", m.expression, x, parameters) for m in problem.end_checks
                )
            ],
        )

    def rates(self, states: Array, controls: Array, parameters: Array) -> Array:
        """Time derivative of the states at every node, (N+1, nx), SI."""
        pairs = zip(states / self._scale, controls, strict=True)
        scaled = np.array([self._rates(x, u, parameters)[0] for x, u in pairs])
        return np.asarray(scaled * self._scale)

    def certify(
        self, times_s: Array, states: Array, controls: Array, parameters: Array
    ) -> PlanCertificate:
        """Fly a plan and check it.

        Args:
            times_s: (N+1,) node times.
            states: (N+1, nx) planned states, SI; only the first is flown from.
            controls: (N+1, nu) planned controls, SI.
            parameters: Packed parameters, SI.
        """
        with warnings.catch_warnings():
            # What it warns of is a reason of the certificate.
            warnings.simplefilter("ignore", scipy.integrate.ODEintWarning)
            flight, failure = self._fly(times_s, states[0], controls, parameters)
        times, flown, applied = flight
        checks: list[Check] = []
        if failure is None:
            missed = self._misses(flown[-1], parameters)[0]
            for miss, value in zip(self._problem.end_checks, missed, strict=True):
                check = _check(miss.name, value, miss.tolerance, miss.unit, times[-1])
                checks.append(replace(check, passed=check.passed and check.worst_value >= 0.0))
        step = float(times_s[-1] - times_s[0]) / self._intervals
        values = self._limits_along(flown, applied, step, parameters)
        table = self._problem.table
        for column, constraint in enumerate(self._checked):
            worst = int(np.argmax(values[:, column]))
            if np.isneginf(values[worst, column]):
                continue  # its bound is infinite: it is not imposed
            bound = constraint.accepted(table, parameters)
            not_negative(f"tolerance of constraint {constraint.name}", bound)
            worst_value = values[worst, column]
            checks.append(
                _check(constraint.name, worst_value, bound, constraint.unit, times[worst])
            )
        reasons = [_reason(check) for check in checks if not check.passed]
        if failure is not None:
            reasons.insert(0, failure)
        names = [s.name for s in self._problem.states]
        used = None
        if "mass" in names:
            used = float(flown[0, names.index("mass")] - flown[-1, names.index("mass")])
        return PlanCertificate(
            passed=not reasons,
            reasons=tuple(reasons),
            checks=tuple(checks),
            times_s=times,
            states=flown,
            controls=applied,
            hold=self._hold,
            mass_used_kg=used,
        )

    def require_tolerances(self, parameters: Array) -> None:
        """Raise `InvalidInputError` for a tolerance that packed parameters, SI, make no number."""
        for constraint in self._checked:
            constraint.accepted(self._problem.table, parameters)

    def _limits_along(self, flown: Array, applied: Array, step: float, parameters: Array) -> Array:
        """Violation of every constraint at every point, (M, constraints)."""
        # A flight that ended early is filled up with its last point.
        index = np.minimum(np.arange(self._points), len(flown) - 1)
        known = np.append(step, parameters)
        violations = self._limits(flown[index].ravel(), applied[index].ravel(), known)[0]
        return violations.reshape(self._points, -1)[: len(flown)]

    def _fly(
        self, times_s: Array, start: Array, controls: Array, parameters: Array
    ) -> tuple[tuple[Array, Array, Array], str | None]:
        """Fine grid with states and controls, and why the integration ended early."""
        grid, flown, applied = [times_s[:1]], [start[None, :] / self._scale], []
        for n in range(self._intervals):
            # Restarted at every node: the controls or their rates jump there.
            origin, end = times_s[n], times_s[n + 1]
            if self._hold is ControlHold.MEAN:
                held, slope = 0.5 * (controls[n] + controls[n + 1]), np.zeros(controls.shape[1])
            else:
                held, slope = controls[n], (controls[n + 1] - controls[n]) / (end - origin)
            moments = np.linspace(origin, end, self._substeps + 1)
            applied.append(held + np.outer(moments[:-1] - origin, slope))
            reached, details = scipy.integrate.odeint(
                self._right_hand_side(origin, held, slope, parameters),
                flown[-1][-1],
                moments,
                rtol=self._relative_tolerance,
                atol=self._relative_tolerance,
                full_output=True,
            )
            if details["message"] != _INTEGRATED or not np.all(np.isfinite(reached)):
                failure = f"integration ended before {end:.3f} s: {details['message']}"
                return _stacked(grid, flown, applied, self._scale), failure
            grid.append(moments[1:])
            flown.append(reached[1:])
        applied.append((held + (times_s[-1] - origin) * slope)[None, :])
        return _stacked(grid, flown, applied, self._scale), None

    def _right_hand_side(
        self, origin: float, held: Array, slope: Array, parameters: Array
    ) -> Callable[[Array, float], Array]:
        """Scaled rates of (state, time) on one interval."""
        if not slope.any():
            rates = self._rates.of_first(held, parameters)
            return lambda x, _t: rates(x)
        return lambda x, t: self._rates(x, held + (t - origin) * slope, parameters)[0]


def _stacked(
    grid: list[Array], flown: list[Array], applied: list[Array], scale: Array
) -> tuple[Array, Array, Array]:
    times, states = np.concatenate(grid), np.vstack(flown) * scale
    return times, states, np.vstack(applied)[: times.size]


def _stack(scalars: Iterable[ca.SX]) -> ca.SX:
    return ca.vertcat(*scalars, ca.SX(0, 1))


def _violation(
    constraint: Constraint, trace: Tracer, point: StagePoint, parameters: dict[str, ca.SX]
) -> ca.SX:
    linear = isinstance(constraint, PathConstraint)
    what = f"constraint {constraint.name}"
    rows = 1 if linear else None
    value = trace(what, constraint.expression, point, parameters, rows=rows)
    if linear:
        return value
    return ca.norm_2(value[1:]) - value[0]


def _reason(failed: Check) -> str:
    text = f"{failed.name} {failed.worst_value:.4g} {failed.unit} at {failed.time_s:.2f} s"
    if failed.worst_value <= failed.bound:
        return f"{text} is negative, so no distance from the target"
    return f"{text} exceeds {failed.bound:.4g}"


def _check(name: str, value: float, bound: float, unit: str, time_s: float) -> Check:
    worst = float(value)
    return Check(name, worst, bound, unit, float(time_s), bool(worst <= bound))
