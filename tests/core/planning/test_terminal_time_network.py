"""The terminal-time network without PyTorch: evaluation, file, refusals."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from learning_support import VEHICLE, network
from safetensors.numpy import save

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.files import FileWriteError, replace_file
from dscp_core.learning.sampling import PAPER_BOX
from dscp_core.planning.terminal_time_network import (
    FeatureMap,
    NetworkFileError,
    TerminalTimeNetwork,
)

STATE = np.array([5000.0, 500.0, 500.0, -150.0, 30.0, -30.0, 38000.0])


@pytest.mark.parametrize("features", FeatureMap)
def test_equals_torch(features: FeatureMap) -> None:
    torch = pytest.importorskip("torch")
    net = network(features)
    data = net.data
    states = PAPER_BOX.uniform(200, np.random.default_rng(1))
    scaled = (features(states) - data.feature_center) / data.feature_scale
    values = torch.from_numpy(scaled)
    for weight, bias in zip(data.weights[:-1], data.biases[:-1], strict=True):
        values = torch.tanh(
            torch.nn.functional.linear(values, torch.from_numpy(weight), torch.from_numpy(bias))
        )
    last = torch.nn.functional.linear(
        values, torch.from_numpy(data.weights[-1]), torch.from_numpy(data.biases[-1])
    )
    expected = 30.0 + 12.0 * torch.sigmoid(last[:, 0]).numpy()
    single = [net.predict(state) for state in states]
    # Rounding of three layers of 64 sums: some 1e-15, relative.
    np.testing.assert_allclose(single, expected, rtol=1e-12)
    np.testing.assert_allclose(net.evaluate(states), expected, rtol=1e-12)
    assert expected.std() > 0.01, "a network that says the same everywhere proves nothing"


def test_extreme_outputs_stay_in_the_interval() -> None:
    data = network().data
    for sign in (-1.0, 1.0):
        biases = (*data.biases[:-1], np.array([sign * 1e6]))
        net = TerminalTimeNetwork(replace(data, biases=biases))
        assert net.predict(STATE) == (30.0 if sign < 0.0 else 42.0)


def test_symmetric_features() -> None:
    net = network()
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned, mirrored = STATE.copy(), STATE.copy()
    turned[1:3], turned[4:6] = turn @ STATE[1:3], turn @ STATE[4:6]
    mirrored[[1, 4]] *= -1.0
    for other in (turned, mirrored):
        assert net.evaluate(other) == pytest.approx(float(net.evaluate(STATE)), rel=1e-12)
    outwards = STATE.copy()
    outwards[5] *= -1.0  # flies away from the target now: another state
    assert abs(float(net.evaluate(outwards) - net.evaluate(STATE))) > 1e-3


def test_file_round_trip(tmp_path: Path) -> None:
    net = TerminalTimeNetwork(replace(network().data, provenance={"seed": 3}))
    path, again = tmp_path / "net.safetensors", tmp_path / "again.safetensors"
    net.save(path)
    loaded = TerminalTimeNetwork.load(path, vehicle=VEHICLE)
    assert loaded.predict(STATE) == net.predict(STATE)
    assert loaded.data.provenance == {"seed": 3}
    assert loaded.data.features is net.data.features
    loaded.save(again)
    assert path.read_bytes() == again.read_bytes(), "equal networks give equal files"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["again.safetensors", "net.safetensors"]


def test_outside_of_the_box() -> None:
    net = network()
    state = STATE.copy()
    assert net.covers(state)
    state[3] = -151.0
    assert not net.covers(state)
    with pytest.raises(InvalidInputError, match=r"vx: got -151.0, expected \[-150, -120\] m/s"):
        net.predict(state)
    state[3] = np.nan
    with pytest.raises(InvalidInputError, match="vx"):
        net.predict(state)
    with pytest.raises(InvalidInputError, match="shape"):
        net.predict(state[:6])


def test_mass_is_part_of_the_box() -> None:
    light = STATE.copy()
    light[6] = 37000.0
    with pytest.raises(InvalidInputError, match=r"mass: got 37000\.0"):
        network().predict(light)


def test_another_vehicle_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "net.safetensors"
    network().save(path)
    with pytest.raises(InvalidInputError, match=r"thrust_max: got 900000.0, expected 845200.0"):
        TerminalTimeNetwork.load(path, vehicle={**VEHICLE, "thrust_max": 900e3})
    other = {"thrust_max": 900e3, "final_position": [1.0, 0.0, 0.0]}
    with pytest.raises(InvalidInputError, match=r"final_position: got .*; thrust_max differ too"):
        TerminalTimeNetwork.load(path, vehicle=other)
    with pytest.raises(InvalidInputError, match="final_position"):
        TerminalTimeNetwork.load(path, vehicle={"thrust_max": 845.2e3})


def test_vehicle_has_what_fixes_the_optimum() -> None:
    problem = problems.get("powered_descent")
    table = problem.table
    names = set(problem.vehicle_of(table.unpack(table.pack())))
    assert {"thrust_min", "thrust_max", "specific_impulse", "gravity", "final_position"} <= names
    assert not names & {"initial_position", "initial_mass", "terminal_time", "trust_region_control"}


def test_changed_bytes_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "net.safetensors"
    network().save(path)
    content = bytearray(path.read_bytes())
    content[-5] ^= 1  # in the middle of a weight
    path.write_bytes(bytes(content))
    with pytest.raises(NetworkFileError, match="checksum"):
        TerminalTimeNetwork.load(path)


@pytest.mark.parametrize("length", [0, 4, 100, -8])
def test_truncated_file(tmp_path: Path, length: int) -> None:
    path = tmp_path / "net.safetensors"
    network().save(path)
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(NetworkFileError, match="safetensors"):
        TerminalTimeNetwork.load(path)


@pytest.mark.parametrize("document", ["", "[]", "{}", '{"format": "other"}', "{"])
def test_safetensors_of_something_else(tmp_path: Path, document: str) -> None:
    path = tmp_path / "other.safetensors"
    path.write_bytes(save({"a": np.zeros(3)}, {"document": document}))
    with pytest.raises(NetworkFileError, match=r"other\.safetensors"):
        TerminalTimeNetwork.load(path)


def test_later_format(tmp_path: Path) -> None:
    path = tmp_path / "net.safetensors"
    document = json.dumps({"format": "dscp_terminal_time_network", "version": 99})
    path.write_bytes(save({"a": np.zeros(3)}, {"document": document}))
    with pytest.raises(NetworkFileError, match="version 99"):
        TerminalTimeNetwork.load(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        TerminalTimeNetwork.load(tmp_path / "none.safetensors")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"feature_scale": np.zeros(5)}, "feature_scale"),
        ({"feature_center": np.full(5, np.nan)}, "feature_center"),
        ({"feature_center": np.zeros(6)}, "feature_center"),
        ({"interval_s": (42.0, 30.0)}, "interval_s"),
        ({"lower": np.full(7, 1e9)}, "lower"),
        ({"weights": ()}, "layers"),
        ({"biases": (np.zeros(64),) * 4}, "layer 3 bias"),
        ({"intervals": 1}, "intervals"),
    ],
)
def test_inconsistent_network(change: dict[str, object], match: str) -> None:
    with pytest.raises(InvalidInputError, match=match):
        replace(network().data, **change)


def test_single_precision_is_refused() -> None:
    data = network().data
    with pytest.raises(InvalidInputError, match="float64"):
        replace(data, weights=(data.weights[0].astype(np.float32), *data.weights[1:]))


def test_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "net.safetensors"
    network().save(path)
    before = path.read_bytes()

    def no_space(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(FileWriteError, match="No space left"):
        network(seed=1).save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["net.safetensors"], "nothing is left behind"


def test_unwritable_place(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileWriteError):
        replace_file(tmp_path / "file" / "net.safetensors", b"")


def test_needs_no_torch(tmp_path: Path) -> None:
    path = tmp_path / "net.safetensors"
    network().save(path)
    code = (
        "import sys, numpy\n"
        "from dscp_core.planning.terminal_time_network import TerminalTimeNetwork\n"
        f"net = TerminalTimeNetwork.load({str(path)!r})\n"
        f"net.predict(numpy.array({STATE.tolist()}))\n"
        "sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
