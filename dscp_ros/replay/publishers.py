"""The publishers that stand in for those that were recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.qos import InvalidQoSProfileException

from dscp_core.errors import InvalidInputError
from dscp_ros.bag import BagError, BagFormatError, BagReader, Qos, TopicInfo
from dscp_ros.bag.qos import publisher_qos
from dscp_ros.replay.options import ReplayOptions
from dscp_ros.replay.stamping import has_leading_header

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.publisher import Publisher

CLOCK_TOPIC = "/clock"
_FAST_DEPTH = 32
"""Messages in flight per topic when the bag's timing is ignored. Hundreds overflow the transport's
buffers, and what is lost there is sent again only after the heartbeat period of seconds."""
ACKNOWLEDGE_S = 5.0
"""How long to wait for subscribers to confirm: longer than that period."""


@dataclass
class TopicPublisher:
    """One replayed topic.

    Attributes:
        topic: The topic of the bag.
        name: Its name now.
        qos: What is offered.
        publisher: The publisher.
        stamped: Whether `header.stamp` is to be set.
        published: Messages sent so far.
        unacknowledged: Messages sent since the subscribers last confirmed, where that is asked.
        silent: Whether subscribers failed to confirm in time.
    """

    topic: TopicInfo
    name: str
    qos: Qos
    publisher: Publisher
    stamped: bool
    published: int = 0
    unacknowledged: int = 0
    silent: bool = False

    def publish(self, data: bytes) -> None:
        """Sends a serialised message."""
        self.publisher.publish(data)
        self.published += 1
        self.unacknowledged += 1

    def await_acknowledgement(self, timeout_s: float) -> None:
        """Waits until every reliable subscriber has what was sent, or has been silent too long."""
        if self.qos.reliability == "reliable" and self.unacknowledged:
            done = self.publisher.wait_for_all_acked(Duration(seconds=timeout_s))
            self.silent = self.silent or not done
        self.unacknowledged = 0


def selected_topics(
    reader: BagReader, options: ReplayOptions
) -> tuple[list[TopicInfo], dict[str, str]]:
    """Chooses the topics to replay.

    Returns:
        The topics, and for each topic that is left out although it was not excluded, the reason.

    Raises:
        TopicNotFoundError: If an option names a topic that the bag does not have.
        UnknownMessageTypeError: If a type is not installed, unless that is to be skipped.
        InvalidInputError: If nothing is left.
    """
    for names in (options.topics, options.exclude, options.remaps, options.qos_overrides):
        reader.require_topics(names)
    chosen = [name for name in options.topics or reader.topics if name not in set(options.exclude)]
    skipped: dict[str, str] = {}
    if options.clock_hz is not None and CLOCK_TOPIC in chosen:
        chosen.remove(CLOCK_TOPIC)
        skipped[CLOCK_TOPIC] = "replaced by --clock"
    good, unknown = reader.decodable(chosen)
    for name, error in unknown.items():
        if not options.skip_unknown_types:
            raise error
        skipped[name] = str(error)
    if not good:
        raise InvalidInputError(
            "topics", ", ".join(chosen) or "none", "at least one topic that can be replayed"
        )
    return [reader.topics[name] for name in good], skipped


def create_publishers(
    node: Node, topics: list[TopicInfo], options: ReplayOptions
) -> dict[str, TopicPublisher]:
    """Creates a publisher for each topic, by recorded name.

    Raises:
        BagError: If two topics of different types get the same name.
        InvalidInputError: If a new name or an overridden policy is invalid.
    """
    types: dict[str, str] = {}
    publishers: dict[str, TopicPublisher] = {}
    for topic in topics:
        name = options.remaps.get(topic.name, topic.name)
        if types.setdefault(name, topic.type_name) != topic.type_name:
            raise BagFormatError(f"--remap: {name} would carry {types[name]} and {topic.type_name}")
        message_type = topic.installed_class()
        qos = _offer(topic, options)
        try:
            publisher = node.create_publisher(message_type, name, qos.to_rclpy())
        except InvalidTopicNameException as error:
            raise InvalidInputError("--remap", name, f"a topic name ({error})") from error
        except (InvalidQoSProfileException, RuntimeError) as error:
            raise BagError(f"topic {name} cannot be published with {qos}: {error}") from error
        stamped = options.restamp and has_leading_header(message_type)
        publishers[topic.name] = TopicPublisher(topic, name, qos, publisher, stamped)
    return publishers


def _offer(topic: TopicInfo, options: ReplayOptions) -> Qos:
    qos = publisher_qos(topic.offers)
    overrides = options.qos_overrides.get(topic.name)
    if overrides is not None:
        qos = Qos.from_dict(overrides, base=qos, where=f"--qos-overrides {topic.name}")
    if options.as_fast_as_possible and not qos.latched:
        # How deep the history is does not affect which subscriptions match, and a history of one
        # would lose all but the last message of each burst.
        return Qos.from_dict({"history": "keep_last", "depth": max(qos.depth, _FAST_DEPTH)}, qos)
    return qos
