"""Functions that worker processes of the tests import, and small networks."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.learning.recipes import Fit, Phase, Recipe, Refinement, Supervised
from dscp_core.learning.sampling import PAPER_BOX
from dscp_core.planning.terminal_time_network import FeatureMap, NetworkData, TerminalTimeNetwork

if TYPE_CHECKING:
    from dscp_core.learning.training import TrainingSettings

VEHICLE = {"thrust_max": 845.2e3, "final_position": [0.0, 0.0, 0.0]}


def network(features: FeatureMap = FeatureMap.AXISYMMETRIC, seed: int = 0) -> TerminalTimeNetwork:
    """A network with random weights, of the usual size."""
    rng = np.random.default_rng(seed)
    sizes = [features.size, 64, 64, 64, 1]
    samples = features(PAPER_BOX.uniform(500, rng))
    lower, upper = PAPER_BOX.bounds(1e-4)
    return TerminalTimeNetwork(
        NetworkData(
            features=features,
            feature_center=samples.mean(axis=0),
            feature_scale=samples.std(axis=0),
            weights=tuple(
                rng.normal(size=(o, i)) / np.sqrt(i) for i, o in itertools.pairwise(sizes)
            ),
            biases=tuple(rng.normal(size=o) for o in sizes[1:]),
            interval_s=(30.0, 42.0),
            lower=lower,
            upper=upper,
            vehicle=VEHICLE,
            intervals=50,
        )
    )


def square() -> Callable[[float], float]:
    """Squares; refuses 13."""

    def evaluate(item: float) -> float:
        if item == 13.0:
            raise ArithmeticError("thirteen")
        return item * item

    return evaluate


def numeric_threads() -> Callable[[int], list[str | None]]:
    """Thread limits that the worker was started with."""
    return lambda _: [os.environ.get(name) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")]


@dataclass(frozen=True)
class KillsItsWorker:
    """Squares, but kills its own process at some items: once, or always.

    Attributes:
        marker: File that remembers that it has happened; None for always.
    """

    marker: Path | None

    def __call__(self) -> Callable[[int], int]:
        """Make the function."""
        return self.evaluate

    def evaluate(self, item: int) -> int:
        """Square or die."""
        if item == 5 and (self.marker is None or not self.marker.exists()):
            if self.marker is not None:
                self.marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return item * item


class FailsToStart:
    """A setup with an error."""

    def __call__(self) -> Callable[[int], int]:
        """Always fails."""
        raise InvalidInputError("formulation", "wrong", "a known one")


def tiny_recipe(**changes: object) -> Recipe:
    """The default recipe, so small that it takes seconds and learns little."""
    fit = Fit(steps=30, batch=32)
    small = Recipe(
        "tiny",
        hidden=(16, 16),
        validation=8,
        profile_points=2,
        supervised=Supervised(phases=(Phase(12, fit), Phase(24, fit))),
        refinement=Refinement(rounds=2, states=16, fit=fit),
    )
    return replace(small, **changes)  # type: ignore[arg-type]


def tiny_training(output: Path, **changes: object) -> TrainingSettings:
    """Settings of a tiny training."""
    from dscp_core.learning.training import TrainingSettings

    settings = TrainingSettings(
        problems.get("powered_descent"), tiny_recipe(), output, {}, intervals=20, seed=1
    )
    return replace(settings, **changes)  # type: ignore[arg-type]
