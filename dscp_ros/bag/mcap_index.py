"""Where the messages of an MCAP file are: from its summary, or from a scan where that is unusable.

A segment is a chunk, or a run of messages outside of chunks. A scan needs no summary: it walks
from record to record, and searches for the next chunk where the bytes are no record.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    Footer,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from dscp_ros.bag.mcap_records import (
    CHUNK_HEAD_MAX,
    MAGIC,
    RECORD_HEADER,
    ChunkHeader,
    RecordError,
    Records,
    parse,
    parse_chunk_header,
    read_chunk,
    read_chunk_prefix,
    read_records,
    split_records,
)
from dscp_ros.bag.recovery import Damage

FOOTER_LENGTH = RECORD_HEADER.size + 20
_CRC_LENGTH = 4
ROSBAG2_RECORD = "rosbag2"
"""Name of the Metadata record in which rosbag2 stores a copy of metadata.yaml."""


@dataclass(frozen=True)
class Segment:
    """A chunk, or a run of messages outside of chunks.

    Attributes:
        offset: First byte, that of the record's header.
        length: Bytes, headers included.
        start_ns: Earliest log time in it.
        end_ns: Latest log time in it.
        chunked: Whether it is a chunk.
        complete: False for a chunk that the end of the file cuts off.
        index_offsets: Offset of the message index of each channel in it.
        channel_ids: The channels with messages in it, or None when that is not known.
        message_counts: Messages by channel, or None when only the message index knows.
    """

    offset: int
    length: int
    start_ns: int
    end_ns: int
    chunked: bool = True
    complete: bool = True
    index_offsets: Mapping[int, int] = field(default_factory=dict)
    channel_ids: frozenset[int] | None = None
    message_counts: Mapping[int, int] | None = None

    def with_times(self, start_ns: int, end_ns: int) -> Segment:
        """Returns a copy with other log times."""
        return replace(self, start_ns=start_ns, end_ns=end_ns)

    def with_counts(self, counts: Mapping[int, int]) -> Segment:
        """Returns a copy that knows its messages by channel."""
        return replace(self, message_counts=counts, channel_ids=frozenset(counts))


@dataclass(frozen=True)
class BadSegment:
    """A segment that a scan could not read to its end.

    Attributes:
        segment: The segment.
        reason: What is wrong with it.
        kept: Messages by channel that are readable nevertheless.
    """

    segment: Segment
    reason: str
    kept: Mapping[int, int]


@dataclass
class FileIndex:
    """What is known about a file before its messages are read.

    Attributes:
        segments: In file order.
        schemas: Schema records by id.
        channels: Channel records by id.
        message_counts: Messages by channel: those promised by the summary, or those found.
        expected_count: Messages that the summary promises, or None without a usable summary.
        damages: What a scan found, other than bad segments.
        bad_segments: The bad segments that a scan found.
        metadata: rosbag2's metadata record, or None.
        data_crc: Checksum of everything before `data_end`, 0 where the file has none.
        data_end: Offset of the DataEnd record, or None when it was not reached.
    """

    segments: list[Segment] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    message_counts: dict[int, int] = field(default_factory=dict)
    expected_count: int | None = None
    damages: list[Damage] = field(default_factory=list)
    bad_segments: list[BadSegment] = field(default_factory=list)
    metadata: Mapping[str, str] | None = None
    data_crc: int = 0
    data_end: int | None = None


def read_body(handle: BinaryIO, offset: int, opcode: int, size: int) -> bytes:
    """Reads the body of the record at an offset.

    Raises:
        RecordError: If there is another record, or it reaches beyond `size`.
    """
    if not 0 <= offset <= size - RECORD_HEADER.size:
        raise RecordError(f"there is no byte {offset} in the file")
    handle.seek(offset)
    found, length = RECORD_HEADER.unpack(handle.read(RECORD_HEADER.size))
    if found != opcode:
        raise RecordError(f"record type {found} instead of {int(opcode)}")
    if length > size - offset - RECORD_HEADER.size:
        raise RecordError("the record reaches beyond the end of the file")
    return handle.read(length)


def read_chunk_header(handle: BinaryIO, offset: int, length: int) -> ChunkHeader:
    """Reads the header of the chunk at an offset; `length` is that of its body.

    Raises:
        RecordError: If the header is inconsistent.
    """
    handle.seek(offset + RECORD_HEADER.size)
    return parse_chunk_header(handle.read(min(CHUNK_HEAD_MAX, length)), length)


def load_segment(handle: BinaryIO, segment: Segment) -> Records:
    """Reads the records of a segment.

    Raises:
        RecordError: If a complete chunk is corrupt.
    """
    if not segment.chunked:
        handle.seek(segment.offset)
        return read_records(handle.read(segment.length))
    handle.seek(segment.offset)
    opcode, length = RECORD_HEADER.unpack(handle.read(RECORD_HEADER.size))
    if opcode != Opcode.CHUNK or length != segment.length - RECORD_HEADER.size:
        raise RecordError("the chunk's record header is wrong")
    header = read_chunk_header(handle, segment.offset, length)
    handle.seek(segment.offset + RECORD_HEADER.size + header.data_start)
    data = handle.read(header.data_length)
    if not segment.complete:
        return read_chunk_prefix(header, data)
    return read_chunk(header, data)


def count_from_index(handle: BinaryIO, segment: Segment, size: int) -> dict[int, int] | None:
    """Counts the messages of a chunk by channel from its message indexes, without reading it.

    Returns:
        The counts, or None when the indexes are missing or unreadable.
    """
    if segment.message_counts is not None:
        return dict(segment.message_counts)
    counts: dict[int, int] = {}
    for channel_id, offset in segment.index_offsets.items():
        try:
            index = parse(MessageIndex, read_body(handle, offset, Opcode.MESSAGE_INDEX, size))
        except RecordError:
            return None
        if index.channel_id != channel_id:
            return None
        counts[channel_id] = len(index.records)
    return counts or None


def read_summary(handle: BinaryIO, path: Path, size: int) -> FileIndex | None:
    """Builds the index from the summary at the end of the file.

    Returns:
        The index, or None when the file has no summary, or one without the records needed.

    Raises:
        RecordError: If the summary is cut off or corrupt.
    """
    footer_offset = size - len(MAGIC) - FOOTER_LENGTH
    handle.seek(max(footer_offset, 0))
    tail = handle.read()
    if footer_offset < len(MAGIC) or tail[-len(MAGIC) :] != MAGIC:
        raise RecordError("the file does not end as an MCAP file does")
    footer = parse(Footer, read_body(handle, footer_offset, Opcode.FOOTER, size))
    if footer.summary_start == 0:
        return None
    if not len(MAGIC) < footer.summary_start <= footer_offset:
        raise RecordError(f"the summary cannot start at byte {footer.summary_start}")
    handle.seek(footer.summary_start)
    summary = handle.read(footer_offset - footer.summary_start)
    covered = summary + tail[: FOOTER_LENGTH - _CRC_LENGTH]
    if footer.summary_crc and zlib.crc32(covered) != footer.summary_crc:
        raise RecordError("the summary's checksum is wrong")
    return _index_from_summary(handle, summary, footer.summary_start, size)


def _index_from_summary(
    handle: BinaryIO, summary: bytes, summary_start: int, size: int
) -> FileIndex | None:
    index = FileIndex()
    metadata_index: MetadataIndex | None = None
    for opcode, start, end in split_records(summary):
        body = summary[start:end]
        if opcode == Opcode.SCHEMA:
            schema = parse(Schema, body)
            index.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse(Channel, body)
            index.channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            statistics = parse(Statistics, body)
            index.expected_count = statistics.message_count
            index.message_counts = dict(statistics.channel_message_counts)
        elif opcode == Opcode.CHUNK_INDEX:
            index.segments.append(_segment_of(parse(ChunkIndex, body)))
        elif opcode == Opcode.METADATA_INDEX:
            entry = parse(MetadataIndex, body)
            metadata_index = entry if entry.name == ROSBAG2_RECORD else metadata_index
    if index.expected_count is None or index.message_counts.keys() - index.channels.keys():
        return None
    if index.expected_count and not index.segments:
        return None
    for segment in index.segments:
        if not RECORD_HEADER.size <= segment.length <= size - segment.offset:
            raise RecordError(f"the summary places a chunk at byte {segment.offset} of {size}")
    index.segments.sort(key=lambda segment: segment.offset)
    if metadata_index is not None:
        body = read_body(handle, metadata_index.offset, Opcode.METADATA, size)
        index.metadata = parse(Metadata, body).metadata
    index.data_crc, index.data_end = _data_end(handle, summary_start, size)
    return index


def _segment_of(chunk: ChunkIndex) -> Segment:
    offsets = dict(chunk.message_index_offsets)
    return Segment(
        offset=chunk.chunk_start_offset,
        length=chunk.chunk_length,
        start_ns=chunk.message_start_time,
        end_ns=chunk.message_end_time,
        index_offsets=offsets,
        channel_ids=frozenset(offsets) if offsets else None,
    )


def _data_end(handle: BinaryIO, summary_start: int, size: int) -> tuple[int, int]:
    """Returns checksum and offset of the DataEnd record, which stands before the summary."""
    offset = summary_start - RECORD_HEADER.size - _CRC_LENGTH
    body = read_body(handle, offset, Opcode.DATA_END, size)
    if len(body) != _CRC_LENGTH:
        raise RecordError(f"the record that ends the data has {len(body)} bytes")
    return int.from_bytes(body, "little"), offset
