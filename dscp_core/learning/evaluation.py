"""Measuring the terminal-time network against brute force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.learning.evaluator import BestTimeJob, Job, OptimumModel, Outcome
from dscp_core.learning.labels import (
    TRUTH,
    LabelError,
    Progress,
    best_time_jobs,
    given_times,
    run_jobs,
)
from dscp_core.learning.nonlinear import NonlinearProgram
from dscp_core.learning.run import Errors
from dscp_core.planning.terminal_time_network import FeatureMap
from dscp_core.problem.declaration import TERMINAL_TIME
from dscp_core.scp.scp import ScpOptions
from dscp_core.workers.engine import Engine

Array = NDArray[np.float64]
Predict = Callable[[Array], Array]

_GIVEN = ScpOptions(cost_tolerance=1e-9, max_iterations=60)
# Whether there is a plan, not how good it is: half the iterations.
_FEASIBLE = ScpOptions(cost_tolerance=1e-6, max_iterations=60)


@dataclass(frozen=True, eq=False)
class Measurement:
    """A network against the truth on one set of states.

    Attributes:
        states: (n, 7) those with a known optimum.
        true_s: (n,) optimal terminal times.
        predicted_s: (n,).
        fuel_lost_kg: (n,) final mass at the optimum less that at the predicted time; NaN where
            the predicted time is infeasible.
        unsolved: States without a known optimum, left out.
    """

    states: Array
    true_s: Array
    predicted_s: Array
    fuel_lost_kg: Array
    unsolved: int

    @property
    def relative_error(self) -> Array:
        """(n,) signed; positive is late."""
        return self.predicted_s / self.true_s - 1.0

    def document(self) -> dict[str, Any]:
        """The figures as JSON holds them."""
        errors = Errors.of(self.predicted_s, self.true_s)
        lost = self.fuel_lost_kg[np.isfinite(self.fuel_lost_kg)]
        infeasible = int(np.count_nonzero(~np.isfinite(self.fuel_lost_kg)))
        return {
            "states": len(self.states),
            "unsolved": self.unsolved,
            "mean_relative_error": errors.mean,
            "p99_relative_error": errors.p99,
            "max_relative_error": errors.maximum,
            "mean_fuel_lost_kg": float(np.mean(lost)) if lost.size else None,
            "p99_fuel_lost_kg": float(np.quantile(lost, 0.99)) if lost.size else None,
            "max_fuel_lost_kg": float(np.max(lost)) if lost.size else None,
            "infeasible": infeasible,
            "infeasible_share": infeasible / len(self.states),
        }


def measure(
    engine: Engine[Job, Outcome],
    predict: Predict,
    states: Array,
    *,
    symmetric: bool,
    progress: Progress | None = None,
) -> Measurement:
    """Solve for the optimum of every state, and at the predicted time.

    Args:
        engine: Evaluates.
        predict: Predicted times (n,) of states (n, 7).
        states: (n, 7).
        symmetric: Whether states that differ by a rotation about the vertical or a reflection
            have the same optimum; such states are solved once.
        progress: Told the number of states of every finished job, twice per state.

    Raises:
        LabelError: No state has an optimum that is found.
    """
    # 1 mm and 1 um/s: states that are the same but for rounding.
    features = np.round(FeatureMap.AXISYMMETRIC(states), 6)
    _, first, inverse = np.unique(features, axis=0, return_index=True, return_inverse=True)
    if not symmetric:
        first = inverse = np.arange(len(states))
    unique = states[first]
    jobs = best_time_jobs(unique, TRUTH)
    best = Outcome.join(list(run_jobs(engine, jobs, progress)))
    if not np.any(best.converged):
        raise LabelError(f"none of {len(unique)} states has an optimum that converges")
    predicted = predict(unique)
    at_predicted = given_times(
        engine, unique, predicted, _GIVEN, references=best.references, progress=progress
    )
    mass = np.where(at_predicted.converged, at_predicted.final_mass_kg, np.nan)
    again = np.flatnonzero(np.isnan(mass))
    if again.size:
        # Not proven infeasible before a start from nothing has failed too.
        cold = given_times(engine, unique[again], predicted[again], _GIVEN)
        mass[again] = np.where(cold.converged, cold.final_mass_kg, np.nan)
    lost = best.final_mass_kg - mass
    inverse = np.ravel(inverse)
    known = best.converged[inverse]
    return Measurement(
        states=states[known],
        true_s=best.terminal_time_s[inverse][known],
        predicted_s=predict(states[known]),
        fuel_lost_kg=lost[inverse][known],
        unsolved=int(np.count_nonzero(~known)),
    )


def infeasible_predictions(
    engine: Engine[Job, Outcome],
    predict: Predict,
    states: Array,
    progress: Progress | None = None,
) -> Array:
    """The states (k, 7) of (n, 7) for which no trajectory was found at the predicted time."""
    outcome = given_times(engine, states, predict(states), _FEASIBLE, progress=progress)
    failed = np.flatnonzero(~outcome.converged)
    if failed.size:
        # A start from the optimum is closer than one from nothing.
        best = Outcome.join(
            list(engine.map([BestTimeJob(states[failed], TRUTH)])),
        )
        again = given_times(
            engine,
            states[failed],
            predict(states[failed]),
            _FEASIBLE,
            references=best.references,
        )
        failed = failed[~again.converged]
    return states[failed]


@dataclass(frozen=True)
class NonlinearCheck:
    """Optimal terminal times of this project against those of IPOPT.

    Attributes:
        states: Number of states compared.
        failed: States for which IPOPT found no optimum, left out.
        max_relative_difference: Of the terminal times.
        max_mass_difference_kg: Of the final masses.
    """

    states: int
    failed: int
    max_relative_difference: float
    max_mass_difference_kg: float


def check_against_ipopt(
    engine: Engine[Job, Outcome],
    model: OptimumModel,
    states: Array,
    progress: Progress | None = None,
) -> NonlinearCheck:
    """Solve states (n, 7) with both.

    Args:
        engine: Evaluates with the model.
        model: The problem.
        states: (n, 7).
        progress: Told the number of states done with IPOPT.
    """
    best = Outcome.join(list(engine.map(best_time_jobs(states, TRUTH))))
    problem = model.problem
    base = problem.table.pack(model.parameters)
    program = NonlinearProgram(problem, model.intervals, base)
    times, masses = np.full(len(states), np.nan), np.full(len(states), np.nan)
    for row, state in enumerate(states):
        packed = problem.table.pack(
            {**problem.initial_state_values(state), TERMINAL_TIME: 34.0}, base=base
        )
        found = program.best_time(packed)
        if found is not None and best.converged[row]:
            times[row], masses[row] = found
        if progress is not None:
            progress(1)
    known = np.isfinite(times)
    if not np.any(known):
        return NonlinearCheck(0, len(states), float("nan"), float("nan"))
    difference = np.abs(best.terminal_time_s[known] / times[known] - 1.0)
    return NonlinearCheck(
        states=int(np.count_nonzero(known)),
        failed=int(np.count_nonzero(~known)),
        max_relative_difference=float(np.max(difference)),
        max_mass_difference_kg=float(np.max(np.abs(best.final_mass_kg[known] - masses[known]))),
    )
