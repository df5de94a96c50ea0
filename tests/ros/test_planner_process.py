"""Start and end of the node's process: signals, exit codes, refused command lines."""

from __future__ import annotations

import signal
import subprocess
import sys
from contextlib import suppress

import pytest
from ros.planner_support import (
    ROOT,
    START_TIMEOUT_S,
    PlannerClient,
    running_planner,
    start,
)

# An attempt that cannot converge, and goes on until its deadline of many seconds.
ENDLESS = """\
/**:
  ros__parameters:
    cost_tolerance: 1.0e-15
    defect_tolerance: 1.0e-15
    virtual_control_tolerance: 1.0e-15
    max_iterations: 1000
    intervals: 1000
"""


# A launcher and a terminal may both send the signal.
REPEAT_AFTER_S = 0.05


def end(process: subprocess.Popen[str], number: signal.Signals) -> str:
    process.send_signal(number)
    with suppress(subprocess.TimeoutExpired):
        process.wait(REPEAT_AFTER_S)
    process.send_signal(number)
    output, _ = process.communicate(timeout=START_TIMEOUT_S)
    return output


def test_sigterm_ends_the_idle_node_with_code_0(ros):
    with running_planner(ros) as (_, process):
        output = end(process, signal.SIGTERM)
        assert process.returncode == 0, output
        assert "Traceback" not in output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_the_middle_of_a_plan_ends_the_node_with_code_0(ros, tmp_path, number):
    path = tmp_path / "endless.yaml"
    path.write_text(ENDLESS)
    with running_planner(ros, ["--params-file", str(path)]) as (client, process):
        client.send()
        # The health says that the state was taken; it has no report yet.
        client.wait_for(
            lambda: any(
                pair.key == "received" and pair.value == "1"
                for message in client.diagnostics
                for pair in message.status[0].values
            )
        )
        assert not client.report_messages
        output = end(process, number)
        assert process.returncode == 0, output
        assert "Traceback" not in output
        assert "unfinished" in output


def test_a_signal_during_the_start_ends_the_process_with_code_0(ros):
    process = start(ros)
    try:
        assert ros.wait_for(lambda: _handles_sigterm(process.pid), START_TIMEOUT_S)
        output = end(process, signal.SIGTERM)
        assert process.returncode == 0, output
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def _handles_sigterm(pid: int) -> bool:
    with open(f"/proc/{pid}/status") as status:
        caught = next(line for line in status if line.startswith("SigCgt:"))
    return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)


def refused(arguments: list[str], ros) -> str:
    result = subprocess.run(
        [sys.executable, "-m", "dscp_ros.planner.main", *arguments],
        cwd=ROOT,
        env=ros.child_env(),
        capture_output=True,
        text=True,
        timeout=START_TIMEOUT_S,
    )
    assert result.returncode == 2, result.stderr
    assert "Traceback" not in result.stderr
    return result.stderr


def test_a_misspelt_parameter_in_a_file_is_refused(ros, tmp_path):
    path = tmp_path / "misspelt.yaml"
    path.write_text("/**:\n  ros__parameters: {dedline_s: 1.0, parameters: {thrust_mx: 1.0}}\n")
    message = refused(["--params-file", str(path)], ros)
    assert "dedline_s (did you mean deadline_s?)" in message
    assert "thrust_mx (did you mean parameters.thrust_max" in message


def test_a_misspelt_node_name_in_a_file_is_refused(ros, tmp_path):
    path = tmp_path / "misspelt.yaml"
    path.write_text("planer:\n  ros__parameters: {deadline_s: 1.0}\n")
    message = refused(["--params-file", str(path)], ros)
    assert "planer" in message
    assert "did you mean /planner?" in message


def test_ros_errors_are_bad_input(ros):
    assert "--bogus" in refused(["--ros-args", "--bogus"], ros)


def test_the_command_line_runs_the_node_until_sigint(ros):
    process = subprocess.Popen(
        [sys.executable, "-c", "from dscp_ros.cli.main import main; raise SystemExit(main())",
         "planner", "--params-file", "config/powered_descent.yaml", "--ros-args", "-p",
         "intervals:=60"],
        cwd=ROOT,
        env=ros.child_env(),
        stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    try:
        client = PlannerClient(ros)
        client.wait_until_connected(process)
        assert client.send_and_report().published
        client.wait_for(lambda: client.trajectories)
        assert len(client.trajectories[-1].points) == 61
        end(process, signal.SIGINT)
        assert process.returncode == 0
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
