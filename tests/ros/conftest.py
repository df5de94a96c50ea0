"""rclpy without launch files: one private context and spin thread per test."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

# Child processes inherit both: the first name is for Fast DDS 2 (Jazzy), the second for 3.
_REPOSITORY = Path(__file__).resolve().parents[2]
_PROFILES = str(_REPOSITORY / "config" / "fastdds_profiles.xml")
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = _PROFILES
os.environ["FASTDDS_DEFAULT_PROFILES_FILE"] = _PROFILES

if TYPE_CHECKING:
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node

    from dscp_ros.spinning import SpinningThread

WAIT_TIMEOUT_S = 10.0
"""How long `wait_for` waits unless told: far above the 0.5 s that discovery may take."""

_POLL_INTERVAL_S = 0.005


def wait_for(predicate: Callable[[], bool], timeout: float = WAIT_TIMEOUT_S) -> bool:
    """Polls `predicate` until it holds or `timeout` seconds have passed.

    Returns:
        The last value of the predicate: use it as `assert wait_for(...)`.
    """
    deadline = time.monotonic() + timeout
    while not predicate():
        if time.monotonic() >= deadline:
            return predicate()
        time.sleep(_POLL_INTERVAL_S)
    return True


class RosHarness:
    """A private ROS context whose nodes are spun by one background thread.

    Attributes:
        domain_id: The domain of the context. A child process reaches the same topics
            with `env=harness.child_env()`.
        context: The private context; `rclpy`'s default context stays untouched.
        executor: Spins in a daemon thread.
    """

    def __init__(
        self,
        domain_id: int,
        context: Context,
        executor: SingleThreadedExecutor,
        thread: SpinningThread,
    ) -> None:
        self.domain_id = domain_id
        self.context = context
        self.executor = executor
        self._thread = thread
        self._nodes: list[Node] = []

    def create_node(self, name: str, **kwargs: object) -> Node:
        """Creates a node in this context and lets the executor spin it."""
        from rclpy.node import Node

        return self.add_node(Node(name, context=self.context, **kwargs))  # type: ignore[arg-type]

    def add_node(self, node: Node) -> Node:
        """Adopts a node made with `context=harness.context`; it is destroyed at the end."""
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def child_env(self, **extra: str) -> dict[str, str]:
        """Returns the environment of a child process that shares this domain.

        It imports the packages of this checkout, whether or not they are installed.
        """
        search = os.pathsep.join(filter(None, (str(_REPOSITORY), os.environ.get("PYTHONPATH"))))
        domain = str(self.domain_id)
        return {**os.environ, "ROS_DOMAIN_ID": domain, "PYTHONPATH": search, **extra}

    def wait_for(self, predicate: Callable[[], bool], timeout: float = WAIT_TIMEOUT_S) -> bool:
        """Same as the module's `wait_for`."""
        return wait_for(predicate, timeout)

    def stop_spinning(self) -> bool:
        """No callback runs any more; returns whether the thread ended in time."""
        return self._thread.stop(5.0)

    def destroy_nodes(self) -> None:
        """Destroys every node of the harness. The executor must have been shut down."""
        for node in self._nodes:
            node.destroy_node()
        self._nodes.clear()


def _free_domain_id() -> int:
    """Returns a domain id that differs between the workers and runs of one machine."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    return 1 + (os.getpid() * 7 + worker) % 100


@pytest.fixture
def ros() -> Iterator[RosHarness]:
    """A `RosHarness`: own context and domain, own executor in a background thread."""
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor

    from dscp_ros.spinning import SpinningThread

    context = Context()
    domain_id = _free_domain_id()
    rclpy.init(context=context, domain_id=domain_id, args=[])
    executor = SingleThreadedExecutor(context=context)
    thread = SpinningThread(executor, "ros-test-executor")
    harness = RosHarness(domain_id, context, executor, thread)
    try:
        yield harness
    finally:
        ended = harness.stop_spinning()
        harness.destroy_nodes()
        rclpy.shutdown(context=context)
        assert ended, "the executor's thread did not end"
