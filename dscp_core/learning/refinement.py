"""Second stage of the default training: DSCP's gradients at the network's own times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dscp_core.learning.evaluator import GradientMethod, Outcome
from dscp_core.learning.labels import Progress, given_times
from dscp_core.learning.recipes import Refinement
from dscp_core.learning.run import Run, TrainingError
from dscp_core.learning.supervised import fit_targets, label_targets, targets
from dscp_core.scp.scp import ScpOptions

Array = NDArray[np.float64]

_OPTIONS = ScpOptions(cost_tolerance=1e-9, max_iterations=40)


def refine(run: Run) -> None:
    """Rounds of planning at the predicted times and fitting, see `Refinement`.

    Raises:
        TrainingError: No state has a slope.
    """
    settings = run.recipe.refinement
    if settings is None:
        return
    progress = run.document.setdefault(
        "refinement", {"round": 0, "planned": False, "best": None, "waited": 0}
    )
    run.arrays["refinement.states"] = run.box.training(
        settings.states, run.rng("refinement"), run.recipe.mixture
    )
    while progress["round"] < settings.rounds and progress["waited"] < settings.patience:
        if not progress["planned"]:
            _plan(run, settings, progress["round"])
            # Kept, so that a training that is killed during the fit still knows it.
            progress |= {"planned": True, "best": run.document["best"]}
            run.save()
        _fit(run, settings, progress["round"])
        improved = run.document["best"] < progress["best"]
        progress["waited"] = 0 if improved else progress["waited"] + 1
        progress["round"] += 1
        progress["planned"] = False
        run.save()
    run.use_best()


def _plan(run: Run, settings: Refinement, number: int) -> None:
    """Times at which the slope of the cost vanishes, from slopes at the predicted times."""
    states = run.arrays["refinement.states"]
    times = run.network.predict(states)
    with run.bar(2 * len(states), f"round {number + 1}: plans") as bar:
        first = _slopes(run, states, times, run.arrays.get("refinement.references"), bar.update)
        near, far = settings.probe_s
        size = np.clip(np.abs(first.slope_kg_s) / settings.curvature_guess, near, far)
        probe = -np.sign(first.slope_kg_s) * np.where(first.converged, size, 0.0)
        probe = np.where(np.isfinite(probe), probe, 0.0)
        second = _slopes(run, states, times + probe, first.references, bar.update)
    step = _steps(settings, first, second, probe)
    if not np.any(np.isfinite(step)):
        raise TrainingError("no state has a slope at its predicted terminal time")
    run.arrays["refinement.wanted"] = times + step
    # An infeasible trajectory is a bad place to start from.
    run.arrays["refinement.references"] = np.where(
        first.converged[:, None], first.references, np.nan
    )
    slopes = np.abs(first.slope_kg_s[first.converged])
    report = run.document["refinement"]
    report["mean_abs_slope_kg_s"] = float(np.mean(slopes)) if slopes.size else None
    report["failures"] = int(np.count_nonzero(~first.converged))


def _slopes(
    run: Run, states: Array, times: Array, references: Array | None, progress: Progress
) -> Outcome:
    return given_times(
        run.engine,
        states,
        times,
        _OPTIONS,
        method=GradientMethod.ENVELOPE,
        references=references,
        progress=progress,
    )


def _steps(settings: Refinement, first: Outcome, second: Outcome, probe: Array) -> Array:
    """Changes (n,) of the times that slopes ask for; NaN where there are none."""
    low, high = settings.curvature_range
    with np.errstate(invalid="ignore", divide="ignore"):
        curvature = np.clip((second.slope_kg_s - first.slope_kg_s) / probe, low, high)
    step = np.where(second.converged, probe - second.slope_kg_s / curvature, np.nan)
    # Where the time is infeasible, the slope is that of the virtual control's penalty.
    outwards = settings.infeasible_margin_s - first.slope_kg_s / settings.infeasible_curvature
    outwards = np.where(np.isfinite(outwards), outwards, settings.step_limit_s)
    step = np.where(first.infeasible, outwards, np.where(first.converged, step, np.nan))
    return np.clip(step, -settings.step_limit_s, settings.step_limit_s)


def _fit(run: Run, settings: Refinement, number: int) -> None:
    states, times = label_targets(run)
    wanted = run.arrays["refinement.wanted"]
    usable = np.isfinite(wanted)
    states = np.concatenate([states, run.arrays["refinement.states"][usable]])
    times = np.concatenate([times, wanted[usable]])
    report = run.document["refinement"]
    fit_targets(
        run,
        "refinement_fit",
        settings.fit,
        targets(run, states, times),
        f"round {number + 1}: fit",
        mean_abs_slope_kg_s=report["mean_abs_slope_kg_s"],
        failures=report["failures"],
    )
