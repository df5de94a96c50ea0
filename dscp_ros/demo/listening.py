"""Recording in this process, with something to look at meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from std_srvs.srv import Trigger

from dscp_core.errors import DscpError
from dscp_ros.bag import BagWriter
from dscp_ros.record import Recorder

_SPIN_S = 0.05
_SERVICE_S = 10.0


class DemoTimeoutError(DscpError):
    """Something that was waited for did not happen in time."""


class Listener:
    """Records until its block ends."""

    def __init__(self, node: Node, executor: SingleThreadedExecutor, recorder: Recorder) -> None:
        self._node = node
        self._executor = executor
        self._recorder = recorder

    @property
    def waiting_for(self) -> tuple[str, ...]:
        """Topics that nobody publishes yet."""
        return self._recorder.waiting_for

    def count(self, topic: str) -> int:
        """Messages recorded so far."""
        return self._recorder.counts[topic]

    def call(self, service: str) -> Future:
        """Asks a service; the answer comes while this listens."""
        client = self._node.create_client(Trigger, service)
        if not client.wait_for_service(_SERVICE_S):
            raise DemoTimeoutError(f"there is no service {service}")
        return client.call_async(Trigger.Request())

    def listen_until(
        self, condition: Callable[[], bool], deadline_s: float, waiting_for: Callable[[], str]
    ) -> None:
        """Records until a condition holds.

        Args:
            condition: Asked after every message; it may raise.
            deadline_s: Latest end, by ``time.monotonic``.
            waiting_for: Says what is missing, for the error.

        Raises:
            DemoTimeoutError: The deadline has passed.
        """
        while not condition():
            if time.monotonic() > deadline_s:
                raise DemoTimeoutError(f"time is up, still waiting for {waiting_for()}")
            self._executor.spin_once(timeout_sec=_SPIN_S)


@contextmanager
def listening(output: Path, topics: Sequence[str]) -> Iterator[Listener]:
    """Records topics into a bag for the length of the block.

    Raises:
        BagExistsError: Something else than a bag has the output's name.
        BagWriteError: The bag cannot be written.
    """
    context = Context()
    with BagWriter(output, overwrite=True) as writer:
        rclpy.init(context=context, args=[], signal_handler_options=SignalHandlerOptions.NO)
        try:
            node = Node("dscp_demo", context=context)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            yield Listener(node, executor, Recorder(node, writer, topics))
            executor.shutdown()
            node.destroy_node()
        finally:
            rclpy.shutdown(context=context)
