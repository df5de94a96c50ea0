"""Mean loss over many states and its gradient by everything that is tuned; a stream, no store."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dscp_core.learning.network_torch import TorchNetwork
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.tuning.evaluator import CHUNK, GradientJob, Gradients, Job, PlanJob, Plans
from dscp_core.tuning.references import ReferenceStore
from dscp_core.tuning.samples import StateSet
from dscp_core.tuning.space import SearchSpace
from dscp_core.workers.engine import Engine

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Progress = Callable[[int], object]

# Slope of an infeasible terminal time against the median of the others, at most.
_INFEASIBLE_SHARE = 3.0


@dataclass(frozen=True, eq=False)
class ObjectiveValue:
    """Mean loss of a number of states, and its gradient.

    Attributes:
        loss: Mean over the states that have one, failed ones at the penalty if that was given; NaN
            if there is none.
        gradient: (D,) by the coordinates of the search space.
        network: By the network's weights, by name; empty where they are not tuned.
        penalty: Loss that a state without one was counted with, or None.
        states: Number of states.
        used: Those whose gradient is in the mean.
        failures: Those without a converged, feasible trajectory.
        untrusted: Those whose gradient cannot be relied upon and was left out.
        iterations: Mean number of iterations.
        message: Why the first failed one failed, or "".
    """

    loss: float
    gradient: Array
    network: Mapping[str, torch.Tensor]
    penalty: float | None
    states: int
    used: int
    failures: int
    untrusted: int
    iterations: float
    message: str

    @property
    def norm(self) -> float:
        """Euclidean norm of the whole gradient."""
        squares = float(np.sum(self.gradient**2))
        squares += sum(float(torch.sum(g**2)) for g in self.network.values())
        return float(np.sqrt(squares))


@dataclass
class _Sums:
    """What is kept of the states that have been evaluated."""

    gradient: Array
    loss: float = 0.0
    losses: int = 0
    low: float = np.inf
    high: float = -np.inf
    used: int = 0
    failures: int = 0
    untrusted: int = 0
    iterations: int = 0
    message: str = ""

    def add(self, outcome: Gradients) -> None:
        has_loss = np.isfinite(outcome.loss)
        usable = has_loss & np.all(np.isfinite(outcome.gradient), axis=1)
        losses = outcome.loss[has_loss]
        self.loss += float(np.sum(losses))
        self.losses += losses.size
        self.low = min(self.low, float(np.min(losses, initial=np.inf)))
        self.high = max(self.high, float(np.max(losses, initial=-np.inf)))
        self.gradient += np.sum(outcome.gradient[usable], axis=0)
        self.used += int(np.count_nonzero(usable))
        self.failures += int(np.count_nonzero(outcome.failed))
        # A loss that is not finite, as the user's function may return, has no gradient either.
        lost = outcome.untrusted | (~outcome.failed & ~usable)
        self.untrusted += int(np.count_nonzero(lost))
        self.iterations += int(np.sum(outcome.iterations))
        self.message = self.message or outcome.message

    def penalty(self) -> float:
        """Clearly above the worst loss so far; NaN if there is none."""
        return self.high + max(self.high - self.low, 0.1 * abs(self.high), 1e-6)


class _Jobs(Sequence[Job]):
    """Jobs of a number of states, each made when it is asked for."""

    def __init__(self, states: int, make: Callable[[slice], Job]) -> None:
        self._chunks, self._make = _chunks(states), make

    def __len__(self) -> int:
        return len(self._chunks)

    def __getitem__(self, number: Any) -> Any:
        return self._make(self._chunks[number])


class Objective:
    """Evaluates states at a point of the search.

    Attributes:
        space: Coordinates of the tuned parameters.
        network: That gives the terminal times, or None.
        tunes_network: Whether its weights are tuned.
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        engine: Engine[Job, Any],
        space: SearchSpace,
        network: TorchNetwork | None,
        *,
        tunes_network: bool,
    ) -> None:
        self._engine = engine
        self._size = problem.table.size
        self._time = problem.table.slice(TERMINAL_TIME).start
        self.space = space
        self.network = network
        self.tunes_network = tunes_network

    def evaluate(
        self,
        point: Array,
        states: StateSet,
        *,
        penalised: bool = False,
        penalty: float | None = None,
        store: ReferenceStore | None = None,
        progress: Progress | None = None,
    ) -> ObjectiveValue:
        """Mean loss and gradient.

        Args:
            point: (D,) coordinates.
            states: One or more.
            penalised: Whether states without a loss count, with the penalty; the gradient is then
                that of the same mean, in which infeasible times have no say.
            penalty: Loss of a state that has none; None for one above the worst of the others.
            store: Where the iterations start from, and what they lead to is put; None: from the
                problem's own guess.
            progress: Told the number of states of every finished job.
        """
        sums = _Sums(np.zeros(self._size))
        slopes, outwards = np.zeros(len(states)), np.full(len(states), np.nan)
        packed = self.space.packed(point)

        def job(rows: slice) -> Job:
            known = None if store is None else store.read(states.rows[rows])
            return GradientJob(states.states[rows], packed, self._times(states, rows), known)

        done = 0
        for outcome in self._engine.map(_Jobs(len(states), job)):
            rows = slice(done, done + len(outcome.loss))
            if store is not None and outcome.references is not None:
                store.write(states.rows[rows], outcome.references)
            slopes[rows] = np.where(np.isfinite(outcome.loss), outcome.gradient[:, self._time], 0.0)
            outwards[rows] = outcome.time_slope
            sums.add(outcome)
            done = rows.stop
            if progress is not None:
                progress(len(outcome.loss))
        slopes = np.where(np.isfinite(slopes), slopes, 0.0)
        counted, loss = sums.used, sums.loss
        used, mean_of = sums.used, sums.losses
        if penalised:
            penalty = sums.penalty() if penalty is None else penalty
            counted = mean_of = len(states)
            loss += penalty * (len(states) - sums.losses)
        elif self.tunes_network:
            slopes += _infeasible(outwards, slopes)
            counted += int(np.count_nonzero(np.isfinite(outwards)))
            used = counted
        share = 1.0 / max(counted, 1)
        return ObjectiveValue(
            loss=loss / mean_of if mean_of else np.nan,
            gradient=self.space.pull(point, share * sums.gradient),
            network=self._network_gradient(states, share * slopes) if self.tunes_network else {},
            penalty=penalty,
            states=len(states),
            used=used,
            failures=sums.failures,
            untrusted=sums.untrusted,
            iterations=sums.iterations / len(states),
            message=sums.message,
        )

    def plans(
        self,
        parameters: Array,
        states: StateSet,
        *,
        differentiate: bool = False,
        progress: Progress | None = None,
    ) -> Iterator[Plans]:
        """Plans as the planner makes them, in the order of the states.

        Args:
            parameters: (P,) packed, SI.
            states: One or more.
            differentiate: Whether to find out also if the gradients can be trusted.
            progress: Told the number of states of every finished job.
        """

        def job(rows: slice) -> Job:
            times = self._times(states, rows)
            return PlanJob(states.states[rows], parameters, times, differentiate)

        for outcome in self._engine.map(_Jobs(len(states), job)):
            if progress is not None:
                progress(len(outcome.loss))
            yield outcome

    def _times(self, states: StateSet, rows: slice) -> Array:
        """Terminal times of some states: predicted, given, or NaN."""
        if self.network is None:
            return states.times_s[rows]
        return self.network.predict(states.states[rows])

    def _network_gradient(self, states: StateSet, slopes: Array) -> dict[str, torch.Tensor]:
        """Gradient by the network's weights from that by the terminal times (n,)."""
        assert self.network is not None
        weights = dict(self.network.named_parameters())
        sums = {name: torch.zeros_like(weight) for name, weight in weights.items()}
        for rows in _chunks(len(states)):
            times = self.network(self.network.inputs(states.states[rows]))
            pulled = torch.autograd.grad(
                times, list(weights.values()), torch.from_numpy(slopes[rows].copy())
            )
            for name, part in zip(sums, pulled, strict=True):
                sums[name] += part
        return sums


def _infeasible(outwards: Array, slopes: Array) -> Array:
    """Slopes of infeasible times, cut to a size that the others have; zero elsewhere.

    The penalty of the virtual control is orders of magnitude steeper than any loss: its sign is
    what counts.
    """
    others = np.abs(slopes[slopes != 0.0])
    limit = _INFEASIBLE_SHARE * float(np.median(others)) if others.size else 1.0
    return np.where(np.isfinite(outwards), np.clip(outwards, -limit, limit), 0.0)


def _chunks(count: int) -> Sequence[slice]:
    return [slice(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK)]
