"""A whole tuning: samples in, parameter values and their judgement on unseen states out."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from dscp_core.errors import InvalidInputError
from dscp_core.learning.checkpoint import CheckpointError
from dscp_core.planning.planner import TerminalTime
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.tuning.assessment import Evaluation, improved
from dscp_core.tuning.choice import LossChoice, cost_is_minus_mass
from dscp_core.tuning.errors import TuningError
from dscp_core.tuning.evaluator import TuningModel
from dscp_core.tuning.network import exported, trainable
from dscp_core.tuning.objective import Objective
from dscp_core.tuning.quantities import NETWORK, WEIGHTS, check_corners, components
from dscp_core.tuning.references import ReferenceStore, reference_files, reference_size
from dscp_core.tuning.samples import Refusal, StateSet, screen
from dscp_core.tuning.search import Search, checkpoint_path
from dscp_core.tuning.settings import Sample, TuningSettings
from dscp_core.tuning.space import SearchSpace
from dscp_core.workers.choice import make_engine

Array = NDArray[np.float64]

__all__ = [
    "Evaluation",
    "Refusal",
    "Sample",
    "TuningError",
    "TuningResult",
    "TuningSettings",
    "discard_checkpoint",
    "screen",
    "tune",
]


@dataclass(frozen=True, eq=False)
class TuningResult:
    """What came out.

    Attributes:
        values: Parameters that changed, by name, SI, whole vectors.
        network: The tuned network, or None where it was not tuned.
        history: One entry per epoch: epoch, elapsed_s, loss, gradient, iterations, failures,
            untrusted, validation_loss, validation_iterations, validation_failures, values.
        before: The present parameters on the held-out states.
        after: The tuned ones.
        improved: Whether the tuned ones are better there: no more failures and a lower mean loss,
            or fewer failures and no higher loss.
        refused: Samples that were left out.
        best_epoch: Epoch that the values are from; 0 for the start.
        notes: What a reader should know, such as starts that are not the present values.
        elapsed_s: Wall time of the search, earlier sittings included.
    """

    values: dict[str, float | list[float]]
    network: TerminalTimeNetwork | None
    history: tuple[dict[str, Any], ...]
    before: Evaluation
    after: Evaluation
    improved: bool
    refused: tuple[Refusal, ...]
    best_epoch: int
    notes: tuple[str, ...]
    elapsed_s: float


def tune(
    settings: TuningSettings,
    training: Sequence[Sample],
    held_out: Sequence[Sample],
    *,
    network: TerminalTimeNetwork | None = None,
) -> TuningResult:
    """Tune, and judge the result on the held-out states, which nothing else looks at.

    The checkpoint stays, see `discard_checkpoint`: a run that is killed before its result has been
    written ends at once when it is resumed.

    Args:
        settings: What to tune and how.
        training: States to learn from.
        held_out: States to judge by.
        network: For, and only for, predicted terminal times.

    Raises:
        InvalidInputError: A bad setting, parameter or bound.
        TuningError: No state can be used, or none has a gradient.
        CheckpointError: There is a checkpoint but `resume` is not set, or it is of another tuning.
        FileNotFoundError: `resume` is set and there is no checkpoint.
        FileWriteError: The checkpoint cannot be written.
        WorkerLostError: Workers keep dying.
    """
    problem, planner = settings.problem, settings.planner
    _check(settings, problem, network)
    loss = LossChoice.parse(settings.loss)
    base = problem.pack(planner.parameters)
    space = SearchSpace(problem, settings.tuned, base)
    good, refused = _usable(settings, training, network, "training")
    unseen, also_refused = _usable(settings, held_out, network, "held-out")
    path = checkpoint_path(settings.output)
    if path.exists() and not settings.resume:
        raise CheckpointError(f"{path} exists: resume that tuning, or choose another folder")
    # Two threads add up in another order than one: results would depend on the machine.
    torch.set_num_threads(1)
    given = planner.terminal_time is TerminalTime.FIXED and TERMINAL_TIME not in _names(settings)
    states = StateSet.of(good, given_times=given)
    judged = StateSet.of(unseen, given_times=given)
    predictor = None if network is None else trainable(network.data)
    warm = _warm(settings, problem, loss, base)
    model = TuningModel(problem, planner, loss, settings.fixed_iterations, envelope=warm)
    identity = _identity(settings, loss, base, states, network)
    engine = make_engine(model, settings.workers, settings.ray_address)
    try:
        objective = Objective(
            problem, engine, space, predictor, tunes_network=settings.tunes_network
        )
        search = Search(
            settings,
            objective,
            states,
            identity=identity,
            counts_iterations=loss.counts_iterations,
            store=ReferenceStore(settings.output, reference_size(problem, planner))
            if warm
            else None,
        )
        if settings.resume:
            search.resume()
        search.search()
        tuned = space.packed(search.use_best())
        after = _evaluate(settings, objective, tuned, judged, loss, "after")
        objective.network = None if network is None else trainable(network.data)
        before = _evaluate(settings, objective, base, judged, loss, "before")
    finally:
        engine.close()
    document = search.document
    return TuningResult(
        values=_changed(problem, base, tuned),
        network=_tuned_network(settings, problem, tuned, predictor, network, identity),
        history=tuple(document["history"]),
        before=before,
        after=after,
        improved=improved(before, after),
        refused=(*refused, *also_refused),
        best_epoch=document["best_epoch"],
        notes=(*space.notes, *([document["stopped"]] if "stopped" in document else [])),
        elapsed_s=search.elapsed_s,
    )


def discard_checkpoint(output: Path) -> None:
    """Remove the checkpoint of a tuning whose result has been written, and its folder if empty."""
    for path in (checkpoint_path(output), *reference_files(output)):
        path.unlink(missing_ok=True)
    if output.is_dir() and not any(output.iterdir()):
        output.rmdir()


def _check(
    settings: TuningSettings, problem: OptimalControlProblem, network: TerminalTimeNetwork | None
) -> None:
    """Refuse settings that contradict each other.

    Raises:
        InvalidInputError: They do.
    """
    mode = settings.planner.terminal_time
    if (mode is TerminalTime.PREDICTED) != (network is not None):
        raise InvalidInputError(
            "network", network, f"given exactly when terminal_time ({mode.value}) is predicted"
        )
    if settings.tunes_network and mode is not TerminalTime.PREDICTED:
        raise InvalidInputError(
            "parameters", NETWORK, f"predicted terminal times, not {mode.value} ones"
        )
    if mode is TerminalTime.PREDICTED and TERMINAL_TIME in _names(settings):
        raise InvalidInputError("parameters", TERMINAL_TIME, "no predicted terminal time")
    # A network that is tuned may start from another vehicle's.
    if network is not None and not settings.tunes_network:
        values = problem.table.unpack(problem.pack(settings.planner.parameters))
        network.check_vehicle(problem.vehicle_of(values))
    check_corners(problem, settings.tuned, settings.planner.parameters)


def _warm(
    settings: TuningSettings, problem: OptimalControlProblem, loss: LossChoice, base: Array
) -> bool:
    """Whether runs may start from the last epoch's trajectories, see `TuningSettings`."""
    fixed = settings.fixed_iterations or settings.planner.options.fixed_iterations
    if not settings.warm_start or fixed or any(name in WEIGHTS for name in _names(settings)):
        return False
    if loss.is_fuel(problem):
        tuned = [
            problem.table.slice(quantity.name).start + index
            for quantity in settings.tuned
            if not quantity.is_network
            for index in components(quantity, problem.table[quantity.name])
        ]
        return cost_is_minus_mass(problem, base, tuned)
    return loss.is_cost(problem)


def _names(settings: TuningSettings) -> set[str]:
    return {quantity.name for quantity in settings.tuned}


def _usable(
    settings: TuningSettings,
    samples: Sequence[Sample],
    network: TerminalTimeNetwork | None,
    what: str,
) -> tuple[list[Sample], list[Refusal]]:
    """Samples that can be planned.

    Raises:
        TuningError: There are none.
    """
    good, refused = screen(settings, samples, network)
    if not good:
        why = f", all refused; the first: {refused[0].reason}" if refused else ""
        raise TuningError(f"no {what} state can be used: {len(samples)} given{why}")
    return good, refused


def _evaluate(
    settings: TuningSettings,
    objective: Objective,
    parameters: Array,
    states: StateSet,
    loss: LossChoice,
    label: str,
) -> Evaluation:
    silent = None if settings.show_progress else True
    with tqdm(total=len(states), desc=f"held-out states, {label}", disable=silent) as bar:
        parts = objective.plans(parameters, states, differentiate=True, progress=bar.update)
        return Evaluation.of(parts, states.logs, counts_iterations=loss.counts_iterations)


def _changed(
    problem: OptimalControlProblem, base: Array, tuned: Array
) -> dict[str, float | list[float]]:
    """Values that differ, by name."""
    table = problem.table
    values = {name: np.asarray(value).tolist() for name, value in table.unpack(tuned).items()}
    return {
        n: v for n, v in values.items() if np.any(tuned[table.slice(n)] != base[table.slice(n)])
    }


def _tuned_network(
    settings: TuningSettings,
    problem: OptimalControlProblem,
    tuned: Array,
    predictor: Any,
    network: TerminalTimeNetwork | None,
    identity: dict[str, Any],
) -> TerminalTimeNetwork | None:
    if network is None or not settings.tunes_network:
        return None
    return exported(
        predictor, network.data, problem.vehicle_of(problem.table.unpack(tuned)), identity
    )


def _identity(
    settings: TuningSettings,
    loss: LossChoice,
    base: Array,
    states: StateSet,
    network: TerminalTimeNetwork | None,
) -> dict[str, Any]:
    """What two tunings must have in common for one to go on from the other's checkpoint, JSON."""
    planner = settings.planner
    arrays = [base, states.states, states.times_s]
    if network is not None:
        arrays += [*network.data.weights, *network.data.biases]
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return {
        "problem": settings.problem.name,
        "formulation": settings.problem.formulation,
        "intervals": planner.intervals,
        "terminal_time": planner.terminal_time.value,
        "hold": planner.hold.value,
        "discretisation": planner.discretisation.value,
        "options": _json(replace(planner.options, deadline_s=None)),
        "tuned": [_json(quantity) for quantity in settings.tuned],
        "loss": settings.loss if loss.function is None else loss.function.sha256,
        "optimiser": settings.optimiser,
        "epochs": settings.epochs,
        "learning_rates": [settings.rate, settings.network_learning_rate],
        "batch": settings.batch,
        "seed": settings.seed,
        "fixed_iterations": settings.fixed_iterations,
        "warm_start": settings.warm_start,
        "validation": settings.validation,
        "patience": settings.patience,
        "states": len(states),
        "data_sha256": digest.hexdigest(),
    }


def _json(settings: Any) -> dict[str, Any]:
    """A dataclass as JSON holds it."""
    return asdict(
        settings,
        dict_factory=lambda items: {
            key: value.value if isinstance(value, Enum) else value for key, value in items
        },
    )
