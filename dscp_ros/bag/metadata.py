"""rosbag2's `metadata.yaml`: version 9 (ROS 2 Jazzy) is written, versions 1 to 9 are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from dscp_core.errors import InvalidInputError
from dscp_ros.bag.errors import BagFormatError
from dscp_ros.bag.qos import Qos, parse_offers

METADATA_FILE = "metadata.yaml"
METADATA_VERSION = 9
EMPTY_START_NS = 2**63 - 1
"""What rosbag2 writes as the starting time of a bag without messages."""

_ROOT = "rosbag2_bagfile_information"
_STORAGE = "mcap"


@dataclass(frozen=True)
class TopicMetadata:
    """One topic of the bag.

    Attributes:
        name: Topic name.
        type_name: Message type, such as `nav_msgs/msg/Odometry`.
        offers: Quality of service of each recorded publisher.
        type_hash: REP-2016 hash of the type, or empty.
        message_count: Messages on this topic.
        serialization_format: How payloads are encoded.
    """

    name: str
    type_name: str
    offers: tuple[Qos, ...] = ()
    type_hash: str = ""
    message_count: int = 0
    serialization_format: str = "cdr"


@dataclass(frozen=True)
class FileMetadata:
    """One file of the bag.

    Attributes:
        path: Name relative to the bag's directory.
        start_ns: First log time.
        duration_ns: Last minus first log time.
        message_count: Messages in this file.
    """

    path: str
    start_ns: int
    duration_ns: int
    message_count: int


@dataclass(frozen=True)
class BagMetadata:
    """Content of `metadata.yaml`.

    Attributes:
        start_ns: First log time, `EMPTY_START_NS` without messages.
        duration_ns: Last minus first log time.
        message_count: Messages in the bag.
        topics: The topics.
        relative_file_paths: The bag's files, in order.
        files: The files with their times and counts (empty before version 5).
        custom_data: Whatever the one who recorded it wanted to note.
        ros_distro: ROS distribution that recorded it.
        compression_mode: Empty, `file` or `message` (rosbag2's own, on top of the file format's).
        compression_format: Empty or `zstd`.
        storage_identifier: File format, `mcap` or `sqlite3`.
        version: Version of the metadata format.
    """

    start_ns: int
    duration_ns: int
    message_count: int
    topics: tuple[TopicMetadata, ...]
    relative_file_paths: tuple[str, ...]
    files: tuple[FileMetadata, ...] = ()
    custom_data: Mapping[str, str] = field(default_factory=dict)
    ros_distro: str = ""
    compression_mode: str = ""
    compression_format: str = ""
    storage_identifier: str = _STORAGE
    version: int = METADATA_VERSION

    def to_dict(self) -> dict[str, Any]:
        """Returns the content without its root key, in rosbag2's order."""
        return {
            "version": METADATA_VERSION,
            "storage_identifier": self.storage_identifier,
            "duration": {"nanoseconds": self.duration_ns},
            "starting_time": {"nanoseconds_since_epoch": self.start_ns},
            "message_count": self.message_count,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type_name,
                        "serialization_format": topic.serialization_format,
                        "offered_qos_profiles": [qos.to_dict() for qos in topic.offers],
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": topic.message_count,
                }
                for topic in self.topics
            ],
            "compression_format": self.compression_format,
            "compression_mode": self.compression_mode,
            "relative_file_paths": list(self.relative_file_paths),
            "files": [
                {
                    "path": file.path,
                    "starting_time": {"nanoseconds_since_epoch": file.start_ns},
                    "duration": {"nanoseconds": file.duration_ns},
                    "message_count": file.message_count,
                }
                for file in self.files
            ],
            "custom_data": dict(self.custom_data) or None,
            "ros_distro": self.ros_distro,
        }

    def to_yaml(self) -> str:
        """Returns the text of `metadata.yaml`."""
        return _dump({_ROOT: self.to_dict()})

    def to_record(self) -> dict[str, str]:
        """Returns the MCAP Metadata record named `rosbag2` that goes into the file itself."""
        return {"serialized_metadata": _dump(self.to_dict())}


def read_metadata(path: Path) -> BagMetadata:
    """Reads a `metadata.yaml`.

    Raises:
        BagFormatError: If it is unreadable, incomplete, or of an unknown version.
    """
    try:
        loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise BagFormatError(f"{path}: {error}") from error
    if not isinstance(loaded, Mapping) or not isinstance(loaded.get(_ROOT), Mapping):
        raise BagFormatError(f"{path}: no {_ROOT}")
    return _parse(loaded[_ROOT], str(path))


def parse_record(record: Mapping[str, str], where: str) -> BagMetadata | None:
    """Reads the MCAP Metadata record named `rosbag2`; None for the empty one of a started bag.

    Raises:
        BagFormatError: If its content is unreadable.
    """
    text = record.get("serialized_metadata", "")
    if not text:
        return None
    try:
        loaded = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise BagFormatError(f"{where}: metadata record: {error}") from error
    if not isinstance(loaded, Mapping):
        raise BagFormatError(f"{where}: metadata record holds no mapping")
    return _parse(loaded, where)


def _dump(content: dict[str, Any]) -> str:
    # Text must not be folded: some YAML readers in use keep the line breaks.
    return yaml.safe_dump(content, sort_keys=False, width=2**20, allow_unicode=True)


def _parse(data: Mapping[str, Any], where: str) -> BagMetadata:
    try:
        version = int(data["version"])
        if not 1 <= version <= METADATA_VERSION:
            raise BagFormatError(
                f"{where}: metadata version {version} is not in [1, {METADATA_VERSION}]"
            )
        return BagMetadata(
            version=version,
            storage_identifier=str(data["storage_identifier"]),
            start_ns=int(data["starting_time"]["nanoseconds_since_epoch"]),
            duration_ns=int(data["duration"]["nanoseconds"]),
            message_count=int(data["message_count"]),
            topics=tuple(_parse_topic(entry) for entry in data["topics_with_message_count"]),
            relative_file_paths=tuple(str(name) for name in data["relative_file_paths"]),
            files=tuple(_parse_file(entry) for entry in data.get("files") or ()),
            custom_data={str(k): str(v) for k, v in (data.get("custom_data") or {}).items()},
            ros_distro=str(data.get("ros_distro") or ""),
            compression_mode=_compression(data, "compression_mode"),
            compression_format=_compression(data, "compression_format"),
        )
    except InvalidInputError as error:
        raise BagFormatError(f"{where}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BagFormatError(f"{where}: incomplete metadata ({error!r})") from error


def _parse_topic(entry: Mapping[str, Any]) -> TopicMetadata:
    topic = entry["topic_metadata"]
    return TopicMetadata(
        name=str(topic["name"]),
        type_name=str(topic["type"]),
        offers=parse_offers(topic.get("offered_qos_profiles", "")),
        type_hash=str(topic.get("type_description_hash") or ""),
        message_count=int(entry["message_count"]),
        serialization_format=str(topic["serialization_format"]),
    )


def _parse_file(entry: Mapping[str, Any]) -> FileMetadata:
    return FileMetadata(
        path=str(entry["path"]),
        start_ns=int(entry["starting_time"]["nanoseconds_since_epoch"]),
        duration_ns=int(entry["duration"]["nanoseconds"]),
        message_count=int(entry["message_count"]),
    )


def _compression(data: Mapping[str, Any], key: str) -> str:
    value = str(data.get(key) or "").lower()
    return "" if value == "none" else value
