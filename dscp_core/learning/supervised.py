"""First stage of the default training: regression on optimal terminal times."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from dscp_core.learning.gauss_newton import GaussNewton, Targets
from dscp_core.learning.labels import LABELLING, best_time_jobs, check_failures, run_jobs
from dscp_core.learning.recipes import Fit
from dscp_core.learning.run import Run

Array = NDArray[np.float64]

_RECORD_EVERY = 10


def supervise(run: Run) -> None:
    """Phases of labels and fits; keeps the weights with the least validation error.

    Raises:
        LabelError: More than a few states have no optimum.
    """
    settings = run.recipe.supervised
    if settings is None:
        return
    progress = run.document.setdefault("phase", 0)
    for number, phase in enumerate(settings.phases):
        if number < progress:
            continue
        states = run.box.training(phase.labels, run.rng("labels", number), run.recipe.mixture)
        _collect(run, states)
        known, times = label_targets(run)
        if number == 0 and "supervised" not in run.document:
            run.network.start_at(float(np.mean(times)))
        fit_targets(run, "supervised", phase.fit, targets(run, known, times), "regression")
        run.use_best()
        run.document["phase"] = number + 1
        run.save()


def _collect(run: Run, states: Array) -> None:
    """Solve states (n, 7) up to the number of them, beyond what has been solved before."""
    known = run.arrays.get("labels.states", np.zeros((0, 7)))
    times = run.arrays.get("labels.terminal_time_s", np.zeros(0))
    jobs = best_time_jobs(states[len(times) :], LABELLING)
    with run.bar(len(states), "labels", len(times)) as bar:
        for job, outcome in zip(jobs, run_jobs(run.engine, jobs), strict=True):
            found = np.where(outcome.converged, outcome.terminal_time_s, np.nan)
            times, known = np.concatenate([times, found]), np.concatenate([known, job.states])
            run.arrays["labels.terminal_time_s"] = times
            run.arrays["labels.states"] = known
            bar.update(len(found))
            bar.set_postfix(failures=int(np.count_nonzero(np.isnan(times))))
            run.save(even_if_recent=False)
    check_failures(known, np.isfinite(times))


def label_targets(run: Run) -> tuple[Array, Array]:
    """States (n, 7) and their optimal times (n,); empty where there are no labels."""
    times = run.arrays.get("labels.terminal_time_s", np.zeros(0))
    states = run.arrays.get("labels.states", np.zeros((0, 7)))
    usable = np.isfinite(times)
    return states[usable], times[usable]


def targets(run: Run, states: Array, times_s: Array) -> Targets:
    """States (n, 7) and wanted times (n,) to fit, of equal weight."""
    return Targets(
        run.network.inputs(states),
        torch.from_numpy(times_s),
        torch.ones(len(times_s), dtype=torch.float64),
    )


def fit_targets(
    run: Run,
    name: str,
    settings: Fit,
    wanted: Targets,
    label: str,
    **entry: float | int | None,
) -> None:
    """Fit the network; goes on where a checkpoint was written in the middle.

    Args:
        run: Whose network.
        name: Of the stage, for random numbers, checkpoint and history.
        settings: How to fit.
        wanted: What to fit.
        label: Of the progress bar.
        **entry: For the history.

    Raises:
        FitError: The numbers are no longer finite.
    """
    fit = GaussNewton(run.network, settings)
    progress = run.document.setdefault(name, {"step": 0, "fits": 0})
    key = f"{name}.last_step"
    if progress["step"]:
        fit.number, fit.last = progress["step"], run.arrays[key]
    with run.bar(settings.steps, label, fit.number) as bar:
        while not fit.done:
            length = fit.length
            loss = fit.step(wanted, run.rng(name, progress["fits"], fit.number))
            progress["step"], run.arrays[key] = fit.number, fit.last
            bar.update()
            if fit.number % _RECORD_EVERY == 0 or fit.done:
                rms_s = math.sqrt(loss)
                errors = run.record(name, rms_s=rms_s, learning_rate=length, **entry)
                shown = {"loss_s": f"{rms_s:.1e}", "validation": f"{errors.rms:.1e}", **entry}
                bar.set_postfix(shown)
            run.save(even_if_recent=False)
    progress["step"], progress["fits"] = 0, progress["fits"] + 1
