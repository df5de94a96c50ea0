"""Parameter sets: what is written is read back, by rcl too, and nothing else is."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from learning_support import network as random_network

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_ros.parameter_set import (
    NETWORK_FILE,
    PARAMETERS_FILE,
    PROVENANCE_FILE,
    ParameterSet,
    ParameterSetError,
    directory_of,
    load,
    save,
)
from dscp_ros.parameter_set.format import file_digest, provenance_text, read_provenance
from dscp_ros.parameter_set.renaming import exchange, exchange_in_steps
from dscp_ros.planner.parameter_files import parameter_arguments
from dscp_ros.planner.parameter_server import ParameterServer

TABLE = problems.get("powered_descent").table
DEFAULTS = TABLE.unpack(TABLE.pack())
VALUES: dict[str, Any] = {
    "intervals": 40,
    "solver": "qoco",
    "landing_frame": "1e3",  # a text that looks like a number
    "terminal_time_source": "predicted",
    "parameters.final_position": [1.0, 2.0, 3.0],
    "parameters.thrust_prox": 1e-8,
    "parameters.virtual_control_weight": 3e22,
    "parameters.trust_region_state": [0.0, 1e-300, 0.1, 1.0, 2.0, 1e7, 123456789.123],
}
PROVENANCE = {"logs": [{"path": "a.mcap"}], "options": {"seed": 1}}


def parameters(**changes: object) -> dict[str, Any]:
    """Those that fix the optimum, core axes, of VALUES' vehicle."""
    values = {**DEFAULTS, "final_position": [3.0, 1.0, 2.0], **changes}
    return dict(problems.get("powered_descent").vehicle_of(values))


def fitting_network(seed: int = 0, **changes: object) -> TerminalTimeNetwork:
    """A network of that vehicle."""
    data = random_network(seed=seed).data
    return TerminalTimeNetwork(replace(data, vehicle=parameters(**changes)))


def saved(directory: Path) -> ParameterSet:
    return save(directory, VALUES, fitting_network(), PROVENANCE)


def change_provenance(directory: Path, **changes: object) -> None:
    """Change it together with its checksum, as somebody who knows the format could."""
    path = directory / PROVENANCE_FILE
    path.write_text(provenance_text({**read_provenance(path), **changes}))


def test_a_set_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    written = saved(tmp_path / "set")
    read = load(tmp_path / "set")
    assert read.identifier == written.identifier
    assert read.label == f"set@{read.identifier}"
    assert len(read.identifier) == 12
    assert (read.problem, read.formulation) == ("powered_descent", "convergent")
    assert {
        name: value for name, value in read.values.items() if name not in ("problem", "formulation")
    } == {**VALUES, "terminal_time_network": NETWORK_FILE}
    assert read.network == tmp_path / "set" / NETWORK_FILE
    assert read.terminal_time_network is not None
    state = [5000.0, 500.0, 500.0, -150.0, 30.0, -30.0, 38000.0]
    assert read.terminal_time_network.predict(state) == fitting_network().predict(state)
    assert read.provenance["logs"] == PROVENANCE["logs"]
    assert read.vehicle["final_position"] == [3.0, 1.0, 2.0]
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["set"]


def test_the_identifier_is_that_of_the_content(tmp_path: Path) -> None:
    first = saved(tmp_path / "a")
    same = save(tmp_path / "b", VALUES, fitting_network(), {"options": {"seed": 2}})
    other = save(tmp_path / "c", VALUES, fitting_network(seed=1))
    without = save(tmp_path / "d", {"intervals": 40})
    assert first.identifier == same.identifier
    assert len({first.identifier, other.identifier, without.identifier}) == 3
    assert without.network is None
    assert without.terminal_time_network is None


def test_the_node_reads_it_through_rcl(tmp_path: Path, ros: Any) -> None:
    from rclpy.node import Node

    saved(tmp_path / "set")
    words = ["--ros-args", "--params-file", str(tmp_path / "set" / PARAMETERS_FILE)]
    node = ros.add_node(Node("planner", context=ros.context, cli_args=words))
    ParameterServer(node, parameter_arguments(words))
    for name, value in VALUES.items():
        found = node.get_parameter(name).value
        assert found == value if isinstance(value, str | int | float) else list(found) == value


def test_directory_of_a_parameter_file(tmp_path: Path) -> None:
    saved(tmp_path / "set")
    assert directory_of(tmp_path / "set" / PARAMETERS_FILE) == tmp_path / "set"
    (tmp_path / "other.yaml").write_text("")
    assert directory_of(tmp_path / "other.yaml") is None


def test_a_vehicle_that_the_set_was_not_made_for(tmp_path: Path) -> None:
    found = saved(tmp_path / "set")
    found.check_vehicle(parameters())
    found.check_vehicle(parameters(terminal_time=30.0, trust_region_control=[1.0, 1.0, 1.0]))
    with pytest.raises(ParameterSetError, match=r"another vehicle: thrust_max 900000.0 instead"):
        found.check_vehicle(parameters(thrust_max=9e5))


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    def apply(directory: Path) -> None:
        path = directory / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return apply


def flip_last_byte(directory: Path) -> None:
    path = directory / NETWORK_FILE
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(bytes(content))


def other_network(directory: Path) -> None:
    fitting_network(seed=1).save(directory / NETWORK_FILE)


def half(name: str) -> Callable[[Path], None]:
    def apply(directory: Path) -> None:
        content = (directory / name).read_bytes()
        (directory / name).write_bytes(content[: len(content) // 2])

    return apply


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (edit(PARAMETERS_FILE, "intervals: 40", "intervals: 41"), "parameters.yaml.*was changed"),
        (flip_last_byte, "safetensors.*was changed"),
        (other_network, "safetensors.*was changed"),
        (edit(PROVENANCE_FILE, '"seed": 1', '"seed": 2'), r"provenance.json.*was changed"),
        (half(PROVENANCE_FILE), "no JSON"),
        (half(PARAMETERS_FILE), "was changed"),
        (lambda d: (d / PROVENANCE_FILE).unlink(), "provenance.json: not readable"),
        (lambda d: (d / PARAMETERS_FILE).unlink(), "parameters.yaml: not readable"),
        (lambda d: (d / NETWORK_FILE).unlink(), "safetensors: not readable"),
        (lambda d: (d / PROVENANCE_FILE).write_bytes(b"\xff\xfe"), "not readable"),
        (lambda d: (d / PROVENANCE_FILE).write_text("[]"), "no provenance"),
        (edit(PROVENANCE_FILE, "dscp_parameter_set", "other"), "no provenance"),
        (edit(PROVENANCE_FILE, '"version": 1', '"version": 2'), "version 2.*1 expected"),
        (lambda d: change_provenance(d, files={}), "expected checksums"),
        (lambda d: change_provenance(d, files={"../x": "0"}), "expected checksums"),
        (lambda d: change_provenance(d, problem="entry"), "as in the provenance"),
        (lambda d: change_provenance(d, vehicle=None), "no mapping"),
        (lambda d: change_provenance(d, vehicle={"thrust_max": 9e5}), "of another vehicle"),
    ],
)
def test_a_changed_set_is_refused(
    tmp_path: Path, change: Callable[[Path], None], message: str
) -> None:
    saved(tmp_path / "set")
    change(tmp_path / "set")
    with pytest.raises(ParameterSetError, match=message) as caught:
        load(tmp_path / "set")
    assert str(caught.value).startswith(str(tmp_path / "set"))
    assert "/proc/" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("intervals: 4", r"intervals: got 4, expected \[5, 1000\]"),
        ("intervals: 40.0", "a whole number"),
        ("parameters: {thrust_max: 845200}", "a number with a point"),
        ("parameters: {thrust_max: .nan}", "finite"),
        ("parameters: {thrust_mx: 1.0}", "did you mean parameters.thrust_max"),
        ("parameters: {trust_region_control: [1.0, 2.0]}", "3 numbers"),
        ("parameters: {trust_region_control: [1.0, 2.0, -3.0]}", r"\[0, inf\]"),
        ("parameters: {thrust_min: 9.0e+5}", "thrust_min"),
        ("solver: none", "solver"),
        ("terminal_time_network: ../other.safetensors", "names its own file"),
        ("terminal_time_network: terminal_time.safetensors", "names its own file"),
    ],
)
def test_bounds_and_schema_are_checked(tmp_path: Path, text: str, message: str) -> None:
    directory = tmp_path / "set"
    save(directory, {"intervals": 40})
    (directory / PARAMETERS_FILE).write_text(f"/**: {{ros__parameters: {{{text}}}}}")
    change_provenance(directory, files={PARAMETERS_FILE: file_digest(directory / PARAMETERS_FILE)})
    with pytest.raises(ParameterSetError, match=message):
        load(directory)


def test_no_directory(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for name in ("none", "file"):
        with pytest.raises(ParameterSetError, match="no parameter set"):
            load(tmp_path / name)


def test_bad_values_are_not_written(tmp_path: Path) -> None:
    for values in ({"intervals": 4}, {"intervls": 40}, {"parameters.thrust_max": 1}):
        with pytest.raises(InvalidInputError):
            save(tmp_path / "set", values)
    with pytest.raises(ParameterSetError, match="thrust_max"):
        save(tmp_path / "set", VALUES, fitting_network(thrust_max=9e5))
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_kept_unless_told_otherwise(tmp_path: Path) -> None:
    directory = tmp_path / "sets" / "first"
    before = saved(directory)
    with pytest.raises(ParameterSetError, match="not overwritten"):
        save(directory, {"intervals": 40})
    assert load(directory).identifier == before.identifier
    after = save(directory, {"intervals": 40}, overwrite=True)
    assert load(directory).identifier == after.identifier != before.identifier
    assert sorted(entry.name for entry in directory.iterdir()) == [PARAMETERS_FILE, PROVENANCE_FILE]
    assert [entry.name for entry in directory.parent.iterdir()] == ["first"]


def test_only_sets_are_overwritten(tmp_path: Path) -> None:
    directory = tmp_path / "set"
    saved(directory)
    (directory / "notes.txt").write_text("mine")
    with pytest.raises(ParameterSetError, match=r"holds more than a parameter set \(notes.txt\)"):
        save(directory, {"intervals": 40}, overwrite=True)
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(directory)
    for name in ("file", "link"):
        with pytest.raises(ParameterSetError, match="no directory"):
            save(tmp_path / name, {"intervals": 40}, overwrite=True)
    assert (tmp_path / "file").read_text() == "mine"
    (tmp_path / "empty").mkdir()
    assert save(tmp_path / "empty", {"intervals": 40}).identifier


@pytest.mark.parametrize("swap", [exchange, exchange_in_steps])
def test_directories_are_exchanged_or_stay(
    tmp_path: Path, swap: Callable[[Path, Path], None]
) -> None:
    for name in ("new", "old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
    swap(tmp_path / "new", tmp_path / "old")
    assert [entry.name for entry in (tmp_path / "old").iterdir()] == ["new"]
    assert [entry.name for entry in (tmp_path / "new").iterdir()] == ["old"]
    with pytest.raises(FileNotFoundError):
        swap(tmp_path / "none", tmp_path / "old")
    assert [entry.name for entry in (tmp_path / "old").iterdir()] == ["new"]
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["new", "old"]


def test_provenance_is_strict_json(tmp_path: Path) -> None:
    saved(tmp_path / "set")
    document = json.loads((tmp_path / "set" / PROVENANCE_FILE).read_text())
    assert set(document["files"]) == {PARAMETERS_FILE, NETWORK_FILE}
    with pytest.raises(ValueError, match="not JSON compliant"):
        save(tmp_path / "other", VALUES, fitting_network(), {"loss": float("nan")})
    assert [entry.name for entry in tmp_path.iterdir()] == ["set"]
