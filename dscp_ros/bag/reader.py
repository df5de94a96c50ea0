"""Reading bags in time order, with bounded memory, across damage."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from dscp_core.errors import InvalidInputError
from dscp_ros.bag.errors import (
    BagDamagedError,
    TopicNotFoundError,
    UnknownMessageTypeError,
)
from dscp_ros.bag.files import open_bag
from dscp_ros.bag.mcap_file import McapFile
from dscp_ros.bag.mcap_index import Segment
from dscp_ros.bag.mcap_records import RawMessage
from dscp_ros.bag.recovery import Damage, DamageKind, RecoveryReport
from dscp_ros.bag.topics import BagMessage, TopicInfo, merge_topics, topics_of


class BagReader(AbstractContextManager["BagReader"]):
    """Reads a bag: a directory, with or without metadata.yaml, or a single MCAP file.

    Damage is skipped and reported (`report`), unless `strict` is set. At any time, memory holds the
    chunks of the file that overlap in time, not the bag.

    Args:
        path: The bag.
        strict: Whether to raise at the first damage instead.

    Attributes:
        path: The bag.
        topics: The bag's topics by name.
        metadata: The bag's metadata as rosbag2 stores it, or None.

    Raises:
        BagNotFoundError: If there is no bag at the path.
        BagFormatError: If it cannot be read at all.
        BagDamagedError: If `strict` is set and the bag is damaged.
    """

    def __init__(self, path: str | Path, *, strict: bool = False) -> None:
        self.path = Path(path)
        self._strict = strict
        self._damages: dict[tuple[DamageKind, Path, int | str], Damage] = {}
        self._messages_read: int | None = None
        self._bag = open_bag(self.path)
        self.metadata = self._bag.metadata
        try:
            for damage in self._bag.damages:
                self._note(damage)
            self._topics_by_channel = {
                file.path: topics_of(file, self._note) for file in self._bag.files
            }
            self.topics = merge_topics(self.path, self._topics_by_channel.values())
        except BaseException:
            self.close()
            raise

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the bag's files."""
        self._bag.close()

    @property
    def files(self) -> tuple[Path, ...]:
        """The readable files of the bag."""
        return tuple(file.path for file in self._bag.files)

    @property
    def size_bytes(self) -> int:
        """Size of the files."""
        return sum(file.size for file in self._bag.files)

    @property
    def message_count(self) -> int:
        """Messages that the readable files promise."""
        return sum(topic.message_count for topic in self.topics.values())

    @property
    def start_ns(self) -> int:
        """First log time; 0 for a bag without messages."""
        return min((segment.start_ns for _, segment in self._segments()), default=0)

    @property
    def end_ns(self) -> int:
        """Last log time; 0 for a bag without messages."""
        return max((segment.end_ns for _, segment in self._segments()), default=0)

    @property
    def duration_ns(self) -> int:
        """Last minus first log time."""
        return self.end_ns - self.start_ns

    @property
    def report(self) -> RecoveryReport:
        """What was found damaged so far; complete after `verify`."""
        return RecoveryReport(
            tuple(self._damages.values()), self._messages_read, self._expected_count()
        )

    def require_topics(self, topics: Iterable[str]) -> None:
        """Checks that the bag has these topics.

        Raises:
            TopicNotFoundError: Naming the missing ones and those that the bag has.
        """
        missing = [topic for topic in topics if topic not in self.topics]
        if missing:
            raise TopicNotFoundError(missing, self.topics)

    def messages(
        self,
        topics: Iterable[str] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[BagMessage]:
        """Iterates over messages by log time.

        Args:
            topics: Only these topics; chunks without them are not read.
            start_ns: Only messages logged then or later.
            end_ns: Only messages logged before then.

        Raises:
            TopicNotFoundError: If the bag does not have one of the topics.
        """
        if isinstance(topics, str):
            raise InvalidInputError("topics", topics, "a collection of topic names")
        wanted = set(self.topics) if topics is None else set(topics)
        self.require_topics(sorted(wanted))
        return self._iterate(wanted, start_ns, end_ns)

    def decoded_messages(
        self,
        topics: Iterable[str] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[tuple[BagMessage, Any]]:
        """Iterates over messages and their decoded form; the arguments are those of `messages`.

        Raises:
            TopicNotFoundError: If the bag does not have one of the topics.
            UnknownMessageTypeError: If a type is not installed as it was recorded. `decodable`
                tells beforehand which topics are.
            MessageDecodeError: If the bytes of a message are no such message.
        """
        for message in self.messages(topics, start_ns=start_ns, end_ns=end_ns):
            yield message, message.decode()

    def decodable(
        self, topics: Iterable[str]
    ) -> tuple[list[str], dict[str, UnknownMessageTypeError]]:
        """Splits topics into those whose type is installed, and the others with the reason."""
        good: list[str] = []
        unknown: dict[str, UnknownMessageTypeError] = {}
        for name in topics:
            try:
                self.topics[name].installed_class()
            except UnknownMessageTypeError as error:
                unknown[name] = error
            else:
                good.append(name)
        return good, unknown

    def last_messages(self, depths: Mapping[str, int], before_ns: int) -> list[BagMessage]:
        """Returns the last messages of each topic before a time: what a latched topic holds then.

        Args:
            depths: How many messages, by topic.
            before_ns: Log time before which they were recorded.
        """
        last = {topic: deque[BagMessage](maxlen=depth) for topic, depth in depths.items()}
        for message in self.messages(depths, end_ns=before_ns):
            last[message.topic.name].append(message)
        return sorted(
            (message for queue in last.values() for message in queue),
            key=lambda message: message.log_time_ns,
        )

    def verify(self) -> RecoveryReport:
        """Reads everything, compares all checksums and counts, and reports."""
        read = 0
        for file in self._bag.files:
            for segment in file.index.segments:
                read += len(self._load(file, segment))
            damage = file.check_data_crc()
            if damage is not None and not self._damaged(file.path):
                self._note(damage)
        self._messages_read = read
        expected = self._expected_count()
        if expected is not None and expected != read and not self._damages:
            self._note(
                Damage(
                    DamageKind.COUNT_MISMATCH,
                    self.path,
                    f"{read} messages instead of {expected}",
                    messages_lost=max(0, expected - read),
                )
            )
        return self.report

    def _segments(self) -> Iterator[tuple[McapFile, Segment]]:
        for file in self._bag.files:
            for segment in file.index.segments:
                yield file, segment

    def _iterate(
        self, wanted: set[str], start_ns: int | None, end_ns: int | None
    ) -> Iterator[BagMessage]:
        """Merges the segments by time, loading each one when its first message is due."""
        pending = sorted(
            (
                (file, segment)
                for file, segment in self._segments()
                if self._overlaps(file, segment, wanted, start_ns, end_ns)
            ),
            key=lambda entry: entry[1].start_ns,
        )
        queue: list[tuple[int, int, BagMessage]] = []
        serial = 0  # keeps file order among equal times
        for file, segment in pending:
            while queue and queue[0][0] < segment.start_ns:
                yield heapq.heappop(queue)[2]
            topics = self._topics_by_channel[file.path]
            for raw in self._load(file, segment):
                topic = topics[raw.channel_id]
                time_ns = raw.log_time_ns
                if (
                    topic.name in wanted
                    and (start_ns is None or time_ns >= start_ns)
                    and (end_ns is None or time_ns < end_ns)
                ):
                    heapq.heappush(queue, (time_ns, serial, _message(topic, raw)))
                    serial += 1
        while queue:
            yield heapq.heappop(queue)[2]

    def _overlaps(
        self,
        file: McapFile,
        segment: Segment,
        wanted: set[str],
        start_ns: int | None,
        end_ns: int | None,
    ) -> bool:
        if start_ns is not None and segment.end_ns < start_ns:
            return False
        if end_ns is not None and segment.start_ns >= end_ns:
            return False
        if segment.channel_ids is None:
            return True
        topics = self._topics_by_channel[file.path]
        # A channel that is not known is read, so that its messages are reported as lost.
        return any(c not in topics or topics[c].name in wanted for c in segment.channel_ids)

    def _load(self, file: McapFile, segment: Segment) -> list[RawMessage]:
        messages, damages = file.load(segment)
        for damage in damages:
            self._note(damage)
        return messages

    def _note(self, damage: Damage) -> None:
        place = damage.detail if damage.start_offset is None else damage.start_offset
        key = (damage.kind, damage.file, place)
        if key not in self._damages:
            self._damages[key] = damage
            if self._strict:
                raise BagDamagedError(damage)

    def _damaged(self, path: Path) -> bool:
        return any(damage.file == path for damage in self._damages.values())

    def _expected_count(self) -> int | None:
        if self.metadata is not None:
            return self.metadata.message_count
        counts = [file.index.expected_count for file in self._bag.files]
        if any(count is None for count in counts):
            return None
        return sum(count or 0 for count in counts)


def _message(topic: TopicInfo, raw: RawMessage) -> BagMessage:
    return BagMessage(topic, raw.log_time_ns, raw.publish_time_ns, raw.sequence, raw.data)
