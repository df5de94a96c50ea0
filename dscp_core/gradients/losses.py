"""Scalars of an SCP trace, and their derivatives with respect to the iterates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.scp.scp import ScpResult
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LossGradient:
    """Explicit derivatives of a loss L of the trace (section 3.2.2).

    Attributes:
        decisions: (K, n) with respect to the scaled decision vector of every iteration.
        parameters: (P,) with respect to the packed parameters, SI, iterates held fixed.
    """

    decisions: Array
    parameters: Array


class Loss(Protocol):
    """A scalar function of a trace."""

    def value(self, transcription: Transcription, trace: ScpResult) -> float:
        """The loss."""
        ...

    def gradient(self, transcription: Transcription, trace: ScpResult) -> LossGradient:
        """Its explicit derivatives."""
        ...


def _zeros(transcription: Transcription, trace: ScpResult) -> LossGradient:
    if not trace.iterations:
        raise InvalidInputError("trace", "0 iterations", ">= 1 iteration")
    return LossGradient(
        np.zeros((len(trace.iterations), transcription.layout.size)),
        np.zeros(transcription.table.size),
    )


@dataclass(frozen=True)
class FinalStateLoss:
    """``factor * state(t_f)`` in SI, for example -m(t_f) of section 4.1.2 with factor -1.

    Attributes:
        state: Name of the state.
        factor: Sign or weight.

    Example:
        >>> from dscp_core import FinalStateLoss, Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> fuel = planner.gradient(FinalStateLoss("mass", -1.0))
        >>> fuel["specific_impulse"] < 0.0  # a better engine burns less
        True
    """

    state: str
    factor: float = 1.0

    def _index(self, transcription: Transcription) -> tuple[int, float]:
        names = [s.name for s in transcription.problem.states]
        if self.state not in names:
            raise InvalidInputError("state", self.state, f"one of {', '.join(names)}")
        number, layout = names.index(self.state), transcription.layout
        return layout.state_index(layout.intervals, number), float(layout.state_scale[number])

    def value(self, transcription: Transcription, trace: ScpResult) -> float:
        """See `Loss.value`."""
        index, scale = self._index(transcription)
        return float(self.factor * scale * trace.final_reference[index])

    def gradient(self, transcription: Transcription, trace: ScpResult) -> LossGradient:
        """See `Loss.gradient`."""
        gradient = _zeros(transcription, trace)
        index, scale = self._index(transcription)
        gradient.decisions[-1, index] = self.factor * scale
        return gradient


@dataclass(frozen=True)
class CostLoss:
    """True cost J of the final trajectory (eq. 1, discretised), in its own units.

    Example:
        >>> from dscp_core import CostLoss, Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> planner.gradient(CostLoss()).of.name
        'cost'
    """

    def value(self, transcription: Transcription, trace: ScpResult) -> float:
        """See `Loss.value`."""
        return trace.iterations[-1].cost

    def gradient(self, transcription: Transcription, trace: ScpResult) -> LossGradient:
        """See `Loss.gradient`."""
        gradient = _zeros(transcription, trace)
        reference, parameters = transcription.cost_gradient(trace.final_reference, trace.parameters)
        gradient.decisions[-1, : reference.size] = reference
        gradient.parameters[:] = parameters
        return gradient


@dataclass(frozen=True)
class ConvergenceLoss:
    """Sum over iterations k >= 2 of |J_k - J_K|, the convergence metric of section 4.2.1.

    Example:
        >>> from dscp_core import ConvergenceLoss, Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> planner.gradient(ConvergenceLoss()).of.symbol
        'sum |J_k - J_K|'
    """

    def value(self, transcription: Transcription, trace: ScpResult) -> float:
        """See `Loss.value`."""
        costs = np.array([iteration.cost for iteration in trace.iterations])
        return float(np.sum(np.abs(costs[1:] - costs[-1])))

    def gradient(self, transcription: Transcription, trace: ScpResult) -> LossGradient:
        """See `Loss.gradient`."""
        gradient = _zeros(transcription, trace)
        costs = np.array([iteration.cost for iteration in trace.iterations])
        weights = np.sign(costs - costs[-1])
        weights[0] = 0.0
        weights[-1] -= np.sum(weights)
        size = trace.initial_reference.size
        for k, (iteration, weight) in enumerate(zip(trace.iterations, weights, strict=True)):
            if weight != 0.0:
                reference, parameters = transcription.cost_gradient(
                    iteration.solution.z[:size], trace.parameters
                )
                gradient.decisions[k, :size] += weight * reference
                gradient.parameters[:] += weight * parameters
        return gradient


@dataclass(frozen=True)
class LogConvergenceLoss:
    """Logarithm of the convergence metric, ``log(L / scale + floor)``.

    The metric spans decades; its logarithm is what a descent makes even progress on.

    Attributes:
        scale: Unit of the metric.
        floor: What is no more than rounding or the tolerance of the stopping test.
    """

    scale: float
    floor: float

    def _argument(self, transcription: Transcription, trace: ScpResult) -> float:
        return ConvergenceLoss().value(transcription, trace) / self.scale + self.floor

    def value(self, transcription: Transcription, trace: ScpResult) -> float:
        """See `Loss.value`."""
        return math.log(self._argument(transcription, trace))

    def gradient(self, transcription: Transcription, trace: ScpResult) -> LossGradient:
        """See `Loss.gradient`."""
        metric = ConvergenceLoss().gradient(transcription, trace)
        factor = 1.0 / (self.scale * self._argument(transcription, trace))
        return LossGradient(factor * metric.decisions, factor * metric.parameters)


@dataclass(frozen=True, eq=False)
class SeedLoss:
    """Linear functional ``seed . final_reference``, whose gradient is any wanted cotangent.

    Attributes:
        seed: (R,) weight of every entry of the scaled reference vector after the last iteration.
    """

    seed: Array

    def value(self, transcription: Transcription, trace: ScpResult) -> float:
        """See `Loss.value`."""
        return float(self.seed @ trace.final_reference)

    def gradient(self, transcription: Transcription, trace: ScpResult) -> LossGradient:
        """See `Loss.gradient`."""
        decisions = np.zeros((len(trace.iterations), transcription.layout.size))
        decisions[-1, : self.seed.size] = self.seed
        return LossGradient(decisions, np.zeros(transcription.table.size))
