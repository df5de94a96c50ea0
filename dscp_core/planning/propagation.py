"""The true dynamics flown by Dormand-Prince steps, with what is watched along the way.

Every step gives the state at its end, an estimate of its error, and at both ends the value of every
watched quantity with its rate along the flight. Another method and other code than those of any
transcription, so that a certificate does not repeat its errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.declaration import OptimalControlProblem, StagePoint, named
from dscp_core.problem.tracing import Tracer
from dscp_core.transcription.compiled import CompiledFunction

Array = NDArray[np.float64]

# Dormand and Prince 1980, order 5 with an embedded order 4; the last stage is the end's rate.
_NODES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
_STAGES = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_ERRORS = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)


@dataclass(frozen=True)
class Watched:
    """One scalar along a flight, made of a head and, for a cone, of the tail whose size counts.

    Attributes:
        expression: Of a point and the parameters: the scalar, or [g0; g1] for ``|g1| - g0``.
        what: As messages call it.
        cone: Which of both.
    """

    expression: Callable[..., ca.SX]
    what: str
    cone: bool = False


@dataclass(frozen=True)
class Steps:
    """Controls over consecutive steps, linear in each.

    Attributes:
        lengths_s: (M,).
        controls: (M, nu) at the start of each, SI.
        slopes: (M, nu) their rates.
        changes: (M, nu) change of the planned control over the interval that the step belongs to.
    """

    lengths_s: Array
    controls: Array
    slopes: Array
    changes: Array

    def halved(self) -> Steps:
        """The same controls in twice as many steps."""
        half = np.repeat(self.lengths_s / 2, 2)
        controls = np.repeat(self.controls, 2, axis=0)
        slopes = np.repeat(self.slopes, 2, axis=0)
        controls[1::2] += half[1::2, None] * slopes[1::2]
        return Steps(half, controls, slopes, np.repeat(self.changes, 2, axis=0))

    def first(self, count: int) -> Steps:
        """The first steps."""
        return Steps(*(part[:count] for part in vars(self).values()))


@dataclass(frozen=True)
class Flight:
    """Consecutive steps as they were flown.

    Attributes:
        steps: What was flown.
        times_s: (M+1,) ends of the steps.
        states: (M+1, nx), SI.
        errors: (M,) estimates, relative to the states' scales.
        left: (2, M, watched) values at the start of each step, and their rates.
        right: The same at its end.
    """

    steps: Steps
    times_s: Array
    states: Array
    errors: Array
    left: Array
    right: Array

    @property
    def whole(self) -> int:
        """Number of steps before the first that is not finite."""
        finite = np.isfinite(self.states[1:]).all(axis=1) & np.isfinite(self.errors)
        return int(finite.size if finite.all() else np.argmin(finite))

    def first(self, count: int) -> Flight:
        """The first steps."""
        return Flight(
            self.steps.first(count),
            self.times_s[: count + 1],
            self.states[: count + 1],
            self.errors[:count],
            self.left[:, :count],
            self.right[:, :count],
        )

    def and_then(self, other: Flight) -> Flight:
        """Both, the other's first state being this one's last."""
        both = zip(vars(self.steps).values(), vars(other.steps).values(), strict=True)
        return Flight(
            Steps(*(np.concatenate(parts) for parts in both)),
            np.concatenate([self.times_s, other.times_s[1:]]),
            np.concatenate([self.states, other.states[1:]]),
            np.concatenate([self.errors, other.errors]),
            np.concatenate([self.left, other.left], axis=1),
            np.concatenate([self.right, other.right], axis=1),
        )


class Propagator:
    """Flies steps of one problem; not safe for calls from several threads at once."""

    def __init__(
        self, problem: OptimalControlProblem, watched: Sequence[Watched], counts: Sequence[int]
    ) -> None:
        """Compile one step.

        Args:
            problem: The declaration.
            watched: What is evaluated along the way.
            counts: Numbers of steps to be ready for.
        """
        self._nx, self._nu = len(problem.states), len(problem.controls)
        self._packed = problem.table.size
        self._watched = len(watched)
        self._scale = np.array([s.scale for s in problem.states])
        self._step = _step_function(problem, watched, self._scale)
        self._one = CompiledFunction("one_step", *_inlined(self._step))
        self._many = {count: self._mapped(count) for count in counts}

    def fly(
        self, start_s: float, state: Array, steps: Steps, interval_s: float, packed: Array
    ) -> Flight:
        """Fly steps from a state.

        Args:
            start_s: Time of it.
            state: (nx,), SI.
            steps: M of them.
            interval_s: Length of the plan's intervals, for constraints that know it.
            packed: Parameters, SI.
        """
        count = steps.lengths_s.size
        if count not in self._many:
            self._many[count] = self._mapped(count)
        scaled = state / self._scale
        flown, errors, watched = self._many[count](
            scaled,
            steps.controls.ravel(),
            steps.slopes.ravel(),
            steps.changes.ravel(),
            steps.lengths_s,
            np.append(interval_s, packed),
        )
        values = watched.reshape(count, 4, self._watched).transpose(1, 0, 2)
        return Flight(
            steps,
            start_s + np.concatenate([[0.0], np.cumsum(steps.lengths_s)]),
            np.concatenate([scaled[None], flown.reshape(count, self._nx)]) * self._scale,
            errors,
            values[:2],
            values[2:],
        )

    def within(
        self, flight: Flight, step: int, after_s: float, interval_s: float, packed: Array
    ) -> Flight:
        """A part of one step of a flight, from its start on, as a flight of one step."""
        steps = Steps(*(part[step : step + 1] for part in vars(flight.steps).values()))
        steps = replace(steps, lengths_s=np.array([after_s]))
        scaled = flight.states[step] / self._scale
        flown, errors, watched = self._one(
            scaled,
            steps.controls[0],
            steps.slopes[0],
            steps.changes[0],
            steps.lengths_s,
            np.append(interval_s, packed),
        )
        values = watched.reshape(4, 1, self._watched)
        start = flight.times_s[step]
        return Flight(
            steps,
            np.array([start, start + after_s]),
            np.stack([flight.states[step], flown * self._scale]),
            errors,
            values[:2],
            values[2:],
        )

    def _mapped(self, count: int) -> CompiledFunction:
        inputs = [
            ca.MX.sym("x", self._nx),
            *(ca.MX.sym(name, self._nu, count) for name in ("u", "slope", "change")),
            ca.MX.sym("h", 1, count),
            ca.MX.sym("T_p", 1 + self._packed),
        ]
        mapped = self._step.mapaccum(f"steps_{count}", count)
        outputs = mapped(*inputs[:-1], ca.repmat(inputs[-1], 1, count))
        return CompiledFunction(f"flight_{count}", inputs, [ca.vec(part) for part in outputs])


def _inlined(function: ca.Function) -> tuple[list[ca.SX], list[ca.SX]]:
    inputs = function.sx_in()
    return inputs, list(function.call(inputs))


def _step_function(
    problem: OptimalControlProblem, watched: Sequence[Watched], scale: Array
) -> ca.Function:
    """(x, u, slope, change, h, [T; p]) to the scaled state at the end, its error, the watched."""
    nx, nu = len(problem.states), len(problem.controls)
    x, u, slope = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("slope", nu)
    change, length = ca.SX.sym("change", nu), ca.SX.sym("h")
    interval, packed = ca.SX.sym("T"), ca.SX.sym("p", problem.table.size)
    parameters = named(problem, packed)
    state, control = ca.SX.sym("state", nx), ca.SX.sym("control", nu)
    trace = Tracer(problem.table, state, control, packed)
    traced = trace("dynamics", problem.dynamics, state, control, parameters, rows=nx)
    # Scaled, so that one tolerance suits every state.
    dynamics = ca.Function("rates", [state, control, packed], [traced / ca.DM(scale)])

    def rates(at: ca.SX, time: ca.SX) -> ca.SX:
        return dynamics(at * ca.DM(scale), u + time * slope, packed)

    stages: list[ca.SX] = []
    for node, weights in zip(_NODES, _STAGES, strict=True):
        moved = x + length * sum(
            (w * k for w, k in zip(weights, stages, strict=True)), ca.SX(nx, 1)
        )
        stages.append(rates(moved, node * length))
    error = length * sum((w * k for w, k in zip(_ERRORS, stages, strict=True)), ca.SX(nx, 1))
    ends = []
    for at, time, rate, forward in ((x, 0.0, stages[0], 1.0), (moved, length, stages[-1], -1.0)):
        point = StagePoint(at * ca.DM(scale), u + time * slope, interval, change)
        ends.append(
            _watch(problem, watched, point, parameters, rate * ca.DM(scale), slope, forward)
        )
    known = ca.vertcat(interval, packed)
    outputs = [moved, ca.norm_inf(error), ca.vertcat(*ends)]
    return ca.Function("step", [x, u, slope, change, length, known], ca.cse(outputs))


def _watch(
    problem: OptimalControlProblem,
    watched: Sequence[Watched],
    at: StagePoint,
    parameters: dict[str, ca.SX],
    rate: ca.SX,
    slope: ca.SX,
    forward: float,
) -> ca.SX:
    """Values of all that is watched, then their rates along the flight."""
    nx, nu = at.x.numel(), at.u.numel()
    symbols = [ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("T"), ca.SX.sym("change", nu)]
    x, u, step, change = symbols
    point = StagePoint(x, u, step, change)
    packed = ca.vertcat(*parameters.values())
    trace = Tracer(problem.table, *symbols, packed)
    values, rates = [], []
    for one in watched:
        value = trace(one.what, one.expression, point, parameters, rows=None if one.cone else 1)
        along = ca.jtimes(value, x, rate) + ca.jtimes(value, u, slope)
        if one.cone:
            value, along = _cone(value, along, forward)
        values.append(value)
        rates.append(along)
    both = ca.vertcat(*values, *rates, ca.SX(0, 1))
    placed = ca.vertcat(*(ca.SX(part) for part in vars(at).values()))
    return ca.substitute(both, ca.vertcat(*symbols), placed)


def _cone(value: ca.SX, along: ca.SX, forward: float) -> tuple[ca.SX, ca.SX]:
    """``|g1| - g0`` and its rate, one-sided where g1 is zero."""
    size = ca.norm_2(value[1:])
    growing = ca.if_else(
        size > 0.0, ca.dot(value[1:], along[1:]) / size, forward * ca.norm_2(along[1:])
    )
    return size - value[0], growing - along[0]
