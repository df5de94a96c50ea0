"""metadata.yaml of every version, and broken ones."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from dscp_ros.bag import BagFormatError, Qos
from dscp_ros.bag.metadata import BagMetadata, FileMetadata, TopicMetadata, read_metadata

# Of a bag that `ros2 bag` of Galactic wrote (abridged): no files, no custom data, QoS as a string.
VERSION_4 = """\
rosbag2_bagfile_information:
  compression_format: ''
  compression_mode: NONE
  duration: {nanoseconds: 4531096768}
  message_count: 10
  relative_file_paths: [talker.mcap]
  starting_time: {nanoseconds_since_epoch: 1585866235112411371}
  storage_identifier: mcap
  topics_with_message_count:
  - message_count: 10
    topic_metadata:
      name: /topic
      offered_qos_profiles: "- history: 3\\n  depth: 0\\n  reliability: 1\\n  durability: 2"
      serialization_format: cdr
      type: std_msgs/msg/String
  version: 4
"""

METADATA = BagMetadata(
    start_ns=1_700_000_000_000_000_000,
    duration_ns=5,
    message_count=3,
    topics=(TopicMetadata("/t", "std_msgs/msg/String", (Qos(depth=2), Qos()), "RIHS01_00", 3),),
    relative_file_paths=("bag_0.mcap",),
    files=(FileMetadata("bag_0.mcap", 1_700_000_000_000_000_000, 5, 3),),
    custom_data={"story": "two: lines\nwith a long text " + "x" * 200},
    ros_distro="jazzy",
)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "metadata.yaml"
    path.write_text(METADATA.to_yaml())
    assert read_metadata(path) == METADATA


def test_no_custom_data_is_written_as_null() -> None:
    bare = BagMetadata(0, 0, 0, (), ())
    assert yaml.safe_load(bare.to_yaml())["rosbag2_bagfile_information"]["custom_data"] is None


def test_version_4(tmp_path: Path) -> None:
    path = tmp_path / "metadata.yaml"
    path.write_text(VERSION_4)
    metadata = read_metadata(path)
    assert (metadata.version, metadata.message_count, metadata.files) == (4, 10, ())
    assert metadata.compression_mode == ""
    (topic,) = metadata.topics
    assert topic.offers == (Qos(history="unknown", depth=0),)
    assert topic.type_hash == ""


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "no rosbag2_bagfile_information"),
        ("rosbag2_bagfile_information: 3", "no rosbag2_bagfile_information"),
        ("a: [", "parsing"),
        ("\x00", "unacceptable character"),
        (VERSION_4.replace("version: 4", "version: 10"), r"version 10 is not in \[1, 9\]"),
        (VERSION_4.replace("  message_count: 10\n", "", 1), "message_count"),
        (VERSION_4.replace("message_count: 10", "message_count: ten"), "ten"),
        (VERSION_4.replace("durability: 2", "durability: 77"), "durability: got 77"),
        (
            VERSION_4.replace("topics_with_message_count:", "topics_with_message_count: 5\n  x:"),
            "iterable",
        ),
    ],
)
def test_broken_metadata_is_an_error_that_says_what(
    tmp_path: Path, text: str, complaint: str
) -> None:
    path = tmp_path / "metadata.yaml"
    path.write_text(text)
    with pytest.raises(BagFormatError, match=complaint) as caught:
        read_metadata(path)
    assert str(path) in str(caught.value)
