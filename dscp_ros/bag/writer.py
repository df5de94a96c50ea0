"""Writing bags that rosbag2 (Jazzy), `mcap_ros2` and `rosbags` read."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from dscp_core.errors import InvalidInputError
from dscp_ros.bag.cdr import serialise
from dscp_ros.bag.errors import BagWriteError
from dscp_ros.bag.mcap_index import ROSBAG2_RECORD
from dscp_ros.bag.metadata import EMPTY_START_NS, BagMetadata, FileMetadata, TopicMetadata
from dscp_ros.bag.partial import PartialBag
from dscp_ros.bag.qos import Qos, dump_offers
from dscp_ros.bag.schemas import (
    MessageDefinition,
    message_class,
    message_definition,
    type_name_of,
)

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

DEFAULT_CHUNK_BYTES = 256 * 1024
"""A damaged chunk is lost as a whole, so it is smaller than rosbag2's 768 KiB."""

_COMPRESSIONS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}
_MESSAGE_ENCODING = "cdr"
_PROFILE = "ros2"
_TIME_LIMIT_NS = 2**63
_ResultT = TypeVar("_ResultT")


class _Topic:
    def __init__(self, info: TopicMetadata, channel_id: int) -> None:
        self.info = info
        self.channel_id = channel_id
        self.message_count = 0


class BagWriter(AbstractContextManager["BagWriter"]):
    """Writes one bag; use it as a context manager.

    Everything is written under a temporary name beside the bag (`partial_path`) and renamed when
    the bag is closed, so that the bag is either whole or not there. When an exception leaves the
    `with` block, or the process dies, what was written stays under the temporary name, which
    `recover_bag` reads; nothing stays if no message was written.

    Args:
        path: A path that ends in `.mcap` makes a single file, any other a bag directory with
            `<name>_0.mcap` and `metadata.yaml`.
        overwrite: Whether to replace a bag that is there. Anything but a bag is never replaced.
        compression: `zstd`, `lz4` or `none`.
        chunk_bytes: Uncompressed size at which a chunk ends.
        custom_data: Notes to store in the bag's metadata.

    Attributes:
        path: Where the bag will be.
        message_count: Messages written so far.

    Raises:
        BagExistsError: If the path is taken.
        BagWriteError: If it cannot be created.
        InvalidInputError: If an argument is out of range.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        overwrite: bool = False,
        compression: str = "zstd",
        chunk_bytes: int = DEFAULT_CHUNK_BYTES,
        custom_data: Mapping[str, str] | None = None,
    ) -> None:
        if compression not in _COMPRESSIONS:
            raise InvalidInputError(
                "compression", compression, f"one of {', '.join(_COMPRESSIONS)}"
            )
        if chunk_bytes < 1:
            raise InvalidInputError("chunk_bytes", chunk_bytes, "at least 1")
        self.path = Path(path)
        self.message_count = 0
        self._custom_data = dict(custom_data or {})
        self._topics: dict[str, _Topic] = {}
        self._schema_ids: dict[str, int] = {}
        self._start_ns = EMPTY_START_NS
        self._end_ns = 0
        try:
            self._bag = PartialBag(self.path, overwrite=overwrite)
        except OSError as error:
            raise BagWriteError(self.path, _reason(error), None) from error
        self._open = True
        # Not all methods of the library's class have type annotations.
        self._mcap: Any = McapWriter(
            self._bag.stream,
            chunk_size=chunk_bytes,
            compression=_COMPRESSIONS[compression],
            enable_data_crcs=True,
        )
        self._guarded(lambda: self._mcap.start(profile=_PROFILE))

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
        else:
            self.abort()

    @property
    def partial_path(self) -> Path:
        """Where the bag is until it is closed."""
        return self._bag.partial_path

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics added so far."""
        return tuple(self._topics)

    def add_topic(
        self,
        name: str,
        message_type: str | type[Any],
        qos: Qos | QoSProfile | Sequence[Qos] = (),
        *,
        definition: MessageDefinition | None = None,
    ) -> None:
        """Declares a topic; each topic of the bag once, before its first message.

        Args:
            name: Absolute topic name.
            message_type: Message class, or name such as `nav_msgs/msg/Odometry`.
            qos: What the topic's publishers offer; ROS 2's default when empty.
            definition: The type's definition where it is not an installed one.

        Raises:
            InvalidInputError: If the name is not absolute, or was added before.
            UnknownMessageTypeError: If the type is not installed and no definition is given.
        """
        if not name.startswith("/") or name.endswith("/"):
            raise InvalidInputError("topic", name, "an absolute name such as /state")
        if name in self._topics:
            raise InvalidInputError("topic", name, "a topic that was not added before")
        type_name = message_type if isinstance(message_type, str) else type_name_of(message_type)
        if definition is None:
            definition = message_definition(type_name)
        if isinstance(qos, Qos):
            offers: tuple[Qos, ...] = (qos,)
        elif isinstance(qos, Sequence):
            offers = tuple(qos) or (Qos(),)
        else:
            offers = (Qos.from_rclpy(qos),)
        info = TopicMetadata(name, type_name, offers, definition.type_hash)
        channel_id = self._guarded(lambda: self._register(info, definition))
        self._topics[name] = _Topic(info, channel_id)

    def write(
        self, topic: str, message: Any, log_time_ns: int, publish_time_ns: int | None = None
    ) -> None:
        """Serialises a message and writes it.

        Args:
            topic: A topic that was added.
            message: A message of the topic's type.
            log_time_ns: Time by which the message is replayed, nanoseconds since the epoch.
            publish_time_ns: When it was published; `log_time_ns` if not given.

        Raises:
            InvalidInputError: If topic, type or time are wrong.
            BagWriteError: If writing fails.
        """
        type_name = self._topic(topic).info.type_name
        if not isinstance(message, message_class(type_name)):
            raise InvalidInputError(f"message on {topic}", type(message).__name__, type_name)
        self.write_raw(topic, serialise(message), log_time_ns, publish_time_ns)

    def write_raw(
        self,
        topic: str,
        data: bytes,
        log_time_ns: int,
        publish_time_ns: int | None = None,
        sequence: int = 0,
    ) -> None:
        """Writes a message that is serialised already; the arguments are those of `write`.

        Raises:
            InvalidInputError: If topic or time are wrong.
            BagWriteError: If writing fails.
        """
        entry = self._topic(topic)
        publish_time_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        for name, time_ns in (("log_time_ns", log_time_ns), ("publish_time_ns", publish_time_ns)):
            if not 0 <= time_ns < _TIME_LIMIT_NS:
                raise InvalidInputError(name, time_ns, "[0, 2^63)")
        self._guarded(
            lambda: self._mcap.add_message(
                entry.channel_id, log_time_ns, data, publish_time_ns, sequence
            )
        )
        entry.message_count += 1
        self.message_count += 1
        self._start_ns = min(self._start_ns, log_time_ns)
        self._end_ns = max(self._end_ns, log_time_ns)

    def flush(self) -> None:
        """Ends the chunk and hands it to the operating system, so that a crash does not lose it.

        Raises:
            BagWriteError: If writing fails.
        """
        self._guarded(self._mcap.flush)

    def close(self) -> None:
        """Completes the bag and gives it its name. Closing twice does nothing.

        Raises:
            BagWriteError: If writing fails.
            BagExistsError: If the path was taken in the meantime.
        """
        if not self._open:
            return
        self._guarded(self._finish)
        self._open = False
        try:
            self._bag.move_into_place()
        except OSError as error:
            raise BagWriteError(self.path, _reason(error), self.partial_path) from error

    def abort(self) -> None:
        """Stops writing without completing the bag; keeps the partial file if it has messages."""
        if not self._open:
            return
        self._open = False
        self._bag.abandon(keep=self.message_count > 0)

    def _topic(self, name: str) -> _Topic:
        self._require_open()
        if name not in self._topics:
            raise InvalidInputError(
                "topic", name, f"a topic added before: {', '.join(self._topics) or 'none'}"
            )
        return self._topics[name]

    def _register(self, info: TopicMetadata, definition: MessageDefinition) -> int:
        schema_id = self._schema_ids.get(info.type_name)
        if schema_id is None:
            schema_id = self._mcap.register_schema(
                info.type_name, definition.encoding, definition.text.encode()
            )
            self._schema_ids[info.type_name] = schema_id
        metadata = {
            "offered_qos_profiles": dump_offers(info.offers),
            "topic_type_hash": info.type_hash,
        }
        channel_id: int = self._mcap.register_channel(
            info.name, _MESSAGE_ENCODING, schema_id, metadata
        )
        return channel_id

    def _metadata(self) -> BagMetadata:
        duration_ns = max(0, self._end_ns - self._start_ns)
        return BagMetadata(
            start_ns=self._start_ns,
            duration_ns=duration_ns,
            message_count=self.message_count,
            topics=tuple(
                TopicMetadata(
                    entry.info.name,
                    entry.info.type_name,
                    entry.info.offers,
                    entry.info.type_hash,
                    entry.message_count,
                )
                for entry in self._topics.values()
            ),
            relative_file_paths=(self._bag.file_name,),
            files=(
                FileMetadata(self._bag.file_name, self._start_ns, duration_ns, self.message_count),
            ),
            custom_data=self._custom_data,
            ros_distro=os.environ.get("ROS_DISTRO", "jazzy"),
        )

    def _finish(self) -> None:
        metadata = self._metadata()
        self._mcap.flush()
        self._mcap.add_metadata(ROSBAG2_RECORD, metadata.to_record())
        self._mcap.finish()
        self._bag.complete(metadata.to_yaml())

    def _guarded(self, action: Callable[[], _ResultT]) -> _ResultT:
        """Runs a writing step; on failure the bag is given up and the error names what is left."""
        self._require_open()
        try:
            return action()
        except OSError as error:
            self._open = False
            left = self._bag.abandon(keep=self.message_count > 0)
            raise BagWriteError(self.path, _reason(error), left) from error

    def _require_open(self) -> None:
        if not self._open:
            raise InvalidInputError("bag", str(self.path), "a bag that is open for writing")


def _reason(error: OSError) -> str:
    return error.strerror or str(error)
