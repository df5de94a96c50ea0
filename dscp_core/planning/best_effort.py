"""The plan of least violation, where no feasible one exists.

Lexicographic: every error at the end is made as small as it can be while those before it stay
what they were; then the problem's own cost. Each step is a run of convex subproblems of one
relaxed problem (`dscp_core.planning.relaxation`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import chain, repeat
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.planning.relaxation import (
    CURVATURE,
    Relaxation,
    bound_name,
    price_name,
    slack_name,
)
from dscp_core.problem.declaration import TERMINAL_TIME, named
from dscp_core.problem.flight import Discretisation
from dscp_core.problem.tracing import KnownParameters, Tracer, numeric
from dscp_core.scp.restoration import restored
from dscp_core.scp.scp import Iteration, Scp, ScpResult, ScpStatus
from dscp_core.transcription.compiled import CompiledFunction
from dscp_core.transcription.layout import TrajectoryLayout
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

_ITERATIONS, _OF_COST = 40, 15
"""Most of one step, and of the last, without which only some of the cost is lost."""
_PATIENCE = 15
"""Iterations after which the curvature's least factor is raised."""
_RAISED, _DAMPED = 4.0, 30.0
"""By this; and after a failure by that."""
_FAILURES = 3
_RELATIVE_TOLERANCE = 1e-3
"""Of an error: what later steps may add to it."""
_COST_TOLERANCE = 1e-6
_SAME_TIME = 1e-3
_OWN = (1e2, 1e3)
"""Factors of an error's price in its own step, where errors follow: to get near, then nearer."""


@dataclass(frozen=True)
class Reached:
    """What the steps came to from one start.

    Attributes:
        states: (N+1, nx) of the problem's states, SI.
        controls: (N+1, nu), SI.
        terminal_time_s: Flight time.
        errors: One per shortfall, in its unit.
        violations: Of the softened constraints, largest along the nodes, in their units.
        cost: The problem's own, in its unit.
        converged: Whether each step's iterations converged; shorter where steps were not made.
        times_s: Terminal time after each step.
    """

    states: Array
    controls: Array
    terminal_time_s: float
    errors: tuple[float, ...]
    violations: dict[str, float]
    cost: float
    converged: tuple[bool, ...]
    times_s: tuple[float, ...]

    @property
    def whole(self) -> bool:
        """Whether every step was made: one per error, then the cost."""
        return len(self.converged) == len(self.errors) + 1


class LeastViolation:
    """Finds the plan of least violation of one problem; keeps all symbolic work between calls.

    Attributes:
        relaxation: The problem with its concessions.
        scp: Loop of the relaxed problem, one iteration a run.
        layout: Where quantities stand in its decision vectors.
        nx: Number of the problem's own states.
        nu: Number of its own controls.
    """

    def __init__(self, relaxation: Relaxation, like: Scp) -> None:
        """Compile the relaxed problem.

        Args:
            relaxation: Of the problem.
            like: The problem's own loop, whose intervals and options count.
        """
        self.relaxation = relaxation
        own = like.transcription.layout
        transcription = Transcription(
            relaxation.relaxed,
            own.intervals,
            free_terminal_time=True,
            discretisation=like.transcription.discretisation,
            hold=like.transcription.hold,
        )
        # One iteration at a time: each one's multipliers give the next one's curvature.
        options = replace(
            like.options,
            max_iterations=1,
            fixed_iterations=None,
            polish=False,
            cost_tolerance=max(like.cost_tolerance, _COST_TOLERANCE),
        )
        self.scp = Scp(transcription, options, like.clock)
        self.layout = transcription.layout
        problem = relaxation.problem
        self.nx, self.nu = len(problem.states), len(problem.controls)
        x, packed = ca.SX.sym("x", self.nx), ca.SX.sym("p", problem.table.size)
        trace = Tracer(problem.table, x, packed)
        p = named(problem, packed)
        errors = [
            ca.norm_2(trace(f"shortfall {s.name}", s.error, x, p, rows=None))
            for s in relaxation.concessions.shortfalls
        ]
        self._errors = CompiledFunction("errors", [x, packed], [ca.vertcat(*errors)])

    def errors(self, end: Array, packed: Array) -> tuple[float, ...]:
        """The shortfalls of a final state (nx,), SI."""
        return tuple(float(error) for error in self._errors(end, packed)[0])

    def widened(self, state: Array, packed: Array) -> dict[str, float]:
        """Parameters that change for a start from this state, with their new values."""
        widen, table = self.relaxation.concessions.widen, self.relaxation.problem.table
        if widen is None:
            return {}
        return dict(numeric("widen of concessions", table, widen, packed, state))

    def find(
        self,
        packed: Array,
        starts: Iterable[tuple[float, Array | None]],
        left_s: Callable[[], float | None],
        count: Callable[[ScpResult], None],
        otherwise: Iterable[tuple[float, Array | None]] = (),
    ) -> Reached | None:
        """The best that is reached from any of the starts; None where none leads anywhere.

        Args:
            packed: Packed parameters of the problem, SI, widened where they have to be.
            starts: First terminal time, s, and scaled reference of the relaxed problem, or None
                for the problem's guess.
            left_s: Wall time that is left, or None.
            count: Told of every run.
            otherwise: More starts, as long as nothing is found.
        """
        best: Reached | None = None
        every = chain(zip(repeat(False), starts), zip(repeat(True), otherwise))
        for more, (seconds, reference) in every:
            if left_s() == 0.0 or (more and best is not None):
                break
            found = _Search(self, packed, seconds, left_s, count, best).from_(reference)
            if found is not None and (best is None or self._is_better(found, best, packed)):
                best = found
            if best is not None and best.whole and not self.short(best, packed):
                break
        return best

    def tolerances(self, packed: Array) -> tuple[list[float], list[float]]:
        """Of the softened constraints' violations, and of the errors."""
        relaxed, concessions = self.relaxation.relaxed, self.relaxation.concessions
        table = self.relaxation.problem.table
        values = KnownParameters(table.unpack(packed))
        limits = {c.name: c for c in (*relaxed.path_constraints, *relaxed.cone_constraints)}
        softened = [limits[name].accepted(table, values) for name in concessions.softened]
        return softened, [s.tolerance for s in concessions.shortfalls]

    def short(self, reached: Reached, packed: Array) -> bool:
        """Whether an error or a violation is above its tolerance."""
        violations, errors = self.tolerances(packed)
        pairs = [*zip(reached.violations.values(), violations, strict=True)]
        pairs += zip(reached.errors, errors, strict=True)
        return any(value > 2.0 * tolerance for value, tolerance in pairs)

    def _is_better(self, one: Reached, other: Reached, packed: Array) -> bool:
        if one.converged[0] != other.converged[0]:
            return one.converged[0]
        order = self.order(one, other, packed, len(_rank(one)) - 1)
        if order or one.whole != other.whole:
            return order < 0 or (order == 0 and one.whole)
        return one.cost < other.cost

    def order(self, one: Reached, other: Reached, packed: Array, known: int | None = None) -> int:
        """-1 where one is better in lexicographic order, 1 where the other is, 0 for neither.

        Args:
            one: Of two.
            other: Of two.
            packed: Packed parameters, SI.
            known: How many violations and errors count, without the cost; None for all and it.
        """
        violations, errors = self.tolerances(packed)
        tolerances = [*violations, *errors, 0.0][:known]
        for mine, its, tolerance in zip(_rank(one), _rank(other), tolerances, strict=False):
            least = min(abs(mine), abs(its))
            if abs(mine - its) > 2.0 * (tolerance + _RELATIVE_TOLERANCE * least):
                return -1 if mine < its else 1
        return 0

    def curvature(self, iteration: Iteration, parameters: Array) -> float:
        """Price of what the curvature terms stand for, in units of the problem's own cost.

        They are the second-order change of the states that the cost rewards at the end. With an
        error's price, or a bound that is met, those states are worth more than the cost says: by
        the ratio of their multipliers to its gradient.
        """
        layout, nx = self.layout, self.nx
        last = layout.state_index(layout.intervals, 0)
        transcription = self.scp.transcription
        reference = iteration.solution.z[: layout.reference_size]
        gradient = transcription.cost_gradient(reference, parameters)[0][last : last + nx]
        gradient = gradient / transcription.problem.cost_scale
        rows = (layout.intervals - 1) * layout.nx
        worth = -iteration.solution.equality_dual[rows : rows + nx]
        size = float(gradient @ gradient)
        return 1.0 if size == 0.0 else max(1.0, float(worth @ gradient) / size)


def _rank(reached: Reached) -> list[float]:
    return [*reached.violations.values(), *reached.errors, reached.cost]


def _seconds(layout: TrajectoryLayout, reference: Array) -> float:
    seconds = layout.terminal_time(reference)
    assert seconds is not None  # the relaxed problem's is free
    return seconds


class _Search:
    """The steps from one start."""

    def __init__(
        self,
        owner: LeastViolation,
        packed: Array,
        seconds: float,
        left_s: Callable[[], float | None],
        count: Callable[[ScpResult], None],
        best: Reached | None,
    ) -> None:
        self._owner = owner
        self._packed = packed.copy()
        self._packed[owner.relaxation.problem.table.slice(TERMINAL_TIME)] = seconds
        self._left_s, self._count, self._best = left_s, count, best
        table, concessions = owner.relaxation.problem.table, owner.relaxation.concessions
        self._prices = {
            price_name(s.name): float(numeric(f"price of {s.name}", table, s.price, packed))
            for s in concessions.shortfalls
        }
        self._changes: dict[str, Any] = {
            price_name(name): float(numeric(f"price of {name}", table, price, packed))
            for name, price in concessions.softened.items()
        }
        self._done: list[tuple[bool, float]] = []  # converged, and terminal time, of each step

    def from_(self, reference: Array | None) -> Reached | None:
        """What the steps come to; None where the first leads nowhere, or to no more than the best.

        A step that fails, or does not converge, leaves what the one before came to.
        """
        reached: Reached | None = None
        curvature = 1.0
        shortfalls = self._owner.relaxation.concessions.shortfalls
        for index, shortfall in enumerate((*shortfalls, None)):
            for factor in _OWN if index + 1 < len(shortfalls) else (1.0,):
                # Of what costs the same, what is nearest to the errors that come later.
                prices = {
                    price_name(s.name): self._prices[price_name(s.name)] * (1.0 if n else factor)
                    for n, s in enumerate(shortfalls[index:])
                }
                most = _OF_COST if shortfall is None else _ITERATIONS
                step = self._step({**self._changes, **prices}, reference, curvature, most)
                if step is None or not (step[1] or reached is None):
                    return reached
                reference, converged, curvature = step
                done = [*self._done, (converged, _seconds(self._owner.layout, reference))]
                now = self._reached(reference, done)
                if shortfall is not None and self._leads_no_further(index, now):
                    return None
            reached, self._done = now, done
            if shortfall is not None:
                error = now.errors[index]
                bound = (1.0 + _RELATIVE_TOLERANCE) * error + shortfall.tolerance
                self._changes[bound_name(shortfall.name)] = bound
        return reached

    def _leads_no_further(self, index: int, reached: Reached) -> bool:
        """Whether the best so far is better in this step or before, or came the same way."""
        best = self._best
        if best is None or index >= len(best.times_s):
            return False
        known = len(reached.violations) + index + 1
        order = self._owner.order(reached, best, self._packed, known)
        same_time = abs(reached.times_s[index] / best.times_s[index] - 1.0) < _SAME_TIME
        return order > 0 or (order == 0 and same_time)

    def _step(
        self, changes: dict[str, Any], reference: Array | None, curvature: float, most: int
    ) -> tuple[Array, bool, float] | None:
        """Iterate; the reference after the last iteration, and whether it converged."""
        owner, least, failures, before = self._owner, 1.0, 0, reference
        for number in range(most):
            left = self._left_s()
            if left == 0.0:
                return None
            curvature = max(curvature, least)
            parameters = owner.relaxation.pack(self._packed, {**changes, CURVATURE: curvature})
            try:
                result = owner.scp.with_options(deadline_s=left).run(parameters, reference)
            except InvalidInputError:  # a guess that is not finite
                return None
            self._count(result)
            if not result.iterations:
                failures += 1
                infeasible = result.status is ScpStatus.SUBPROBLEM_INFEASIBLE
                if failures > _FAILURES or (infeasible and number == 0):
                    return None
                if infeasible:  # the last iteration led too far
                    reference = before
                least *= _DAMPED
                continue
            before, reference = reference, result.final_reference
            if result.status is ScpStatus.CONVERGED:
                return reference, True, curvature
            if (number + 1) % _PATIENCE == 0:
                least *= _RAISED
            curvature = owner.curvature(result.iterations[-1], parameters)
        return None if reference is None else (reference, False, curvature)

    def _reached(self, reference: Array, done: list[tuple[bool, float]]) -> Reached:
        owner, layout = self._owner, self._owner.layout
        softened = owner.relaxation.concessions.softened
        free = {**self._changes, **dict.fromkeys(self._prices, 0.0)}
        free |= {price_name(name): 0.0 for name in softened}
        parameters = owner.relaxation.pack(self._packed, free)
        transcription = owner.scp.transcription
        if transcription.discretisation is Discretisation.PROPAGATED and done[-1][0]:
            reference = restored(transcription, reference, parameters)
        states, controls = layout.states(reference), layout.controls(reference)
        own = states[:, : owner.nx]
        slacks = {
            control.name: float(np.max(controls[:, owner.nu + index]))
            for index, control in enumerate(owner.relaxation.relaxed.controls[owner.nu :])
        }
        return Reached(
            states=own,
            controls=controls[:, : owner.nu],
            terminal_time_s=_seconds(layout, reference),
            errors=owner.errors(own[-1], self._packed),
            violations={name: max(slacks[slack_name(name)], 0.0) for name in softened},
            cost=transcription.evaluate(reference, parameters).cost,
            converged=tuple(converged for converged, _ in done),
            times_s=tuple(seconds for _, seconds in done),
        )
