"""Records of the MCAP format, read with every length and checksum checked.

The `mcap` library parses the records; what it assumes to be whole (lengths, complete reads, the
size that a chunk says it has) is checked here first, so that damaged bytes raise `RecordError`
and nothing else.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Protocol, TypeVar

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEADER = struct.Struct("<BQ")
CHUNK_HEADER = struct.Struct("<QQQII")
"""Start time, end time, uncompressed size, CRC, length of the compression's name."""

CHUNK_SIZE_LIMIT = 2**30
"""Largest uncompressed chunk accepted, so that a corrupt size cannot exhaust the memory."""

_MESSAGE_HEADER = struct.Struct("<HIQQ")
_CHUNK_DATA_LENGTH = struct.Struct("<Q")
_LONGEST_COMPRESSION_NAME = 16
CHUNK_HEAD_MAX = CHUNK_HEADER.size + _LONGEST_COMPRESSION_NAME + _CHUNK_DATA_LENGTH.size
"""Bytes to read from the start of a chunk's body to see its whole header."""

_RecordT = TypeVar("_RecordT", covariant=True)


class RecordError(Exception):
    """Bytes that are not the record they should be."""


class _RecordType(Protocol[_RecordT]):
    @staticmethod
    def read(stream: ReadDataStream) -> _RecordT: ...


@dataclass(frozen=True, slots=True)
class RawMessage:
    """A message as the file stores it."""

    channel_id: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


@dataclass(frozen=True)
class ChunkHeader:
    """What a chunk says about itself. Sizes in bytes, `data_start` counted from its body."""

    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    compression: str
    data_start: int
    data_length: int


@dataclass
class Records:
    """Content of a chunk, or of a run of records outside of chunks.

    Attributes:
        messages: The messages in file order.
        schemas: Schema records by id.
        channels: Channel records by id.
        error: Why reading stopped before the end, or None.
    """

    messages: list[RawMessage] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    error: str | None = None

    def count_by_channel(self) -> dict[int, int]:
        """Returns the number of messages of each channel."""
        counts: dict[int, int] = {}
        for message in self.messages:
            counts[message.channel_id] = counts.get(message.channel_id, 0) + 1
        return counts


def parse(record_type: _RecordType[_RecordT], body: bytes) -> _RecordT:
    """Parses the body of a record with the `mcap` library.

    Raises:
        RecordError: If the bytes are no such record.
    """
    try:
        return record_type.read(ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, UnicodeDecodeError, OverflowError) as error:
        raise RecordError(f"unreadable record ({error!r})") from error


def split_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields opcode, start and end of the body of each record.

    Raises:
        RecordError: At a record that reaches beyond the data.
    """
    position = 0
    while position < len(data):
        start = position + RECORD_HEADER.size
        if start > len(data):
            raise RecordError("a record header is cut off")
        opcode, length = RECORD_HEADER.unpack_from(data, position)
        if length > len(data) - start:
            raise RecordError(f"a record of {length} bytes is cut off")
        position = start + length
        yield opcode, start, position


def read_records(data: bytes) -> Records:
    """Reads messages, schemas and channels until the end or the first unreadable record."""
    records = Records()
    try:
        for opcode, start, end in split_records(data):
            if opcode == Opcode.MESSAGE:
                records.messages.append(_parse_message(data, start, end))
            elif opcode == Opcode.SCHEMA:
                schema = parse(Schema, data[start:end])
                records.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = parse(Channel, data[start:end])
                records.channels[channel.id] = channel
    except RecordError as error:
        records.error = str(error)
    return records


def parse_chunk_header(head: bytes, length: int) -> ChunkHeader:
    """Reads the header of a chunk.

    Args:
        head: The first bytes of the body, at least `CHUNK_HEAD_MAX` unless the chunk is shorter.
        length: Length of the whole body that the record claims.

    Raises:
        RecordError: If the sizes contradict each other or the compression is unknown.
    """
    try:
        start_ns, end_ns, size, crc, name_length = CHUNK_HEADER.unpack_from(head)
        if name_length > _LONGEST_COMPRESSION_NAME:
            raise RecordError(f"the compression's name has {name_length} bytes")
        name_end = CHUNK_HEADER.size + name_length
        compression = head[CHUNK_HEADER.size : name_end].decode("ascii")
        (data_length,) = _CHUNK_DATA_LENGTH.unpack_from(head, name_end)
    except (struct.error, UnicodeDecodeError) as error:
        raise RecordError(f"unreadable chunk header ({error})") from error
    data_start = name_end + _CHUNK_DATA_LENGTH.size
    if data_start + data_length != length:
        raise RecordError(f"chunk of {length} bytes claims {data_length} bytes of data")
    if compression not in ("", "lz4", "zstd"):
        raise RecordError(f"unknown compression {compression!r}")
    if size > CHUNK_SIZE_LIMIT:
        raise RecordError(f"uncompressed size {size} is above {CHUNK_SIZE_LIMIT} bytes")
    return ChunkHeader(start_ns, end_ns, size, crc, compression, data_start, data_length)


def read_chunk(header: ChunkHeader, data: bytes) -> Records:
    """Reads a whole chunk, or nothing of it where its checksum is wrong.

    Raises:
        RecordError: If the data do not decompress, or size or checksum are wrong.
    """
    plain = _decompress(header, data)
    if len(plain) != header.uncompressed_size:
        raise RecordError(f"{len(plain)} bytes instead of {header.uncompressed_size}")
    # By the format's specification, 0 means that no checksum was stored.
    if header.crc and zlib.crc32(plain) != header.crc:
        raise RecordError("wrong checksum")
    return read_records(plain)


def read_chunk_prefix(header: ChunkHeader, data: bytes) -> Records:
    """Reads what is left of a chunk that the end of the file cuts off. No checksum covers it."""
    try:
        plain = _decompress(header, data)
    except RecordError as error:
        return Records(error=str(error))
    return read_records(plain)


def _decompress(header: ChunkHeader, data: bytes) -> bytes:
    """Decompresses as much as is there, and never more than the size that the header gives."""
    limit = header.uncompressed_size
    try:
        if header.compression == "zstd":
            return bytes(zstandard.ZstdDecompressor().stream_reader(data).read(limit))
        if header.compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit))
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise RecordError(f"{header.compression}: {error}") from error
    return data


def _parse_message(data: bytes, start: int, end: int) -> RawMessage:
    if end - start < _MESSAGE_HEADER.size:
        raise RecordError(f"a message record of {end - start} bytes")
    channel_id, sequence, log_time_ns, publish_time_ns = _MESSAGE_HEADER.unpack_from(data, start)
    payload = data[start + _MESSAGE_HEADER.size : end]
    return RawMessage(channel_id, sequence, log_time_ns, publish_time_ns, payload)
