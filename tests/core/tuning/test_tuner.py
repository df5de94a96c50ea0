"""Whole tunings in worker processes, and what they refuse."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from core import tuning_support as support

from dscp_core.errors import InvalidInputError
from dscp_core.learning.checkpoint import CHECKPOINT_FILE, Checkpoint, CheckpointError
from dscp_core.planning.planner import PlannerSettings, TerminalTime
from dscp_core.tuning.errors import TuningError
from dscp_core.tuning.tuner import Sample, TuningResult, discard_checkpoint, screen, tune


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> TuningResult:
    return support.tune_tiny(tmp_path_factory.mktemp("tuned"))


def test_tuning_improves_unseen_states(tuned: TuningResult) -> None:
    assert tuned.improved
    assert tuned.after.mean_loss < tuned.before.mean_loss
    assert (tuned.before.states, tuned.before.failures) == (4, 0)
    assert tuned.before.logs == ("two",) * 4
    assert set(tuned.values) == {"thrust_max"}
    assert 8e5 < tuned.values["thrust_max"] < 9e5
    assert tuned.network is not None
    # A network belongs to the vehicle that it was tuned with.
    assert tuned.network.data.vehicle["thrust_max"] == tuned.values["thrust_max"]
    assert tuned.network.data.provenance["tuning"]["loss"] == "fuel"
    before, after = (
        support.untrained().data.weights[-1],
        tuned.network.data.weights[-1],
    )
    assert 0.0 < np.max(np.abs(after - before)) < 1e-2
    document = tuned.after.document()
    assert set(document) >= {"loss", "iterations", "failures", "untrusted", "seconds_per_state"}


def test_killed_tuning_goes_on_to_the_same_result_with_two_workers(
    tuned: TuningResult, tmp_path: Path
) -> None:
    code = (
        "import sys\n"
        f"sys.path[:0] = {sys.path!r}\n"
        "from pathlib import Path\n"
        "from core.tuning_support import tune_tiny\n"
        "if __name__ == '__main__':\n"
        f"    tune_tiny(Path({str(tmp_path)!r}))\n"
    )
    checkpoint = tmp_path / CHECKPOINT_FILE
    process = subprocess.Popen([sys.executable, "-c", code])
    try:
        while not (checkpoint.exists() and Checkpoint.load(checkpoint).document["epoch"] >= 1):
            assert process.poll() is None, "the tuning ended before its first epoch"
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    with pytest.raises(CheckpointError, match="resume"):
        support.tune_tiny(tmp_path)
    resumed = support.tune_tiny(tmp_path, workers=2, resume=True)
    assert resumed.values == tuned.values
    assert resumed.best_epoch == tuned.best_epoch
    np.testing.assert_array_equal(resumed.after.loss, tuned.after.loss)
    assert resumed.network is not None
    assert tuned.network is not None
    for mine, other in zip(resumed.network.data.weights, tuned.network.data.weights, strict=True):
        np.testing.assert_array_equal(mine, other)
    discard_checkpoint(tmp_path)
    assert not tmp_path.exists()


def test_states_that_no_plan_can_start_from(tmp_path: Path) -> None:
    settings = support.tiny(tmp_path)
    good = support.samples(1)[0]
    below = replace(good, state=np.array([-50.0, *good.state[1:]]))
    nan = replace(good, state=np.full(7, np.nan))
    short = replace(good, state=good.state[:3])
    far = replace(good, state=np.array([9000.0, *good.state[1:]]))
    endless = replace(good, terminal_time_s=1e6)
    kept, refused = screen(settings, [below, good, nan, short, far, endless], support.untrained())
    assert kept == [good]
    assert [r.sample for r in refused] == [below, nan, short, far, endless]
    assert "landing altitude" in refused[0].reason
    assert "finite" in refused[1].reason
    assert "trained for" in refused[3].reason
    for training, held_out, what in (
        ([below], [good], "training"),
        ([good], [], "held-out"),
    ):
        with pytest.raises(TuningError, match=f"no {what} state"):
            tune(settings, training, held_out, network=support.untrained())
    assert not any(tmp_path.iterdir())


def test_settings_that_contradict_each_other(tmp_path: Path) -> None:
    data = support.samples(2)
    free = PlannerSettings(terminal_time=TerminalTime.FREE)
    predicted = PlannerSettings(terminal_time=TerminalTime.PREDICTED)
    other = replace(predicted, parameters={"thrust_max": 8e5})
    network = support.untrained()
    for planned, tuned, given, message in (
        (predicted, "network", None, "given exactly when"),
        (free, "thrust_max=6e5:9e5", network, "given exactly when"),
        (free, "network", None, "predicted terminal times"),
        (predicted, "terminal_time=30:40", network, "no predicted"),
        (other, "thrust_prox=1e-9:1e-3", network, "thrust_max"),
        (free, "thrust_min=1e5:7e5,thrust_max=6e5:9e5", None, "bounds of"),
    ):
        settings = support.settings(tmp_path, tuned, planned)
        with pytest.raises(InvalidInputError, match=message):
            tune(settings, data, data, network=given)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"optimiser": "sgd"}, "one of adam, lbfgs"),
        ({"epochs": 0}, ">= 1"),
        ({"fixed_iterations": 0}, ">= 1"),
        ({"learning_rate": -1.0}, "> 0"),
        ({"learning_rate": float("nan")}, "> 0"),
        ({"validation": 1.0}, "validation"),
        ({"tuned": ()}, "one or more"),
    ],
)
def test_bad_settings(changes: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=message):
        replace(support.tiny(tmp_path), **changes)  # type: ignore[arg-type]


def test_bad_losses(tmp_path: Path) -> None:
    data = support.samples(1)
    broken = tmp_path / "broken.py"
    broken.write_text("import nothing_of_this_name\n", encoding="utf-8")
    empty = tmp_path / "empty.py"
    empty.write_text("", encoding="utf-8")
    for loss, message in (
        ("fule", "one of fuel"),
        (f"{tmp_path}/none.py:loss", "readable file"),
        (f"{broken}:loss", "ModuleNotFoundError"),
        (f"{empty}:loss", "a function in"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            tune(support.tiny(tmp_path, loss=loss), data, data, network=support.untrained())


def test_logged_times_count_only_where_they_are_fixed() -> None:
    from dscp_core.tuning.samples import StateSet

    data = [Sample(np.zeros(7), "a", 33.0), Sample(np.zeros(7), "b")]
    np.testing.assert_array_equal(StateSet.of(data, given_times=True).times_s, [33.0, np.nan])
    assert np.isnan(StateSet.of(data, given_times=False).times_s).all()
