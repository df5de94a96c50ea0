"""Replays as processes of their own, seen by real subscribers in this one."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import PointStamped
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger

from dscp_ros.bag import BagReader, BagWriter, Qos

START_NS = 1_700_000_000_000_000_000
STEP_NS = 20_000_000
COUNT = 50
LENGTH_S = (COUNT - 1) * STEP_NS / 1e9
NOTES = {0: "zero", 10: "ten", 30: "thirty"}
TIMEOUT_S = 30.0

KEEP_ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
LATCHED_ALL = QoSProfile(
    history=HistoryPolicy.KEEP_ALL,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """One second: a stamped point every 20 ms, and three latched notes."""
    path = tmp_path / "bag"
    with BagWriter(path, chunk_bytes=700) as writer:
        writer.add_topic("/point", PointStamped, Qos(depth=1))
        writer.add_topic("/note", String, Qos(depth=1, durability="transient_local"))
        for index in range(COUNT):
            time_ns = START_NS + index * STEP_NS
            if index in NOTES:
                writer.write("/note", String(data=NOTES[index]), time_ns)
            point = PointStamped()
            point.header.frame_id = "landing_site"
            point.header.stamp.sec = index
            point.point.x = float(index)
            writer.write("/point", point, time_ns)
    return path


class Listener:
    """Collects what arrives on the topics of the bag, and on any other that is asked for."""

    def __init__(self, ros: Any) -> None:
        self.ros = ros
        self.node = ros.create_node("listener")
        self.points: list[PointStamped] = []
        self.notes: list[str] = []
        self.listen(PointStamped, "/point", self.points.append, KEEP_ALL)
        self.listen(String, "/note", lambda m: self.notes.append(m.data), LATCHED_ALL)

    def listen(self, message_type: type[Any], topic: str, callback: Any, qos: Any) -> None:
        self.node.create_subscription(message_type, topic, callback, qos)

    @property
    def numbers(self) -> list[int]:
        return [int(point.point.x) for point in self.points]

    def call(self, service: str) -> str:
        client = self.node.create_client(Trigger, f"/dscp_replay/{service}")
        assert client.wait_for_service(TIMEOUT_S)
        future = client.call_async(Trigger.Request())
        assert self.ros.wait_for(future.done)
        response = future.result()
        assert response.success
        return str(response.message)


class Replay:
    """A replay process."""

    def __init__(self, ros: Any, bag: Path, *options: str, **popen: Any) -> None:
        command = [sys.executable, "-m", "dscp_ros.replay", str(bag), *options]
        popen.setdefault("stdin", subprocess.DEVNULL)
        popen.setdefault("stdout", subprocess.PIPE)
        popen.setdefault("stderr", subprocess.PIPE)
        self.process = subprocess.Popen(command, env=ros.child_env(), text=True, **popen)
        self.out = self.err = ""

    def finish(self, signal_number: int | None = None) -> Replay:
        if signal_number is not None:
            self.process.send_signal(signal_number)
        self.out, self.err = self.process.communicate(timeout=TIMEOUT_S)
        assert self.process.returncode == 0, self.err
        assert "Traceback" not in self.err
        return self

    @property
    def result(self) -> dict[str, Any]:
        content = json.loads(self.out)
        assert isinstance(content, dict)
        return content


@pytest.fixture
def listener(ros: Any) -> Listener:
    return Listener(ros)


@pytest.fixture
def replay(ros: Any, bag: Path) -> Iterator[Any]:
    started: list[Replay] = []

    def start(*options: str, path: Path = bag, **popen: Any) -> Replay:
        started.append(Replay(ros, path, *options, **popen))
        return started[-1]

    yield start
    for entry in started:
        if entry.process.poll() is None:
            entry.process.kill()
            entry.process.communicate()


def test_every_message_arrives_as_it_was_recorded(listener: Listener, replay: Any) -> None:
    done = replay("--wait-for-subscribers", "1", "--json").finish()
    assert listener.ros.wait_for(lambda: len(listener.points) == COUNT)
    assert listener.numbers == list(range(COUNT))
    assert [point.header.stamp.sec for point in listener.points] == list(range(COUNT))
    assert {point.header.frame_id for point in listener.points} == {"landing_site"}
    assert listener.notes == list(NOTES.values())
    result = done.result
    assert result["published"] == {"/point": COUNT, "/note": len(NOTES)}
    assert (result["passes"], result["interrupted"]) == (1, False)
    assert result["unacknowledged"] == []
    assert result["report"]["intact"]
    # Not earlier than recorded; how late depends on the machine, and is only reported.
    assert result["seconds"] >= LENGTH_S
    assert 0 <= result["lateness_mean_s"] <= result["lateness_max_s"]


def test_a_window_begins_with_what_latched_topics_held(listener: Listener, replay: Any) -> None:
    done = replay(
        "--start-offset", "0.5", "--duration", "0.2", "--wait-for-subscribers", "1", "--json"
    ).finish()
    assert listener.ros.wait_for(lambda: len(listener.notes) == 2)
    assert listener.numbers == list(range(25, 35))
    # "ten" is the last (depth 1) note before the offset, "thirty" lies in the window.
    assert listener.notes == ["ten", "thirty"]
    assert done.result["published"] == {"/point": 10, "/note": 2}


def test_topics_are_chosen_and_renamed(listener: Listener, replay: Any) -> None:
    renamed: list[float] = []
    listener.listen(PointStamped, "/renamed", lambda m: renamed.append(m.point.x), KEEP_ALL)
    options = ("--rate", "10", "--wait-for-subscribers", "1", "--json")
    first = replay("--topics", "/point", "--remap", "/point:=/renamed", *options).finish()
    assert listener.ros.wait_for(lambda: len(renamed) == COUNT)
    assert first.result["published"] == {"/point": COUNT}
    second = replay("--exclude", "/point", *options).finish()
    assert listener.ros.wait_for(lambda: len(listener.notes) == len(NOTES))
    assert second.result["published"] == {"/note": len(NOTES)}
    assert listener.points == []


def test_rate_and_delay(listener: Listener, replay: Any) -> None:
    slow = replay("--rate", "0.5", "--duration", "0.5", "--json").finish()
    assert slow.result["seconds"] >= 1.0
    late = replay("--rate", "100", "--delay", "0.7", "--json").finish()
    assert late.result["seconds"] >= 0.7


def test_restamping(listener: Listener, replay: Any) -> None:
    before_ns = time.time_ns()
    done = replay("--restamp", "--rate", "10", "--wait-for-subscribers", "1").finish()
    after_ns = time.time_ns()
    assert listener.ros.wait_for(lambda: len(listener.points) == COUNT)
    stamps = [p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in listener.points]
    assert before_ns <= stamps[0]
    assert stamps == sorted(stamps)
    assert stamps[-1] <= after_ns
    assert listener.numbers == list(range(COUNT))
    assert {point.header.frame_id for point in listener.points} == {"landing_site"}
    assert "/note has no leading header: it is not restamped" in done.err


def test_clock_follows_the_bag(listener: Listener, replay: Any) -> None:
    clocks: list[int] = []
    listener.listen(
        Clock, "/clock", lambda m: clocks.append(m.clock.sec * 10**9 + m.clock.nanosec), KEEP_ALL
    )
    replay("--clock", "100", "--rate", "2", "--restamp", "--wait-for-subscribers", "1").finish()
    assert listener.ros.wait_for(lambda: len(listener.points) == COUNT)
    assert len(clocks) > 2
    assert clocks == sorted(clocks)
    end_ns = START_NS + (COUNT - 1) * STEP_NS + 1
    assert START_NS <= clocks[0] <= clocks[-1] <= end_ns
    stamps = [p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in listener.points]
    # Restamped by the same clock: each message when it was due, or later.
    assert all(
        START_NS + k * STEP_NS <= stamp <= end_ns
        for k, stamp in zip(listener.numbers, stamps, strict=True)
    )


def test_as_fast_as_possible_loses_nothing(listener: Listener, replay: Any, tmp_path: Path) -> None:
    many = 3200
    with BagWriter(tmp_path / "many") as writer:
        writer.add_topic("/value", Float64, Qos(depth=1))
        for index in range(many):
            writer.write("/value", Float64(data=float(index)), START_NS + index * 10**9)
    values: list[float] = []
    clocks: list[int] = []
    listener.listen(Float64, "/value", lambda m: values.append(m.data), KEEP_ALL)
    listener.listen(Clock, "/clock", lambda m: clocks.append(m.clock.sec), KEEP_ALL)
    options = ("--as-fast-as-possible", "--clock", "0.1", "--wait-for-subscribers", "1", "--json")
    done = replay(*options, path=tmp_path / "many").finish()
    assert listener.ros.wait_for(lambda: len(values) == many)
    assert values == [float(index) for index in range(many)]
    assert done.result["unacknowledged"] == []
    # The bag lasts 3200 s, on which this clock has a grid of 10 s.
    assert clocks == sorted(clocks)
    assert all((second - clocks[0]) % 10 == 0 for second in clocks)


def test_pause_services(listener: Listener, replay: Any) -> None:
    running = replay("--paused", "--loop", "--wait-for-subscribers", "1", "--json")
    assert listener.call("pause") == "paused"
    assert listener.points == []
    assert listener.call("resume") == "playing"
    assert listener.ros.wait_for(lambda: len(listener.points) > 3)
    assert listener.call("toggle_paused") == "paused"
    # A message that was sent before the pause may still be on its way; after a second call and
    # answer it has arrived, since both take the same way.
    assert listener.call("pause") == "paused"
    seen = len(listener.points)
    assert not listener.ros.wait_for(lambda: len(listener.points) > seen, timeout=0.3)
    assert listener.call("toggle_paused") == "playing"
    assert listener.ros.wait_for(lambda: len(listener.points) > seen)
    assert running.finish(signal.SIGINT).result["interrupted"]


def test_loop_until_sigint(listener: Listener, replay: Any) -> None:
    running = replay(
        "--loop", "--start-offset", "0.3", "--rate", "5", "--wait-for-subscribers", "1"
    )
    assert listener.ros.wait_for(lambda: listener.numbers.count(COUNT - 1) == 2)
    running.finish(signal.SIGINT)
    one_pass = list(range(15, COUNT))
    assert listener.numbers[: 2 * len(one_pass)] == one_pass * 2
    # Each pass begins with what the latched topic held at the offset.
    assert listener.notes[:4] == ["ten", "thirty"] * 2
    assert "stopped after" in running.out
    assert "passes" in running.out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_stop_at_any_time(listener: Listener, replay: Any, number: int) -> None:
    playing = replay("--rate", "0.1", "--topics", "/point", "--wait-for-subscribers", "1", "--json")
    assert listener.ros.wait_for(lambda: len(listener.points) >= 2)
    result = playing.finish(number).result
    assert result["interrupted"]
    assert result["message_count"] == len(listener.points)
    waiting = replay("--topics", "/point", "--wait-for-subscribers", "9/60", "--json")
    assert listener.ros.wait_for(
        lambda: listener.node.count_publishers("/point") == 1, timeout=TIMEOUT_S
    )
    assert waiting.finish(number).result["message_count"] == 0


def test_quality_of_service_of_the_bag_and_its_override(
    listener: Listener, replay: Any, tmp_path: Path
) -> None:
    overrides = tmp_path / "qos.yaml"
    overrides.write_text("/point:\n  reliability: best_effort\n  deadline: {sec: 3, nsec: 0}\n")
    late = replay("--paused", "--qos-overrides", str(overrides))
    node = listener.node

    def offers() -> dict[str, QoSProfile]:
        return {
            topic: publisher.qos_profile
            for topic in ("/point", "/note")
            for publisher in node.get_publishers_info_by_topic(topic)
        }

    assert listener.ros.wait_for(lambda: len(offers()) == 2, timeout=TIMEOUT_S)
    seen = offers()
    late.finish(signal.SIGTERM)
    assert seen["/point"].reliability == ReliabilityPolicy.BEST_EFFORT
    assert seen["/point"].deadline.nanoseconds == 3 * 10**9
    assert seen["/point"].durability == DurabilityPolicy.VOLATILE
    assert seen["/note"].reliability == ReliabilityPolicy.RELIABLE
    assert seen["/note"].durability == DurabilityPolicy.TRANSIENT_LOCAL


def test_a_late_subscriber_gets_what_is_latched(listener: Listener, replay: Any) -> None:
    running = replay("--loop", "--duration", "0.5", "--topics", "/note")
    assert listener.ros.wait_for(lambda: "ten" in listener.notes)
    late: list[str] = []
    listener.call("pause")
    listener.listen(String, "/note", lambda m: late.append(m.data), LATCHED_ALL)
    assert listener.ros.wait_for(lambda: len(late) == 1)
    running.finish(signal.SIGINT)


def test_a_damaged_bag_is_replayed_as_far_as_it_goes(
    listener: Listener, replay: Any, bag: Path
) -> None:
    file = bag / "bag_0.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])
    with BagReader(bag) as reader:
        readable = reader.verify().messages_read
    assert readable
    done = replay("--rate", "10", "--wait-for-subscribers", "1", "--json").finish()
    assert done.result["message_count"] == readable
    assert done.result["report"]["damages"][0]["kind"] == "truncated"
    assert f"damaged bag: truncated ({file}" in done.err
    assert listener.ros.wait_for(lambda: len(listener.points) + len(listener.notes) == readable)


def test_progress_goes_to_stderr_and_json_to_stdout(replay: Any) -> None:
    shown = replay("--rate", "10", "--progress", "--json").finish()
    assert shown.result["message_count"] == COUNT + len(NOTES)
    assert "100%" in shown.err
    assert f"{COUNT + len(NOTES)} messages" in shown.err
    hidden = replay("--rate", "10", "--no-progress").finish()
    assert hidden.err == ""
    assert hidden.out.startswith(f"replayed {COUNT + len(NOTES)} messages on 2 topics in ")


def test_ros_arguments_rename_the_node(listener: Listener, replay: Any) -> None:
    running = replay("--paused", "--ros-args", "-r", "__node:=other")
    assert listener.ros.wait_for(lambda: "other" in listener.node.get_node_names())
    running.finish(signal.SIGTERM)


def test_keys_pause_and_resume(listener: Listener, replay: Any) -> None:
    main_end, terminal = pty.openpty()

    def take_terminal() -> None:
        os.setsid()
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    running = replay(
        "--paused", "--loop", "--json", "--no-progress",
        stdin=terminal, preexec_fn=take_terminal,
    )  # fmt: skip
    try:
        assert listener.ros.wait_for(lambda: listener.node.count_publishers("/point") == 1)
        assert listener.points == []
        assert listener.ros.wait_for(lambda: _is_cbreak(terminal))
        os.write(main_end, b" ")
        assert listener.ros.wait_for(lambda: len(listener.points) > 2)
        os.write(main_end, b"s")
        assert listener.ros.wait_for(lambda: listener.call("toggle_paused") == "playing")
        os.write(main_end, b"\x03")  # Ctrl-C: the terminal sends SIGINT
        assert running.finish().result["interrupted"]
        assert not _is_cbreak(terminal)
    finally:
        os.close(main_end)
        os.close(terminal)


def _is_cbreak(terminal: int) -> bool:
    return not termios.tcgetattr(terminal)[3] & termios.ICANON
