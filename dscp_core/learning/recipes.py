"""How the terminal-time network is trained: the paper's recipe and the default."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from dscp_core.errors import InvalidInputError
from dscp_core.learning.evaluator import GradientMethod
from dscp_core.learning.sampling import Mixture
from dscp_core.planning.terminal_time_network import FeatureMap
from dscp_core.problem.parameters import Value


@dataclass(frozen=True)
class Fit:
    """Weighted least squares by Gauss-Newton steps on batches, see `GaussNewton`.

    Attributes:
        steps: Number of steps.
        batch: States per step.
        step_length: Share of a Gauss-Newton step that is taken; falls to zero in the second half.
        momentum: Share of the last step that the next one starts from.
        weight_decay: Weight of the squared weights against the mean squared error, s^2.
        damping: First and last damping, s^2; falls geometrically over the first fifth.
    """

    steps: int = 2000
    batch: int = 1024
    step_length: float = 0.2
    momentum: float = 0.9
    weight_decay: float = 1e-9
    damping: tuple[float, float] = (1e-3, 1e-6)


@dataclass(frozen=True)
class Phase:
    """Labels, then a fit to all labels so far.

    Attributes:
        labels: Number of states in all.
        fit: How the network is fitted to them.
    """

    labels: int
    fit: Fit


@dataclass(frozen=True)
class Supervised:
    """Regression on optimal terminal times, found by making the terminal time a decision.

    Attributes:
        phases: In order; the first ones give a network early.
    """

    phases: tuple[Phase, ...] = (
        Phase(4096, Fit(steps=150, damping=(1e-3, 1e-5))),
        Phase(20480, Fit(damping=(1e-5, 1e-6))),
    )


@dataclass(frozen=True)
class Refinement:
    """Newton's method on the cost itself, by DSCP's gradients at the network's own times.

    Every round plans at the predicted times t of a fixed set of states, warm-started from the last
    round, takes the slope of the cost by the time, plans again a little nearer to where the slope
    vanishes, and takes its zero on the line through both slopes. The network is then fitted to
    these times, together with the labels if there are any.

    Attributes:
        rounds: At most this many.
        states: Number of states.
        fit: How the network is fitted in a round.
        step_limit_s: Greatest change of a predicted time that is asked for in one round.
        curvature_guess: Of the cost, for the second time, kg/s^2.
        curvature_range: Least and greatest curvature taken from two slopes, kg/s^2.
        probe_s: Least and greatest distance of the two times.
        infeasible_curvature: Curvature of the penalty of the virtual control below the least
            feasible time, kg/s^2.
        infeasible_margin_s: How far above the least feasible time to go.
        patience: Rounds without a better validation error after which it ends.
    """

    rounds: int = 2
    states: int = 2048
    fit: Fit = field(default_factory=lambda: Fit(steps=500, damping=(1e-6, 1e-6)))
    step_limit_s: float = 0.5
    curvature_guess: float = 500.0
    curvature_range: tuple[float, float] = (50.0, 1e4)
    probe_s: tuple[float, float] = (2e-3, 0.1)
    infeasible_curvature: float = 7e7
    infeasible_margin_s: float = 0.05
    patience: int = 2


@dataclass(frozen=True)
class StochasticSteps:
    """Stochastic gradient steps on DSCP gradients.

    Attributes:
        epochs: Number of epochs.
        samples: New states per epoch.
        batch: States per step.
        learning_rates: (first epoch, rate of Adam), in order.
        method: How DSCP is differentiated.
        failed_slope: Slope that takes the place of a failed state's, in slope units.
        slope_unit_kg_s: Unit of the slopes.
        slope_limit: Slopes are clipped to this, in slope units.
        max_iterations: Limit of the SCP iterations.
        validate_every: Epochs between two looks at the validation set.
    """

    epochs: int = 600
    samples: int = 256
    batch: int = 32
    learning_rates: tuple[tuple[int, float], ...] = ((0, 0.01), (200, 0.005), (400, 0.001))
    method: GradientMethod = GradientMethod.UNROLLED
    failed_slope: float = -5.0
    slope_unit_kg_s: float = 10.0
    slope_limit: float = 5.0
    max_iterations: int = 20
    validate_every: int = 1

    def learning_rate(self, epoch: int) -> float:
        """Rate of an epoch."""
        return [rate for first, rate in self.learning_rates if first <= epoch][-1]


@dataclass(frozen=True)
class Recipe:
    """A whole training.

    Attributes:
        name: Of the recipe.
        features: Inputs of the network.
        hidden: Neurons of every hidden layer.
        interval_s: Least and greatest terminal time that it can predict.
        widening: Share by which the sampling box is wider than the one to be good in.
        mixture: Which states to learn from.
        validation: Number of states of the validation set.
        profile_points: Points per axis of the paper's two profiles, whose errors are recorded.
        supervised: First stage, or None.
        refinement: Second stage, or None.
        stochastic: Third stage, or None.
        parameters: Algorithm parameters that differ from the defaults.
    """

    name: str
    features: FeatureMap = FeatureMap.AXISYMMETRIC
    hidden: tuple[int, ...] = (64, 64, 64)
    interval_s: tuple[float, float] = (30.0, 42.0)
    widening: float = 0.03
    mixture: Mixture = field(default_factory=lambda: Mixture(edges=0.2, outbound=0.3, slow=0.2))
    validation: int = 512
    profile_points: int = 7
    supervised: Supervised | None = None
    refinement: Refinement | None = None
    stochastic: StochasticSteps | None = None
    # The thrust's mean over an interval may not fall below its minimum at all.
    parameters: Mapping[str, Value] = field(default_factory=lambda: {"mean_thrust_fraction": 1.0})

    def __post_init__(self) -> None:
        if not (self.supervised or self.refinement or self.stochastic):
            raise InvalidInputError("recipe", self.name, "at least one stage")

    def document(self) -> dict[str, Any]:
        """The recipe as JSON holds it."""
        return dataclasses.asdict(
            self,
            dict_factory=lambda items: {
                key: value.value if isinstance(value, FeatureMap | GradientMethod) else value
                for key, value in items
            },
        )


RECIPES: dict[str, Recipe] = {
    "default": Recipe("default", supervised=Supervised(), refinement=Refinement()),
    "paper": Recipe(
        "paper",
        features=FeatureMap.STATE,
        interval_s=(31.0, 37.0),
        widening=0.0,
        mixture=Mixture(),
        stochastic=StochasticSteps(),
        parameters={},
    ),
}


def recipe(name: str) -> Recipe:
    """A recipe by name.

    Raises:
        InvalidInputError: Unknown name.
    """
    if name not in RECIPES:
        raise InvalidInputError("recipe", name, f"one of {', '.join(RECIPES)}")
    return RECIPES[name]


def adjusted(
    base: Recipe,
    *,
    labels: int | None = None,
    steps: int | None = None,
    rounds: int | None = None,
    epochs: int | None = None,
) -> Recipe:
    """A recipe of another size; None leaves a number as it is.

    Args:
        base: The recipe.
        labels: States of the supervised stage, in one phase; 0 leaves the stage out.
        steps: Steps of each fit.
        rounds: Rounds of the refinement; 0 leaves the stage out.
        epochs: Epochs of the stochastic steps.

    Raises:
        InvalidInputError: A number below its least value, or one of a stage that is not there.
    """
    supervised, refinement, stochastic = base.supervised, base.refinement, base.stochastic
    for name, value, stage, least in (
        ("labels", labels, supervised, 0),
        ("steps", steps, supervised, 1),
        ("rounds", rounds, refinement, 0),
        ("epochs", epochs, stochastic, 1),
    ):
        if value is not None and stage is None:
            raise InvalidInputError(name, value, f"no number: recipe {base.name} has none")
        if value is not None and value < least:
            raise InvalidInputError(name, value, f">= {least}")
    if supervised is not None and labels != 0 and (labels or steps):
        last = supervised.phases[-1]
        fit = last.fit if steps is None else replace(last.fit, steps=steps)
        first = supervised.phases[0].fit.damping[0]
        fit = replace(fit, damping=(first, fit.damping[1]))
        supervised = replace(supervised, phases=(Phase(labels or last.labels, fit),))
    if refinement is not None:
        fit = refinement.fit if steps is None else replace(refinement.fit, steps=steps)
        kept = refinement.rounds if rounds is None else rounds
        refinement = replace(refinement, rounds=kept, fit=fit)
    if stochastic is not None and epochs is not None:
        stochastic = replace(stochastic, epochs=epochs)
    return replace(
        base,
        supervised=None if labels == 0 else supervised,
        refinement=None if rounds == 0 else refinement,
        stochastic=stochastic,
    )
