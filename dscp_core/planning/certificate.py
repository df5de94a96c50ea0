"""Independent check of a plan: the true dynamics flown under the planned controls.

The plan satisfies the *discrete* dynamics at the nodes; whether it can be flown is decided here, by
Dormand-Prince steps with an error estimate far below what is certified. Limits are checked at their
peaks between the nodes, and a flight ends where the problem's end event, such as contact with the
ground, ends it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.planning.extremes import Piece, highest, peak_bounds
from dscp_core.planning.flying import Flown, Pilot
from dscp_core.planning.limits import Limit, Limits
from dscp_core.problem.checks import not_negative
from dscp_core.problem.declaration import OptimalControlProblem, named
from dscp_core.problem.flight import ControlHold
from dscp_core.problem.tracing import Tracer, known_values
from dscp_core.transcription.compiled import CompiledFunction

Array = NDArray[np.float64]

_RESOLUTION, _LEAST_RESOLUTION = 1e-3, 1e-6
"""How exactly a peak is known: to this part of its margin, or of its bound, the larger one."""
_ROUNDING = 1e-9
"""The same at least, of a constraint's scale."""


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

    @property
    def margin(self) -> float:
        """What is left to the bound; negative where it is exceeded."""
        return self.bound - self.worst_value


@dataclass(frozen=True)
class PlanCertificate:
    """Outcome of flying a plan.

    Attributes:
        passed: Whether every check passed.
        reasons: What failed, with value and bound; empty when passed.
        checks: Every check, those of the end first.
        unchecked: Names of constraints that are not imposed, their bound being unknown or infinite.
        times_s: (M,) fine grid, to the end of the flight.
        states: (M, nx) integrated states, SI.
        controls: (M, nu) controls as flown, SI.
        hold: How the controls were flown.
        contact_time_s: When the end event, such as contact, ended the flight; None where it did
            not, or where the problem has none.
        mass_used_kg: Mass lost in flight, or None where the problem names no propellant.
        propellant_left_kg: Mass above the dry mass at the end, or None where that is not known.
    """

    passed: bool
    reasons: tuple[str, ...]
    checks: tuple[Check, ...]
    unchecked: tuple[str, ...]
    times_s: Array
    states: Array
    controls: Array
    hold: ControlHold
    contact_time_s: float | None
    mass_used_kg: float | None
    propellant_left_kg: float | None

    def check(self, name: str) -> Check:
        """A check by name.

        Raises:
            InvalidInputError: No such check.
        """
        for check in self.checks:
            if check.name == name:
                return check
        raise InvalidInputError("check", name, f"one of {', '.join(c.name for c in self.checks)}")

    def value(self, name: str) -> float:
        """Worst value of a check by name.

        Raises:
            InvalidInputError: No such check.
        """
        return self.check(name).worst_value

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
    ) -> None:
        """Compile dynamics and constraints.

        Args:
            problem: The declaration.
            intervals: Number N of intervals of the plans.
            substeps: Steps of the flight per interval; more where the error asks for it.
            hold: How the controls are flown.
        """
        self._problem = problem
        self._hold = hold
        nx, nu = len(problem.states), len(problem.controls)
        x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
        packed = ca.SX.sym("p", problem.table.size)
        trace = Tracer(problem.table, x, u, packed)
        rates = trace("dynamics", problem.dynamics, x, u, named(problem, packed), rows=nx)
        self._rates = CompiledFunction("rates", [x, u, packed], [rates])
        self._limits = Limits(problem)
        self._pilot = Pilot(problem, self._limits, intervals, substeps, hold)

    def rates(self, states: Array, controls: Array, parameters: Array) -> Array:
        """Time derivative of the states at every node, (N+1, nx), SI."""
        pairs = zip(states, controls, strict=True)
        return np.array([self._rates(x, u, parameters)[0] for x, u in pairs])

    def require_checkable(self, parameters: Array) -> None:
        """Refuse packed parameters, SI, for which there can be no certificate.

        Raises:
            InvalidInputError: A tolerance is no number, or the hold contradicts a limit.
        """
        self._limits.bounds(known_values(self._problem.table, parameters))
        self._limits.require_hold(parameters, self._hold)

    def refused_at(self, state: Array, parameters: Array) -> tuple[str, ...]:
        """Which limits a state is beyond, by more than is accepted, whatever is flown from it.

        Args:
            state: (nx,), SI.
            parameters: Packed parameters, SI.
        """
        bounds = self._limits.bounds(known_values(self._problem.table, parameters))
        return tuple(
            f"{limit.name} {value:.4g} {limit.unit} exceeds {bounds[limit.name]:.4g}"
            for limit, value in self._limits.of_states(state, parameters)
            if value > bounds[limit.name]
        )

    def certify(
        self, times_s: Array, states: Array, controls: Array, parameters: Array
    ) -> PlanCertificate:
        """Fly a plan and check it.

        Args:
            times_s: (N+1,) node times.
            states: (N+1, nx) planned states, SI; only the first is flown from.
            controls: (N+1, nu) planned controls, SI.
            parameters: Packed parameters, SI.

        Raises:
            InvalidInputError: As `require_checkable`.
        """
        values = known_values(self._problem.table, parameters)
        bounds = self._limits.bounds(values)
        self._limits.require_hold(parameters, self._hold)
        flown = self._pilot.fly(times_s, states[0], controls, parameters, values)
        flight = flown.flight
        found = [*self._at_end(flown, parameters), *self._along(flown, bounds, parameters)]
        # At minus infinity its bound is unknown or infinite: it is not imposed.
        unchecked = [limit.name for limit, value, _ in found if np.isneginf(value)]
        checks = [
            _check(limit, worst, bounds[limit.name], when)
            for limit, worst, when in found
            if limit.name not in unchecked
        ]
        reasons = [_reason(check) for check in checks if not check.passed]
        if flown.failure is not None:
            reasons.insert(0, flown.failure)
        used, left = self._propellant(flight.states, parameters)
        return PlanCertificate(
            passed=not reasons,
            reasons=tuple(reasons),
            checks=tuple(checks),
            unchecked=tuple(unchecked),
            times_s=flight.times_s,
            states=flight.states,
            controls=flown.controls,
            hold=self._hold,
            contact_time_s=flown.event_s,
            mass_used_kg=used,
            propellant_left_kg=left,
        )

    def _at_end(self, flown: Flown, packed: Array) -> list[tuple[Limit, float, float]]:
        """Limits of the end of a flight, with value and time."""
        if flown.failure is not None:
            return []
        end_s, end = float(flown.flight.times_s[-1]), flown.flight.states[-1]
        found = self._limits.ends(end, flown.control, flown.change, flown.interval_s, packed)
        skipped = () if flown.meant else self._limits.at_event
        return [(limit, value, end_s) for limit, value in found if limit not in skipped]

    def _along(
        self, flown: Flown, bounds: dict[str, float], packed: Array
    ) -> list[tuple[Limit, float, float]]:
        """Limits of the way, with the worst value and its time."""
        flight, found = flown.flight, []
        lengths = flight.steps.lengths_s
        if not lengths.size:
            return []
        low, high = flight.left[0], flight.right[0]
        # A rate may not exist at a point, such as that of a norm at zero; the value counts there.
        rates = [np.nan_to_num(s[1], posinf=0.0, neginf=0.0) for s in (flight.left, flight.right)]
        reach = peak_bounds(low, high, rates[0], rates[1], lengths[:, None])
        firsts, seconds = low.argmax(axis=0), high.argmax(axis=0)
        for channel, limit in enumerate(self._limits.along):
            first, second = firsts[channel], seconds[channel]
            worst, when = float(low[first, channel]), float(flight.times_s[first])
            if not high[second, channel] <= worst:
                worst, when = float(high[second, channel]), float(flight.times_s[second + 1])
            resolution = partial(_resolution, limit, bounds[limit.name])
            peaks = np.flatnonzero(reach[:, channel] > worst + resolution(worst))
            if peaks.size:
                starts, ends = (low, rates[0]), (high, rates[1])
                pieces = []
                for step in peaks:
                    y0, d0 = (float(side[step, channel]) for side in starts)
                    y1, d1 = (float(side[step, channel]) for side in ends)
                    piece = Piece(0.0, float(lengths[step]), (y0, d0), (y1, d1))
                    pieces.append((piece, self._pilot.within(flown, int(step), channel, packed)))
                worst, after, which = highest(pieces, worst, resolution)
                if which >= 0:
                    when = float(flight.times_s[peaks[which]] + after)
            found.append((limit, worst, when))
        return found

    def _propellant(self, flown: Array, packed: Array) -> tuple[float | None, float | None]:
        """Mass burnt over flown states (M, nx), and what is left above the dry mass."""
        declared, table = self._problem.propellant, self._problem.table
        if declared is None:
            return None, None
        mass = flown[:, [s.name for s in self._problem.states].index(declared.mass)]
        used = float(mass[0] - mass[-1])
        if declared.dry_mass is None:
            return used, None
        dry = float(packed[table.slice(declared.dry_mass)][0])
        return used, float(mass[-1]) - dry if dry > 0.0 else None


def _resolution(limit: Limit, bound: float, worst: float) -> float:
    """How exactly a worst value has to be known."""
    return max(_RESOLUTION * abs(bound - worst), _LEAST_RESOLUTION * bound, _ROUNDING * limit.scale)


def _check(limit: Limit, value: float, bound: float, time_s: float) -> Check:
    worst = float(value)
    not_negative(limit.what, bound)
    passed = worst <= bound and not (limit.distance and worst < 0.0)
    return Check(limit.name, worst, bound, limit.unit, time_s, bool(passed))


def _reason(failed: Check) -> str:
    text = f"{failed.name} {failed.worst_value:.4g} {failed.unit} at {failed.time_s:.2f} s"
    if failed.worst_value <= failed.bound:
        return f"{text} is negative, so no distance from the target"
    return f"{text} exceeds {failed.bound:.4g}"
