"""Training from nothing, from a checkpoint, and what it refuses."""

from __future__ import annotations

import json
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from learning_support import tiny_recipe, tiny_training

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.files import FileWriteError
from dscp_core.learning.checkpoint import CHECKPOINT_FILE, Checkpoint, CheckpointError
from dscp_core.learning.evaluator import GradientMethod, Outcome
from dscp_core.learning.recipes import RECIPES, StochasticSteps, adjusted, recipe
from dscp_core.learning.refinement import refine
from dscp_core.learning.run import Errors, Run, TrainingError
from dscp_core.learning.sampling import PAPER_BOX
from dscp_core.learning.stochastic import take_stochastic_steps
from dscp_core.learning.training import HISTORY_FILE, NETWORK_FILE, train
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("trained")
    train(tiny_training(output))
    return output


def test_training_learns(trained: Path) -> None:
    history = json.loads((trained / HISTORY_FILE).read_text())
    assert {entry["stage"] for entry in history} == {"supervised", "refinement_fit"}
    best = min(entry["validation_rms"] for entry in history)
    # 24 labels of a function that varies by 3e-2: more than the mean has been learnt.
    assert best < 1.5e-2
    assert all(entry["vertical_max"] > 0.0 for entry in history)
    table = problems.get("powered_descent").table
    network = TerminalTimeNetwork.load(
        trained / NETWORK_FILE,
        vehicle=problems.get("powered_descent").vehicle_of(table.unpack(table.pack())),
    )
    assert network.data.intervals == 20
    assert network.data.provenance["seed"] == 1
    states = PAPER_BOX.uniform(50, np.random.default_rng(0))
    times = np.array([network.predict(state) for state in states])
    assert np.all((times > 31.0) & (times < 40.0))


@pytest.mark.parametrize("stage", ["supervised", "refinement"])
def test_killed_training_goes_on_to_the_same_result(
    trained: Path, tmp_path: Path, stage: str
) -> None:
    code = (
        "import sys\n"
        f"sys.path[:0] = {sys.path!r}\n"
        "from pathlib import Path\n"
        "from learning_support import tiny_training\n"
        "from dscp_core.learning.training import train\n"
        "if __name__ == '__main__':\n"
        f"    train(tiny_training(Path({str(tmp_path)!r})))\n"
    )
    checkpoint = tmp_path / CHECKPOINT_FILE
    process = subprocess.Popen([sys.executable, "-c", code])
    try:
        while not (checkpoint.exists() and _stage(checkpoint) == stage):
            assert process.poll() is None, "the training ended before it reached the stage"
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert not (tmp_path / NETWORK_FILE).exists()
    train(tiny_training(tmp_path, resume=True, workers=2))
    assert (tmp_path / NETWORK_FILE).read_bytes() == (trained / NETWORK_FILE).read_bytes()


def _stage(checkpoint: Path) -> str:
    return str(Checkpoint.load(checkpoint).document["stage"])


def test_another_seed_gives_another_network(trained: Path, tmp_path: Path) -> None:
    train(tiny_training(tmp_path, seed=2))
    assert (tmp_path / NETWORK_FILE).read_bytes() != (trained / NETWORK_FILE).read_bytes()


def test_a_finished_training_is_not_overwritten(trained: Path) -> None:
    before = (trained / NETWORK_FILE).read_bytes()
    with pytest.raises(CheckpointError, match="resume that training"):
        train(tiny_training(trained))
    with pytest.raises(CheckpointError, match="seed = 1, not 5"):
        train(tiny_training(trained, resume=True, seed=5))
    with pytest.raises(CheckpointError, match="vehicle"):
        train(tiny_training(trained, resume=True, parameters={"thrust_max": 900e3}))
    assert (trained / NETWORK_FILE).read_bytes() == before
    train(tiny_training(trained, resume=True))
    assert (trained / NETWORK_FILE).read_bytes() == before


def test_nothing_to_resume(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        train(tiny_training(tmp_path, resume=True))


def test_damaged_checkpoint(trained: Path, tmp_path: Path) -> None:
    content = (trained / CHECKPOINT_FILE).read_bytes()
    (tmp_path / CHECKPOINT_FILE).write_bytes(content[: len(content) // 2])
    with pytest.raises(CheckpointError, match="safetensors"):
        train(tiny_training(tmp_path, resume=True))
    network = (trained / NETWORK_FILE).read_bytes()
    (tmp_path / CHECKPOINT_FILE).write_bytes(network)
    with pytest.raises(CheckpointError, match="no training checkpoint"):
        train(tiny_training(tmp_path, resume=True))


def test_bad_settings(tmp_path: Path) -> None:
    for changes, match in (
        ({"seed": -1}, "seed"),
        ({"workers": 0}, "workers"),
        ({"parameters": {"thrust_mix": 1.0}}, "thrust_m"),
        ({"parameters": {"final_position": (0.0, 10.0, 0.0)}}, "final_position"),
    ):
        with pytest.raises(InvalidInputError, match=match):
            train(tiny_training(tmp_path, **changes))
    (tmp_path / "file").write_text("")
    with pytest.raises(FileWriteError):
        train(tiny_training(tmp_path / "file"))


def test_the_papers_recipe(tmp_path: Path) -> None:
    paper = RECIPES["paper"]
    assert paper.stochastic is not None
    rates = [paper.stochastic.learning_rate(epoch) for epoch in (0, 199, 200, 400, 599)]
    assert rates == [0.01, 0.01, 0.005, 0.001, 0.001]
    small = replace(
        paper,
        validation=4,
        profile_points=2,
        stochastic=replace(paper.stochastic, epochs=3, samples=8, batch=4, validate_every=1),
    )
    result = train(tiny_training(tmp_path, recipe=small))
    assert [entry["epoch"] for entry in result.history] == [1, 2, 3]
    assert all(entry["learning_rate"] == 0.01 for entry in result.history)
    assert all(5000.0 < entry["mean_fuel_kg"] < 8000.0 for entry in result.history)
    # The start is the middle of [31, 37] s, which is late for most of the states: slopes count.
    assert all(0.0 < entry["mean_abs_slope"] <= 5.0 for entry in result.history)
    assert TerminalTimeNetwork.load(result.network).data.interval_s == (31.0, 37.0)


def test_stochastic_steps_resume_with_its_optimiser(tmp_path: Path) -> None:
    stochastic = StochasticSteps(
        epochs=2, samples=8, batch=4, method=GradientMethod.ENVELOPE, validate_every=1
    )
    small = tiny_recipe(supervised=None, refinement=None, stochastic=stochastic)
    straight = train(tiny_training(tmp_path / "a", recipe=small)).network.read_bytes()
    train(tiny_training(tmp_path / "b", recipe=small))
    path = tmp_path / "b" / CHECKPOINT_FILE
    checkpoint = Checkpoint.load(path)
    assert any(name.startswith("adam.") for name in checkpoint.arrays)
    # As if it had been killed after the first of two epochs of an identical training.
    one = replace(small, stochastic=replace(stochastic, epochs=1))
    train(tiny_training(tmp_path / "c", recipe=one))
    halfway = Checkpoint.load(tmp_path / "c" / CHECKPOINT_FILE)
    halfway.document["identity"] = checkpoint.document["identity"]
    halfway.document["stage"] = "stochastic"
    halfway.save(path)
    resumed = train(tiny_training(tmp_path / "b", recipe=small, resume=True))
    assert resumed.network.read_bytes() == straight


class _NoSlopes:
    """An engine whose states all fail."""

    workers = 1

    def map(self, items: list[object]) -> list[Outcome]:
        return [Outcome.empty(len(item.states), 10) for item in items]  # type: ignore[attr-defined]

    def close(self) -> None:
        pass


def test_all_samples_failing_is_an_error(tmp_path: Path) -> None:
    run = Run(tiny_recipe(), _NoSlopes(), tmp_path, 0, identity={})  # type: ignore[arg-type]
    with pytest.raises(TrainingError, match="no state has a slope"):
        refine(run)
    stochastic = StochasticSteps(epochs=9, samples=4, batch=2, validate_every=10)
    small = tiny_recipe(supervised=None, refinement=None, stochastic=stochastic)
    run = Run(small, _NoSlopes(), tmp_path, 0, identity={})  # type: ignore[arg-type]
    with pytest.raises(TrainingError, match="all states of 3 epochs have failed"):
        take_stochastic_steps(run)


@contextmanager
def files_no_longer_than(size: int) -> Iterator[None]:
    """A full disk, but for the number of the error: the operating system refuses to write."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_full_disk_loses_no_file(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with files_no_longer_than(1000), pytest.raises(FileWriteError, match="too large"):
        train(tiny_training(tmp_path, resume=True))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    fresh = tmp_path / "fresh"
    with files_no_longer_than(1000), pytest.raises(FileWriteError, match="too large"):
        train(tiny_training(fresh))
    assert list(fresh.iterdir()) == []


def test_errors_are_relative() -> None:
    errors = Errors.of(np.array([10.1, 20.0, 29.7]), np.array([10.0, 20.0, 30.0]))
    assert errors.mean == pytest.approx(0.02 / 3.0)
    assert errors.maximum == pytest.approx(0.01)
    assert errors.rms == pytest.approx(0.01 * np.sqrt(2.0 / 3.0))


def test_recipes_by_name_and_size() -> None:
    assert recipe("default").supervised is not None
    with pytest.raises(InvalidInputError, match="default, paper"):
        recipe("papers")
    smaller = adjusted(recipe("default"), labels=100, steps=5, rounds=0)
    assert smaller.supervised is not None
    assert [(p.labels, p.fit.steps) for p in smaller.supervised.phases] == [(100, 5)]
    assert smaller.refinement is None
    assert adjusted(recipe("default"), labels=0).supervised is None
    for base, changes in (
        ("default", {"epochs": 5}),
        ("paper", {"labels": 5}),
        ("default", {"labels": -1}),
        ("default", {"labels": 0, "rounds": 0}),
        ("paper", {"epochs": 0}),
    ):
        with pytest.raises(InvalidInputError):
            adjusted(recipe(base), **changes)
