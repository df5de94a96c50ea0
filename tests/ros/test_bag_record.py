"""Recording real topics: in this process, and with `dscp bag record` as its own process."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import PointStamped
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64, String

from dscp_core.errors import InvalidInputError
from dscp_ros.bag import BagReader, BagWriter
from dscp_ros.record import Recorder

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_a_recording_holds_messages_times_and_quality_of_service(ros: Any, tmp_path: Path) -> None:
    source = ros.create_node("source")
    note = source.create_publisher(String, "/note", LATCHED)
    note.publish(String(data="before the recorder"))
    value = source.create_publisher(Float64, "/value", BEST_EFFORT)
    with BagWriter(tmp_path / "bag") as writer:
        recorder = Recorder(ros.create_node("recorder"), writer, ["/note", "/value", "/never"])
        assert ros.wait_for(lambda: recorder.waiting_for == ("/never",))
        assert ros.wait_for(lambda: value.get_subscription_count() == 1)
        before_ns = time.time_ns()
        for number in range(10):
            value.publish(Float64(data=float(number)))
        assert ros.wait_for(lambda: recorder.counts == {"/note": 1, "/value": 10, "/never": 0})
        after_ns = time.time_ns()
        ros.stop_spinning()
    with BagReader(tmp_path / "bag") as reader:
        decoded = list(reader.decoded_messages(["/value"]))
        assert [m.data for _, m in decoded] == [float(number) for number in range(10)]
        assert all(before_ns <= raw.publish_time_ns <= raw.log_time_ns for raw, _ in decoded)
        assert decoded[-1][0].log_time_ns <= after_ns
        (latched,) = reader.decoded_messages(["/note"])
        assert latched[1].data == "before the recorder"
        assert reader.topics["/note"].offers[0].latched
        assert reader.topics["/value"].offers[0].reliability == "best_effort"
        assert "/never" not in reader.topics


def test_simulated_time_is_the_log_time(ros: Any, tmp_path: Path) -> None:
    source = ros.create_node("source")
    clock = source.create_publisher(Clock, "/clock", 1)
    value = source.create_publisher(Float64, "/value", 10)
    node = ros.create_node("recorder", parameter_overrides=[Parameter("use_sim_time", value=True)])
    with BagWriter(tmp_path / "bag") as writer:
        recorder = Recorder(node, writer, ["/value"])
        assert ros.wait_for(lambda: clock.get_subscription_count() >= 1)
        message = Clock()
        message.clock.sec = 1234
        clock.publish(message)
        assert ros.wait_for(lambda: node.get_clock().now().nanoseconds == 1234 * 10**9)
        assert ros.wait_for(lambda: value.get_subscription_count() == 1)
        value.publish(Float64(data=1.0))
        assert ros.wait_for(lambda: recorder.counts["/value"] == 1)
        ros.stop_spinning()
    with BagReader(tmp_path / "bag") as reader:
        assert reader.start_ns == 1234 * 10**9


@pytest.mark.parametrize("topics", [["value"], ["/value", "/value"]])
def test_bad_topics_are_refused(ros: Any, tmp_path: Path, topics: list[str]) -> None:
    with (
        BagWriter(tmp_path / "bag") as writer,
        pytest.raises(InvalidInputError, match="absolute name, given once"),
    ):
        Recorder(ros.create_node("recorder"), writer, topics)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_replay_recorded_by_another_process(ros: Any, tmp_path: Path, number: int) -> None:
    count, start_ns = 40, 1_700_000_000_000_000_000
    with BagWriter(tmp_path / "original") as writer:
        writer.add_topic("/point", PointStamped)
        for index in range(count):
            point = PointStamped()
            point.point.x = float(index)
            writer.write("/point", point, start_ns + index * 5_000_000)
    command = [sys.executable, "-c", "import sys; from dscp_ros.cli.main import main; main()"]
    record = [*command, "bag", "record", str(tmp_path / "copy"), "/point", "--json"]
    replay = [*command, "replay", str(tmp_path / "original"), "--wait-for-subscribers", "1/30"]
    environment = ros.child_env()
    observer = ros.create_node("observer")
    with subprocess.Popen(
        record, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            subprocess.run(replay, env=environment, check=True, capture_output=True, timeout=60)
            assert ros.wait_for(lambda: observer.count_publishers("/point") == 0)
            process.send_signal(number)
            out, err = process.communicate(timeout=30)
        finally:
            process.kill()
    assert err == ""
    assert json.loads(out)["recorded"] == {"/point": count}
    with BagReader(tmp_path / "copy") as reader:
        values = [message.point.x for _, message in reader.decoded_messages()]
        assert reader.verify().intact
    assert values == [float(index) for index in range(count)]
