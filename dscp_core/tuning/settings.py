"""What is asked of a tuning."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.planning.planner import PlannerSettings
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.tuning.quantities import TunedParameter

Array = NDArray[np.float64]

ADAM, LBFGS = "adam", "lbfgs"
OPTIMISERS = (ADAM, LBFGS)
_LEARNING_RATES = {ADAM: 0.05, LBFGS: 1.0}


@dataclass(frozen=True, eq=False)
class Sample:
    """A logged state.

    Attributes:
        state: (nx,), SI, in the problem's order.
        log: Which log it is from.
        terminal_time_s: What the planner was given; counts where the terminal time is fixed and
            not tuned. None for that of the parameters.
    """

    state: Array
    log: str
    terminal_time_s: float | None = None


@dataclass(frozen=True)
class TuningSettings:
    """What to tune and how.

    Attributes:
        problem: What is planned.
        planner: How it is planned, and how the result is judged.
        tuned: Quantities, see `dscp_core.tuning.quantities.parse_tuned`.
        output: Folder of the checkpoint.
        loss: One of `dscp_core.tuning.choice.LOSSES`, or ``FILE.py:FUNCTION``.
        optimiser: ``"adam"`` or ``"lbfgs"``.
        epochs: Passes over the training states (Adam) or steps on all of them (L-BFGS).
        learning_rate: Of the quantities, in their logarithms and angles; None for 0.05 (Adam) or
            1 (L-BFGS). Adam's falls to zero along a cosine.
        network_learning_rate: Of the network's weights, Adam.
        batch: States per step, Adam.
        seed: Of everything random.
        fixed_iterations: Differentiate runs of exactly this many iterations; None: of converged
            ones.
        warm_start: Start the iterations from the last epoch's trajectories, and differentiate by
            the envelope theorem, where that is sound: the loss is the cost, runs converge, and no
            weight is tuned.
        validation: Share of the training states that only decide which epoch was the best.
        patience: Epochs without a better one after which it ends.
        workers: Processes that evaluate states; None for one per processor.
        ray_address: Ray cluster to evaluate states on, or None.
        resume: Go on from the checkpoint.
        show_progress: Whether to draw progress bars.
    """

    problem: OptimalControlProblem
    planner: PlannerSettings
    tuned: tuple[TunedParameter, ...]
    output: Path
    loss: str = "fuel"
    optimiser: str = ADAM
    epochs: int = 20
    learning_rate: float | None = None
    network_learning_rate: float = 1e-5
    batch: int = 32
    seed: int = 0
    fixed_iterations: int | None = None
    warm_start: bool = True
    validation: float = 0.2
    patience: int = 5
    workers: int | None = None
    ray_address: str | None = None
    resume: bool = False
    show_progress: bool = False

    def __post_init__(self) -> None:
        if self.optimiser not in OPTIMISERS:
            raise InvalidInputError("optimiser", self.optimiser, f"one of {', '.join(OPTIMISERS)}")
        for name, least in (("epochs", 1), ("batch", 1), ("seed", 0), ("patience", 1)):
            if getattr(self, name) < least:
                raise InvalidInputError(name, getattr(self, name), f">= {least}")
        if self.fixed_iterations is not None and self.fixed_iterations < 1:
            raise InvalidInputError("fixed_iterations", self.fixed_iterations, ">= 1")
        for name, rate in (
            ("learning_rate", self.rate),
            ("network_learning_rate", self.network_learning_rate),
        ):
            if not (math.isfinite(rate) and rate > 0.0):
                raise InvalidInputError(name, rate, "> 0")
        if not 0.0 <= self.validation < 1.0:
            raise InvalidInputError("validation", self.validation, "[0, 1)")
        if not self.tuned:
            raise InvalidInputError("parameters", (), "one or more quantities to tune")

    @property
    def rate(self) -> float:
        """Learning rate of the quantities."""
        if self.learning_rate is None:
            return _LEARNING_RATES[self.optimiser]
        return self.learning_rate

    @property
    def tunes_network(self) -> bool:
        """Whether the network's weights are among the quantities."""
        return any(quantity.is_network for quantity in self.tuned)
