"""A grid of points that survives interruptions: every result is kept as soon as it is there.

Results are JSON Lines in a file that is only appended to; the last member of each line is the
checksum of what stands before it. What a killed process or a full disk leaves half-written fails
its checksum and is computed again.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from dscp_core.errors import DscpError
from dscp_core.workers.engine import Engine

Item: TypeAlias = tuple[str | int | float, ...]
Row: TypeAlias = Mapping[str, Any]

FORMAT = "dscp-grid-2"
_MOST_NAMED = 5
_CHECKSUM = re.compile(rb'(.*),"crc32":"([0-9a-f]{8})"}', re.DOTALL)


class GridFileError(DscpError):
    """A file of results that cannot be continued."""


@dataclass(frozen=True)
class GridResult:
    """A complete grid.

    Attributes:
        rows: Results in the order of the items.
        kept: How many of them an earlier run had left.
        damaged: Lines that had been left half-written or changed; computed again where needed.
    """

    rows: tuple[Row, ...]
    kept: int
    damaged: int


def run_grid(
    path: Path,
    identity: Row,
    items: Sequence[Item],
    make_engine: Callable[[], Engine[Item, Row]],
    report: Callable[[int], object] = lambda _: None,
    *,
    restart: bool = False,
) -> GridResult:
    """Compute what is not in the file yet.

    Args:
        path: File of results; made if there is none. It may hold other items too.
        identity: All that the results depend on beside the item; JSON.
        items: What to compute.
        make_engine: Called if anything is left to compute; results are JSON, null for NaN.
        report: Told how many more items are done.
        restart: Forget what is in the file, whatever it is of.

    Raises:
        GridFileError: The file is of something else, cannot be written, or another process is
            writing to it.
    """
    with _GridFile(path, identity, restart) as file:
        waiting = [item for item in dict.fromkeys(items) if item not in file.rows]
        kept = sum(item in file.rows for item in items)
        report(kept)
        if waiting:
            engine = make_engine()
            try:
                for item, row in zip(waiting, engine.map(waiting), strict=True):
                    file.append(item, row)
                    report(1)
            finally:
                engine.close()
        return GridResult(tuple(file.rows[item] for item in items), kept, file.damaged)


class _GridFile:
    """The file, open for as long as nobody else may write to it."""

    def __init__(self, path: Path, identity: Row, restart: bool) -> None:
        self._path, self._restart = path, restart
        self._identity = json.loads(json.dumps(identity))
        self.rows: dict[Item, Row] = {}
        self.damaged = 0

    def __enter__(self) -> _GridFile:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._descriptor = os.open(self._path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            try:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise GridFileError(f"{self._path}: another process is writing to it") from None
            if self._restart:
                os.ftruncate(self._descriptor, 0)
            self._load()
        except BaseException:
            os.close(self._descriptor)
            raise
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)

    def append(self, item: Item, row: Row) -> None:
        """Keep a result, on the disk when this returns."""
        self._write({"item": item, "row": row})
        # As a later run would read it: the same whether computed now or before.
        self.rows[item] = json.loads(json.dumps(row))

    def _write(self, document: Row) -> None:
        text = json.dumps(document, allow_nan=False, separators=(",", ":"))[:-1]
        line = f'{text},"crc32":"{zlib.crc32(text.encode()):08x}"}}\n'.encode()
        try:
            written = os.write(self._descriptor, line)
            os.fsync(self._descriptor)
        except OSError as error:
            raise GridFileError(f"{self._path}: {error.strerror}") from error
        if written != len(line):
            raise GridFileError(f"{self._path}: no space left")

    def _load(self) -> None:
        content = self._path.read_bytes()
        complete, newline, tail = content.rpartition(b"\n")
        lines = [line for line in (*complete.split(b"\n"), tail) if line]
        documents = [found for line in lines if (found := _document(line)) is not None]
        self.damaged = len(lines) - len(documents)
        if not (documents or complete):  # nothing, or a first line that was never finished
            os.ftruncate(self._descriptor, 0)
            self._write({"format": FORMAT, "identity": self._identity})
            return
        if not documents or documents[0].get("format") != FORMAT:
            raise GridFileError(f"{self._path} is no file of results, or its first line is damaged")
        self._require_same(documents[0]["identity"])
        for document in documents[1:]:
            self.rows.setdefault(tuple(document["item"]), document["row"])
        # What is appended next must not become a part of an unfinished line.
        if tail and _document(tail) is None:
            os.ftruncate(self._descriptor, len(complete) + len(newline))
        elif tail:
            os.write(self._descriptor, b"\n")

    def _require_same(self, found: Row) -> None:
        names = sorted({*self._identity, *found})
        differing = [name for name in names if found.get(name) != self._identity.get(name)]
        if differing:
            named = [
                f"{name} {found.get(name)!r} there, {self._identity.get(name)!r} here"
                for name in differing[:_MOST_NAMED]
            ]
            more = len(differing) - len(named)
            raise GridFileError(
                f"{self._path} holds results of another setup ({'; '.join(named)}"
                f"{f'; and {more} more' if more else ''}): choose another folder, or --restart"
            )


def _document(line: bytes) -> dict[str, Any] | None:
    """A line's content; None where it does not fit its checksum."""
    found = _CHECKSUM.fullmatch(line)
    if found is None or found[2] != f"{zlib.crc32(found[1]):08x}".encode():
        return None
    content: dict[str, Any] = json.loads(found[1] + b"}")
    return content


def code_version() -> str:
    """Fingerprint of the numerical code: results of another one must not be mixed in."""
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parents[1]
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]
