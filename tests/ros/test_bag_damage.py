"""Bags that are really cut, flipped and overwritten: what is saved, and what is reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from std_msgs.msg import Float64, String

from dscp_core.errors import DscpError
from dscp_ros.bag import (
    BagDamagedError,
    BagFormatError,
    BagReader,
    BagWriter,
    Damage,
    DamageKind,
    Qos,
    RecoveryReport,
    recover_bag,
)

START_NS = 1_700_000_000_000_000_000
STEP_NS = 1_000_000
COUNT = 200
MAGIC_LENGTH = 8

Message = tuple[str, int, bytes]


@dataclass(frozen=True)
class Sample:
    """A good file, what is in it, and where its chunks are."""

    content: bytes
    messages: tuple[Message, ...]
    chunks: tuple[ChunkIndex, ...]

    def save(self, path: Path, content: bytes | None = None) -> Path:
        path.write_bytes(self.content if content is None else content)
        return path


def write(path: Path, compression: str) -> None:
    with BagWriter(path, compression=compression, chunk_bytes=1200) as writer:
        writer.add_topic("/x", Float64, Qos(depth=1))
        writer.add_topic("/note", String, Qos(depth=1, durability="transient_local"))
        for index in range(COUNT):
            time_ns = START_NS + index * STEP_NS
            writer.write("/x", Float64(data=float(index)), time_ns)
            if index % 10 == 0:
                writer.write("/note", String(data=f"note {index}"), time_ns + 1)


def read(path: Path) -> tuple[list[Message], RecoveryReport]:
    with BagReader(path) as reader:
        messages = [(m.topic.name, m.log_time_ns, m.data) for m in reader.messages()]
        return messages, reader.verify()


def sample_of(directory: Path, compression: str) -> Sample:
    path = directory / f"{compression}.mcap"
    write(path, compression)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunks = sorted(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)
    assert len(chunks) > 6
    messages, report = read(path)
    assert report.intact
    return Sample(path.read_bytes(), tuple(messages), tuple(chunks))


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Sample]:
    directory = tmp_path_factory.mktemp("samples")
    return {name: sample_of(directory, name) for name in ("none", "zstd", "lz4")}


@pytest.fixture
def sample(samples: dict[str, Sample]) -> Sample:
    return samples["zstd"]


def flipped(content: bytes, position: int, bits: int = 0xFF) -> bytes:
    return content[:position] + bytes([content[position] ^ bits]) + content[position + 1 :]


def in_chunk(chunk: ChunkIndex) -> tuple[int, int]:
    """Log times of a chunk: the messages in it are those from the first to the second."""
    return chunk.message_start_time, chunk.message_end_time


def only(report: RecoveryReport) -> Damage:
    (damage,) = report.damages
    return damage


compressions = st.sampled_from(["none", "zstd", "lz4"])
fraction = st.floats(0.0, 1.0, exclude_max=True)
# The fixtures only hold the good files; each example writes its own damaged one.
on_disk = settings(
    deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@given(compression=compressions, at=fraction)
@on_disk
def test_any_cut_is_reported_and_what_stands_before_it_is_read(
    samples: dict[str, Sample], tmp_path: Path, compression: str, at: float
) -> None:
    sample = samples[compression]
    cut = int(at * len(sample.content))
    path = sample.save(tmp_path / "cut.mcap", sample.content[:cut])
    if cut < MAGIC_LENGTH:
        with pytest.raises(BagFormatError, match=r"empty|not an MCAP file"):
            read(path)
        return
    messages, report = read(path)
    # Chunks do not overlap in time here, so what is saved is a beginning of the whole.
    assert messages == list(sample.messages[: len(messages)])
    whole = [c for c in sample.chunks if c.chunk_start_offset + c.chunk_length <= cut]
    assert len(messages) >= sum(
        1 for m in sample.messages if any(m[1] <= in_chunk(c)[1] for c in whole)
    )
    assert report.messages_read == len(messages)
    assert DamageKind.TRUNCATED in {damage.kind for damage in report.damages}
    if report.messages_lost is not None:
        assert report.messages_lost == len(sample.messages) - len(messages)


@given(
    compression=compressions,
    at=fraction,
    garbage=st.binary(min_size=1, max_size=300),
    cut=st.none() | fraction,
)
@on_disk
def test_any_overwritten_bytes_are_reported_or_a_clear_error(
    samples: dict[str, Sample],
    tmp_path: Path,
    compression: str,
    at: float,
    garbage: bytes,
    cut: float | None,
) -> None:
    sample = samples[compression]
    start = int(at * len(sample.content))
    content = sample.content[:start] + garbage + sample.content[start + len(garbage) :]
    content = content[: len(sample.content)]
    if cut is not None:
        content = content[: int(cut * len(content))]
    assume(content != sample.content)
    path = sample.save(tmp_path / "bad.mcap", content)
    refusal = ""
    try:
        messages, report = read(path)
    except DscpError as error:
        refusal = str(error)
    if refusal:
        assert str(path) in refusal
        assert start < MAGIC_LENGTH or len(content) < MAGIC_LENGTH
        return
    assert not report.intact
    if cut is None:
        # Every chunk has a checksum, so what is read is right. Only of a chunk that the end of the
        # file cuts off, wrong bytes can be read.
        assert set(messages) <= set(sample.messages)
        if report.messages_lost is not None:
            assert report.messages_lost == len(sample.messages) - len(messages)


@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
def test_a_corrupt_chunk_is_lost_alone_and_counted(
    samples: dict[str, Sample], tmp_path: Path, compression: str
) -> None:
    sample = samples[compression]
    chunk = sample.chunks[2]
    position = chunk.chunk_start_offset + chunk.chunk_length - 40
    path = sample.save(tmp_path / "b.mcap", flipped(sample.content, position))
    messages, report = read(path)
    first, last = in_chunk(chunk)
    lost = [m for m in sample.messages if first <= m[1] <= last]
    assert messages == [m for m in sample.messages if m not in lost]
    damage = only(report)
    assert damage.kind is DamageKind.CORRUPT_CHUNK
    assert damage.start_offset == chunk.chunk_start_offset
    assert damage.end_offset == chunk.chunk_start_offset + chunk.chunk_length
    assert (damage.start_time_ns, damage.end_time_ns) == (first, last)
    assert report.messages_lost == damage.messages_lost == len(lost)
    assert damage.lost_by_topic == {
        topic: sum(1 for m in lost if m[0] == topic) for topic in {m[0] for m in lost}
    }
    for part in ("corrupt chunk", str(path), str(chunk.chunk_start_offset), str(len(lost))):
        assert part in str(damage)


def test_a_corrupt_chunk_of_a_file_without_summary(sample: Sample, tmp_path: Path) -> None:
    chunk = sample.chunks[2]
    position = chunk.chunk_start_offset + chunk.chunk_length - 40
    content = flipped(sample.content, position)[: sample.chunks[5].chunk_start_offset]
    messages, report = read(sample.save(tmp_path / "b.mcap", content))
    first, last = in_chunk(chunk)
    lost = [m for m in sample.messages if first <= m[1] <= last]
    end = in_chunk(sample.chunks[4])[1]
    assert messages == [m for m in sample.messages if m not in lost and m[1] <= end]
    truncated, corrupt = report.damages
    assert (truncated.kind, truncated.messages_lost) == (DamageKind.TRUNCATED, None)
    # The message indexes after the chunk tell how many were in it.
    assert (corrupt.kind, corrupt.messages_lost) == (DamageKind.CORRUPT_CHUNK, len(lost))
    assert report.messages_lost is None
    assert report.messages_lost_at_least == len(lost)
    assert f"at least {len(lost)}" in report.lines()[-1]


def test_reading_goes_on_at_the_next_chunk(samples: dict[str, Sample], tmp_path: Path) -> None:
    # Neither the summary nor the length of the record can be used: the next chunk is searched for.
    sample = samples["none"]
    chunk, following = sample.chunks[3], sample.chunks[4]
    content = flipped(sample.content, chunk.chunk_start_offset + 7)[:-MAGIC_LENGTH]
    messages, report = read(sample.save(tmp_path / "b.mcap", content))
    first, last = in_chunk(chunk)
    assert messages == [m for m in sample.messages if not first <= m[1] <= last]
    damage = next(d for d in report.damages if d.kind is DamageKind.UNREADABLE_BYTES)
    assert (damage.start_offset, damage.end_offset) == (
        chunk.chunk_start_offset,
        following.chunk_start_offset,
    )
    assert report.messages_lost is None or report.messages_lost == len(sample.messages) - len(
        messages
    )


def test_a_cut_chunk_is_read_up_to_the_cut(samples: dict[str, Sample], tmp_path: Path) -> None:
    sample = samples["none"]
    chunk = sample.chunks[4]
    content = sample.content[: chunk.chunk_start_offset + chunk.chunk_length // 2]
    messages, report = read(sample.save(tmp_path / "b.mcap", content))
    before = sum(1 for m in sample.messages if m[1] <= in_chunk(sample.chunks[3])[1])
    inside = sum(1 for m in sample.messages if m[1] <= in_chunk(chunk)[1]) - before
    # Half of the chunk's bytes hold about half of its messages; at least a third is asked for.
    assert before + inside // 3 <= len(messages) < before + inside
    damage = only(report)
    assert damage.kind is DamageKind.TRUNCATED
    assert damage.start_offset == chunk.chunk_start_offset
    assert (damage.start_time_ns, damage.end_time_ns) == in_chunk(chunk)


def test_metadata_yaml_tells_how_many_messages_a_cut_lost(tmp_path: Path) -> None:
    write(tmp_path / "bag", "zstd")
    whole, _ = read(tmp_path / "bag")
    file = tmp_path / "bag" / "bag_0.mcap"
    file.write_bytes(file.read_bytes()[:2000])
    messages, report = read(tmp_path / "bag")
    assert 0 < len(messages) < len(whole)
    assert report.messages_expected == len(whole)
    assert report.messages_lost == len(whole) - len(messages)


@pytest.mark.parametrize(
    ("damage_at", "kind"),
    [
        # The last byte of the summary's own records, and of the footer before the closing magic.
        (lambda sample: len(sample.content) - 40, DamageKind.CORRUPT_SUMMARY),
        (lambda sample: len(sample.content) - 12, DamageKind.CORRUPT_SUMMARY),
        # A message index: between two chunks, used for counting only.
        (lambda sample: sample.chunks[1].chunk_start_offset - 3, DamageKind.CORRUPT_INDEX),
    ],
)
def test_damage_that_loses_no_message(
    sample: Sample, tmp_path: Path, damage_at: Callable[[Sample], int], kind: DamageKind
) -> None:
    content = flipped(sample.content, damage_at(sample))
    messages, report = read(sample.save(tmp_path / "b.mcap", content))
    assert messages == list(sample.messages)
    assert only(report).kind is kind
    assert report.messages_lost == 0


def test_a_file_of_zeros_after_its_start(sample: Sample, tmp_path: Path) -> None:
    # What a file system may leave of a file that was being written when the power failed.
    keep = sample.chunks[3].chunk_start_offset
    content = sample.content[:keep] + bytes(len(sample.content) - keep)
    messages, report = read(sample.save(tmp_path / "b.mcap", content))
    end = in_chunk(sample.chunks[2])[1]
    assert messages == [m for m in sample.messages if m[1] <= end]
    damage = only(report)
    assert (damage.start_offset, damage.end_offset) == (keep, len(content))


def test_strict_reading_stops_at_the_first_damage(sample: Sample, tmp_path: Path) -> None:
    position = sample.chunks[2].chunk_start_offset + 60
    corrupt = sample.save(tmp_path / "corrupt.mcap", flipped(sample.content, position))
    with (
        BagReader(corrupt, strict=True) as reader,
        pytest.raises(BagDamagedError, match="corrupt chunk") as caught,
    ):
        list(reader.messages())
    assert caught.value.damage.start_offset == sample.chunks[2].chunk_start_offset
    cut = sample.save(tmp_path / "cut.mcap", sample.content[:1000])
    with pytest.raises(BagDamagedError, match="truncated"):
        BagReader(cut, strict=True)


def test_damage_is_reported_once_however_often_it_is_read(sample: Sample, tmp_path: Path) -> None:
    position = sample.chunks[2].chunk_start_offset + 60
    path = sample.save(tmp_path / "b.mcap", flipped(sample.content, position))
    with BagReader(path) as reader:
        for _ in range(3):
            list(reader.messages())
        assert len(reader.verify().damages) == 1


def test_a_recovered_bag_is_good_and_has_everything_that_was_readable(
    samples: dict[str, Sample], tmp_path: Path
) -> None:
    sample = samples["none"]
    content = flipped(sample.content, sample.chunks[2].chunk_start_offset + 60)
    damaged = sample.save(tmp_path / "damaged.mcap", content[: len(content) - 500])
    before, damage = read(damaged)
    for output in (tmp_path / "good", tmp_path / "good.mcap"):
        report = recover_bag(damaged, output)
        assert report.damages == damage.damages
        after, good = read(output)
        assert good.intact
        assert after == before
    with BagReader(tmp_path / "good") as reader, BagReader(damaged) as source:
        for name, topic in source.topics.items():
            assert reader.topics[name].offers == topic.offers
            assert reader.topics[name].definition == topic.definition
        assert reader.metadata is not None
        assert "corrupt chunk" in reader.metadata.custom_data["recovered_from"]


def test_nothing_is_written_where_nothing_can_be_saved(sample: Sample, tmp_path: Path) -> None:
    hopeless = sample.save(tmp_path / "hopeless.mcap", sample.content[:60])
    with pytest.raises(BagFormatError, match="no message can be saved"):
        recover_bag(hopeless, tmp_path / "output")
    assert [path.name for path in tmp_path.iterdir()] == ["hopeless.mcap"]
