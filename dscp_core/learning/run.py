"""State of a training run, which its stages share and its checkpoints hold."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from dscp_core.errors import DscpError
from dscp_core.learning.checkpoint import CHECKPOINT_FILE, Checkpoint, CheckpointError
from dscp_core.learning.evaluator import Job, Outcome
from dscp_core.learning.labels import LABELLING, MOST_FAILURES, best_times
from dscp_core.learning.network_torch import TorchNetwork
from dscp_core.learning.recipes import Recipe
from dscp_core.learning.sampling import (
    PAPER_BOX,
    StateBox,
    horizontal_profile,
    vertical_profile,
)
from dscp_core.workers.engine import Engine

Array = NDArray[np.float64]

_SECONDS_BETWEEN_CHECKPOINTS = 10.0
_NETWORK_SAMPLES = 4096
# Recorded for the reader; the network is chosen by the validation set alone.
_PROFILES = {"vertical": vertical_profile, "horizontal": horizontal_profile}
_MOST_FAILURES = 0.5  # of the profiles; each is one cut, and some vehicles may not land from there
_BAR_INTERVAL_S = (0.1, 30.0)
_PURPOSES = (
    "weights",
    "validation",
    "labels",
    "supervised",
    "refinement",
    "refinement_fit",
    "stochastic",
)


class TrainingError(DscpError):
    """A training that cannot go on."""


@dataclass(frozen=True)
class Errors:
    """Relative errors of predicted terminal times."""

    mean: float
    p99: float
    maximum: float
    rms: float

    @staticmethod
    def of(predicted_s: Array, true_s: Array) -> Errors:
        """Errors of predictions (n,) against the truth (n,)."""
        error = np.abs(predicted_s / true_s - 1.0)
        return Errors(
            mean=float(np.mean(error)),
            p99=float(np.quantile(error, 0.99)),
            maximum=float(np.max(error)),
            rms=float(np.sqrt(np.mean(error**2))),
        )


class Run:
    """What the stages work on.

    Attributes:
        recipe: How to train.
        engine: Evaluates states.
        network: Being trained.
        arrays: Of the stages, kept in the checkpoint.
        document: Of the stages, kept in the checkpoint, JSON.
        show_progress: Whether to draw progress bars.
    """

    def __init__(
        self,
        recipe: Recipe,
        engine: Engine[Job, Outcome],
        output: Path,
        seed: int,
        *,
        identity: dict[str, Any],
        show_progress: bool = False,
    ) -> None:
        """Start afresh.

        Args:
            recipe: How to train.
            engine: Evaluates states.
            output: Folder of the checkpoint.
            seed: Of everything random.
            identity: What a checkpoint has to agree with, JSON.
            show_progress: Whether to draw progress bars.
        """
        self.recipe = recipe
        self.engine = engine
        self.show_progress = show_progress
        self._path = output / CHECKPOINT_FILE
        self._seed = seed
        self.arrays: dict[str, NDArray[Any]] = {}
        self.document: dict[str, Any] = {
            "identity": json.loads(json.dumps(identity)),
            "stage": "supervised",
            "history": [],
            "elapsed_s": 0.0,
            "best": math.inf,
        }
        self._started = time.monotonic()
        self._saved = -math.inf
        rng = self.rng("weights")
        self.network = TorchNetwork(
            recipe.features,
            recipe.hidden,
            recipe.interval_s,
            self.box.spread(_NETWORK_SAMPLES, rng, edges=0.5),
            int(rng.integers(2**31)),
        )

    @property
    def box(self) -> StateBox:
        """Where training states come from."""
        return PAPER_BOX.widened(self.recipe.widening)

    @property
    def elapsed_s(self) -> float:
        """Wall time of the training so far, earlier sittings included."""
        return float(self.document["elapsed_s"]) + time.monotonic() - self._started

    def rng(self, purpose: str, *counters: int) -> np.random.Generator:
        """Random numbers that depend on nothing but seed, purpose and counters."""
        return np.random.default_rng([self._seed, _PURPOSES.index(purpose), *counters])

    def bar(self, total: int, label: str, done: int = 0) -> tqdm[Any]:
        """A progress bar; a line now and then where no one watches."""
        return tqdm(
            total=total,
            desc=label,
            initial=done,
            disable=not self.show_progress,
            mininterval=_BAR_INTERVAL_S[not sys.stderr.isatty()],
        )

    def ensure_truth(self) -> None:
        """Solve the validation set and coarse profiles, unless that is done."""
        sets = {"validation": PAPER_BOX.uniform(self.recipe.validation, self.rng("validation"))}
        sets |= {name: make(self.recipe.profile_points) for name, make in _PROFILES.items()}
        for name, states in sets.items():
            if f"{name}.states" in self.arrays:
                continue
            with self.bar(len(states), f"{name} set") as bar:
                labels = best_times(
                    self.engine,
                    states,
                    LABELLING,
                    bar.update,
                    most_failures=_MOST_FAILURES if name in _PROFILES else MOST_FAILURES,
                )
            self.arrays[f"{name}.states"] = labels.states
            self.arrays[f"{name}.terminal_time_s"] = labels.terminal_time_s
            self.save()

    def validate(self, name: str = "validation") -> Errors:
        """Errors of the network on the validation set, or on a profile."""
        predicted = self.network.predict(self.arrays[f"{name}.states"])
        return Errors.of(predicted, self.arrays[f"{name}.terminal_time_s"])

    def record(self, stage: str, **entry: float | int | None) -> Errors:
        """Append to the history; keeps the network when it is the best so far.

        Args:
            stage: What is going on.
            **entry: Loss, learning rate, mean absolute slope, failures.

        Returns:
            The errors on the validation set.
        """
        errors = self.validate()
        self.document["history"].append(
            {
                "stage": stage,
                "elapsed_s": self.elapsed_s,
                **entry,
                "validation_mean": errors.mean,
                "validation_p99": errors.p99,
                "validation_max": errors.maximum,
                "validation_rms": errors.rms,
                **{f"{name}_max": self.validate(name).maximum for name in _PROFILES},
            }
        )
        if errors.rms < self.document["best"]:
            self.document["best"] = errors.rms
            for name, tensor in self.network.tensors().items():
                self.arrays[f"best.{name}"] = tensor
        return errors

    def use_best(self) -> None:
        """Go back to the best network so far."""
        best = {
            name.removeprefix("best."): array
            for name, array in self.arrays.items()
            if name.startswith("best.")
        }
        self.network.set_tensors(best)

    def save(self, *, even_if_recent: bool = True) -> None:
        """Write the checkpoint.

        Args:
            even_if_recent: Also if the last one is a few seconds old only.

        Raises:
            FileWriteError: It cannot be written.
        """
        if not even_if_recent and time.monotonic() - self._saved < _SECONDS_BETWEEN_CHECKPOINTS:
            return
        arrays = dict(self.arrays)
        arrays |= {f"network.{name}": tensor for name, tensor in self.network.tensors().items()}
        Checkpoint(arrays, {**self.document, "elapsed_s": self.elapsed_s}).save(self._path)
        self._saved = time.monotonic()

    def resume(self) -> None:
        """Go on from the checkpoint.

        Raises:
            FileNotFoundError: There is none.
            CheckpointError: It is damaged, or of another training.
        """
        checkpoint = Checkpoint.load(self._path)
        for name, value in self.document["identity"].items():
            found = checkpoint.document.get("identity", {}).get(name)
            if found != value:
                raise CheckpointError(
                    f"{self._path} was made with {name} = {_short(found)}, not {_short(value)}"
                )
        self.document = checkpoint.document
        prefix = "network."
        self.network.set_tensors(
            {
                name.removeprefix(prefix): checkpoint.arrays.pop(name)
                for name in list(checkpoint.arrays)
                if name.startswith(prefix)
            }
        )
        self.arrays = checkpoint.arrays


def stage(run: Run, name: str, following: str, work: Callable[[Run], None]) -> None:
    """Do a stage, if it is the current one, and note that it is done."""
    if run.document["stage"] == name:
        work(run)
        run.document["stage"] = following
        run.save()


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 100 else text[:97] + "..."
