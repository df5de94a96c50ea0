"""Indexing an MCAP file without its summary, across damage."""

from __future__ import annotations

import mmap
import re
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Metadata, Schema

from dscp_ros.bag.mcap_index import (
    ROSBAG2_RECORD,
    BadSegment,
    FileIndex,
    Segment,
    load_segment,
    read_body,
    read_chunk_header,
)
from dscp_ros.bag.mcap_records import (
    CHUNK_HEAD_MAX,
    MAGIC,
    RECORD_HEADER,
    RecordError,
    parse,
    parse_chunk_header,
)
from dscp_ros.bag.recovery import Damage, DamageKind

_RUN_LENGTH_LIMIT = 2**20
"""Bytes of unchunked messages that make one segment: they are sorted in memory together."""
_PRIVATE_OPCODES = 0x80
"""Record types from here on are free for other software to use: they are skipped."""
# Record type and length, 28 bytes of times, size and checksum, and the name of a compression.
_CHUNK_START = re.compile(
    rb"\x06(?=.{8}.{28}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd))", flags=re.DOTALL
)


def scan_file(handle: BinaryIO, path: Path, size: int) -> FileIndex:
    """Builds the index of a file by walking through it.

    Every chunk is read once, for its channels and to see whether it is good. Memory use is that of
    the largest chunk.

    Args:
        handle: The file, opened for reading bytes.
        path: Its path, for the damage reports.
        size: Its size in bytes.
    """
    return _Scan(handle, path, size).run()


class _Scan:
    """One walk through a file; methods named after records return the position to go on at."""

    def __init__(self, handle: BinaryIO, path: Path, size: int) -> None:
        self._handle = handle
        self._path = path
        self._size = size
        self._index = FileIndex()
        self._run_start: int | None = None  # of consecutive messages outside of chunks
        self._chunk_indexes: dict[int, int] = {}  # of the last chunk

    def run(self) -> FileIndex:
        position: int | None = len(MAGIC)
        while position is not None and position < self._size:
            position = self._step(position)
        if position is not None:
            self._end_run(self._size)
            self._truncated(self._size, "the records that end a file are missing")
        index = self._index
        for segment in index.segments:
            for channel_id, count in (segment.message_counts or {}).items():
                index.message_counts[channel_id] = index.message_counts.get(channel_id, 0) + count
        return index

    def _step(self, position: int) -> int | None:
        body = position + RECORD_HEADER.size
        if body > self._size:
            self._end_run(position)
            self._truncated(position, "the file ends inside a record's header")
            return None
        self._handle.seek(position)
        opcode, length = RECORD_HEADER.unpack(self._handle.read(RECORD_HEADER.size))
        known = opcode >= _PRIVATE_OPCODES or Opcode.HEADER <= opcode <= Opcode.DATA_END
        overlong = length > self._size - body
        if opcode != Opcode.MESSAGE or overlong:
            self._end_run(position)
        if overlong:
            return self._overlong(position, opcode, length, known)
        if not known:
            return self._unreadable(position, f"there is no record type {opcode}")
        try:
            return self._record(opcode, position, body + length)
        except RecordError as error:
            return self._unreadable(position, str(error))

    def _record(self, opcode: int, position: int, end: int) -> int | None:
        index = self._index
        if opcode == Opcode.CHUNK:
            self._chunk(position, end)
        elif opcode == Opcode.MESSAGE:
            self._message(position, end)
        elif opcode == Opcode.MESSAGE_INDEX:
            channel_id = int.from_bytes(self._handle.read(2), "little")
            self._chunk_indexes[channel_id] = position
        elif opcode == Opcode.SCHEMA:
            schema = parse(Schema, self._body(position, opcode))
            index.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse(Channel, self._body(position, opcode))
            index.channels[channel.id] = channel
        elif opcode == Opcode.METADATA:
            metadata = parse(Metadata, self._body(position, opcode))
            if metadata.name == ROSBAG2_RECORD:
                index.metadata = metadata.metadata
        elif opcode == Opcode.DATA_END:
            index.data_crc = parse(DataEnd, self._body(position, opcode)).data_section_crc
            index.data_end = position
            self._summary(end)
            return None
        return end

    def _summary(self, position: int) -> None:
        """Ends the scan: what follows the data only repeats what was read."""
        self._handle.seek(max(position, self._size - len(MAGIC)))
        if self._handle.read() != MAGIC:
            self._truncated(position, "the file ends inside its summary", lost=0)

    def _message(self, position: int, end: int) -> None:
        if self._run_start is None:
            self._run_start = position
        if end - self._run_start > _RUN_LENGTH_LIMIT:
            self._end_run(end)

    def _end_run(self, end: int) -> None:
        start, self._run_start = self._run_start, None
        if start is not None:
            self._add(Segment(start, end - start, 0, 0, chunked=False))

    def _chunk(self, position: int, end: int) -> None:
        self._chunk_indexes = {}
        segment = Segment(position, end - position, 0, 0, index_offsets=self._chunk_indexes)
        try:
            header = read_chunk_header(self._handle, position, end - position - RECORD_HEADER.size)
            segment = segment.with_times(header.start_ns, header.end_ns)
            self._add(segment)
        except RecordError as error:
            self._index.bad_segments.append(BadSegment(segment, str(error), {}))

    def _add(self, segment: Segment) -> int:
        """Reads a segment and lists it with what is in it; returns its number of messages."""
        records = load_segment(self._handle, segment)
        counts = records.count_by_channel()
        if records.error is not None and segment.complete:
            self._index.bad_segments.append(BadSegment(segment, records.error, counts))
        self._index.schemas.update(records.schemas)
        self._index.channels.update(records.channels)
        if records.messages:
            times = [message.log_time_ns for message in records.messages]
            self._index.segments.append(
                segment.with_times(min(times), max(times)).with_counts(counts)
            )
        return len(records.messages)

    def _overlong(self, position: int, opcode: int, length: int, known: bool) -> int | None:
        """Handles a record that claims to reach beyond the end of the file."""
        detail = f"the file ends inside a record of {length} bytes"
        if opcode == Opcode.CHUNK:
            try:
                header = read_chunk_header(self._handle, position, length)
            except RecordError as error:
                if position + RECORD_HEADER.size + CHUNK_HEAD_MAX > self._size:
                    self._truncated(position, "the file ends inside a chunk's header")
                    return None
                return self._unreadable(position, str(error))
            # The header agrees with itself, so its length is right and the file is too short.
            segment = Segment(position, RECORD_HEADER.size + length, 0, 0, complete=False)
            saved = self._add(segment)
            self._truncated(
                position,
                f"the file ends inside a chunk; messages of it that were saved: {saved}",
                times=(header.start_ns, header.end_ns),
            )
            return None
        if known and self._next_chunk(position) is None:
            self._truncated(position, detail)
            return None
        return self._unreadable(position, detail)

    def _unreadable(self, position: int, reason: str) -> int | None:
        """Reports bytes that are no record and goes on at the next chunk."""
        following = self._next_chunk(position)
        end = self._size if following is None else following
        self._damage(DamageKind.UNREADABLE_BYTES, position, end, reason, lost=None)
        return following

    def _next_chunk(self, position: int) -> int | None:
        with mmap.mmap(self._handle.fileno(), 0, access=mmap.ACCESS_READ) as data:
            for match in _CHUNK_START.finditer(data, position + 1):
                start = match.start()
                _, length = RECORD_HEADER.unpack_from(data, start)
                body = start + RECORD_HEADER.size
                try:
                    parse_chunk_header(data[body : body + CHUNK_HEAD_MAX], length)
                except RecordError:
                    continue
                return start
        return None

    def _body(self, position: int, opcode: int) -> bytes:
        return read_body(self._handle, position, opcode, self._size)

    def _truncated(
        self,
        position: int,
        detail: str,
        lost: int | None = None,
        times: tuple[int, int] | None = None,
    ) -> None:
        self._damage(DamageKind.TRUNCATED, position, self._size, detail, lost, times)

    def _damage(
        self,
        kind: DamageKind,
        start: int,
        end: int,
        detail: str,
        lost: int | None,
        times: tuple[int, int] | None = None,
    ) -> None:
        start_ns, end_ns = times or (None, None)
        self._index.damages.append(
            Damage(kind, self._path, detail, start, end, lost, {}, start_ns, end_ns)
        )
