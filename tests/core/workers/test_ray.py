"""Evaluation on a Ray cluster: two nodes on this machine."""

from __future__ import annotations

import importlib
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learning_support import KillsItsWorker, square
from ray_support import Located, descent_jobs, descents, two_nodes

from dscp_core.errors import InvalidInputError
from dscp_core.learning.evaluator import Outcome
from dscp_core.workers.choice import make_engine
from dscp_core.workers.engine import Engine, WorkerLostError
from dscp_core.workers.processes import ProcessEngine

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.slow
@pytest.mark.timeout(300)  # ten processes have to start; minutes where many others are busy
def test_a_cluster_that_loses_a_worker_and_a_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One test, because starting a cluster takes longer than what is tested.
    import ray

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    # Every worker that is started takes a second of processor time: none in advance.
    monkeypatch.setenv("RAY_prestart_worker_first_driver", "0")
    monkeypatch.setenv("RAY_enable_worker_prestart", "0")
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "tests"))  # where the workers' functions are
    with two_nodes() as (cluster, second):
        first: Engine[float, float] = make_engine(square, None, cluster.address)
        try:
            assert first.workers == 2
            items = [float(n) for n in range(30) if n != 13]
            assert list(first.map(items)) == [n * n for n in items]
            assert list(first.map([])) == []
            # An abandoned map, then an error, which is the worker's own and comes in its place.
            assert next(first.map(items)) == 0.0
            results = first.map([1.0, 13.0, 2.0])
            assert next(results) == 1.0
            with pytest.raises(ArithmeticError, match="thirteen"):
                next(results)

            _check_losses(cluster, second)
            _check_poison(cluster.address)
            _check_missing_module(cluster.address, tmp_path, monkeypatch)
            assert list(first.map([3.0])) == [9.0], "the others have left its connection alone"
        finally:
            first.close()
        assert not ray.is_initialized()


def _check_losses(cluster: Any, second: Any) -> None:
    jobs = descent_jobs(24)
    engine = make_engine(descents, None, cluster.address)
    try:
        results = engine.map(jobs)
        found: list[Located] = [next(results)]
        killed = found[0].pid
        os.kill(killed, signal.SIGKILL)
        found += [next(results) for _ in range(8)]
        cluster.remove_node(second, allow_graceful=False)
        found += list(results)
    finally:
        engine.close()
    under_way = 3 * engine.workers  # these it may have finished before
    assert killed not in {result.pid for result in found[under_way:]}
    assert {result.threads for result in found} == {("1", "1", "1")}

    processes: ProcessEngine[Any, Located] = ProcessEngine(descents, 2)
    try:
        expected = list(processes.map(jobs))
    finally:
        processes.close()
    for name in Outcome.__dataclass_fields__:
        for one, other in zip(found, expected, strict=True):
            # To the last bit: no other library, and no other number of threads, has computed them.
            np.testing.assert_array_equal(getattr(one.outcome, name), getattr(other.outcome, name))
    assert np.all(Outcome.join([result.outcome for result in found]).converged)


def _check_poison(address: str) -> None:
    from dscp_core.workers.ray import RayEngine

    engine: RayEngine[int, int] = RayEngine(KillsItsWorker(None), 2, address, most_retries=1)
    try:
        assert engine.workers == 2
        results: list[int] = []
        with pytest.raises(WorkerLostError, match="item 5 of 20, and at each of 1 retries"):
            results.extend(engine.map(range(20)))
        assert results == [n * n for n in range(5)]
    finally:
        engine.close()


def _check_missing_module(address: str, directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from dscp_core.workers.ray import RayClusterError

    (directory / "only_here.py").write_text("def setup(): return abs\n")
    monkeypatch.syspath_prepend(directory)
    engine = make_engine(importlib.import_module("only_here").setup, None, address)
    with pytest.raises(RayClusterError, match="No module named 'only_here'"):
        list(engine.map([1]))
    engine.close()


@pytest.mark.parametrize("address", ["nowhere", "ray://127.0.0.1:10001", "host:port", "h:99999"])
def test_address_of_another_form(address: str) -> None:
    with pytest.raises(InvalidInputError, match="HOST:PORT"):
        make_engine(square, None, address)


def test_nobody_at_the_address() -> None:
    from dscp_core.workers.ray import RayClusterError

    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))  # and nobody listens
        address = f"127.0.0.1:{reserved.getsockname()[1]}"
        with pytest.raises(RayClusterError, match=f"no Ray cluster at {address}"):
            make_engine(square, None, address)


def test_no_workers() -> None:
    with pytest.raises(InvalidInputError, match="workers"):
        make_engine(square, 0, "127.0.0.1:6379")


def test_without_ray_the_error_names_the_extra() -> None:
    code = (
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] == 'ray':\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Refuse())\n"
        "from dscp_ros.cli.main import main\n"
        "sys.exit(main(['train', 'terminal-time', '--ray', '127.0.0.1:6379', "
        "'--output', sys.argv[1]]))\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, "/nonexistent/out"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 2, result.stderr
    assert "pip install 'dscp[ray]'" in result.stderr
