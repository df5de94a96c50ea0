"""Finite differences of whole SCP runs: the reference that a gradient is compared with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.losses import Loss
from dscp_core.gradients.run import tangent
from dscp_core.scp.scp import Scp, ScpResult

Array = NDArray[np.float64]

# First steps relative to the parameter's size. Below the least, rounding costs more digits than
# the change of an active set, whose multipliers are nearly zero there.
_LARGEST_FIRST_STEP = 1e-3
_LEAST_FIRST_STEP = 1e-5
_SHRINKING = 3.0
_MOST_STEPS = 8
_SATISFIED = 1e-8
_REPEATABILITY = 4.0 * float(np.finfo(float).eps)
"""Polished runs of one case repeat to this fraction of the value."""


@dataclass(frozen=True)
class Difference:
    """A derivative by finite differences.

    Attributes:
        value: The derivative per SI unit, Richardson-extrapolated; None where too few steps had
            runs that can be trusted.
        uncertainty: Disagreement of the best two extrapolations, at least the rounding.
        step: The largest step behind the value.
        kind: ``"central"``; ``"forward"`` or ``"backward"`` next to a bound of the parameter or
            to a change of an active set.
        active_set_radius: Change of the parameter in the directions of the runs, to first order,
            at which the first active set changes.
        rejected: Steps that were not used, because a run failed or could not be polished.
    """

    value: float | None
    uncertainty: float
    step: float
    kind: str
    active_set_radius: float
    rejected: int

    @property
    def crosses_active_set_change(self) -> bool:
        """Whether the derivative may jump within the reach of the runs behind the value."""
        return self.step * _REACH[self.kind] > self.active_set_radius


# Offsets in steps, weights, and the longest offset of the formulas of second order.
_STENCILS = {
    "central": ((1.0, -1.0), (0.5, -0.5)),
    "forward": ((0.0, 1.0, 2.0), (-1.5, 2.0, -0.5)),
    "backward": ((0.0, -1.0, -2.0), (1.5, -2.0, 0.5)),
}
_REACH = {kind: max(map(abs, offsets)) for kind, (offsets, _) in _STENCILS.items()}


@dataclass(frozen=True)
class _Extrapolation:
    value: float
    step: float
    rounding: float


class RunDifferences:
    """Derivatives of a loss by running the whole SCP again, at the K of a trace.

    Not safe for calls from several threads at once.
    """

    def __init__(self, scp: Scp, trace: ScpResult, loss: Loss) -> None:
        """Fix the number of iterations.

        Args:
            scp: The loop that made the trace; with polished subproblems.
            trace: A cold run with at least one iteration.
            loss: Scalar of the trace.
        """
        self._scp = scp.with_options(fixed_iterations=len(trace.iterations), deadline_s=None)
        self._trace = trace
        self._loss = loss
        self._size = abs(loss.value(scp.transcription, trace))

    def derivative(
        self,
        name: str,
        component: int = 0,
        *,
        step: float | None = None,
        most_steps: int = _MOST_STEPS,
    ) -> Difference:
        """Derivative with respect to one component of a parameter.

        The first step stays within the active set where rounding allows, and steps shrink until
        two extrapolations agree.

        Args:
            name: Name of the parameter.
            component: Index into a vector parameter.
            step: Longest step, SI; None for one that suits the parameter.
            most_steps: Most steps, at least 2; with 2 there is one extrapolation, and its
                uncertainty is what it changed.

        Raises:
            InvalidInputError: Unknown name, or a step that is not positive or leaves the
                parameter's bounds.
        """
        table = self._scp.transcription.table
        declared, position = table[name], table.slice(name)
        theta = self._trace.parameters
        direction = np.zeros(theta.size)
        direction[position.start + component] = 1.0
        radii = {sign: self._radius(sign * direction) for sign in (1.0, -1.0)}
        size = float(np.max(np.abs(theta[position])))
        here = float(theta[position.start + component])
        usable: list[tuple[str, float, float]] = []
        for kind, (offsets, _) in _STENCILS.items():
            radius = min(radii[float(np.sign(offset))] for offset in offsets if offset)
            first = _first_step(size, radius / _REACH[kind], step)
            ends = [here + first * offset for offset in offsets]
            if declared.lower <= min(ends) and max(ends) <= declared.upper:
                usable.append((kind, first, radius))
        if not usable:
            bounds = f"[{declared.lower:g}, {declared.upper:g}]"
            raise InvalidInputError("step", step, f"within {bounds} of {name} at {here:g}")
        # Central, unless a kink is so close that one side reaches further; steps shrink anyway.
        inside = [(k, h, radius) for k, h, radius in usable if h * _REACH[k] <= radius]
        widest = max(usable, key=lambda choice: choice[2] / (choice[1] * _REACH[choice[0]]))
        return self._shrink(direction, most_steps, *(inside[0] if inside else widest))

    def _radius(self, direction: Array) -> float:
        return tangent(self._scp, self._trace, direction).active_set_radius

    def _shrink(
        self, direction: Array, most_steps: int, kind: str, first: float, radius: float
    ) -> Difference:
        slopes: list[tuple[float, float]] = []
        older: _Extrapolation | None = None
        best, doubt, rejected = None, np.inf, 0
        for number in range(most_steps):
            h = first / _SHRINKING**number
            slope = self._slope(direction, h, kind)
            if slope is None:
                rejected += 1
                continue
            slopes.append((h, slope))
            if len(slopes) < 2:
                continue
            newer = self._extrapolate(*slopes[-2:])
            if older is not None:
                difference = max(abs(newer.value - older.value), older.rounding)
                if difference < doubt:
                    best, doubt = older, difference
                if doubt <= max(_SATISFIED * abs(older.value), older.rounding):
                    break
            older = newer
        if best is None and older is not None:
            best, doubt = older, max(abs(older.value - slopes[-1][1]), older.rounding)
        if best is None:
            return Difference(None, np.inf, first, kind, radius, rejected)
        return Difference(best.value, float(doubt), best.step, kind, radius, rejected)

    def _extrapolate(
        self, coarse: tuple[float, float], fine: tuple[float, float]
    ) -> _Extrapolation:
        """Richardson: remove the error of second order in the step."""
        gain = (coarse[0] / fine[0]) ** 2
        value = (gain * fine[1] - coarse[1]) / (gain - 1.0)
        return _Extrapolation(value, coarse[0], _REPEATABILITY * self._size / fine[0])

    def _slope(self, direction: Array, h: float, kind: str) -> float | None:
        """Difference quotient, or None when a run cannot be trusted."""
        total = 0.0
        for offset, weight in zip(*_STENCILS[kind], strict=True):
            value = self._value(self._trace.parameters + offset * h * direction)
            if value is None:
                return None
            total += weight * value
        return total / h

    def _value(self, parameters: Array) -> float | None:
        trace = self._scp.run(parameters)
        if not trace.succeeded:
            return None
        for iteration in trace.iterations:
            # An unpolished solution is off by the solver's tolerance, 1e4 times the rounding.
            if iteration.linearisation is None or not iteration.linearisation.verdict.polished:
                return None
        return self._loss.value(self._scp.transcription, trace)


def relative_error(gradient: float, difference: Difference, size: float) -> float | None:
    """|gradient - difference| over a size.

    Args:
        gradient: Derivative to be checked.
        difference: The finite difference.
        size: The larger of the two; for a component of a vector, the vector's largest.

    Returns:
        None where there is no difference, or one that cannot tell the size from zero.
    """
    if difference.value is None or not size > difference.uncertainty:
        return None
    return abs(gradient - difference.value) / size


def _first_step(size: float, reach: float, asked: float | None) -> float:
    """First step for a parameter of a size whose active sets hold within a reach."""
    inside = 0.5 * reach
    if asked is not None:
        if not (np.isfinite(asked) and asked > 0.0):
            raise InvalidInputError("step", asked, "finite and > 0")
        return min(asked, inside) if inside > 0.0 else asked
    if size == 0.0:
        return float(inside) if 0.0 < inside < np.inf else 1.0
    return float(np.clip(inside, _LEAST_FIRST_STEP * size, _LARGEST_FIRST_STEP * size))
