"""Training the terminal-time network, from nothing or from a checkpoint."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from dscp_core.errors import InvalidInputError
from dscp_core.files import replace_file
from dscp_core.learning.checkpoint import CHECKPOINT_FILE, CheckpointError
from dscp_core.learning.evaluator import OptimumModel
from dscp_core.learning.recipes import Recipe
from dscp_core.learning.refinement import refine
from dscp_core.learning.run import Errors, Run, stage
from dscp_core.learning.sampling import PAPER_BOX
from dscp_core.learning.stochastic import take_stochastic_steps
from dscp_core.learning.supervised import supervise
from dscp_core.planning.terminal_time_network import FeatureMap, TerminalTimeNetwork
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.parameters import Value
from dscp_core.workers.choice import make_engine

NETWORK_FILE = "terminal_time.safetensors"
HISTORY_FILE = "history.json"
MASS_TOLERANCE = 1e-4
"""Relative deviation from the mass that the network is trained for; moves the optimum by 1e-5."""


@dataclass(frozen=True)
class TrainingSettings:
    """What to train and where.

    Attributes:
        problem: The declaration; see `OptimumModel`.
        recipe: How to train.
        output: Folder for network, history and checkpoint.
        parameters: Vehicle and mission parameters that differ from the defaults, SI.
        intervals: Number of intervals of the discretisation.
        seed: Of everything random.
        workers: Processes that evaluate states; None for one per processor.
        ray_address: Of the Ray cluster that evaluates states; None for this machine.
        resume: Go on from the checkpoint in the folder.
        show_progress: Whether to draw progress bars.
    """

    problem: OptimalControlProblem
    recipe: Recipe
    output: Path
    parameters: Mapping[str, Value]
    intervals: int = 50
    seed: int = 0
    workers: int | None = 1
    ray_address: str | None = None
    resume: bool = False
    show_progress: bool = False


@dataclass(frozen=True)
class TrainingResult:
    """What came out.

    Attributes:
        network: File of the network.
        history: Entries as in the history file.
        errors: On the validation set.
        elapsed_s: Wall time of the whole training.
    """

    network: Path
    history: tuple[Mapping[str, Any], ...]
    errors: Errors
    elapsed_s: float


def train(settings: TrainingSettings) -> TrainingResult:
    """Train, and write network and history.

    Raises:
        InvalidInputError: A bad setting or parameter.
        CheckpointError: There is a checkpoint but `resume` is not set, or it is of another
            training.
        FileNotFoundError: `resume` is set and there is no checkpoint.
        TrainingError: The training cannot go on.
        RayMissingError, RayClusterError: No usable cluster at the address.
        FileWriteError: The folder cannot be written to.
    """
    recipe = settings.recipe
    if settings.seed < 0:
        raise InvalidInputError("seed", settings.seed, ">= 0")
    table = settings.problem.table
    parameters = {**recipe.parameters, **settings.parameters}
    values = table.unpack(table.pack(parameters))
    vehicle = settings.problem.vehicle_of(values)
    if recipe.features is FeatureMap.AXISYMMETRIC:
        _require_symmetry(values)
    path = settings.output / CHECKPOINT_FILE
    if path.exists() and not settings.resume:
        raise CheckpointError(f"{path} exists: resume that training, or choose another folder")
    # Two threads add up in another order than one: results would depend on the machine.
    torch.set_num_threads(1)
    model = OptimumModel(settings.problem, parameters, settings.intervals)
    engine = make_engine(model, settings.workers, settings.ray_address)
    try:
        run = Run(
            recipe,
            engine,
            settings.output,
            settings.seed,
            identity={
                "recipe": recipe.document(),
                "vehicle": vehicle,
                "intervals": settings.intervals,
                "seed": settings.seed,
            },
            show_progress=settings.show_progress,
        )
        if settings.resume:
            run.resume()
        _stages(run)
    finally:
        engine.close()
    return _finish(run, settings, vehicle)


def _require_symmetry(values: Mapping[str, Any]) -> None:
    """Refuse a problem that is not symmetric about the vertical through the origin.

    Raises:
        InvalidInputError: A final position or velocity off the axis.
    """
    for name in ("final_position", "final_velocity"):
        if values[name][1] != 0.0 or values[name][2] != 0.0:
            raise InvalidInputError(
                name, values[name].tolist(), "lateral components zero: the features are symmetric"
            )


def _stages(run: Run) -> None:
    run.ensure_truth()
    stage(run, "supervised", "refinement", supervise)
    stage(run, "refinement", "stochastic", refine)
    stage(run, "stochastic", "done", take_stochastic_steps)


def _finish(run: Run, settings: TrainingSettings, vehicle: Mapping[str, Any]) -> TrainingResult:
    errors = run.validate()
    lower, upper = PAPER_BOX.widened(settings.recipe.widening).bounds(MASS_TOLERANCE)
    data = run.network.export(
        lower=lower,
        upper=upper,
        vehicle=vehicle,
        intervals=settings.intervals,
        provenance={
            "recipe": settings.recipe.document(),
            "seed": settings.seed,
            "torch": torch.__version__,
            "validation": {
                "states": settings.recipe.validation,
                "mean_relative_error": errors.mean,
                "p99_relative_error": errors.p99,
                "max_relative_error": errors.maximum,
            },
        },
    )
    network = settings.output / NETWORK_FILE
    TerminalTimeNetwork(data).save(network)
    history = run.document["history"]
    replace_file(
        settings.output / HISTORY_FILE, (json.dumps(history, indent=1) + "\n").encode("utf-8")
    )
    elapsed_s = float(history[-1]["elapsed_s"]) if history else math.nan
    return TrainingResult(network, tuple(history), errors, elapsed_s)
