"""Predicted terminal times and parameter sets in the running node."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rclpy.parameter import Parameter
from ros.planner_support import (
    ROOT,
    START_TIMEOUT_S,
    STATE,
    local_planner,
    running_planner,
)

from dscp_core.errors import InvalidInputError
from dscp_core.planning.plan import PlanStatus
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_core.problems.powered_descent.definition import NETWORK
from dscp_ros.parameter_set import ParameterSet, ParameterSetError, save
from dscp_ros.planner.parameter_files import ParameterArguments

PREDICTED = {"terminal_time_source": "predicted"}
# A little less thrust than the vehicle of the shipped network: its predictions stay feasible.
WEAK = {"parameters.thrust_max": 840000.0}


def shipped(**changes: object) -> TerminalTimeNetwork:
    return TerminalTimeNetwork(replace(TerminalTimeNetwork.load(NETWORK).data, **changes))


def weak_network() -> TerminalTimeNetwork:
    """The shipped one, as if it had been trained for less thrust and for lighter vehicles too."""
    data = shipped().data
    lower = np.array([*data.lower[:6], 30000.0])
    return shipped(vehicle={**data.vehicle, "thrust_max": 840000.0}, lower=lower)


def arguments(parameter_set: ParameterSet | Path, *names: str) -> ParameterArguments:
    """What a command line with this set, and with -p for these names, gives."""
    folder = parameter_set.directory if isinstance(parameter_set, ParameterSet) else parameter_set
    return ParameterArguments((str(folder / "parameters.yaml"),), frozenset(names), ())


def write(path: Path, **values: str) -> Path:
    lines = "".join(f"    {name}: {value}\n" for name, value in values.items())
    path.write_text(f"/**:\n  ros__parameters:\n{lines}")
    return path


# Predicted terminal times


def test_the_shipped_network_is_used_by_default_and_reported(ros):
    with local_planner(ros) as (client, _):
        report = client.send_and_report()
        assert report.published
        assert report.attempt.terminal_time_source == "predicted"
        assert report.attempt.terminal_time_reason is None
        expected = TerminalTimeNetwork.load(NETWORK).predict(STATE)
        assert report.attempt.terminal_time_predicted_s == expected
        assert report.attempt.terminal_time_used_s == expected
        assert report.parameter_set == "none"


def test_a_state_outside_the_envelope_gets_a_free_terminal_time_and_the_report_says_why(ros):
    with local_planner(ros, **PREDICTED) as (client, _):
        burnt = client.send_and_report(STATE - [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 500.0])
        assert burnt.published
        assert burnt.attempt.terminal_time_source == "free"
        assert burnt.attempt.terminal_time_predicted_s is None
        assert burnt.attempt.terminal_time_reason.startswith("mass: got 37500.0, expected [")


def test_the_shipped_network_gives_way_to_another_vehicle(ros):
    with local_planner(ros, **PREDICTED, **WEAK) as (client, planner):
        report = client.send_and_report()
        assert report.published
        assert report.attempt.terminal_time_source == "free"
        assert report.attempt.terminal_time_reason.startswith("thrust_max: got 840000.0")
        # It is for this vehicle again.
        change = [Parameter("parameters.thrust_max", value=845200.0)]
        assert planner._node.set_parameters(change)[0].successful
        assert client.send_and_report().attempt.terminal_time_source == "predicted"


def test_a_named_network_of_another_vehicle_is_refused(ros, tmp_path):
    path = tmp_path / "weak.safetensors"
    weak_network().save(path)
    named = {"terminal_time_network": str(path)}
    misfit = local_planner(ros, **PREDICTED, **named)
    with pytest.raises(InvalidInputError, match=r"thrust_max: got 845200\.0, expected 840000\.0"):
        misfit.__enter__()
    with local_planner(ros, **PREDICTED, **WEAK, **named) as (client, planner):
        assert client.send_and_report().attempt.terminal_time_source == "predicted"
        change = [Parameter("parameters.thrust_max", value=800000.0)]
        (result,) = planner._node.set_parameters(change)
        assert not result.successful
        assert "thrust_max: got 800000.0" in result.reason
        assert client.send_and_report().attempt.terminal_time_source == "predicted"


def test_a_network_file_that_is_none_is_refused(ros, tmp_path):
    path = tmp_path / "network.safetensors"
    free = {"terminal_time_source": "free"}
    with local_planner(ros, **free, terminal_time_network=str(path)) as (client, planner):
        node = planner._node
        for content, words in ((None, "a readable file"), (b"junk", "no readable safetensors")):
            if content is not None:
                path.write_bytes(content)
            (result,) = node.set_parameters([Parameter("terminal_time_source", value="predicted")])
            assert not result.successful
            assert words in result.reason
        assert client.send_and_report().attempt.terminal_time_source == "free"


def test_a_network_is_looked_for_beside_the_file_that_names_it(ros, tmp_path):
    shipped(interval_s=(29.0, 43.0)).save(tmp_path / "mine.safetensors")
    path = write(
        tmp_path / "p.yaml",
        terminal_time_source="predicted",
        terminal_time_network="mine.safetensors",
    )
    given = ParameterArguments((str(path),), frozenset(), ())
    named = {"terminal_time_network": "mine.safetensors"}
    with local_planner(ros, given, **PREDICTED, **named) as (client, _):
        mine = TerminalTimeNetwork.load(tmp_path / "mine.safetensors").predict(STATE)
        assert client.send_and_report().attempt.terminal_time_predicted_s == mine
        # Written over: nothing changes until it is read again.
        shipped(interval_s=(28.9, 43.1)).save(tmp_path / "mine.safetensors")
        assert client.send_and_report().attempt.terminal_time_predicted_s == mine
        assert client.call("reload").success
        other = TerminalTimeNetwork.load(tmp_path / "mine.safetensors").predict(STATE)
        assert other != mine
        report = client.send_and_report()
        assert report.attempt.terminal_time_predicted_s == other


# Parameter sets


def test_a_set_is_loaded_at_the_start_and_exchanged_by_reload(ros, tmp_path):
    folder = tmp_path / "lander"
    first = save(folder, {**PREDICTED, **WEAK}, weak_network())
    with running_planner(ros, ["--params-file", str(folder / "parameters.yaml")]) as (
        client,
        process,
    ):
        light = STATE - [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 3000.0]
        report = client.send_and_report(light)
        assert report.code == PlanStatus.CERTIFIED
        assert report.parameter_set == first.label == f"lander@{first.identifier}"
        assert report.attempt.terminal_time_source == "predicted"
        assert report.attempt.terminal_time_predicted_s == weak_network().predict(light)
        assert "torch" not in Path(f"/proc/{process.pid}/maps").read_text()

        free = {"terminal_time_source": "free"}
        second = save(folder, {**free, "intervals": 60, "deadline_s": 14.0}, overwrite=True)
        assert second.identifier != first.identifier
        assert client.send_and_report(light).parameter_set == first.label
        answer = client.call("reload")
        assert answer.success, answer.message
        assert second.label in answer.message
        report = client.send_and_report()
        # deadline_s is set by -p, which wins over files (see running_planner).
        assert report.parameter_set == f"{second.label} (changed: deadline_s)"
        client.wait_for(lambda: len(client.trajectories[-1].points) == 61)

        (folder / "parameters.yaml").write_text(
            (folder / "parameters.yaml").read_text().replace("60", "80")
        )
        answer = client.call("reload")
        assert not answer.success
        assert "the file was changed" in answer.message
        report = client.send_and_report()
        assert report.published
        assert report.parameter_set == f"{second.label} (changed: deadline_s)"


@pytest.mark.parametrize("damage", ["network", "parameters", "provenance", "missing", "vehicle"])
def test_the_old_set_stays_if_the_new_one_is_bad(ros, tmp_path, damage):
    folder = tmp_path / "lander"
    values = {**PREDICTED, **WEAK}
    first = save(folder, values, weak_network())
    with local_planner(
        ros, arguments(first), **values, terminal_time_network="terminal_time.safetensors"
    ) as (client, _):
        assert client.send_and_report().parameter_set == first.label
        save(folder, {**values, "intervals": 60}, weak_network(), overwrite=True)
        file = folder / {
            "network": "terminal_time.safetensors",
            "missing": "terminal_time.safetensors",
            "provenance": "provenance.json",
        }.get(damage, "parameters.yaml")
        if damage == "missing":
            file.unlink()
        elif damage == "vehicle":  # by its own files good, but the network is of another vehicle
            shipped().save(folder / "terminal_time.safetensors")
        else:
            content = bytearray(file.read_bytes())
            content[len(content) // 2] ^= 1
            file.write_bytes(content)
        answer = client.call("reload")
        assert not answer.success
        assert "lander" in answer.message
        report = client.send_and_report()
        assert report.published
        assert report.parameter_set == first.label
        assert report.attempt.terminal_time_source == "predicted"


def test_reports_say_what_of_the_set_was_changed(ros, tmp_path):
    values = {"intervals": 50, "cost_tolerance": 1e-6}
    one = save(tmp_path / "set", values)
    with local_planner(ros, arguments(one), **values) as (client, planner):
        assert client.send_and_report().parameter_set == one.label

        def change(name: str, value: object) -> str:
            (result,) = planner._node.set_parameters([Parameter(name, value=value)])
            assert result.successful, result.reason
            return client.send_and_report().parameter_set

        assert change("cost_tolerance", 1e-5) == f"{one.label} (changed: cost_tolerance)"
        assert change("cost_tolerance", 1e-6) == one.label
        landing = [5.0, 0.0, 0.0]
        changed = change("parameters.final_position", landing)
        assert changed == f"{one.label} (changed: parameters.final_position)"


def test_a_set_for_another_vehicle_than_the_command_line_says_is_refused(ros, tmp_path):
    one = save(tmp_path / "set", WEAK)
    with pytest.raises(ParameterSetError, match=r"thrust_max 800000\.0 instead of 840000\.0"):
        local_planner(
            ros,
            arguments(one, "parameters.thrust_max"),
            **{"parameters.thrust_max": 800000.0},
        ).__enter__()


def test_a_tampered_set_is_refused_at_the_start(ros, tmp_path):
    one = save(tmp_path / "set", {**PREDICTED, **WEAK}, weak_network())
    with (one.directory / "terminal_time.safetensors").open("ab") as file:
        file.write(b"\0")
    result = subprocess.run(
        [sys.executable, "-m", "dscp_ros.planner.main", "--params-file",
         str(one.directory / "parameters.yaml")],
        cwd=ROOT, env=ros.child_env(), capture_output=True, text=True, timeout=START_TIMEOUT_S,
    )  # fmt: skip
    assert result.returncode == 2, result.stderr
    assert "Traceback" not in result.stderr
    assert "terminal_time.safetensors: content and checksum differ" in result.stderr
