"""The demonstration end to end, with short bags, in real processes."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from dscp_ros.bag import BagReader, BagWriter, Qos
from dscp_ros.cli import ExitCode
from dscp_ros.parameter_set import load

ROOT = Path(__file__).resolve().parents[2]
DISPERSED = ROOT / "bags" / "powered_descent_dispersed"
NOMINAL = ROOT / "bags" / "powered_descent_nominal"
REPORT, TRAJECTORY = "/planner/report", "/planner/trajectory"
MARK = "DSCP_DEMO_TEST"
# Start of a few interpreters and some plans, on a machine that also does other things.
PATIENCE_S = 240.0
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def excerpt(source: Path, target: Path, seconds: float, topics: tuple[str, ...] = ()) -> Path:
    """The first seconds of a bag."""
    with BagReader(source) as reader, BagWriter(target) as writer:
        names = topics or tuple(reader.topics)
        for name in names:
            topic = reader.topics[name]
            writer.add_topic(name, topic.type_name, topic.offers)
        end_ns = reader.start_ns + round(seconds * 1e9)
        for message in reader.messages(names, end_ns=end_ns):
            writer.write_raw(message.topic.name, message.data, message.log_time_ns)
    return target


@dataclass
class Demo:
    """A running demonstration."""

    process: subprocess.Popen[str]
    output: Path
    mark: str
    lines: list[str] = field(default_factory=list)

    def read_until(self, text: str) -> None:
        """Reads what it says up to a line with a text."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))
            if text in line:
                return
        raise AssertionError(f"{text!r} is not in\n" + "\n".join(self.lines))

    def finish(self) -> int:
        """Reads the rest and waits for the end."""
        rest, _ = self.process.communicate(timeout=PATIENCE_S)
        self.lines += rest.splitlines()
        return self.process.returncode

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    def processes(self, command: str = "") -> list[int]:
        """Processes of this demonstration whose command line holds a text."""
        found = []
        for folder in Path("/proc").iterdir():
            if not folder.name.isdecimal():
                continue
            try:
                environment = (folder / "environ").read_bytes()
                arguments = (folder / "cmdline").read_bytes()
            except OSError:  # ended meanwhile
                continue
            if f"{MARK}={self.mark}".encode() in environment and command.encode() in arguments:
                found.append(int(folder.name))
        return found


@contextmanager
def running(output: Path, *arguments: str | Path) -> Iterator[Demo]:
    mark = uuid.uuid4().hex
    process = subprocess.Popen(
        [sys.executable, "-m", "dscp_ros.demo", "--output", str(output), *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
        env={**os.environ, MARK: mark, "PYTHONPATH": str(ROOT)},
    )
    demo = Demo(process, output, mark)
    try:
        yield demo
    finally:
        for pid in demo.processes():
            os.kill(pid, signal.SIGKILL)
        process.communicate()


def recorded(output: Path) -> dict[str, list[Any]]:
    """Messages by topic, read without this project's code."""
    messages: dict[str, list[Any]] = {}
    with (output / "planner_output" / "planner_output_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for item in reader.iter_decoded_messages():
            messages.setdefault(item.channel.topic, []).append(item.decoded_message)
    return messages


def values_of(report: Any) -> dict[str, str]:
    (status,) = report.status
    return {pair.key: pair.value for pair in status.values}


def table_of(lines: list[str]) -> dict[str, str]:
    """Last column of the table by row: that of all bags together."""
    start = next(i for i, line in enumerate(lines) if line.startswith("states replayed"))
    rows = {}
    for line in lines[start:]:
        if not line.strip():
            break
        name, cells = line[:32].strip(), re.split(r"\s{2,}", line[32:].strip())
        rows[name] = cells[-1]
    return rows


def wait_for(predicate: Callable[[], bool]) -> bool:
    deadline_s = time.monotonic() + 10.0
    while not predicate() and time.monotonic() < deadline_s:
        time.sleep(0.05)
    return predicate()


def test_the_table_is_what_the_recording_holds(tmp_path: Path) -> None:
    # One second of story, then eight states, one of them bad; and seven states with their mass.
    first = excerpt(DISPERSED, tmp_path / "in_dispersed", 1.0 + 8 * 0.3)
    second = excerpt(NOMINAL, tmp_path / "in_nominal", 1.0 + 0.7)
    with running(tmp_path / "out", "--bag", first, "--bag", second, "--rate", "1") as demo:
        code = demo.finish()
        assert code == ExitCode.OK, demo.text
        assert demo.processes() == []

    messages = recorded(tmp_path / "out")
    reports = [values_of(report) for report in messages[REPORT]]
    attempts = [report for report in reports if "iterations" in report]
    refused = Counter(report["code"] for report in reports if "bound" in report)
    certified = [report for report in attempts if report["code"] == "0"]
    table = table_of(demo.lines)

    assert refused["101"] == 1, demo.text
    assert int(table["states replayed"]) == 15
    # A busy machine may make states stale, too.
    assert int(table["inputs refused"]) == refused.total()
    assert int(table["planning attempts"]) == len(attempts) > 1
    assert int(table["certified"]) == len(certified) > 0
    assert int(table["superseded by a newer state"]) == 15 - refused.total() - len(attempts)
    iterations = [int(report["iterations"]) for report in attempts]
    assert table["iterations, mean / max"] == f"{np.mean(iterations):.1f} / {max(iterations)}"
    for row, key, chosen in (
        ("planning, median / p99 [ms]", "solve_time_ms", attempts),
        ("latency, median / p99 [ms]", "latency_ms", certified),
    ):
        times = [float(report[key]) for report in chosen]
        assert table[row] == f"{np.median(times):.0f} / {np.percentile(times, 99):.0f}"
    miss = max(float(report["certificate.miss_position_m"]) for report in certified)
    assert table["largest miss [m]"] == f"{miss:.3f}"
    assert re.search(r"^  101 +NOT_FINITE +1  ", demo.text, re.MULTILINE), demo.text

    # Nothing but certified plans is published, and each belongs to a state that was replayed.
    assert len(messages[TRAJECTORY]) == len(certified)
    stamps = [message.header.stamp for message in messages[TRAJECTORY]]
    published = {f"{stamp.sec}.{stamp.nanosec:09d}" for stamp in stamps}
    assert published == {report["input_stamp"] for report in certified}
    picture = (tmp_path / "out" / "landing.png").read_bytes()
    assert picture.startswith(PNG_SIGNATURE)
    assert len(picture) > 20_000  # an empty figure of this size takes 5 kB


def test_without_a_certified_plan_it_fails(tmp_path: Path) -> None:
    bag = tmp_path / "bad"
    with BagReader(DISPERSED) as reader, BagWriter(bag) as writer:
        states = list(reader.messages(["/planner/vehicle_state"]))
        writer.add_topic("/planner/vehicle_state", "sensor_msgs/msg/JointState", Qos())
        writer.write_raw("/planner/vehicle_state", states[4].data, states[4].log_time_ns)
    with running(tmp_path / "out", "--bag", bag) as demo:
        assert demo.finish() == ExitCode.NO_PLAN, demo.text
    assert "demo failed: no certified plan came out" in demo.text
    assert not (tmp_path / "out" / "landing.png").exists()


def test_ctrl_c_stops_every_process(tmp_path: Path) -> None:
    with running(tmp_path / "out", "--bag", NOMINAL, "--rate", "1") as demo:
        demo.read_until("replaying powered_descent_nominal")
        assert wait_for(lambda: bool(demo.processes("dscp_ros.replay")))
        assert demo.processes("dscp_ros.planner")
        demo.process.send_signal(signal.SIGINT)
        assert demo.finish() == ExitCode.INTERRUPTED, demo.text
        assert demo.processes() == []
    assert "interrupted" in demo.lines[-1]
    assert not (tmp_path / "out" / "planner_output").exists()


def test_a_planner_that_dies_is_noticed(tmp_path: Path) -> None:
    with running(tmp_path / "out", "--bag", NOMINAL, "--rate", "1") as demo:
        demo.read_until("replaying powered_descent_nominal")
        (planner,) = demo.processes("dscp_ros.planner")
        os.kill(planner, signal.SIGKILL)
        assert demo.finish() == 1, demo.text
        assert demo.processes() == []
    assert "demo failed: the planner node ended with signal SIGKILL" in demo.text


def test_time_that_is_up_is_said(tmp_path: Path) -> None:
    with running(tmp_path / "out", "--bag", NOMINAL, "--timeout", "0.01") as demo:
        assert demo.finish() == 1, demo.text
        assert demo.processes() == []
    assert "demo failed: time is up, still waiting for the planner node to offer" in demo.text


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--bag", "no_such_bag", "no_such_bag"),
        ("--rate", "0", "rate"),
        ("--rate", "nan", "rate"),
        ("--timeout", "-1", "timeout"),
        ("--campaign", "0", "flights: got 0"),
        ("--campaign", "2 --loop", "neither --loop nor --bag"),
    ],
)
def test_bad_options_are_named(tmp_path: Path, option: str, value: str, said: str) -> None:
    with running(tmp_path / "out", option, *value.split()) as demo:
        assert demo.finish() == ExitCode.BAD_INPUT
    assert said in demo.text
    assert not (tmp_path / "out").exists()


def test_an_output_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with running(tmp_path / "out", "--bag", NOMINAL) as demo:
        assert demo.finish() == ExitCode.BAD_INPUT
    assert "--output" in demo.text
    assert (tmp_path / "out").read_text() == "mine"


def test_a_bag_without_the_planners_topics_is_refused(tmp_path: Path) -> None:
    bag = excerpt(NOMINAL, tmp_path / "story", 5.0, ("/story",))
    with running(tmp_path / "out", "--bag", bag) as demo:
        assert demo.finish() == ExitCode.BAD_INPUT
    assert "/planner/vehicle_state" in demo.text


@pytest.mark.timeout(PATIENCE_S)
def test_the_loop_tunes_on_the_log_and_reloads_what_it_found(tmp_path: Path) -> None:
    # One second of story, then sixteen states to tune on, and five that the tuning does not see.
    log = excerpt(ROOT / "bags" / "ignitions_log", tmp_path / "log", 1.0 + 16 * 0.2)
    unseen = excerpt(ROOT / "bags" / "ignitions_unseen", tmp_path / "unseen", 1.0 + 5 * 0.2)
    out = tmp_path / "out"
    with running(out, "--loop", "--bag", log, "--bag", unseen, "--epochs", "4") as demo:
        code = demo.finish()
        assert code == ExitCode.OK, demo.text
        assert demo.processes() == []

    tuned = load(out / "parameter_set")
    assert tuned.terminal_time_network is not None
    assert tuned.terminal_time_network.data.vehicle["thrust_max"] == 824000.0
    assert tuned.provenance["logs"]
    (first,) = re.findall(r"plans with parameter set (\S+),", demo.text)
    assert first != tuned.label

    reports = [values_of(report) for report in recorded(out)[REPORT]]
    attempts = [report for report in reports if "iterations" in report]
    sets = [report["parameter_set"].split(" ")[0] for report in attempts]
    # First all of the log and the unseen with the one set, then the unseen with the other.
    assert list(dict.fromkeys(sets)) == [first, tuned.label]
    assert sets == sorted(sets, key=[first, tuned.label].index)
    after = [report for report, name in zip(attempts, sets, strict=True) if name == tuned.label]
    stamps = {report["input_stamp"] for report in after}
    before = [
        report
        for report, name in zip(attempts, sets, strict=True)
        if name == first and report["input_stamp"] in stamps
    ]
    assert {report["terminal_time_source"] for report in before} == {"free"}
    assert "specific_impulse: got 279.2" in before[0]["terminal_time_reason"]
    rows = {line[:32].strip(): line[32:].split() for line in demo.lines if line[:32].strip()}
    predicted = sum(report["terminal_time_source"] == "predicted" for report in after)
    assert rows["terminal time predicted"] == ["0", str(predicted)]
    certified = sum(report["code"] == "0" for report in after)
    assert rows["certified"][1] == str(certified)
    assert rows["planning attempts"][1] == str(len(after))


def test_a_small_campaign_shows_its_table_and_figure(tmp_path: Path) -> None:
    with running(tmp_path, "--campaign", "2") as demo:
        assert demo.finish() == ExitCode.OK, demo.text
    assert "dscp simulate powered_descent --flights 2" in demo.text
    assert "powered_descent: 2 of 2 flights succeeded" in demo.text
    assert (tmp_path / "campaign.png").read_bytes().startswith(PNG_SIGNATURE)
