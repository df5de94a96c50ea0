"""What is written, read by independent readers; and what happens when writing goes wrong."""

from __future__ import annotations

import errno
import json
import os
import stat
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import yaml
from geometry_msgs.msg import InertiaStamped
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader as Rosbag2Reader
from std_msgs.msg import Float64, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from dscp_core.errors import InvalidInputError
from dscp_ros.bag import (
    BagExistsError,
    BagReader,
    BagWriteError,
    BagWriter,
    Qos,
    UnknownMessageTypeError,
)
from dscp_ros.bag.schemas import message_definition

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
STATES = 25
LATCHED = Qos(depth=1, durability="transient_local")
# What `ros2 interface show --...` and rosbag2 give for these types in Jazzy.
ODOMETRY_HASH = "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"


def odometry(index: int) -> Odometry:
    message = Odometry()
    message.header.stamp.sec = index
    message.header.frame_id = "landing_site"
    message.child_frame_id = "base_link"
    message.pose.pose.position.x = 0.5 * index
    message.twist.twist.linear.z = -1.0 - index
    return message


def trajectory() -> JointTrajectory:
    points = [JointTrajectoryPoint(positions=[float(k), 2.0], effort=[3.0]) for k in range(4)]
    return JointTrajectory(joint_names=["x", "y"], points=points)


def write_bag(path: Path, **options: object) -> Path:
    with BagWriter(path, **options) as writer:  # type: ignore[arg-type]
        writer.add_topic("/state", Odometry, Qos(depth=1))
        writer.add_topic("/trajectory", "trajectory_msgs/msg/JointTrajectory", LATCHED)
        writer.add_topic("/mass", InertiaStamped)
        writer.write("/trajectory", trajectory(), START_NS, START_NS - 7)
        for index in range(STATES):
            writer.write("/state", odometry(index), START_NS + index * STEP_NS)
    return path


@pytest.fixture(params=["bag", "bag.mcap"])
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write_bag(tmp_path / request.param, custom_data={"story": "a: test"})


def mcap_file(bag: Path) -> Path:
    return bag / f"{bag.name}_0.mcap" if bag.is_dir() else bag


def test_rosbags_reads_every_message(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        topics = {connection.topic: connection for connection in reader.connections}
        assert {topic: c.msgcount for topic, c in topics.items()} == {
            "/state": STATES,
            "/trajectory": 1,
            "/mass": 0,
        }
        messages = [
            (connection.topic, time_ns, reader.deserialize(data, connection.msgtype))
            for connection, time_ns, data in reader.messages()
        ]
    states = [(time_ns, m) for topic, time_ns, m in messages if topic == "/state"]
    assert [time_ns for time_ns, _ in states] == [START_NS + k * STEP_NS for k in range(STATES)]
    for index, (_, state) in enumerate(states):
        assert state.pose.pose.position.x == 0.5 * index
        assert state.twist.twist.linear.z == -1.0 - index
        assert (state.header.frame_id, state.child_frame_id) == ("landing_site", "base_link")
    (plan,) = [m for topic, _, m in messages if topic == "/trajectory"]
    assert plan.joint_names == ["x", "y"]
    assert [list(point.positions) for point in plan.points] == [[k, 2.0] for k in range(4)]


def test_rosbags_sees_quality_of_service_and_metadata(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", custom_data={"story": "a: test"})
    with Rosbag2Reader(bag) as reader:
        offers = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
        digests = {c.topic: c.digest for c in reader.connections}
        assert reader.storage.metadata.custom == {"story": "a: test"}  # type: ignore[attr-defined]
        assert reader.ros_distro == "jazzy"
        assert reader.duration == (STATES - 1) * STEP_NS + 1
    assert offers["/trajectory"][0].durability is QosDurability.TRANSIENT_LOCAL
    assert offers["/state"][0].depth == 1
    assert digests["/state"] == ODOMETRY_HASH


def test_mcap_ros2_decodes_with_the_schema_in_the_file(bag: Path) -> None:
    with mcap_file(bag).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages())
    assert len(decoded) == STATES + 1
    states = [d.decoded_message for d in decoded if d.channel.topic == "/state"]
    assert [state.pose.pose.position.x for state in states] == [0.5 * k for k in range(STATES)]


def test_records_are_those_of_rosbag2(bag: Path) -> None:
    with mcap_file(bag).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        channel = next(c for c in summary.channels.values() if c.topic == "/trajectory")
        schema = summary.schemas[channel.schema_id]
        metadata = list(reader.iter_metadata())
        _, _, first = next(iter(reader.iter_messages(topics=["/trajectory"])))
    assert (schema.name, schema.encoding) == ("trajectory_msgs/msg/JointTrajectory", "ros2msg")
    assert channel.message_encoding == "cdr"
    (stored,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
    assert (stored["durability"], stored["depth"]) == ("transient_local", 1)
    assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
    assert (first.log_time, first.publish_time) == (START_NS, START_NS - 7)
    (record,) = metadata
    assert record.name == "rosbag2"
    assert yaml.safe_load(record.metadata["serialized_metadata"])["message_count"] == STATES + 1


def test_metadata_yaml_is_version_9(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag")
    content = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert content["version"] == 9
    assert content["storage_identifier"] == "mcap"
    assert content["starting_time"] == {"nanoseconds_since_epoch": START_NS}
    assert content["duration"] == {"nanoseconds": (STATES - 1) * STEP_NS}
    assert content["relative_file_paths"] == ["bag_0.mcap"]
    assert content["message_count"] == STATES + 1
    assert content["files"][0]["message_count"] == STATES + 1
    assert (content["compression_format"], content["compression_mode"]) == ("", "")
    by_name = {t["topic_metadata"]["name"]: t for t in content["topics_with_message_count"]}
    assert by_name["/mass"]["message_count"] == 0
    assert by_name["/state"]["topic_metadata"]["type_description_hash"] == ODOMETRY_HASH
    assert by_name["/state"]["topic_metadata"]["offered_qos_profiles"][0]["depth"] == 1


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_every_compression_is_read_by_the_others(tmp_path: Path, compression: str) -> None:
    bag = write_bag(tmp_path / "bag.mcap", compression=compression, chunk_bytes=2000)
    with AnyReader([bag]) as reader:
        assert sum(1 for _ in reader.messages()) == STATES + 1
    with BagReader(bag) as own:
        assert own.verify().messages_read == STATES + 1


def test_an_empty_bag_is_a_bag(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
        writer.add_topic("/state", Odometry)
    with Rosbag2Reader(bag) as reader:
        assert reader.message_count == 0
    with BagReader(bag) as own:
        assert own.verify().intact
        assert list(own.messages()) == []


def test_rclpy_quality_of_service_is_accepted(tmp_path: Path) -> None:
    bag = tmp_path / "bag.mcap"
    with BagWriter(bag) as writer:
        profile = QoSProfile(depth=4, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        writer.add_topic("/t", String, profile)
        writer.write("/t", String(data="x"), START_NS)
    with BagReader(bag) as reader:
        (offer,) = reader.topics["/t"].offers
    assert (offer.depth, offer.latched) == (4, True)


def test_definitions_contain_every_nested_type() -> None:
    text = message_definition("nav_msgs/msg/Odometry").text
    assert text.startswith("# This represents an estimate of a position")
    for nested in ("std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/Quaternion"):
        assert f"{'=' * 80}\nMSG: {nested}\n" in text


def test_a_path_that_is_taken_is_left_alone(tmp_path: Path) -> None:
    for name in ("bag", "bag.mcap"):
        bag = write_bag(tmp_path / name)
        before = mcap_file(bag).read_bytes()
        with pytest.raises(BagExistsError, match="exists"):
            BagWriter(bag)
        assert mcap_file(bag).read_bytes() == before


def test_overwriting_replaces_only_bags(tmp_path: Path) -> None:
    for name in ("bag", "bag.mcap"):
        bag = write_bag(tmp_path / name)
        with BagWriter(bag, overwrite=True) as writer:
            writer.add_topic("/only", Float64)
        with BagReader(bag) as reader:
            assert list(reader.topics) == ["/only"]
    precious = tmp_path / "bag" / "thesis.tex"
    precious.write_text("years of work")
    with pytest.raises(BagExistsError, match=r"thesis\.tex"):
        BagWriter(tmp_path / "bag", overwrite=True)
    assert precious.exists()
    directory = tmp_path / "directory.mcap"
    directory.mkdir()
    with pytest.raises(BagExistsError, match="not replaced"):
        BagWriter(directory, overwrite=True)


def test_nothing_has_the_final_name_before_the_bag_is_complete(tmp_path: Path) -> None:
    for name in ("bag", "bag.mcap"):
        path = tmp_path / name
        writer = BagWriter(path)
        writer.add_topic("/x", Float64)
        writer.write("/x", Float64(data=1.0), START_NS)
        writer.flush()
        assert not path.exists()
        assert writer.partial_path.parent == tmp_path
        assert ".partial-" in writer.partial_path.name
        writer.close()
        writer.close()
        assert path.exists()
        assert not writer.partial_path.exists()


def test_permissions_are_those_of_a_normal_file(tmp_path: Path) -> None:
    former = os.umask(0o027)
    try:
        write_bag(tmp_path / "bag.mcap")
        write_bag(tmp_path / "bag")
    finally:
        os.umask(former)
    assert stat.S_IMODE((tmp_path / "bag.mcap").stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "bag").stat().st_mode) == 0o750


def test_an_exception_keeps_what_was_written_under_the_partial_name(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    writer = BagWriter(bag)
    writer.add_topic("/x", Float64)
    for index in range(3):
        writer.write("/x", Float64(data=float(index)), START_NS + index)
    writer.flush()
    with pytest.raises(ZeroDivisionError), writer:
        raise ZeroDivisionError
    assert not bag.exists()
    with BagReader(writer.partial_path) as reader:
        assert sum(1 for _ in reader.messages()) == 3


def test_an_exception_before_the_first_message_leaves_nothing(tmp_path: Path) -> None:
    for name in ("bag", "bag.mcap"):
        with pytest.raises(ZeroDivisionError), BagWriter(tmp_path / name):
            raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_killed_writer_leaves_a_readable_partial_bag(tmp_path: Path) -> None:
    script = f"""
        import os, signal
        from std_msgs.msg import Float64
        from dscp_ros.bag import BagWriter
        writer = BagWriter({str(tmp_path / "bag")!r})
        writer.add_topic("/x", Float64)
        for index in range(100):
            writer.write("/x", Float64(data=float(index)), {START_NS} + index)
        writer.flush()
        writer.write("/x", Float64(data=-1.0), {START_NS} + 1000)
        os.kill(os.getpid(), signal.SIGKILL)
    """
    run_script(script)
    (partial,) = tmp_path.iterdir()
    assert partial.name.startswith("bag.partial-")
    with BagReader(partial) as reader:
        assert [m.decode().data for m in reader.messages()] == [float(k) for k in range(100)]
        assert not reader.report.intact


def test_a_full_disk_is_a_clear_error(tmp_path: Path) -> None:
    # The size limit of a process makes write() fail just as a full disk does, with another number.
    script = f"""
        import resource, signal
        from std_msgs.msg import String
        from dscp_ros.bag import BagWriteError, BagWriter
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
        written = 0
        try:
            with BagWriter({str(tmp_path / "bag")!r}, compression="none", chunk_bytes=5_000) as w:
                w.add_topic("/x", String)
                while True:
                    w.write("/x", String(data="y" * 1000), {START_NS} + written)
                    written += 1
        except BagWriteError as error:
            print(written, error.partial_path, error, sep="\\n")
    """
    written, partial, message = run_script(script).splitlines()
    assert message.startswith(f"cannot write {tmp_path / 'bag'}: {os.strerror(errno.EFBIG)}")
    assert partial in message
    assert not (tmp_path / "bag").exists()
    with BagReader(partial) as reader:
        saved = sum(1 for _ in reader.messages())
    # Of 60 kB, the last chunk (5 kB) and the buffers (8 kB) may be missing.
    assert 45 <= saved <= int(written)


def test_an_unwritable_place_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BagWriteError, match=r"cannot write .*File exists"):
        BagWriter(tmp_path / "file" / "bag")


def test_wrong_calls_are_named(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag.mcap") as writer:
        writer.add_topic("/x", Float64)
        with pytest.raises(InvalidInputError, match="added before: /x"):
            writer.write("/y", Float64(), START_NS)
        with pytest.raises(InvalidInputError, match=r"'String', expected std_msgs/msg/Float64"):
            writer.write("/x", String(), START_NS)
        with pytest.raises(InvalidInputError, match="log_time_ns: got -1"):
            writer.write("/x", Float64(), -1)
        with pytest.raises(InvalidInputError, match="absolute name"):
            writer.add_topic("relative", Float64)
        with pytest.raises(InvalidInputError, match="not added before"):
            writer.add_topic("/x", Float64)
        with pytest.raises(UnknownMessageTypeError, match="mars_msgs is not installed"):
            writer.add_topic("/z", "mars_msgs/msg/Rover")
        with pytest.raises(UnknownMessageTypeError, match="Float63"):
            writer.add_topic("/z", "std_msgs/msg/Float63")
        with pytest.raises(UnknownMessageTypeError, match="package/msg/Name"):
            writer.add_topic("/z", "std_msgs/Float64")
        with pytest.raises(UnknownMessageTypeError, match="int: is not a ROS message"):
            writer.add_topic("/z", int)
    with pytest.raises(InvalidInputError, match="open for writing"):
        writer.write("/x", Float64(), START_NS)
    with pytest.raises(InvalidInputError, match="compression: got 'rar'"):
        BagWriter(tmp_path / "other", compression="rar")


def run_script(script: str) -> str:
    """Runs a script in its own process, in which the packages of this checkout can be imported."""
    root = str(Path(__file__).resolve().parents[2])
    environment = {**os.environ, "PYTHONPATH": root}
    done = subprocess.run(
        [sys.executable, "-c", "import sys\n" + textwrap.dedent(script)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stderr == "", json.dumps(done.stderr)
    return done.stdout
