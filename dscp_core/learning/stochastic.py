"""The paper's training: stochastic gradient steps on DSCP's gradients (section 4.1.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from dscp_core.learning.labels import given_times
from dscp_core.learning.recipes import StochasticSteps
from dscp_core.learning.run import Run, TrainingError
from dscp_core.scp.scp import ScpOptions

Array = NDArray[np.float64]

_MOST_FAILED_EPOCHS = 3


@dataclass(frozen=True)
class _Epoch:
    """What an epoch was like.

    Attributes:
        fuel_kg: Mean fuel of the states that converged; None without one.
        slope: Mean absolute slope, in slope units.
        failures: How many states failed.
    """

    fuel_kg: float | None
    slope: float
    failures: int


def take_stochastic_steps(run: Run) -> None:
    """Train epoch by epoch.

    Raises:
        TrainingError: Every state has failed for several epochs.
    """
    settings = run.recipe.stochastic
    if settings is None:
        return
    progress = run.document.setdefault("stochastic", {"epoch": 0, "failed_epochs": 0})
    optimiser = torch.optim.Adam(run.network.parameters(), lr=settings.learning_rate(0))
    _restore(run, optimiser)
    validation = "not yet"
    with run.bar(settings.epochs, "epochs", progress["epoch"]) as bar:
        while progress["epoch"] < settings.epochs:
            epoch = progress["epoch"]
            rate = settings.learning_rate(epoch)
            for group in optimiser.param_groups:
                group["lr"] = rate
            done = _epoch(run, settings, optimiser, epoch)
            all_failed = done.failures == settings.samples
            progress["failed_epochs"] = progress["failed_epochs"] + 1 if all_failed else 0
            if progress["failed_epochs"] == _MOST_FAILED_EPOCHS:
                raise TrainingError(
                    f"all states of {_MOST_FAILED_EPOCHS} epochs have failed, the last in epoch "
                    f"{epoch + 1}"
                )
            progress["epoch"] += 1
            last = progress["epoch"] == settings.epochs
            if last or progress["epoch"] % settings.validate_every == 0:
                errors = run.record(
                    "stochastic",
                    epoch=progress["epoch"],
                    learning_rate=rate,
                    mean_fuel_kg=done.fuel_kg,
                    mean_abs_slope=done.slope,
                    failures=done.failures,
                )
                validation = f"{errors.rms:.1e}"
            bar.set_postfix(
                loss="none" if done.fuel_kg is None else f"{done.fuel_kg:.1f} kg",
                gradient=f"{done.slope:.2g}",
                failures=done.failures,
                validation=validation,
            )
            bar.update()
            _keep(run, optimiser)
            run.save(even_if_recent=False)
    run.use_best()


def _epoch(
    run: Run, settings: StochasticSteps, optimiser: torch.optim.Optimizer, epoch: int
) -> _Epoch:
    options = ScpOptions.for_gradients(max_iterations=settings.max_iterations)
    states = run.box.uniform(settings.samples, run.rng("stochastic", epoch))
    fuel: list[float] = []
    total, failures = 0.0, 0
    for start in range(0, len(states), settings.batch):
        batch = states[start : start + settings.batch]
        optimiser.zero_grad()
        times = run.network(run.network.inputs(batch))
        outcome = given_times(
            run.engine, batch, times.detach().numpy(), options, method=settings.method
        )
        limit = settings.slope_limit
        slopes = np.clip(outcome.slope_kg_s / settings.slope_unit_kg_s, -limit, limit)
        failed = ~(outcome.converged & np.isfinite(slopes))
        slopes = np.where(failed, settings.failed_slope, slopes)
        times.backward(torch.from_numpy(slopes / len(batch)))
        optimiser.step()
        total += float(np.sum(np.abs(slopes)))
        failures += int(np.count_nonzero(failed))
        fuel += (batch[:, 6] - outcome.final_mass_kg)[outcome.converged].tolist()
    return _Epoch(float(np.mean(fuel)) if fuel else None, total / len(states), failures)


def _keep(run: Run, optimiser: torch.optim.Optimizer) -> None:
    """Copy the optimiser's tensors to the run's arrays."""
    for number, values in optimiser.state_dict()["state"].items():
        for name, tensor in values.items():
            run.arrays[f"adam.{number}.{name}"] = tensor.numpy().copy()


def _restore(run: Run, optimiser: torch.optim.Optimizer) -> None:
    """Inverse of `_keep`."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    for key, array in run.arrays.items():
        if key.startswith("adam."):
            _, number, name = key.split(".")
            state.setdefault(int(number), {})[name] = torch.from_numpy(array.copy())
    if state:
        optimiser.load_state_dict({**optimiser.state_dict(), "state": state})
