"""A plan flown to its end, or to the event that ends it before or after."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dscp_core.planning.extremes import Evaluate, Piece, first_rise, highest, peak_bounds
from dscp_core.planning.limits import Limits
from dscp_core.planning.propagation import Flight, Propagator, Steps
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.ending import EndEvent
from dscp_core.problem.flight import ControlHold
from dscp_core.problem.tracing import KnownParameters

Array = NDArray[np.float64]

_MOST_ERROR = 1e-8
"""Sum of the steps' error estimates relative to the states' scales: 0.05 mm of 5 km."""
_HALVINGS = 6
_SETTLING = 0.25
"""Halved steps of order 4 leave a sixteenth of the error; with more than this they do not help."""
_ROUNDING = 1e-9
"""Of the flight time; and how near to zero the quantity of the event counts as there, SI."""
_EVENT = 0  # comes first of what is watched


@dataclass(frozen=True)
class Flown:
    """How it went.

    Attributes:
        flight: Every step, to the end of the flight.
        control: Held at its end, or at the plan's end where the flight went on, (nu,), SI.
        change: Of the planned control over the interval of that moment, (nu,), SI.
        interval_s: Mean length of the plan's intervals.
        event_s: When the end event ended the flight; None where it did not.
        meant: Whether it was meant to.
        failure: Why this is no flight of the plan; None where it is one.
    """

    flight: Flight
    control: Array
    change: Array
    interval_s: float
    event_s: float | None
    meant: bool
    failure: str | None

    @property
    def controls(self) -> Array:
        """Controls at every end of the steps as flown, (M+1, nu), SI."""
        flight = self.flight
        last = _last_control(flight)[0] if flight.errors.size else self.control
        return np.vstack([flight.steps.controls, last])


class Pilot:
    """Flies plans of one problem; not safe for calls from several threads at once."""

    def __init__(
        self,
        problem: OptimalControlProblem,
        limits: Limits,
        intervals: int,
        substeps: int,
        hold: ControlHold,
    ) -> None:
        """Compile the dynamics and what is watched.

        Args:
            problem: The declaration.
            limits: Of it.
            intervals: Number N of intervals of the plans.
            substeps: Steps per interval; more where the error asks for it.
            hold: How the controls are flown.
        """
        self._problem = problem
        self._of_state = limits.of_state
        self._intervals = intervals
        self._substeps = substeps
        self._hold = hold
        self._propagator = Propagator(problem, limits.watched, (1, intervals * substeps))

    def fly(
        self,
        times_s: Array,
        start: Array,
        controls: Array,
        packed: Array,
        values: KnownParameters,
    ) -> Flown:
        """Fly a plan.

        Args:
            times_s: (N+1,) node times.
            start: (nx,) first state, SI.
            controls: (N+1, nu) planned controls, SI.
            packed: Parameters, SI.
            values: The same by name.
        """
        interval_s = float(times_s[-1] - times_s[0]) / self._intervals
        event, reached = self._problem.end_event, False
        steps, before = self._steps(times_s, controls), None
        for _ in range(_HALVINGS + 1):
            planned = self._propagator.fly(float(times_s[0]), start, steps, interval_s, packed)
            flight = planned.first(planned.whole)
            if event is not None:
                flight, reached = self._until_event(flight, interval_s, packed)
            complete = reached or planned.whole == steps.lengths_s.size
            error = float(flight.errors.sum()) if complete else np.inf
            stuck = before is not None and not error <= _SETTLING * before
            if error <= _MOST_ERROR or stuck:
                break
            steps, before = steps.halved(), error
        control, change = _last_control(flight if flight.errors.size else planned)
        meant = event is not None and event.is_meant(self._problem.table, values)
        flown = Flown(flight, control, change, interval_s, None, meant, None)
        if error > _MOST_ERROR:
            return _lost(flown, finite=complete)
        if event is not None and meant and not reached:
            after = event.control_after(self._problem.table, values, controls.shape[1])
            if after is not None:
                flight, reached = self._wait(event, after, flight, interval_s, packed)
        event_s = float(flight.times_s[-1]) if reached else None
        failure = None
        if event is not None and meant and not reached:
            waited = "" if event.after is None else f"within {event.patience_s:g} s of "
            failure = f"no {event.name} {waited or 'at '}the end of the plan"
        elif event is not None and reached and not meant:
            failure = f"{event.name} at {event_s:.2f} s, where none is meant to be"
        return replace(flown, flight=flight, event_s=event_s, failure=failure)

    def within(self, flown: Flown, step: int, channel: int, packed: Array) -> Evaluate:
        """A watched quantity and its rate over one step, by the time after its start."""
        return self._evaluate(flown.flight, step, channel, flown.interval_s, packed)

    def _evaluate(
        self, flight: Flight, step: int, channel: int, interval_s: float, packed: Array
    ) -> Evaluate:
        def evaluate(after_s: float) -> tuple[float, float]:
            part = self._propagator.within(flight, step, after_s, interval_s, packed)
            return float(part.right[0, 0, channel]), float(part.right[1, 0, channel])

        return evaluate

    def _steps(self, times_s: Array, controls: Array) -> Steps:
        lengths = np.diff(times_s)
        changes = np.diff(controls, axis=0)
        if self._hold is ControlHold.MEAN:
            first, slopes = controls[:-1] + changes / 2, np.zeros_like(changes)
        else:
            first, slopes = controls[:-1], changes / lengths[:, None]
        count = self._substeps
        length = np.repeat(lengths / count, count)
        slope = np.repeat(slopes, count, axis=0)
        elapsed = length * np.tile(np.arange(count), self._intervals)
        started = np.repeat(first, count, axis=0) + elapsed[:, None] * slope
        return Steps(length, started, slope, np.repeat(changes, count, axis=0))

    def _until_event(self, flight: Flight, interval_s: float, packed: Array) -> tuple[Flight, bool]:
        """The flight up to its event, and whether it comes to that."""
        lengths = flight.steps.lengths_s
        # What is watched is the negative of the event's quantity.
        low, high = flight.left[0, :, _EVENT], flight.right[0, :, _EVENT]
        rates = flight.left[1, :, _EVENT], flight.right[1, :, _EVENT]
        falls = np.flatnonzero((low < 0.0) & (high >= 0.0))
        last = falls[0] if falls.size else low.size
        reach = peak_bounds(
            low[:last], high[:last], rates[0][:last], rates[1][:last], lengths[:last]
        )
        dips = np.flatnonzero((low[:last] < 0.0) & (reach >= 0.0))
        for step in [*dips, *falls[:1]]:
            piece = Piece(
                0.0,
                float(lengths[step]),
                (float(low[step]), float(rates[0][step])),
                (float(high[step]), float(rates[1][step])),
            )
            rising = self._evaluate(flight, step, _EVENT, interval_s, packed)
            if step < last:
                _, at, where = highest([(piece, rising)], -_ROUNDING, lambda _: 0.0, enough=0.0)
                if where < 0:
                    continue
                piece = piece.split(at, rising(at))[0]
            at = first_rise(piece, rising, _ROUNDING * float(lengths[step]))
            part = self._propagator.within(flight, step, at, interval_s, packed)
            part.right[0, 0, _EVENT] = 0.0  # up to what is left of looking for it
            return flight.first(step).and_then(part), True
        return flight, False

    def _wait(
        self, event: EndEvent, held: Array, flight: Flight, interval_s: float, packed: Array
    ) -> tuple[Flight, bool]:
        """The flight and what comes after the plan's end, and whether the event came then."""
        length = interval_s / self._substeps
        none = np.zeros((1, held.size))
        step = Steps(np.array([length]), held[None], none, none)
        end, error = float(flight.times_s[-1]), float(flight.errors.sum())
        reached = False
        while not reached and flight.times_s[-1] < end + event.patience_s:
            after = self._propagator.fly(
                float(flight.times_s[-1]), flight.states[-1], step, interval_s, packed
            )
            if not after.whole:
                break
            after, reached = self._until_event(after, interval_s, packed)
            for side in (after.left, after.right):
                # Limits of the control are those of a plan.
                side[:, :, ~self._of_state] = np.array([-np.inf, 0.0])[:, None, None]
            flight = flight.and_then(after)
            error += float(after.errors.sum())
            if error > _MOST_ERROR:
                return flight, False
        return flight, reached


def _last_control(flight: Flight) -> tuple[Array, Array]:
    """Control at the end of a flight, and its change over that interval."""
    steps = flight.steps
    return steps.controls[-1] + steps.lengths_s[-1] * steps.slopes[-1], steps.changes[-1]


def _lost(flown: Flown, *, finite: bool) -> Flown:
    """The flight as far as it is known, and why not further."""
    flight = flown.flight
    known = int(np.searchsorted(np.cumsum(flight.errors), _MOST_ERROR, side="right"))
    why = "the flight is not finite"
    if finite or known < flight.errors.size:
        why = f"its error is estimated as {flight.errors.sum():.1g} of the states' scales"
    known = min(known, flight.errors.size)
    failure = f"integration ended before {flight.times_s[known]:.3f} s: {why}"
    return replace(flown, flight=flight.first(known), failure=failure)
