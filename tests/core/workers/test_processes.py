"""Evaluation in worker processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from learning_support import FailsToStart, KillsItsWorker, numeric_threads, square

from dscp_core.errors import InvalidInputError
from dscp_core.workers.choice import available_cores, make_engine
from dscp_core.workers.engine import WorkerLostError
from dscp_core.workers.processes import ProcessEngine, SerialEngine


def test_results_in_order_for_any_number_of_workers() -> None:
    items = [float(n) for n in range(40) if n != 13]
    expected = [n * n for n in items]
    assert list(SerialEngine(square).map(items)) == expected
    for workers in (1, 3):
        engine = ProcessEngine(square, workers)
        try:
            assert engine.workers == workers
            assert list(engine.map(items)) == expected
            assert list(engine.map([])) == []
            assert list(engine.map(items)) == expected, "an engine can be used again"
        finally:
            engine.close()


def test_one_numeric_thread_per_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    engine = ProcessEngine(numeric_threads, 2)
    try:
        assert list(engine.map([0, 1])) == [["1", "1"], ["1", "1"]]
    finally:
        engine.close()
    assert os.environ["OMP_NUM_THREADS"] == "4"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_a_setup_that_fails_says_why(tmp_path: Path) -> None:
    engine = ProcessEngine(FailsToStart(), 1)
    try:
        with pytest.raises(InvalidInputError, match="formulation"):
            list(engine.map([1]))
    finally:
        engine.close()


def test_an_engine_for_this_machine_has_a_worker_per_processor() -> None:
    for given, expected in ((None, available_cores()), (1, 1)):
        engine = make_engine(square, given)
        try:
            assert isinstance(engine, ProcessEngine), "one worker is a process too"
            assert engine.workers == expected
        finally:
            engine.close()


def test_a_dead_worker_is_replaced(tmp_path: Path) -> None:
    marker = tmp_path / "died"
    engine = ProcessEngine(KillsItsWorker(marker), 2)
    try:
        assert list(engine.map(range(20))) == [n * n for n in range(20)]
        assert marker.exists(), "a worker did die"
    finally:
        engine.close()


def test_workers_that_keep_dying() -> None:
    engine = ProcessEngine(KillsItsWorker(None), 2)
    try:
        results: list[int] = []
        with pytest.raises(WorkerLostError, match="near item 5 of 20"):
            results.extend(engine.map(range(20)))
        # What came before is not lost, and comes in order.
        assert results == [n * n for n in range(5)]
    finally:
        engine.close()


def test_an_error_in_a_worker_reaches_the_caller() -> None:
    engine = ProcessEngine(square, 2)
    try:
        with pytest.raises(ArithmeticError, match="thirteen"):
            list(engine.map([1.0, 13.0, 2.0]))
        assert list(engine.map([3.0])) == [9.0]
    finally:
        engine.close()


def test_no_workers() -> None:
    with pytest.raises(InvalidInputError, match="workers"):
        ProcessEngine(square, 0)
    assert available_cores() >= 1


def test_workers_end_with_their_parent() -> None:
    code = (
        "import sys, time\n"
        f"sys.path[:0] = {sys.path!r}\n"
        "from learning_support import square\n"
        "from dscp_core.workers.processes import ProcessEngine\n"
        "if __name__ == '__main__':\n"
        "    engine = ProcessEngine(square, 2)\n"
        "    list(engine.map([1.0, 2.0]))\n"
        "    print(*engine._pool._processes, flush=True)\n"
        "    time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    workers = [int(word) for word in parent.stdout.readline().split()]
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    parent.stdout.close()
    assert len(workers) == 2
    for _ in range(200):
        if not any(_running(worker) for worker in workers):
            return
        time.sleep(0.05)
    pytest.fail("workers outlived their parent by 10 s")


def _running(pid: int) -> bool:
    """Whether a process exists and is no zombie that nobody has asked about yet."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"
