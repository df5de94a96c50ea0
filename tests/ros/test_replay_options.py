"""Options: what is refused, with name, value and bound."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
from std_msgs.msg import Float64, String

from dscp_core.errors import InvalidInputError
from dscp_ros.bag import BagReader, BagWriter, Qos, TopicNotFoundError, UnknownMessageTypeError
from dscp_ros.bag.schemas import MessageDefinition
from dscp_ros.cli.main import main
from dscp_ros.replay.main import main as replay_main
from dscp_ros.replay.options import ReplayOptions, SubscriberWait, parse_remaps
from dscp_ros.replay.publishers import selected_topics

START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / "bag"
    rover = MessageDefinition("mars_msgs/msg/Rover", "float64 x")
    with BagWriter(path) as writer:
        writer.add_topic("/x", Float64)
        writer.add_topic("/note", String, Qos(depth=1, durability="transient_local"))
        writer.add_topic("/rover", rover.type_name, definition=rover)
        writer.write("/x", Float64(data=1.0), START_NS)
        writer.write("/x", Float64(data=2.0), START_NS + 10**9)
        writer.write_raw("/rover", b"\0\1\0\0" + bytes(8), START_NS)
    return path


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--rate", "0"], "--rate: got 0.0, expected (0, 1000]"),
        (["--rate", "-1"], "--rate: got -1.0, expected (0, 1000]"),
        (["--rate", "nan"], "--rate: got nan, expected (0, 1000]"),
        (["--rate", "2000"], "--rate: got 2000.0, expected (0, 1000]"),
        (["--rate", "fast"], "argument --rate: invalid float value: 'fast'"),
        (
            ["--rate", "2", "--as-fast-as-possible"],
            "--rate: got 2.0, expected no --rate together with",
        ),
        (["--start-offset", "-0.5"], "--start-offset: got -0.5, expected [0, 1e+08]"),
        (
            ["--start-offset", "7", "--exclude", "/rover"],
            "--start-offset: got 7.0, expected [0, 1]",
        ),
        (["--duration", "0"], "--duration: got 0.0, expected (0, 1e+08]"),
        (["--delay", "inf"], "--delay: got inf, expected [0, 1e+08]"),
        (["--clock", "0"], "--clock: got 0.0, expected (0, 10000]"),
        (["--wait-for-subscribers", "0"], "--wait-for-subscribers N: got 0, expected [1, 1000]"),
        (
            ["--wait-for-subscribers", "x"],
            "--wait-for-subscribers: got 'x', expected N or N/TIMEOUT",
        ),
        (["--wait-for-subscribers", "1/-3"], "TIMEOUT: got -3.0, expected (0, 1e+08]"),
        (["--remap", "/x"], "--remap: got '/x', expected old:=new"),
        (["--remap", "/x:=/a", "/x:=/b"], "--remap: got '/x:=/b', expected one rule for /x"),
        (
            ["--remap", "/x:=/a b", "--exclude", "/rover"],
            "--remap: got '/a b', expected a topic name",
        ),
        (["--remap", "/y:=/a"], "no topic /y in the bag; it has: /note, /rover, /x"),
        (["--topics", "/y"], "no topic /y in the bag; it has: /note, /rover, /x"),
        (["--exclude", "/y"], "no topic /y in the bag; it has: /note, /rover, /x"),
        (["--exclude", "/x", "/note", "/rover"], "expected at least one topic"),
        (["--topics", "/x", "/note", "--remap", "/note:=/x"], "/x would carry"),
        (["--topics", "/note"], None),
        ([], "message type mars_msgs/msg/Rover on topic /rover: ROS package mars_msgs"),
        (
            ["--loop", "--topics", "/x", "--start-offset", "1"],
            "--loop: got True, expected a window",
        ),
        (
            ["--topics", "/x", "--ros-args", "--bogus"],
            "--ros-args: got '--bogus', expected arguments",
        ),
        (["--qos-overrides", "{tmp}/none.yaml"], "none.yaml', expected a readable file"),
        (["--qos-overrides", "{tmp}/list.yaml"], "expected a mapping of topics to policies"),
        (["--qos-overrides", "{tmp}/topic.yaml"], "no topic /z in the bag"),
        (
            ["--qos-overrides", "{tmp}/policy.yaml", "--topics", "/x"],
            "--qos-overrides /x durability: got 'lasting', expected one of",
        ),
    ],
)
def test_bad_options_are_exit_code_2_and_name_value_and_bound(
    bag: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    complaint: str | None,
) -> None:
    (tmp_path / "list.yaml").write_text("[1]")
    (tmp_path / "topic.yaml").write_text("/z: {depth: 1}")
    (tmp_path / "policy.yaml").write_text("/x: {durability: lasting}")
    arguments = [argument.format(tmp=tmp_path) for argument in arguments]
    code = main(["replay", str(bag), "--json", *arguments])
    printed = capsys.readouterr()
    if complaint is None:
        assert code == 0  # the bag has the topic, without messages
        assert json.loads(printed.out)["message_count"] == 0
        return
    assert code == 2
    assert complaint in printed.err
    assert complaint in json.loads(printed.out)["error"]["message"]


@pytest.mark.parametrize("content", [None, b"", b"no bag"])
def test_bad_bags_are_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes | None
) -> None:
    path = tmp_path / "b.mcap"
    if content is not None:
        path.write_bytes(content)
    assert replay_main([str(path)]) == 2
    assert str(path) in capsys.readouterr().err


def test_a_bag_without_messages_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/x", Float64)
    assert replay_main([str(tmp_path / "bag")]) == 2
    assert "there is no message in it" in capsys.readouterr().err


def test_a_bag_of_which_nothing_can_be_read_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "b.mcap"
    with BagWriter(path, compression="none") as writer:
        writer.add_topic("/x", Float64)
        writer.write("/x", Float64(data=1234.5), START_NS)
    content = bytearray(path.read_bytes())
    content[content.index(struct.pack("<d", 1234.5))] ^= 1
    path.write_bytes(content)
    assert replay_main([str(path)]) == 2
    error = capsys.readouterr().err
    assert "no message can be read: corrupt chunk" in error


def test_a_wait_for_nobody_ends(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--topics", "/x", "--wait-for-subscribers", "1/0.1"]
    assert replay_main([str(bag), *arguments]) == 2
    assert "after 0.1 s, fewer than 1 on /x (0)" in capsys.readouterr().err


def test_unknown_types_are_left_out_when_asked(bag: Path) -> None:
    with BagReader(bag) as reader:
        with pytest.raises(UnknownMessageTypeError, match="on topic /rover"):
            selected_topics(reader, ReplayOptions(bag))
        topics, skipped = selected_topics(reader, ReplayOptions(bag, skip_unknown_types=True))
    assert [topic.name for topic in topics] == ["/note", "/x"]
    assert "mars_msgs is not installed" in skipped["/rover"]


def test_the_bags_own_clock_gives_way(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/clock", "rosgraph_msgs/msg/Clock")
        writer.add_topic("/x", Float64)
    with BagReader(tmp_path / "bag") as reader:
        own, _ = selected_topics(reader, ReplayOptions(tmp_path))
        replaced, skipped = selected_topics(reader, ReplayOptions(tmp_path, clock_hz=10.0))
    assert [topic.name for topic in own] == ["/clock", "/x"]
    assert [topic.name for topic in replaced] == ["/x"]
    assert skipped == {"/clock": "replaced by --clock"}


def test_overrides_must_name_topics_of_the_bag(bag: Path) -> None:
    with BagReader(bag) as reader, pytest.raises(TopicNotFoundError):
        selected_topics(reader, ReplayOptions(bag, qos_overrides={"/z": {}}))


def test_texts_are_parsed() -> None:
    assert parse_remaps(["/a:=/b", "/c:=d"]) == {"/a": "/b", "/c": "d"}
    assert SubscriberWait.parse("2") == SubscriberWait(2)
    assert SubscriberWait.parse("2/0.5") == SubscriberWait(2, 0.5)
    with pytest.raises(InvalidInputError):
        SubscriberWait.parse("2/")
