"""A Ray cluster of two nodes on this machine, and items that its workers evaluate."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dscp_core import problems
from dscp_core.learning.evaluator import BestTimeJob, OptimumModel, Outcome
from dscp_core.learning.sampling import PAPER_BOX
from dscp_core.scp.scp import ScpOptions

NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}


@contextmanager
def two_nodes() -> Iterator[tuple[Any, Any]]:
    """The cluster, and the node that no driver is connected to. Leaves no process behind."""
    import ray
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args=NODE)
    session = cluster.head_node.get_session_dir_path()
    try:
        yield cluster, cluster.add_node(**NODE)
    finally:
        ray.shutdown()
        cluster.shutdown()
    for _ in range(100):
        if not processes_with(session):
            return
        time.sleep(0.1)
    raise AssertionError(f"Ray left processes behind: {processes_with(session)}")


def processes_with(text: str) -> list[str]:
    """Command lines of the processes that have a text in command line or environment."""
    found = []
    for directory in Path("/proc").glob("[0-9]*"):
        if directory.name == str(os.getpid()):
            continue
        try:
            command = (directory / "cmdline").read_bytes()
            environment = (directory / "environ").read_bytes()
        except OSError:
            continue  # it has ended meanwhile, or is another user's
        if text.encode() in command + environment:
            found.append(command.replace(b"\0", b" ").decode(errors="replace"))
    return found


@dataclass(frozen=True, eq=False)
class Located:
    """An outcome, and where it was computed.

    Attributes:
        outcome: Of the item.
        pid: Of the worker.
        threads: Its limits of numeric threads.
    """

    outcome: Outcome
    pid: int
    threads: tuple[str | None, ...]


def descents() -> Callable[[BestTimeJob], Located]:
    """Solves powered descents for their best time, coarsely."""
    evaluate = OptimumModel(problems.get("powered_descent"), intervals=10)()
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS")

    def located(job: BestTimeJob) -> Located:
        return Located(evaluate(job), os.getpid(), tuple(os.environ.get(n) for n in names))

    return located


def descent_jobs(count: int) -> list[BestTimeJob]:
    """Random initial states, one per job."""
    states = PAPER_BOX.uniform(count, np.random.default_rng(3))
    return [BestTimeJob(state[None], ScpOptions()) for state in states]
