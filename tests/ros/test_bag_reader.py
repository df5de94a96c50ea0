"""Reading good bags: what is in them, in which order, and clear errors for wrong questions."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import Float64, String

from dscp_core.errors import InvalidInputError
from dscp_ros.bag import (
    BagFormatError,
    BagNotFoundError,
    BagReader,
    BagWriter,
    DamageKind,
    MessageDecodeError,
    Qos,
    TopicNotFoundError,
    UnknownMessageTypeError,
)
from dscp_ros.bag.cdr import serialise
from dscp_ros.bag.info import bag_info, info_lines
from dscp_ros.bag.schemas import MessageDefinition, message_definition

START_NS = 1_700_000_000_000_000_000
STEP_NS = 1_000_000
COUNT = 100


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / "bag"
    with BagWriter(path, chunk_bytes=600, custom_data={"seed": "7"}) as writer:
        writer.add_topic("/x", Float64, Qos(depth=3))
        writer.add_topic("/note", String, Qos(depth=1, durability="transient_local"))
        for index in range(COUNT):
            writer.write("/x", Float64(data=float(index)), START_NS + index * STEP_NS)
            if index % 25 == 0:
                writer.write("/note", String(data=f"n{index}"), START_NS + index * STEP_NS + 1)
    return path


def foreign_bag(path: Path, **options: object) -> Path:
    """A file with the library's own writer and other settings than ours."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, **options)  # type: ignore[arg-type]
        writer.start(profile="ros2")
        definition = message_definition("std_msgs/msg/Float64")
        schema_id = writer.register_schema(
            definition.type_name, "ros2msg", definition.text.encode()
        )
        channel_id = writer.register_channel("/x", "cdr", schema_id)
        for index in range(COUNT):
            data = serialise(Float64(data=float(index)))
            writer.add_message(channel_id, START_NS + index, data, START_NS + index)
        writer.finish()
    return path


def values(reader: BagReader) -> list[float]:
    return [message.data for _, message in reader.decoded_messages(["/x"])]


def test_what_is_in_the_bag(bag: Path) -> None:
    with BagReader(bag) as reader:
        assert list(reader.topics) == ["/note", "/x"]
        topic = reader.topics["/x"]
        assert (topic.type_name, topic.message_count) == ("std_msgs/msg/Float64", COUNT)
        assert topic.offers == (Qos(depth=3),)
        assert topic.type_hash == message_definition("std_msgs/msg/Float64").type_hash
        assert reader.message_count == COUNT + 4
        assert reader.start_ns == START_NS
        assert reader.duration_ns == (COUNT - 1) * STEP_NS
        assert reader.verify().intact


def test_messages_come_by_time_whatever_their_order_in_the_file(tmp_path: Path) -> None:
    times = np.random.default_rng(5).permutation(500) * STEP_NS + START_NS
    with BagWriter(tmp_path / "b.mcap", chunk_bytes=2000) as writer:
        writer.add_topic("/x", Float64)
        for time_ns in times:
            writer.write("/x", Float64(data=float(time_ns - START_NS)), int(time_ns))
    with BagReader(tmp_path / "b.mcap") as reader:
        read = [(m.log_time_ns, m.decode().data) for m in reader.messages()]
    assert [time_ns for time_ns, _ in read] == sorted(times)
    assert all(value == time_ns - START_NS for time_ns, value in read)


def test_equal_times_keep_the_order_of_the_file(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "b.mcap", chunk_bytes=300) as writer:
        writer.add_topic("/x", Float64)
        for index in range(COUNT):
            writer.write("/x", Float64(data=float(index)), START_NS)
    with BagReader(tmp_path / "b.mcap") as reader:
        assert values(reader) == [float(index) for index in range(COUNT)]


def test_topics_and_times_are_filtered(bag: Path) -> None:
    with BagReader(bag) as reader:
        assert [m.decode().data for m in reader.messages(["/note"])] == ["n0", "n25", "n50", "n75"]
        window = reader.messages(
            ["/x"], start_ns=START_NS + 10 * STEP_NS, end_ns=START_NS + 13 * STEP_NS
        )
        assert [m.decode().data for m in window] == [10.0, 11.0, 12.0]
        assert list(reader.messages(start_ns=reader.end_ns + 1)) == []


def test_the_last_messages_before_a_time(bag: Path) -> None:
    with BagReader(bag) as reader:
        before_ns = START_NS + 60 * STEP_NS
        last = reader.last_messages({"/note": 2, "/x": 1}, before_ns)
        assert [m.decode().data for m in last] == ["n25", "n50", 59.0]
        assert reader.last_messages({"/note": 1}, START_NS) == []


def test_a_topic_that_is_not_there_is_named_with_those_that_are(bag: Path) -> None:
    with BagReader(bag) as reader:
        with pytest.raises(TopicNotFoundError, match=r"no topic /y .* it has: /note, /x") as caught:
            reader.messages(["/x", "/y"])
        assert (caught.value.missing, caught.value.available) == (("/y",), ("/note", "/x"))
        with pytest.raises(InvalidInputError, match="collection of topic names"):
            reader.messages("/x")


def test_a_directory_without_metadata(bag: Path) -> None:
    (bag / "metadata.yaml").unlink()
    with BagReader(bag) as reader:
        assert values(reader) == [float(index) for index in range(COUNT)]
        assert reader.metadata is not None  # from the copy inside the file
        assert reader.metadata.custom_data == {"seed": "7"}
        assert reader.verify().intact


def test_several_files_are_one_bag(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    for part in range(11):
        with BagWriter(bag / f"bag_{part}.mcap") as writer:
            writer.add_topic("/x", Float64)
            for index in range(3):
                number = 3 * part + index
                writer.write("/x", Float64(data=float(number)), START_NS + number)
    with BagReader(bag) as reader:
        assert [path.name for path in reader.files][-2:] == ["bag_9.mcap", "bag_10.mcap"]
        assert values(reader) == [float(number) for number in range(33)]
        assert reader.topics["/x"].message_count == 33


def test_a_file_that_metadata_names_is_missing(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    shutil.copytree(_two_files(tmp_path), bag, dirs_exist_ok=True)
    (bag / "b_1.mcap").unlink()
    with BagReader(bag) as reader:
        assert values(reader) == [0.0, 1.0]
        report = reader.verify()
    (damage,) = report.damages
    assert (damage.kind, damage.messages_lost) == (DamageKind.MISSING_FILE, 2)
    assert report.messages_lost == 2


def _two_files(tmp_path: Path) -> Path:
    bag = tmp_path / "two"
    bag.mkdir()
    for part in range(2):
        with BagWriter(bag / f"b_{part}.mcap") as writer:
            writer.add_topic("/x", Float64)
            for index in range(2):
                writer.write("/x", Float64(data=float(2 * part + index)), START_NS + 2 * part)
    with BagWriter(tmp_path / "template") as writer:
        writer.add_topic("/x", Float64)
        for _ in range(4):
            writer.write("/x", Float64(), START_NS)
    text = (tmp_path / "template" / "metadata.yaml").read_text()
    content = yaml.safe_load(text)["rosbag2_bagfile_information"]
    names = ["b_0.mcap", "b_1.mcap"]
    content["relative_file_paths"] = names
    content["files"] = [{**content["files"][0], "path": name, "message_count": 2} for name in names]
    (bag / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": content}))
    return bag


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"use_statistics": False},
        {"repeat_channels": False},
        {"enable_crcs": False, "compression": CompressionType.NONE, "chunk_size": 500},
        {"compression": CompressionType.LZ4, "chunk_size": 500},
    ],
    ids=lambda options: next(iter(options)),
)
def test_files_that_others_write(tmp_path: Path, options: dict[str, object]) -> None:
    path = foreign_bag(tmp_path / "b.mcap", **options)
    with BagReader(path) as reader:
        assert values(reader) == [float(index) for index in range(COUNT)]
        assert reader.topics["/x"].message_count == COUNT
        assert reader.topics["/x"].offers == ()
        assert reader.verify().intact


def test_bags_that_rosbags_writes(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    float_type = store.types["std_msgs/msg/Float64"]
    writer = Rosbag2Writer(tmp_path / "b", version=8, storage_plugin=StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection("/x", "std_msgs/msg/Float64", typestore=store)
        for index in range(COUNT):
            data = store.serialize_cdr(float_type(float(index)), "std_msgs/msg/Float64")
            writer.write(connection, START_NS + index, data)
    with BagReader(tmp_path / "b") as reader:
        assert values(reader) == [float(index) for index in range(COUNT)]
        assert reader.verify().intact


def test_a_type_that_is_not_installed(tmp_path: Path) -> None:
    path = _strange_bag(tmp_path, MessageDefinition("mars_msgs/msg/Rover", "float64 x"))
    with BagReader(path) as reader:
        assert len(list(reader.messages())) == 2
        with pytest.raises(UnknownMessageTypeError) as caught:
            list(reader.decoded_messages())
        assert str(caught.value) == (
            "message type mars_msgs/msg/Rover on topic /rover: "
            "ROS package mars_msgs is not installed (No module named 'mars_msgs')"
        )
        good, unknown = reader.decodable(reader.topics)
        assert (good, list(unknown)) == (["/x"], ["/rover"])
        assert [m.data for _, m in reader.decoded_messages(good)] == [1.0]


def test_a_type_with_another_definition_is_not_decoded(tmp_path: Path) -> None:
    other = MessageDefinition("std_msgs/msg/Float32", "float64 data", type_hash="RIHS01_00")
    with (
        BagReader(_strange_bag(tmp_path, other)) as reader,
        pytest.raises(UnknownMessageTypeError, match=r"RIHS01_00.*not the installed one"),
    ):
        list(reader.decoded_messages(["/rover"]))


def _strange_bag(tmp_path: Path, definition: MessageDefinition) -> Path:
    path = tmp_path / "strange.mcap"
    with BagWriter(path) as writer:
        writer.add_topic("/x", Float64)
        writer.add_topic("/rover", definition.type_name, definition=definition)
        writer.write("/x", Float64(data=1.0), START_NS)
        writer.write_raw("/rover", serialise(Float64(data=2.0)), START_NS + 1)
    return path


def test_a_payload_that_is_too_short(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "b.mcap") as writer:
        writer.add_topic("/x", Float64)
        writer.write_raw("/x", b"\x00\x01\x00\x00abc", START_NS)
        writer.write_raw("/x", b"\x00", START_NS + 1)
    with BagReader(tmp_path / "b.mcap") as reader:
        (message,) = reader.messages()
        with pytest.raises(MessageDecodeError, match=rf"std_msgs/msg/Float64 on .*{START_NS} ns"):
            message.decode()
        (damage,) = reader.report.damages
        assert (damage.kind, damage.messages_lost) == (DamageKind.CORRUPT_MESSAGE, 1)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "the file is empty"),
        (b"SQLite format 3\0", "not an MCAP file.*SQLite"),
        (b"\x89MCA", "not an MCAP file"),
        (b"#ROSBAG V2.0\n", "not an MCAP file"),
    ],
)
def test_files_that_are_no_bags(tmp_path: Path, content: bytes, complaint: str) -> None:
    for name in ("b.mcap", "directory/b.mcap"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        with pytest.raises(BagFormatError, match=complaint) as caught:
            BagReader(path if name == "b.mcap" else path.parent)
        assert str(path) in str(caught.value)


def test_paths_without_a_bag(tmp_path: Path) -> None:
    with pytest.raises(BagNotFoundError, match="nowhere: no such file"):
        BagReader(tmp_path / "nowhere")
    with pytest.raises(BagNotFoundError, match=r"no metadata.yaml and no .mcap file"):
        BagReader(tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "complaint"),
    [
        ("storage_identifier", "sqlite3", "storage 'sqlite3' is not supported"),
        ("compression_mode", "FILE", "compression mode 'file' is not supported"),
    ],
)
def test_kinds_of_bags_that_are_not_read(bag: Path, key: str, value: str, complaint: str) -> None:
    path = bag / "metadata.yaml"
    content = yaml.safe_load(path.read_text())
    content["rosbag2_bagfile_information"][key] = value
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(BagFormatError, match=complaint):
        BagReader(bag)


def test_broken_metadata_does_not_hide_the_messages(bag: Path) -> None:
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    with BagReader(bag) as reader:
        assert len(values(reader)) == COUNT
        report = reader.verify()
    assert [damage.kind for damage in report.damages] == [DamageKind.CORRUPT_METADATA]
    assert report.messages_lost == 0


def test_memory_does_not_grow_with_the_bag(tmp_path: Path) -> None:
    chunk_bytes, chunks, payload = 200_000, 60, b"\0\1\0\0" + bytes(996)
    with BagWriter(tmp_path / "b.mcap", chunk_bytes=chunk_bytes, compression="none") as writer:
        writer.add_topic("/x", String)
        for index in range(chunks * chunk_bytes // len(payload)):
            writer.write_raw("/x", payload, START_NS + index)
    with BagReader(tmp_path / "b.mcap") as reader:
        tracemalloc.start()
        count = sum(1 for _ in reader.messages())
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert count == chunks * chunk_bytes // len(payload)
    # A chunk is held as read, as messages, and once more while it is split; the bag has 12 MB.
    assert peak < 6 * chunk_bytes


def test_info_for_scripts_and_people(bag: Path) -> None:
    with BagReader(bag) as reader:
        info = bag_info(reader)
        text = "\n".join(info_lines(reader))
    assert info["message_count"] == COUNT + 4
    assert info["custom_data"] == {"seed": "7"}
    x_topic = next(topic for topic in info["topics"] if topic["name"] == "/x")
    assert x_topic["mean_rate_hz"] == pytest.approx(1e9 / STEP_NS)
    for part in ("2023-11-14 22:13:20", "/note  std_msgs/msg/String", "latched", "seed: 7"):
        assert part in text


def test_bags_are_inspected_without_ros(bag: Path) -> None:
    script = (
        "import sys; from dscp_ros.bag import BagReader; "
        f"reader = BagReader({str(bag)!r}); print(reader.verify().messages_read, "
        "[name for name in sys.modules if name.startswith(('rclpy', 'std_msgs'))])"
    )
    root = Path(__file__).resolve().parents[2]
    printed = subprocess.run(
        [sys.executable, "-c", script], cwd=root, capture_output=True, text=True, check=True
    ).stdout
    assert printed == f"{COUNT + 4} []\n"
