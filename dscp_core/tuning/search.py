"""The search: epochs of Adam or steps of L-BFGS, the best point kept, resumable at any moment."""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from dscp_core.learning.checkpoint import CHECKPOINT_FILE, Checkpoint, CheckpointError
from dscp_core.tuning.assessment import Evaluation, better
from dscp_core.tuning.errors import TuningError
from dscp_core.tuning.objective import Objective, ObjectiveValue
from dscp_core.tuning.optimiser import anneal, make_optimiser, restore, state_of
from dscp_core.tuning.references import ReferenceStore
from dscp_core.tuning.samples import StateSet
from dscp_core.tuning.settings import ADAM, TuningSettings

Array = NDArray[np.float64]

_SECONDS_BETWEEN_CHECKPOINTS = 10.0
_FEWEST_TO_SPLIT = 20
_MOST_VALIDATION = 64
_VALIDATION_PURPOSE, _ORDER_PURPOSE = 0, 1
_KEPT = ("loss", "differentiated", "iterations", "failed", "trusted", "seconds")


class Search:
    """A search for the least mean loss over training states.

    Attributes:
        document: What is known so far, JSON: history, best epoch, epochs waited for a better one,
            why it stopped if states stopped having gradients.
    """

    def __init__(
        self,
        settings: TuningSettings,
        objective: Objective,
        training: StateSet,
        *,
        identity: dict[str, Any],
        counts_iterations: bool = False,
        store: ReferenceStore | None = None,
    ) -> None:
        """Start afresh.

        Args:
            settings: How to search.
            objective: What to minimise.
            training: States; some of them are set aside to tell which epoch was the best.
            identity: What a checkpoint has to agree with, JSON.
            counts_iterations: Whether a point is judged by the number of iterations.
            store: Where the iterations of a state start from, and what they lead to is put.
        """
        self._store = store
        self._settings, self._objective = settings, objective
        self._counts_iterations = counts_iterations
        self._path = checkpoint_path(settings.output)
        self._point = torch.nn.Parameter(torch.from_numpy(objective.space.start()))
        self._network = objective.network if objective.tunes_network else None
        self._optimiser = make_optimiser(settings, self._point, self._network)
        self._training, self._validation = self._split(training)
        self._arrays: dict[str, NDArray[Any]] = {}
        self._evaluated: dict[bytes, ObjectiveValue] = {}
        self._started, self._saved = time.monotonic(), -math.inf
        self.document: dict[str, Any] = {
            "identity": json.loads(json.dumps(identity)),
            "epoch": 0,
            "step": 0,
            "waited": 0,
            "penalty": None,
            "best_epoch": None,
            "history": [],
            "elapsed_s": 0.0,
        }

    @property
    def elapsed_s(self) -> float:
        """Wall time so far, earlier sittings included."""
        return float(self.document["elapsed_s"]) + time.monotonic() - self._started

    def search(self) -> None:
        """Go on to the end.

        Raises:
            TuningError: No state has a gradient, from the first epoch on.
            FileWriteError: The checkpoint cannot be written.
        """
        settings, document = self._settings, self.document
        with self._bar(settings.epochs, "epochs", document["epoch"]) as bar:
            if document["best_epoch"] is None:
                if self._store is not None:
                    self._store.clear()
                self._validate(0)
            while document["epoch"] < settings.epochs and document["waited"] < settings.patience:
                if self._store is not None:
                    self._store.begin(document["epoch"])
                try:
                    means = self._epoch() if settings.optimiser == ADAM else self._step()
                except TuningError as error:
                    if not document["history"]:
                        raise
                    # The search has gone to where nothing works; what it found before is good.
                    document["stopped"] = f"stopped in epoch {document['epoch'] + 1}: {error}"
                    break
                document["epoch"] += 1
                document["step"] = 0
                document.pop("partial", None)
                validation = self._validate(document["epoch"])
                self._record(means, validation)
                bar.update()
                bar.set_postfix(
                    loss=f"{means['loss']:.6g}",
                    gradient=f"{means['gradient']:.1e}",
                    failures=int(means["failures"]),
                    validation=f"{validation.mean_loss:.6g}",
                )
                self._save()

    def use_best(self) -> Array:
        """Set the network to that of the best epoch, and return its point (D,)."""
        if self._network is not None:
            self._network.set_tensors(_without_prefix(self._arrays, "best.network."))
        return self._arrays["best.point"]

    def resume(self) -> None:
        """Go on from the checkpoint.

        Raises:
            FileNotFoundError: There is none.
            CheckpointError: It is damaged, or of another tuning.
        """
        checkpoint = Checkpoint.load(self._path)
        for name, value in self.document["identity"].items():
            found = checkpoint.document.get("identity", {}).get(name)
            if found != value:
                raise CheckpointError(f"{self._path} was made with {name} = {found}, not {value}")
        self.document, self._arrays = checkpoint.document, checkpoint.arrays
        with torch.no_grad():
            self._point.copy_(torch.from_numpy(self._arrays.pop("point")))
        if self._network is not None:
            self._network.set_tensors(_without_prefix(self._arrays, "network."))
        restore(self._optimiser, self._arrays, self.document.pop("optimiser"))
        self._arrays = {n: a for n, a in self._arrays.items() if n.startswith("best.")}

    def _epoch(self) -> dict[str, float]:
        """One pass of Adam over the training states; returns means over its steps."""
        settings, document = self._settings, self.document
        count = len(self._training)
        order = self._rng(_ORDER_PURPOSE, document["epoch"]).permutation(count)
        steps = math.ceil(count / settings.batch)
        sums = _Epoch(**document.get("partial", {}))
        with self._bar(count, "states", document["step"] * settings.batch) as bar:
            while document["step"] < steps:
                first = document["step"] * settings.batch
                part = self._training.part(order[first : first + settings.batch])
                anneal(
                    self._optimiser,
                    (document["epoch"] + document["step"] / steps) / settings.epochs,
                )
                found = self._objective.evaluate(
                    self._at(), part, store=self._store, progress=bar.update
                )
                sums.add(found)
                if found.used:
                    self._set_gradient(found)
                    self._optimiser.step()
                document["step"] += 1
                document["partial"] = asdict(sums)
                if sums.used and time.monotonic() - self._saved > _SECONDS_BETWEEN_CHECKPOINTS:
                    self._save()
        return sums.means()

    def _step(self) -> dict[str, float]:
        """One step of L-BFGS with its line search; returns the figures of where it ended."""

        def closure() -> float:
            found = self._evaluate_all()
            self._optimiser.zero_grad()
            self._set_gradient(found)
            return found.loss

        self._optimiser.step(closure)
        reached = self._evaluate_all()
        # This one is asked for again, as the first of the next step; but from other starts of the
        # iterations, where those are kept, and a resumed search has to do the same.
        self._evaluated = {self._key(): reached} if self._store is None else {}
        sums = _Epoch()
        sums.add(reached)
        return sums.means()

    def _evaluate_all(self) -> ObjectiveValue:
        """Mean over all training states at the present point.

        A state that fails costs more than the worst of the first evaluation, so that the line
        search backs off from where states fail.
        """
        key = self._key()
        if key not in self._evaluated:
            with self._bar(len(self._training), "states") as bar:
                found = self._objective.evaluate(
                    self._at(),
                    self._training,
                    penalised=True,
                    penalty=self.document["penalty"],
                    store=self._store,
                    progress=bar.update,
                )
            if self.document["penalty"] is None:
                first = _Epoch()
                first.add(found)
                first.means()  # raises where there is no gradient at all
                self.document["penalty"] = found.penalty
            self._evaluated[key] = found
        return self._evaluated[key]

    def _set_gradient(self, found: ObjectiveValue) -> None:
        self._point.grad = torch.from_numpy(found.gradient.copy())
        if self._network is not None:
            for name, weight in self._network.named_parameters():
                weight.grad = found.network[name].clone()

    def _validate(self, epoch: int) -> Evaluation:
        """Judge the present point, and keep it if it is the best so far."""
        parts = self._objective.plans(self._objective.space.packed(self._at()), self._validation)
        found = Evaluation.of(
            parts, self._validation.logs, counts_iterations=self._counts_iterations
        )
        best = self._best()
        if best is None or better(best, found):
            self._arrays |= {f"best.{name}": getattr(found, name) for name in _KEPT}
            self._arrays["best.point"] = self._at()
            if self._network is not None:
                for name, tensor in self._network.tensors().items():
                    self._arrays[f"best.network.{name}"] = tensor
            self.document["best_epoch"], self.document["waited"] = epoch, 0
        else:
            self.document["waited"] += 1
        return found

    def _best(self) -> Evaluation | None:
        if self.document["best_epoch"] is None:
            return None
        kept = {name: self._arrays[f"best.{name}"] for name in _KEPT}
        return Evaluation(**kept, logs=self._validation.logs)

    def _record(self, means: dict[str, float], validation: Evaluation) -> None:
        loss = validation.mean_loss
        self.document["history"].append(
            {
                "epoch": self.document["epoch"],
                "elapsed_s": self.elapsed_s,
                **means,
                "validation_loss": loss if math.isfinite(loss) else None,
                "validation_iterations": validation.mean_iterations,
                "validation_failures": validation.failures,
                "values": self._objective.space.values(self._at()),
            }
        )

    def _split(self, training: StateSet) -> tuple[StateSet, StateSet]:
        """States to search on, and states to judge the epochs by: few states do both."""
        count = round(self._settings.validation * len(training))
        if len(training) < _FEWEST_TO_SPLIT or count == 0:
            rows = np.arange(min(len(training), _MOST_VALIDATION))
            return training, training.part(rows)
        order = self._rng(_VALIDATION_PURPOSE).permutation(len(training))
        count = min(count, _MOST_VALIDATION)
        return training.part(np.sort(order[count:])), training.part(np.sort(order[:count]))

    def _save(self) -> None:
        arrays, optimiser = state_of(self._optimiser)
        arrays = {**self._arrays, **arrays, "point": self._at()}
        if self._network is not None:
            tensors = self._network.tensors()
            arrays |= {f"network.{name}": tensor for name, tensor in tensors.items()}
        document = {**self.document, "optimiser": optimiser, "elapsed_s": self.elapsed_s}
        Checkpoint(arrays, document).save(self._path)
        self._saved = time.monotonic()

    def _at(self) -> Array:
        return np.array(self._point.detach().numpy())

    def _key(self) -> bytes:
        parts = [self._at().tobytes()]
        if self._network is not None:
            parts += [tensor.tobytes() for tensor in self._network.tensors().values()]
        return b"".join(parts)

    def _rng(self, purpose: int, *counters: int) -> np.random.Generator:
        """Random numbers that depend on nothing but seed, purpose and counters."""
        return np.random.default_rng([self._settings.seed, purpose, *counters])

    def _bar(self, total: int, label: str, done: int = 0) -> tqdm[Any]:
        return tqdm(
            total=total,
            desc=label,
            initial=done,
            leave=label == "epochs",
            disable=None if self._settings.show_progress else True,
        )


def checkpoint_path(output: Path) -> Path:
    """Where the checkpoint of a tuning is."""
    return output / CHECKPOINT_FILE


@dataclass
class _Epoch:
    """Figures of the steps of an epoch so far, as JSON holds them."""

    loss: float = 0.0
    gradient: float = 0.0
    weight: int = 0
    states: int = 0
    used: int = 0
    failures: int = 0
    untrusted: int = 0
    iterations: float = 0.0
    message: str = ""

    def add(self, found: ObjectiveValue) -> None:
        """Another step."""
        if math.isfinite(found.loss):
            self.loss += found.states * found.loss
            self.gradient += found.states * found.norm
            self.weight += found.states
        self.states += found.states
        self.used += found.used
        self.failures += found.failures
        self.untrusted += found.untrusted
        self.iterations += found.states * found.iterations
        self.message = self.message or found.message

    def means(self) -> dict[str, float]:
        """Per state; failures and untrusted gradients are counts.

        Raises:
            TuningError: No state has a gradient.
        """
        if not self.used:
            raise TuningError(
                f"none of {self.states} training states has a gradient that can be used: "
                f"{self.failures} failed, {self.untrusted} are not trusted"
                + (f"; the first failed with: {self.message}" if self.message else "")
            )
        return {
            "loss": self.loss / self.weight,
            "gradient": self.gradient / self.weight,
            "iterations": self.iterations / self.states,
            "failures": self.failures,
            "untrusted": self.untrusted,
        }


def _without_prefix(arrays: dict[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    return {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}
