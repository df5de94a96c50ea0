"""One MCAP file: its index, and its messages segment by segment."""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path

from dscp_ros.bag.errors import BagFormatError, BagNotFoundError
from dscp_ros.bag.mcap_index import (
    FileIndex,
    Segment,
    count_from_index,
    load_segment,
    read_summary,
)
from dscp_ros.bag.mcap_records import MAGIC, RawMessage, RecordError
from dscp_ros.bag.mcap_scan import scan_file
from dscp_ros.bag.recovery import Damage, DamageKind

_CDR_HEADER_LENGTH = 4
_BLOCK_LENGTH = 2**20
_LATEST_TIME_NS = 2**63 - 1
"""ROS times are signed."""
_BAG_SUFFIXES_NOT_READ = {".db3": "an SQLite bag", ".bag": "a ROS 1 bag", ".zstd": "compressed"}


class McapFile(AbstractContextManager["McapFile"]):
    """An open MCAP file.

    Args:
        path: The file.

    Attributes:
        path: The file.
        size: Its size in bytes.
        index: Where its messages are.
        damages: What was found damaged on opening.

    Raises:
        BagNotFoundError: If there is no such file.
        BagFormatError: If it is no MCAP file, or cannot be read at all.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._handle = path.open("rb")
        except FileNotFoundError as error:
            raise BagNotFoundError(f"{path}: no such file") from error
        except OSError as error:
            raise BagFormatError(f"{path}: {error.strerror}") from error
        try:
            self.size = os.fstat(self._handle.fileno()).st_size
            self._check_magic()
            self.damages: list[Damage] = []
            self.index = self._build_index()
        except BaseException:
            self._handle.close()
            raise

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the file."""
        self._handle.close()

    def load(self, segment: Segment) -> tuple[list[RawMessage], list[Damage]]:
        """Reads the messages of a segment.

        Returns:
            The readable messages in file order, and what was found damaged.
        """
        try:
            records = load_segment(self._handle, segment)
        except RecordError as error:
            return [], [self._segment_damage(segment, str(error), {})]
        damages = []
        if records.error is not None and segment.complete:
            damages.append(self._segment_damage(segment, records.error, records.count_by_channel()))
        good = [message for message in records.messages if self._usable(message)]
        if len(good) < len(records.messages):
            damages.append(self._unusable_damage(segment, records.messages))
        return good, damages

    def check_data_crc(self) -> Damage | None:
        """Compares the checksum over all data, where the file has one."""
        if not self.index.data_crc or self.index.data_end is None:
            return None
        self._handle.seek(0)
        crc, left = 0, self.index.data_end
        while left > 0:
            block = self._handle.read(min(left, _BLOCK_LENGTH))
            crc = zlib.crc32(block, crc)
            left -= len(block)
        if crc == self.index.data_crc:
            return None
        return Damage(
            DamageKind.CORRUPT_INDEX,
            self.path,
            "the checksum over all data is wrong, though every chunk is good",
            start_offset=len(MAGIC),
            end_offset=self.index.data_end,
        )

    def _check_magic(self) -> None:
        start = self._handle.read(len(MAGIC))
        if start == MAGIC:
            return
        if not start:
            raise BagFormatError(f"{self.path}: the file is empty")
        known = _BAG_SUFFIXES_NOT_READ.get(self.path.suffix)
        hint = "" if known is None else f" ({known}, which is not supported)"
        raise BagFormatError(f"{self.path}: not an MCAP file{hint}: it starts with {start!r}")

    def _build_index(self) -> FileIndex:
        summary_error: str | None = None
        try:
            index = read_summary(self._handle, self.path, self.size)
        except RecordError as error:
            index, summary_error = None, str(error)
        if index is not None:
            return index
        index = scan_file(self._handle, self.path, self.size)
        self.damages.extend(index.damages)
        for bad in index.bad_segments:
            self.damages.append(self._segment_damage(bad.segment, bad.reason, bad.kept, index))
        whole = index.data_end is not None and all(
            damage.kind is not DamageKind.TRUNCATED for damage in self.damages
        )
        if summary_error is not None and whole:
            detail = f"{summary_error}; the file was read without it"
            self.damages.append(
                Damage(DamageKind.CORRUPT_SUMMARY, self.path, detail, start_offset=index.data_end)
            )
        return index

    def _usable(self, message: RawMessage) -> bool:
        channel = self.index.channels.get(message.channel_id)
        if channel is None or channel.schema_id not in self.index.schemas:
            return False
        if max(message.log_time_ns, message.publish_time_ns) > _LATEST_TIME_NS:
            return False
        return channel.message_encoding != "cdr" or len(message.data) >= _CDR_HEADER_LENGTH

    def _unusable_damage(self, segment: Segment, messages: list[RawMessage]) -> Damage:
        bad = [message for message in messages if not self._usable(message)]
        times = [message.log_time_ns for message in bad]
        counts: dict[int, int] = {}
        for message in bad:
            counts[message.channel_id] = counts.get(message.channel_id, 0) + 1
        return Damage(
            DamageKind.CORRUPT_MESSAGE,
            self.path,
            "messages without channel or schema, or with an impossible time or length",
            start_offset=segment.offset,
            end_offset=segment.offset + segment.length,
            messages_lost=len(bad),
            lost_by_topic=_by_topic(counts, self.index),
            start_time_ns=min(times),
            end_time_ns=max(times),
        )

    def _segment_damage(
        self,
        segment: Segment,
        reason: str,
        kept: Mapping[int, int],
        index: FileIndex | None = None,
    ) -> Damage:
        counts = count_from_index(self._handle, segment, self.size)
        lost: dict[int, int] = {}
        if counts is not None:
            lost = {c: n - kept.get(c, 0) for c, n in counts.items() if n > kept.get(c, 0)}
        return Damage(
            DamageKind.CORRUPT_CHUNK if segment.chunked else DamageKind.CORRUPT_MESSAGE,
            self.path,
            reason,
            start_offset=segment.offset,
            end_offset=segment.offset + segment.length,
            messages_lost=None if counts is None else sum(lost.values()),
            lost_by_topic=_by_topic(lost, index or self.index),
            start_time_ns=segment.start_ns or None,
            end_time_ns=segment.end_ns or None,
        )


def _by_topic(counts: Mapping[int, int], index: FileIndex) -> dict[str, int]:
    by_topic: dict[str, int] = {}
    for channel_id, count in counts.items():
        channel = index.channels.get(channel_id)
        name = f"channel {channel_id}" if channel is None else channel.topic
        by_topic[name] = by_topic.get(name, 0) + count
    return by_topic
