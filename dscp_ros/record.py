"""Recording topics into a bag."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from rclpy.clock import ROSClock
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dscp_core.errors import InvalidInputError
from dscp_ros.bag import BagWriter, Qos
from dscp_ros.bag.qos import subscription_qos
from dscp_ros.bag.schemas import message_class
from dscp_ros.replay.wake import Wake, stop_signals

NODE_NAME = "dscp_recorder"
_QUEUE_DEPTH = 1000
"""Messages per topic that may arrive between two spins, or that a latched topic may hold."""
_DISCOVERY_PERIOD_S = 0.05
_FLUSH_PERIOD_S = 1.0
_SPIN_S = 0.1


class Recorder:
    """Writes what is published on given topics into a bag.

    A topic is subscribed to as soon as it has a publisher, with a quality of service that every
    publisher satisfies, and the publishers' own quality of service is stored in the bag. The log
    time is the time of receipt, the publish time that of the sender, both in nanoseconds of the
    system clock; with `use_sim_time`, the log time is that of /clock.

    Args:
        node: Spun by the caller; its callbacks must not run in parallel.
        writer: Closed by the caller.
        topics: Absolute names of the topics.

    Attributes:
        counts: Messages recorded so far by topic.

    Raises:
        InvalidInputError: If a name is not absolute, or given twice.
    """

    def __init__(self, node: Node, writer: BagWriter, topics: Sequence[str]) -> None:
        for topic in topics:
            if not topic.startswith("/") or topics.count(topic) > 1:
                raise InvalidInputError("topic", topic, "an absolute name, given once")
        self._node = node
        self._writer = writer
        self._pending = list(topics)
        self.counts = dict.fromkeys(topics, 0)
        self._discover()
        node.create_timer(_DISCOVERY_PERIOD_S, self._discover)
        node.create_timer(_FLUSH_PERIOD_S, self._flush)

    @property
    def waiting_for(self) -> tuple[str, ...]:
        """Topics that have no publisher yet."""
        return tuple(self._pending)

    def _discover(self) -> None:
        for topic in tuple(self._pending):
            publishers = self._node.get_publishers_info_by_topic(topic)
            if publishers:
                self._pending.remove(topic)
                offers = [Qos.from_rclpy(publisher.qos_profile) for publisher in publishers]
                self._subscribe(topic, publishers[0].topic_type, offers)

    def _subscribe(self, topic: str, type_name: str, offers: Iterable[Qos]) -> None:
        distinct = tuple(dict.fromkeys(offers))
        self._writer.add_topic(topic, type_name, distinct)
        self._node.create_subscription(
            message_class(type_name),
            topic,
            partial(self._write, topic),
            subscription_qos(distinct, _QUEUE_DEPTH).to_rclpy(),
            raw=True,
        )

    def _write(self, topic: str, data: bytes, info: dict[str, Any]) -> None:
        clock = self._node.get_clock()
        simulated = isinstance(clock, ROSClock) and clock.ros_time_is_active
        log_time_ns = clock.now().nanoseconds if simulated else info["received_timestamp"]
        self._writer.write_raw(topic, data, log_time_ns, info["source_timestamp"])
        self.counts[topic] += 1

    def _flush(self) -> None:
        self._writer.flush()


def record(
    output: Path,
    topics: Sequence[str],
    *,
    overwrite: bool = False,
    compression: str = "zstd",
) -> dict[str, int]:
    """Records topics until SIGINT or SIGTERM. Must be called in the main thread.

    Args:
        output: The bag to write: a directory, or a file that ends in `.mcap`.
        topics: Absolute names of the topics.
        overwrite: Whether to replace a bag that is there.
        compression: `zstd`, `lz4` or `none`.

    Returns:
        Messages recorded by topic.

    Raises:
        BagExistsError: If the output is taken.
        BagWriteError: If writing fails.
        InvalidInputError: If a topic is invalid.
        UnknownMessageTypeError: If the type of a topic is not installed.
    """
    context = Context()
    with (
        closing(Wake()) as wake,
        stop_signals(wake) as stopping,
        BagWriter(output, overwrite=overwrite, compression=compression) as writer,
    ):
        rclpy.init(context=context, args=[], signal_handler_options=SignalHandlerOptions.NO)
        try:
            node = Node(NODE_NAME, context=context)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            recorder = Recorder(node, writer, topics)
            while not stopping:
                executor.spin_once(timeout_sec=_SPIN_S)
            executor.shutdown()
            node.destroy_node()
        finally:
            rclpy.shutdown(context=context)
    return recorder.counts
