"""What a tuning starts from: parameter files, sets and networks, as the node would take them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from learning_support import network

from dscp_core import problems
from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.planning.planner import TerminalTime
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_core.tuning.quantities import parse_tuned
from dscp_ros.parameter_set import PARAMETERS_FILE, save
from dscp_ros.parameter_set.values import check_values
from dscp_ros.tuning.outcome import set_values
from dscp_ros.tuning.start import check_tuned, read_start

PROBLEM = problems.get("powered_descent")
VALUES = PROBLEM.table.unpack(PROBLEM.table.pack())
PREDICTED = "terminal_time_source: predicted"


def parameter_file(folder: Path, text: str, name: str = "p.yaml") -> Path:
    (folder / name).write_text(f"/**: {{ros__parameters: {{{text}}}}}")
    return folder / name


def other_network(path: Path, **changes: float) -> TerminalTimeNetwork:
    found = TerminalTimeNetwork(
        replace(
            network().data,
            vehicle=problems.get("powered_descent").vehicle_of({**VALUES, **changes}),
        )
    )
    found.save(path)
    return found


def test_without_files_it_is_what_the_node_has() -> None:
    start = read_start([], "/planner")
    assert start.values.planner == check_values({}).planner
    assert (start.network is not None) == (
        start.values.planner.terminal_time is TerminalTime.PREDICTED
    )


def test_a_network_that_is_tuned_makes_the_time_predicted(tmp_path: Path) -> None:
    free = parameter_file(tmp_path, "terminal_time_source: free")
    assert read_start([free], "/planner").network is None
    start = read_start([free], "/planner", tunes_network=True)
    assert start.values.planner.terminal_time is TerminalTime.PREDICTED
    assert start.network is not None
    assert start.origin["network"] == "shipped"
    assert "it was free" in start.notes[0]


def test_a_network_is_relative_to_the_file_that_names_it(tmp_path: Path) -> None:
    other_network(tmp_path / "n.safetensors")
    file = parameter_file(tmp_path, f"{PREDICTED}, terminal_time_network: n.safetensors")
    start = read_start([file], "/planner")
    assert start.network is not None
    assert start.network.data.interval_s == network().data.interval_s
    (tmp_path / "n.safetensors").unlink()
    with pytest.raises(OSError, match=r"n\.safetensors"):
        read_start([file], "/planner")


def test_a_network_of_another_vehicle(tmp_path: Path) -> None:
    heavy = parameter_file(tmp_path, f"{PREDICTED}, parameters: {{thrust_max: 9.0e+5}}")
    start = read_start([heavy], "/planner")
    assert start.network is None
    assert start.values.planner.terminal_time is TerminalTime.FREE
    assert "thrust_max: got 900000.0" in start.notes[0]

    tuned = read_start([heavy], "/planner", tunes_network=True)
    assert tuned.network is not None
    assert "starts from one of another vehicle: thrust_max" in tuned.notes[0]

    path = tmp_path / "light.safetensors"
    other_network(path, thrust_max=8e5)
    with pytest.raises(InvalidInputError, match="thrust_max"):
        read_start([heavy], "/planner", network=path)
    assert read_start([heavy], "/planner", network=path, tunes_network=True).network is not None


def test_a_set_to_start_from(tmp_path: Path) -> None:
    own = other_network(tmp_path / "n.safetensors")
    found = save(tmp_path / "set", {"intervals": 20, "terminal_time_source": "predicted"}, own)
    file = tmp_path / "set" / PARAMETERS_FILE
    start = read_start([file], "/planner")
    assert start.values.planner.intervals == 20
    assert start.network is not None
    assert start.network.data.interval_s == own.data.interval_s
    assert start.origin["parameter_sets"] == [found.label]

    heavy = parameter_file(tmp_path, "parameters: {thrust_max: 9.0e+5}")
    with pytest.raises(DscpError, match=r"of another vehicle: thrust_max 900000\.0"):
        read_start([file, heavy], "/planner")
    file.write_text(file.read_text().replace("20", "21"))
    with pytest.raises(DscpError, match="was changed"):
        read_start([file], "/planner")


def test_names_of_node_and_problem(tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text("ship: {ros__parameters: {intervals: 20}}")
    assert read_start([path], "/ship").values.planner.intervals == 20
    with pytest.raises(InvalidInputError, match="a section for /planner"):
        read_start([path], "/planner")
    file = parameter_file(tmp_path, "problem: powered_descent")
    with pytest.raises(InvalidInputError, match="as in the files"):
        read_start([file], "/planner", problem="entry")
    assert read_start([], "/planner", problem="entry").values.problem.name == "entry"
    with pytest.raises(InvalidInputError, match="a problem that has networks"):
        read_start([], "/planner", problem="entry", tunes_network=True)


def test_a_vehicle_is_not_tuned_under_its_network(tmp_path: Path) -> None:
    start = read_start([parameter_file(tmp_path, PREDICTED)], "/planner")
    check_tuned(start, parse_tuned(PROBLEM, "trust_region_control"))
    check_tuned(start, parse_tuned(PROBLEM, "thrust_max=8e5:9e5,network"))
    with pytest.raises(InvalidInputError, match="together with network"):
        check_tuned(start, parse_tuned(PROBLEM, "trust_region_control,thrust_max=8e5:9e5"))
    free = read_start([parameter_file(tmp_path, "terminal_time_source: free")], "/planner")
    check_tuned(free, parse_tuned(PROBLEM, "thrust_max=8e5:9e5"))


@pytest.mark.parametrize("problem", problems.names())
def test_a_set_says_everything_that_decides_about_plans(problem: str, tmp_path: Path) -> None:
    start = read_start([], "/planner", problem=problem)
    tuned = {"terminal_time": 33.0} if problem == "powered_descent" else {"terminal_time": 2400.0}
    values = set_values(start.values, tuned)
    found = save(tmp_path / "set", values, start.network)
    again = check_values(found.values)
    expected = {**start.values.parameters, **tuned}
    for name, value in again.parameters.items():
        assert value == pytest.approx(expected[name], rel=0.0, abs=0.0)
    assert replace(again.planner, parameters={}) == replace(start.values.planner, parameters={})
