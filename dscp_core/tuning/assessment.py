"""How good a set of parameters is on given states, and which of two sets is better."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.tuning.evaluator import Plans

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Plans of n states.

    Attributes:
        loss: (n,) what the set is judged by; NaN where there is none.
        differentiated: (n,) what has a derivative; the same, unless iterations are counted.
        iterations: (n,).
        failed: (n,) without a certified plan.
        trusted: (n,) with a gradient that can be relied upon, where that was asked for.
        seconds: (n,) wall time of the iterations.
        logs: (n,) where the states come from.
    """

    loss: Array
    differentiated: Array
    iterations: NDArray[np.intp]
    failed: Flags
    trusted: Flags
    seconds: Array
    logs: tuple[str, ...]

    @staticmethod
    def of(
        parts: Iterable[Plans], logs: Sequence[str], *, counts_iterations: bool = False
    ) -> Evaluation:
        """Join the parts.

        Args:
            parts: In the order of the states.
            logs: Of all states.
            counts_iterations: Whether the set is judged by the number of iterations.
        """
        plans = list(parts)

        def joined(name: str) -> Any:
            return np.concatenate([getattr(part, name) for part in plans])

        loss, iterations = joined("loss"), joined("iterations")
        loss = np.where(np.isfinite(loss), loss, math.nan)
        judged = np.where(np.isfinite(loss), iterations, math.nan) if counts_iterations else loss
        return Evaluation(
            loss=judged,
            differentiated=loss,
            iterations=iterations,
            failed=joined("failed"),
            trusted=~joined("untrusted"),
            seconds=joined("seconds"),
            logs=tuple(logs),
        )

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.loss)

    @property
    def mean_loss(self) -> float:
        """Over the states that have one; NaN if none has."""
        return _mean(self.loss[np.isfinite(self.loss)])

    @property
    def mean_iterations(self) -> float:
        """Over all states."""
        return _mean(self.iterations)

    @property
    def failures(self) -> int:
        """Number of states without a certified plan."""
        return int(np.count_nonzero(self.failed))

    @property
    def untrusted(self) -> int:
        """Number of states with a gradient that cannot be relied upon."""
        return int(np.count_nonzero(~self.trusted))

    @property
    def seconds_per_state(self) -> float:
        """Mean wall time of the iterations."""
        return _mean(self.seconds)

    def document(self) -> dict[str, float | int | None]:
        """The figures as JSON holds them."""
        loss = self.mean_loss
        return {
            "states": self.states,
            "loss": loss if math.isfinite(loss) else None,
            "iterations": self.mean_iterations,
            "failures": self.failures,
            "untrusted": self.untrusted,
            "seconds_per_state": self.seconds_per_state,
        }


def better(old: Evaluation, new: Evaluation) -> bool:
    """Whether a set is better than another on the same states.

    It must not fail on more states; and have a lower mean loss on the states where both have one,
    or fail on fewer states without a higher loss. Equal numbers of iterations are told apart by
    what was differentiated.
    """
    if new.failures > old.failures:
        return False
    change = _change(old.loss, new.loss) or _change(old.differentiated, new.differentiated)
    return change < 0.0 or (new.failures < old.failures and change <= 0.0)


def improved(old: Evaluation, new: Evaluation) -> bool:
    """Whether a set is better by what it is judged by, or fails on fewer states at no loss."""
    change = _change(old.loss, new.loss)
    fewer = new.failures < old.failures
    return new.failures <= old.failures and (change < 0.0 or (fewer and change <= 0.0))


def _change(old: Array, new: Array) -> float:
    """Of the mean over what both have; 0 if that is nothing."""
    common = np.isfinite(old) & np.isfinite(new)
    return float(np.mean(new[common] - old[common])) if common.any() else 0.0


def _mean(values: NDArray[Any]) -> float:
    return float(np.mean(values)) if values.size else math.nan
