"""`dscp tune`: from logs to a parameter set, and everything that can be wrong on the way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from learning_support import network
from sensor_msgs.msg import JointState

from dscp_core import problems
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_core.tuning import tuner
from dscp_core.workers.processes import SerialEngine
from dscp_ros.bag import BagWriter, Qos
from dscp_ros.cli import ExitCode
from dscp_ros.cli import main as frame
from dscp_ros.parameter_set import PARAMETERS_FILE, load, save
from dscp_ros.tuning.sources import file_digests
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import problem_layout
from msg_adapters.state import StampedState

ROOT = Path(__file__).resolve().parents[2]
LAYOUT = problem_layout(problems.get("powered_descent"))
CENTRE = np.array([5200.0, 0.0, 0.0, -135.0, 0.0, 0.0, 38000.0])
SPREAD = np.array([200.0, 600.0, 600.0, 15.0, 30.0, 30.0, 0.0])
HOPELESS = np.array([1400.0, 0.0, 0.0, -200.0, 0.0, 0.0, 38000.0])
START_NS = 1_700_000_000_000_000_000
SECOND_NS = 10**9
# A coarse grid: the tests are about what happens to the numbers, not about their worth.
SETTINGS = "/**: {ros__parameters: {intervals: 20, deadline_s: 2.0, terminal_time_source: free}}"

KILLED_AT_THE_SECOND_CHECKPOINT = """
import os, signal, sys
from dscp_ros.cli.main import main
count = 0
def hook(name, arguments):
    global count
    if name == "os.rename" and str(arguments[1]).endswith("checkpoint.safetensors"):
        count += 1
        if count == 2:
            os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(hook)
sys.exit(main())
"""


def write_log(path: Path, states: Sequence[np.ndarray]) -> Path:
    with BagWriter(path) as bag:
        bag.add_topic("/planner/vehicle_state", JointState, Qos())
        for k, values in enumerate(states):
            stamp_ns = START_NS + k * SECOND_NS
            message = joint_state_from_state(StampedState(stamp_ns, values), LAYOUT)
            bag.write("/planner/vehicle_state", message, stamp_ns)
    return path


def states(count: int, seed: int) -> list[np.ndarray]:
    unit = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 7))
    return list(CENTRE + SPREAD * unit)


@dataclass(frozen=True)
class Case:
    """Two small logs and a parameter file."""

    folder: Path

    @property
    def logs(self) -> list[str]:
        return [str(self.folder / "a"), str(self.folder / "b.mcap")]

    def arguments(
        self, output: Path, *more: str, parameters: str = "trust_region_control"
    ) -> list[str]:
        return [
            *("tune", *self.logs, "--parameters", parameters, "--output", str(output)),
            *("--params-file", str(self.folder / "vehicle.yaml"), "--loss", "convergence"),
            *("--epochs", "2", "--workers", "1", "--held-out-share", "0.5", *more),
        ]


@pytest.fixture(scope="module", autouse=True)
def in_this_process() -> Iterator[None]:
    """Spares every tuning the start of a worker process; the one that is killed has its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuner, "make_engine", lambda setup, *_: SerialEngine(setup))
        yield


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("logs")
    write_log(folder / "a", states(3, seed=1))
    write_log(folder / "b.mcap", [*states(2, seed=2), CENTRE * [1, 1, 1, 1, 1, 1, 300]])
    (folder / "vehicle.yaml").write_text(SETTINGS)
    return Case(folder)


@pytest.fixture(scope="module")
def finished(case: Case, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, int]:
    """A tuning from beginning to end: the set, what was printed, the exit code."""
    import contextlib
    import io

    output, text = tmp_path_factory.mktemp("sets") / "set", io.StringIO()
    with contextlib.redirect_stdout(text):
        code = frame.main(case.arguments(output, "--json", "--even-if-worse"))
    return output, text.getvalue(), code


def test_a_set_is_written_with_its_provenance(case: Case, finished: tuple[Path, str, int]) -> None:
    output, text, code = finished
    assert code == ExitCode.OK
    printed = json.loads(text)
    found = load(output)
    assert printed["parameter_set"] == found.label
    assert [entry.name for entry in output.parent.iterdir()] == ["set"]

    values = found.values
    assert values["intervals"] == 20
    assert values["deadline_s"] == 2.0
    assert values["terminal_time_source"] == "free"
    tuned = printed["tuned_values"]["trust_region_control"]
    assert all(0.0 < weight < 1.0 and weight != 1e-3 for weight in tuned)
    assert values["parameters.trust_region_control"] == [tuned[1], tuned[2], tuned[0]]
    declared = {f"parameters.{name}" for name in problems.get("powered_descent").table.names}
    missing = declared - set(values)
    assert missing == {f"parameters.initial_{n}" for n in ("position", "velocity", "mass")}

    provenance = found.provenance
    logs = {Path(log["path"]).name: log for log in provenance["logs"]}
    for name, log in logs.items():
        assert log["sha256"] == file_digests(case.folder / name)
        assert log["start_ns"] == START_NS
        assert log["end_ns"] == START_NS + 2 * SECOND_NS
        assert log["start"] == "2023-11-14T22:13:20+00:00"
    assert logs["b.mcap"]["refused"] == {"OUTSIDE_ENVELOPE": 1}
    usable = {"a": 3, "b.mcap": 2}
    for name, log in logs.items():
        assert {log["training_states"], log["held_out_states"]} == {0, usable[name]}
    assert len(provenance["loss_history"]) == 2
    assert provenance["options"]["loss"] == "convergence"
    assert provenance["options"]["seed"] == 0
    assert provenance["made_by"]["version"]
    assert provenance["tuned"][0]["name"] == "trust_region_control"
    for when in ("before", "after"):
        figures = provenance["held_out"][when]
        assert figures == printed["held_out"][when]
        assert figures["failures"] == 0
        assert figures["states"] in (2, 3)


def test_the_node_takes_it(finished: tuple[Path, str, int]) -> None:
    from dscp_ros.planner.parameter_files import ParameterArguments
    from dscp_ros.planner.parameter_sources import read_sources

    output = finished[0]
    files = (str(output / PARAMETERS_FILE),)
    sources = read_sources(ParameterArguments(files, frozenset(), ()), "/planner")
    assert [one.identifier for one in sources.sets] == [load(output).identifier]


def test_kill_and_resume_end_where_an_undisturbed_run_does(
    case: Case, finished: tuple[Path, str, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "set"
    arguments = case.arguments(output, "--json", "--even-if-worse")
    done = subprocess.run(
        [sys.executable, "-c", KILLED_AT_THE_SECOND_CHECKPOINT, *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    left = [path.name for path in (tmp_path / "set.tuning").iterdir()]
    assert "checkpoint.safetensors" in left
    assert not output.exists()

    assert frame.main(arguments) == ExitCode.BAD_INPUT
    assert "resume" in json.loads(capsys.readouterr().out)["error"]["message"]
    other = case.arguments(output, "--resume", "--seed", "1")
    assert frame.main(other) == ExitCode.BAD_INPUT
    assert "seed = 0, not 1" in capsys.readouterr().err
    assert frame.main([*arguments, "--resume"]) == ExitCode.OK
    assert load(output).identifier == load(finished[0]).identifier
    assert [entry.name for entry in tmp_path.iterdir()] == ["set"]


def test_a_set_that_is_not_better_is_not_written(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Iterations are whole numbers; a step of 1e-9 changes none."""
    output = tmp_path / "set"
    before = save(output, {"intervals": 20})
    arguments = case.arguments(output, "--overwrite", "--epochs", "1", "--learning-rate", "1e-9")
    arguments += ["--loss", "iterations", "--states", "2"]
    assert frame.main(arguments) == ExitCode.NOT_BETTER
    printed = capsys.readouterr()
    assert "nothing is written" in printed.err
    for word in (
        "before",
        "after",
        "loss (iterations)",
        "failures",
        "time per state",
        "1 of 2 logs",
    ):
        assert word in printed.out
    assert load(output).identifier == before.identifier
    assert (tmp_path / "set.tuning").is_dir()

    assert frame.main([*arguments, "--resume", "--even-if-worse"]) == ExitCode.OK
    assert "wrote" in capsys.readouterr().out
    assert load(output).identifier != before.identifier
    assert load(output).provenance["held_out"]["improved"] is False
    assert [entry.name for entry in tmp_path.iterdir()] == ["set"]


def test_a_network_goes_into_the_set(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = problems.get("powered_descent").table
    start = replace(
        network().data,
        vehicle=problems.get("powered_descent").vehicle_of(table.unpack(table.pack())),
        interval_s=(38.0, 42.0),
    )
    TerminalTimeNetwork(start).save(tmp_path / "start.safetensors")
    output = tmp_path / "set"
    arguments = case.arguments(output, "--even-if-worse", "--epochs", "1", parameters="network")
    arguments += ["--network", str(tmp_path / "start.safetensors"), "--loss", "fuel"]
    assert frame.main([*arguments, "--states", "2"]) == ExitCode.OK
    assert "terminal_time_source is predicted" in capsys.readouterr().err
    found = load(output)
    assert found.values["terminal_time_source"] == "predicted"
    assert found.provenance["start"]["network"].endswith("start.safetensors")
    assert found.provenance["best_epoch"] == 1
    assert found.terminal_time_network is not None
    before, after = TerminalTimeNetwork(start), found.terminal_time_network
    assert after.predict(CENTRE) < before.predict(CENTRE)  # it was too long


@pytest.mark.parametrize(
    ("parameters", "more", "message"),
    [
        ("trust_region_contrl", (), "did you mean trust_region_control"),
        ("networ", (), "did you mean network"),
        ("thrust_max=9e5:8e5", (), "bounds of thrust_max"),
        ("thrust_max", (), "LOWER:UPPER"),
        ("thrust_min=1e5:9e5,thrust_max=8e5:9e5", (), "bounds of thrust_min"),
        ("initial_mass=1:2", (), "those come from the logs"),
        ("network", ("--problem", "entry"), "network"),
        ("trust_region_control", ("--problem", "entr"), "problem"),
        ("trust_region_control", ("--loss", "fule"), "fuel"),
        ("trust_region_control", ("--optimiser", "sgd"), "adam"),
        ("trust_region_control", ("--epochs", "0"), "epochs"),
        ("trust_region_control", ("--held-out-share", "1.5"), "--held-out-share"),
        ("trust_region_control", ("--held-out", "x"), "not together"),
        ("trust_region_control", ("--topic", "state=/x"), "NAME:=/TOPIC"),
        ("trust_region_control", ("--topic", "path:=/x"), "one of state"),
        ("trust_region_control", ("--node", "/other"), "/other/vehicle_state"),
        ("trust_region_control", ("--states", "1"), "--states"),
        ("trust_region_control", ("--resume",), "checkpoint"),
        ("trust_region_control", ("--network", "none.safetensors"), "none.safetensors"),
        ("trust_region_control", ("--params-file", "none.yaml"), "none.yaml"),
    ],
)
def test_bad_arguments(
    case: Case,
    parameters: str,
    more: tuple[str, ...],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments = case.arguments(tmp_path / "set", *more, parameters=parameters)
    assert frame.main(arguments) == ExitCode.BAD_INPUT
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_logs_that_cannot_be_used(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty.mcap").write_bytes(b"")
    write_log(tmp_path / "silent", [])
    write_log(tmp_path / "outside", [CENTRE * [1, 1, 1, 1, 1, 1, 300]] * 3)
    (tmp_path / "copy.mcap").write_bytes((case.folder / "b.mcap").read_bytes())
    for name, message in (
        ("empty.mcap", "empty.mcap"),
        ("silent", "with messages on /planner/vehicle_state"),
        ("outside", "refused: OUTSIDE_ENVELOPE 3"),
        ("copy.mcap", "each log once"),
        ("none", "none"),
    ):
        arguments = case.arguments(tmp_path / "set")
        arguments.insert(1, str(tmp_path / name))
        assert frame.main(arguments) == ExitCode.BAD_INPUT
        assert message in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


def test_a_cut_log_is_used_as_far_as_it_goes(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = (case.folder / "b.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[:-200])
    arguments = case.arguments(tmp_path / "set", "--json", "--epochs", "1", "--even-if-worse")
    arguments = [str(cut) if word.endswith("b.mcap") else word for word in arguments]
    assert frame.main([*arguments, "--loss", "iterations"]) == ExitCode.OK
    printed = capsys.readouterr()
    assert "cut.mcap: damaged, going on with the rest: truncated" in printed.err
    log = json.loads(printed.out)["logs"][1]
    assert "truncated" in log["damage"][0]
    assert log["training_states"] + log["held_out_states"] == 2


def test_all_states_failing(case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_log(tmp_path / "hopeless", [HOPELESS + k for k in range(5)])
    arguments = ["tune", str(tmp_path / "hopeless"), *case.arguments(tmp_path / "set")[3:]]
    assert frame.main(arguments) == ExitCode.BAD_INPUT
    error = capsys.readouterr().err
    assert "none of 2 training states has a gradient" in error
    assert "2 failed" in error
    assert not (tmp_path / "set").exists()


def test_a_loss_without_a_number(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "loss.py").write_text(
        "def nan(states, controls, time):\n    return states[-1, 6] * float('nan')\n"
    )
    for loss, message in (
        (f"{tmp_path}/loss.py:nan", "none of 2 training states has a gradient"),
        (f"{tmp_path}/loss.py:other", "a function in"),
        (f"{tmp_path}/none.py:nan", "readable file"),
    ):
        assert frame.main(case.arguments(tmp_path / "set", "--loss", loss)) == ExitCode.BAD_INPUT
        assert message in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


def test_sets_and_networks_that_do_not_fit(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.safetensors"
    network().save(other)
    assert frame.main(case.arguments(tmp_path / "set", "--network", str(other))) == 2
    assert "which the terminal-time network was trained for" in capsys.readouterr().err

    damaged = bytearray(other.read_bytes())
    damaged[-1] ^= 1
    other.write_bytes(bytes(damaged))
    assert frame.main(case.arguments(tmp_path / "set", "--network", str(other))) == 2
    assert "content and checksum differ" in capsys.readouterr().err

    heavy = tmp_path / "heavy.yaml"
    heavy.write_text("/**: {ros__parameters: {parameters: {thrust_max: 9.0e+5}}}")

    predicted = tmp_path / "predicted.yaml"
    predicted.write_text("/**: {ros__parameters: {terminal_time_source: predicted}}")
    arguments = ["--params-file", str(predicted)]
    arguments = case.arguments(tmp_path / "set", *arguments, parameters="thrust_max=8e5:9e5")
    assert frame.main(arguments) == ExitCode.BAD_INPUT
    assert "together with network" in capsys.readouterr().err

    save(tmp_path / "tampered", {"intervals": 20})
    files = [tmp_path / "tampered" / PARAMETERS_FILE, heavy]
    arguments = [word for file in files for word in ("--params-file", str(file))]
    assert frame.main(case.arguments(tmp_path / "set", *arguments)) == ExitCode.BAD_INPUT
    assert "of another vehicle: thrust_max 900000.0 instead" in capsys.readouterr().err

    parameters = tmp_path / "tampered" / PARAMETERS_FILE
    parameters.write_text(parameters.read_text().replace("20", "21"))
    arguments = case.arguments(tmp_path / "set", "--params-file", str(parameters))
    assert frame.main(arguments) == ExitCode.BAD_INPUT
    assert "the file was changed" in capsys.readouterr().err

    taken = tmp_path / "taken"
    before = save(taken, {"intervals": 20})
    assert frame.main(case.arguments(taken)) == ExitCode.BAD_INPUT
    assert "not overwritten" in capsys.readouterr().err
    assert load(taken).identifier == before.identifier
