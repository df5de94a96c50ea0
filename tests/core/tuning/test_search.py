"""The search itself, in this process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core import tuning_support as support

from dscp_core import problems
from dscp_core.files import FileWriteError
from dscp_core.learning.checkpoint import CHECKPOINT_FILE, CheckpointError
from dscp_core.planning.planner import PlannerSettings, TerminalTime
from dscp_core.tuning import search as search_module
from dscp_core.tuning.assessment import Evaluation, better, improved
from dscp_core.tuning.errors import TuningError
from dscp_core.tuning.evaluator import GradientJob
from dscp_core.tuning.objective import Objective
from dscp_core.tuning.references import ReferenceStore, reference_files, reference_size
from dscp_core.tuning.samples import StateSet
from dscp_core.tuning.search import Search
from dscp_core.tuning.settings import TuningSettings

FIXED = support.planner(intervals=12)
PREDICTED = PlannerSettings(intervals=12, terminal_time=TerminalTime.PREDICTED)


class Interrupted(BaseException):
    """Stands for a kill: nothing of the search runs afterwards."""


class Counting:
    """An engine that counts batches of gradients, and dies at the n-th."""

    workers = 1

    def __init__(self, engine: Any, last: float = float("inf")) -> None:
        self._engine, self._last = engine, last
        self.count = 0

    def map(self, items: Sequence[Any]) -> Iterator[Any]:
        self.count += isinstance(items[0], GradientJob)
        if self.count >= self._last:
            raise Interrupted
        return self._engine.map(items)  # type: ignore[no-any-return]

    def close(self) -> None: ...


def search(
    objective: Objective,
    settings: TuningSettings,
    states: StateSet,
    loss: str = "fuel",
    store: ReferenceStore | None = None,
) -> Search:
    return Search(
        settings,
        objective,
        states,
        identity={"seed": settings.seed, "loss": loss},
        counts_iterations=loss == "iterations",
        store=store,
    )


@pytest.mark.parametrize(("optimiser", "rate"), [("adam", 0.7), ("lbfgs", 0.2)])
def test_parameter_goes_to_its_better_bound(optimiser: str, rate: float, tmp_path: Path) -> None:
    """More thrust saves fuel: the optimum is known."""
    tuned = "thrust_max=8e5:9e5"
    objective = support.objective(tuned, "fuel", FIXED)
    settings = support.settings(
        tmp_path, tuned, FIXED, optimiser=optimiser, epochs=4, learning_rate=rate
    )
    found = search(objective, settings, support.state_set(support.STATES[:1]))
    found.search()
    history = found.document["history"]
    assert history[-1]["validation_loss"] < history[0]["validation_loss"]
    assert 8.9e5 < objective.space.values(found.use_best())["thrust_max"] <= 9e5
    assert {"loss", "gradient", "failures", "untrusted", "values"} <= set(history[0])


def test_trust_region_converges_faster(tmp_path: Path) -> None:
    """From a weight that holds the iterations back, by the gradient of the convergence metric."""
    tuned = "trust_region_control@0.01"
    objective = support.objective(tuned, "iterations", FIXED)
    settings = support.settings(tmp_path, tuned, FIXED, epochs=4, learning_rate=1.0)
    found = search(objective, settings, support.state_set(), "iterations")
    found.search()
    history = found.document["history"]
    assert history[-1]["loss"] < history[0]["loss"] - 0.5  # logarithm of the metric
    assert objective.space.values(found.use_best())["trust_region_control.thrust_x"] < 5e-3
    # Judged by what users see.
    iterations = [entry["validation_iterations"] for entry in history]
    assert history[-1]["validation_loss"] == iterations[-1] < iterations[0]


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
@pytest.mark.parametrize("warm", [False, True])
def test_interrupted_search_goes_on_to_the_same_result(
    optimiser: str, warm: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search_module, "_SECONDS_BETWEEN_CHECKPOINTS", 0.0)
    tuned = "thrust_max=8e5:9e5,network"

    def fresh(folder: str) -> tuple[Objective, Search]:
        objective = support.objective(
            tuned, "fuel", PREDICTED, envelope=warm, predictor=support.untrained()
        )
        settings = support.settings(
            tmp_path / folder, tuned, PREDICTED, optimiser=optimiser, epochs=3, batch=1
        )
        store = (
            ReferenceStore(
                settings.output, reference_size(problems.get("powered_descent"), PREDICTED)
            )
            if warm
            else None
        )
        states = support.state_set(support.STATES[:2])
        return objective, search(objective, settings, states, store=store)

    whole, uninterrupted = fresh("whole")
    counting = Counting(whole._engine)
    whole._engine = counting
    uninterrupted.search()
    expected = uninterrupted.use_best()
    cut, first = fresh("cut")
    cut._engine = Counting(cut._engine, counting.count - 1)
    with pytest.raises(Interrupted):
        first.search()
    resumed, second = fresh("cut")
    second.resume()
    second.search()
    np.testing.assert_array_equal(second.use_best(), expected)
    assert whole.network is not None
    assert resumed.network is not None
    for name, tensor in whole.network.tensors().items():
        np.testing.assert_array_equal(resumed.network.tensors()[name], tensor)

    def without_clock(found: Search) -> list[dict[str, Any]]:
        return [{k: v for k, v in e.items() if k != "elapsed_s"} for e in found.document["history"]]

    assert without_clock(second) == without_clock(uninterrupted)


def test_warm_starts_save_iterations_and_end_at_the_same(tmp_path: Path) -> None:
    tuned = "thrust_max=8e5:9e5"
    ends, iterations = [], []
    for warm in (False, True):
        objective = support.objective(tuned, "fuel", FIXED, envelope=warm)
        settings = support.settings(tmp_path / str(warm), tuned, FIXED, epochs=4)
        store = (
            ReferenceStore(settings.output, reference_size(problems.get("powered_descent"), FIXED))
            if warm
            else None
        )
        found = search(objective, settings, support.state_set(), store=store)
        found.search()
        ends.append(found.use_best())
        iterations.append(found.document["history"][-1]["iterations"])
    # Adam's steps depend on little but the gradients' signs.
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-4)
    assert iterations[1] <= iterations[0] - 2.0
    assert any(path.exists() for path in reference_files(tmp_path / "True"))


def test_references_of_older_epochs_do_not_count(tmp_path: Path) -> None:
    store = ReferenceStore(tmp_path, 3)
    first, second = np.arange(6.0).reshape(2, 3), np.full((1, 3), 7.0)
    store.begin(0)
    assert np.isnan(store.read(np.array([0, 5]))).all()
    store.write(np.array([0, 5]), first)
    store.write(np.array([1]), np.full((1, 3), np.nan))
    np.testing.assert_array_equal(store.read(np.array([5])), [[np.nan] * 3])
    store.begin(1)
    np.testing.assert_array_equal(store.read(np.array([5, 0])), first[::-1])
    assert np.isnan(store.read(np.array([1, 3, 9]))).all()
    store.write(np.array([5]), second)
    store.begin(2)
    np.testing.assert_array_equal(store.read(np.array([0, 5])), [[np.nan] * 3, second[0]])
    store.begin(3)  # epoch 2 wrote nothing; what epoch 0 left in its file is too old
    assert np.isnan(store.read(np.array([0, 5]))).all()
    store.clear()
    assert not any(tmp_path.iterdir())


def test_all_states_failing_writes_nothing(tmp_path: Path) -> None:
    tuned = "thrust_max=8e5:9e5"
    planned = support.planner(intervals=12, parameters={"terminal_time": support.SHORT_TIME_S})
    for optimiser in ("adam", "lbfgs"):
        objective = support.objective(tuned, "fuel", planned)
        settings = support.settings(tmp_path / "out", tuned, planned, optimiser=optimiser)
        found = search(objective, settings, support.state_set())
        with pytest.raises(TuningError, match=r"none of 3 training states.*3 failed.*virtual"):
            found.search()
    assert not (tmp_path / "out").exists()


def test_search_that_goes_astray_keeps_its_best(tmp_path: Path) -> None:
    """Gravity pulls harder than the engine at the upper end; the loss asks for more of it."""
    source = tmp_path / "own.py"
    source.write_text(
        "def loss(states, controls, time_s):\n    return -1e-5 * controls.abs().sum()\n",
        encoding="utf-8",
    )
    tuned = "gravity=9:40"
    objective = support.objective(tuned, f"{source}:loss", FIXED)
    settings = support.settings(
        tmp_path / "out", tuned, FIXED, epochs=6, learning_rate=0.7, batch=9
    )
    found = search(objective, settings, support.state_set(support.STATES[:2]))
    found.search()
    assert "none of 2 training states" in found.document["stopped"]
    assert objective.space.values(found.use_best())["gravity"] < 20.0


def test_checkpoint_of_another_tuning(tmp_path: Path) -> None:
    tuned = "thrust_max=8e5:9e5"
    objective = support.objective(tuned, "fuel", FIXED)
    settings = support.settings(tmp_path, tuned, FIXED, epochs=1)
    search(objective, settings, support.state_set()).search()
    other = search(objective, replace(settings, seed=9), support.state_set())
    with pytest.raises(CheckpointError, match="seed = 0, not 9"):
        other.resume()
    path = tmp_path / CHECKPOINT_FILE
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(CheckpointError, match="no readable"):
        search(objective, settings, support.state_set()).resume()


def test_full_disk_is_an_error(tmp_path: Path) -> None:
    tuned = "thrust_max=8e5:9e5"
    objective = support.objective(tuned, "fuel", FIXED)
    output = tmp_path / "file"
    output.write_text("no folder", encoding="utf-8")
    settings = support.settings(output, tuned, FIXED, epochs=1)
    with pytest.raises(FileWriteError):
        search(objective, settings, support.state_set()).search()


def evaluation(loss: list[float], failed: list[bool], iterations: list[int]) -> Evaluation:
    count = len(loss)
    return Evaluation(
        loss=np.array(loss),
        differentiated=np.array(loss),
        iterations=np.array(iterations),
        failed=np.array(failed),
        trusted=np.ones(count, dtype=bool),
        seconds=np.zeros(count),
        logs=("one",) * count,
    )


def test_judgement_compares_what_both_have() -> None:
    nan = float("nan")
    old = evaluation([1.0, 5.0, nan], [False, False, True], [3, 3, 3])
    lower = evaluation([0.5, 5.0, 100.0], [False, False, False], [3, 3, 3])
    assert improved(old, lower)
    assert better(old, lower)
    assert old.mean_loss == 3.0
    assert not improved(lower, old)
    # Better on average, but a state is lost.
    assert not improved(old, evaluation([0.0, nan, nan], [False, True, True], [3, 3, 3]))
    assert not improved(old, old)
    # One state less fails at no loss.
    assert improved(old, evaluation([1.0, 5.0, 7.0], [False] * 3, [3, 3, 3]))


def test_equal_iteration_counts_are_told_apart_by_the_metric() -> None:
    old = replace(evaluation([5.0, 5.0], [False] * 2, [5, 5]), differentiated=np.array([1.0, 2.0]))
    new = replace(old, differentiated=np.array([0.0, 2.0]))
    assert better(old, new)
    assert not improved(old, new)
