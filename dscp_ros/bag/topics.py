"""Topics of a bag and their messages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mcap.records import Channel, Schema

from dscp_core.errors import InvalidInputError
from dscp_ros.bag.errors import BagFormatError, MessageDecodeError, UnknownMessageTypeError
from dscp_ros.bag.mcap_file import McapFile
from dscp_ros.bag.qos import Qos, parse_offers
from dscp_ros.bag.recovery import Damage, DamageKind
from dscp_ros.bag.schemas import MessageDefinition, installed_type_hash, message_class


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a bag.

    Attributes:
        name: Topic name.
        type_name: Message type, such as `nav_msgs/msg/Odometry`.
        message_count: Messages that the bag promises, damaged ones included.
        offers: Quality of service of each recorded publisher.
        definition: The definition stored in the bag, with the type's hash where it is known.
        encoding: How payloads are encoded, `cdr` for ROS 2.
    """

    name: str
    type_name: str
    message_count: int
    offers: tuple[Qos, ...]
    definition: MessageDefinition = field(repr=False)
    encoding: str = "cdr"

    @property
    def type_hash(self) -> str:
        """REP-2016 hash of the type when it was recorded, or empty."""
        return self.definition.type_hash

    def installed_class(self) -> type[Any]:
        """Returns the Python class that decodes this topic's messages.

        Raises:
            UnknownMessageTypeError: If the type is not installed, or is installed with another
                definition than the bag was recorded with.
        """
        if self.encoding != "cdr":
            raise UnknownMessageTypeError(
                self.type_name, f"its encoding is {self.encoding!r}, not 'cdr'", self.name
            )
        try:
            found = message_class(self.type_name)
            installed_hash = installed_type_hash(self.type_name) if self.type_hash else ""
        except UnknownMessageTypeError as error:
            raise UnknownMessageTypeError(error.type_name, error.reason, self.name) from error
        if installed_hash != self.type_hash:
            raise UnknownMessageTypeError(
                self.type_name,
                f"the bag's definition ({self.type_hash}) is not the installed one "
                f"({installed_hash})",
                self.name,
            )
        return found


@dataclass(frozen=True, slots=True)
class BagMessage:
    """One recorded message, not yet decoded.

    Attributes:
        topic: The topic it was recorded on.
        log_time_ns: When it was recorded.
        publish_time_ns: When it was published, as far as the recorder knew.
        sequence: The publisher's message counter, 0 where there is none.
        data: The serialised message.
    """

    topic: TopicInfo
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes

    def decode(self) -> Any:
        """Deserialises the message with rclpy.

        Raises:
            UnknownMessageTypeError: If the type is not installed as it was recorded.
            MessageDecodeError: If the bytes are no such message.
        """
        from rclpy.serialization import deserialize_message

        try:
            return deserialize_message(self.data, self.topic.installed_class())
        except (RuntimeError, ValueError, MemoryError) as error:  # RMWError is a RuntimeError
            raise MessageDecodeError(
                self.topic.name, self.topic.type_name, self.log_time_ns, str(error)
            ) from error


def topics_of(file: McapFile, note: Callable[[Damage], None]) -> dict[int, TopicInfo]:
    """Returns the topics of a file by channel id.

    Args:
        file: The file.
        note: Is told of quality of service that cannot be read.
    """
    index = file.index
    return {
        channel_id: _topic_of(
            file.path,
            channel,
            index.schemas[channel.schema_id],
            index.message_counts.get(channel_id, 0),
            note,
        )
        for channel_id, channel in index.channels.items()
        if channel.schema_id in index.schemas
    }


def _topic_of(
    path: Path, channel: Channel, schema: Schema, count: int, note: Callable[[Damage], None]
) -> TopicInfo:
    try:
        offers = parse_offers(channel.metadata.get("offered_qos_profiles", ""))
    except InvalidInputError as error:
        offers = ()
        detail = f"topic {channel.topic}: {error}; ROS 2's default is used"
        note(Damage(DamageKind.CORRUPT_METADATA, path, detail))
    definition = MessageDefinition(
        schema.name,
        schema.data.decode("utf-8", errors="replace"),
        schema.encoding,
        channel.metadata.get("topic_type_hash", ""),
    )
    return TopicInfo(
        channel.topic, schema.name, count, offers, definition, channel.message_encoding
    )


def merge_topics(path: Path, by_file: Iterable[Mapping[int, TopicInfo]]) -> dict[str, TopicInfo]:
    """Joins what several channels or files hold of one topic.

    Raises:
        BagFormatError: If a topic has two types.
    """
    merged: dict[str, TopicInfo] = {}
    for topics in by_file:
        for topic in topics.values():
            known = merged.get(topic.name)
            if known is None:
                merged[topic.name] = topic
                continue
            if known.type_name != topic.type_name:
                raise BagFormatError(
                    f"{path}: topic {topic.name} has two types, "
                    f"{known.type_name} and {topic.type_name}"
                )
            merged[topic.name] = replace(
                known,
                message_count=known.message_count + topic.message_count,
                offers=tuple(dict.fromkeys((*known.offers, *topic.offers))),
            )
    return dict(sorted(merged.items()))
