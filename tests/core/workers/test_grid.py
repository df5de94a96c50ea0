"""A grid that is interrupted, damaged, and continued."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from study_support import Counting

from dscp_core.workers.grid import GridFileError, GridResult, Item, code_version, run_grid
from dscp_core.workers.processes import ProcessEngine, SerialEngine

IDENTITY = {"study": "toy", "tolerance": 1e-3}
ITEMS: list[Item] = [("point", n, 0.1 * n) for n in range(12)]


def grid(
    path: Path,
    log: Path,
    items: list[Item] = ITEMS,
    identity: Mapping[str, object] = IDENTITY,
    report: Callable[[int], object] = lambda _: None,
    restart: bool = False,
) -> GridResult:
    return run_grid(
        path, identity, items, lambda: SerialEngine(Counting(log)), report, restart=restart
    )


def evaluated(log: Path) -> list[int]:
    return [int(line) for line in log.read_text().split()] if log.exists() else []


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "new" / "toy.results"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "log"


def test_results_are_kept_and_used_by_larger_grids(path: Path, log: Path) -> None:
    first = grid(path, log, ITEMS[2:5])
    assert [row["square"] for row in first.rows] == [4, 9, 16]
    assert (first.kept, first.damaged) == (0, 0)
    done: list[int] = []
    whole = grid(path, log, report=done.append)
    assert [row["square"] for row in whole.rows] == [n * n for n in range(12)]
    assert whole.kept == 3
    assert sum(done) == 12
    assert sorted(evaluated(log)) == list(range(12)), "each once"
    again = grid(path, log)
    assert again.rows == whole.rows, "to the last bit, whether computed now or before"
    assert again.kept == 12
    assert len(evaluated(log)) == 12


def test_killed_in_the_middle(path: Path, log: Path, tmp_path: Path) -> None:
    code = (
        "import sys\n"
        f"sys.path[:0] = {sys.path!r}\n"
        "from pathlib import Path\n"
        "from study_support import Counting\n"
        "from dscp_core.workers.processes import ProcessEngine\n"
        "from dscp_core.workers.grid import run_grid\n"
        "if __name__ == '__main__':\n"
        f"    items = [('point', n, 0.1 * n) for n in range(2000)]\n"
        f"    setup = Counting(Path({str(log)!r}), seconds=0.01)\n"
        f"    run_grid(Path({str(path)!r}), {IDENTITY!r}, items, lambda: ProcessEngine(setup, 2))\n"
    )
    child = subprocess.Popen([sys.executable, "-c", code])
    try:
        while not path.exists() or path.read_bytes().count(b"\n") < 15:
            assert child.poll() is None, "it ended by itself"
            time.sleep(0.01)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    written = path.read_bytes().count(b"\n") - 1
    items: list[Item] = [("point", n, 0.1 * n) for n in range(written + 20)]
    # Another log: workers may finish what they have when their parent is killed.
    second = tmp_path / "second"
    result = run_grid(path, IDENTITY, items, lambda: ProcessEngine(Counting(second), 2))
    assert [row["square"] for row in result.rows] == [n * n for n in range(len(items))]
    assert result.kept >= written
    repeated = sorted(evaluated(second))
    assert repeated == list(range(result.kept, len(items))), "what was kept is not repeated"
    lines = path.read_bytes().splitlines()
    assert len(lines) == 1 + len(items), "and nothing is there twice"


@pytest.mark.parametrize("cut", [1, 2, 9, 30])
def test_half_written_line(path: Path, log: Path, cut: int) -> None:
    whole = grid(path, log)
    content = path.read_bytes()
    path.write_bytes(content[:-cut])
    again = grid(path, log)
    assert again.rows == whole.rows
    lost = cut > 1  # the end of the line alone is no loss
    assert (again.kept, again.damaged) == (12 - lost, int(lost))
    assert path.read_bytes() == content
    assert evaluated(log)[12:] == ([11] if lost else [])


def test_changed_line_in_the_middle(path: Path, log: Path) -> None:
    whole = grid(path, log)
    lines = path.read_bytes().splitlines(keepends=True)
    lines[5] = lines[5].replace(b'"square":16', b'"square":17')
    path.write_bytes(b"".join(lines))
    again = grid(path, log)
    assert again.rows == whole.rows
    assert (again.kept, again.damaged) == (11, 1)
    assert evaluated(log)[12:] == [4]


def test_killed_while_the_file_was_begun(path: Path, log: Path) -> None:
    whole = grid(path, log)
    path.write_bytes(path.read_bytes()[:20])
    assert grid(path, log).rows == whole.rows


@pytest.mark.parametrize(
    "content",
    [b"name,value\n1,2\n", b'{"format":"dscp-grid-2","crc32":"00000000"}\n', b"\0\0\0\n\0"],
)
def test_a_file_of_something_else_is_left_alone(path: Path, log: Path, content: bytes) -> None:
    path.parent.mkdir()
    path.write_bytes(content)
    with pytest.raises(GridFileError, match="no file of results"):
        grid(path, log)
    assert path.read_bytes() == content
    assert evaluated(log) == []


def test_results_of_other_settings_are_not_mixed(path: Path, log: Path) -> None:
    grid(path, log)
    content = path.read_bytes()
    with pytest.raises(
        GridFileError, match=r"\(code None there, '\w+' here; tolerance 0.001 there, 0.0001 here\)"
    ):
        grid(path, log, identity={"study": "toy", "tolerance": 1e-4, "code": code_version()})
    assert path.read_bytes() == content
    assert grid(path, log, restart=True).kept == 0
    assert grid(path, log).kept == len(ITEMS)


def test_one_writer_at_a_time(path: Path, log: Path) -> None:
    def report(_: int) -> None:
        for restart in (False, True):
            with pytest.raises(GridFileError, match="another process"):
                grid(path, log, restart=restart)

    grid(path, log, ITEMS[:1], report=report)
    assert grid(path, log, ITEMS[:1]).kept == 1, "nothing was forgotten"


def test_full_disk(path: Path, log: Path) -> None:
    grid(path, log, ITEMS[:3])
    before = path.stat().st_size
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (before + 70, limits[1]))
    try:
        with pytest.raises(GridFileError, match=r"no space left|too large"):
            grid(path, log)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    result = grid(path, log)
    assert [row["square"] for row in result.rows] == [n * n for n in range(12)]
    assert result.kept >= 3


def test_nan_is_refused_and_rows_are_json(path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        run_grid(path, IDENTITY, [("nan",)], lambda: SerialEngine(lambda: lambda _: {"x": 1e999}))
    for line in path.read_bytes().splitlines():
        json.loads(line)
    assert os.access(path, os.W_OK)
