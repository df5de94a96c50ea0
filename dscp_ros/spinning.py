"""An executor that spins in a thread of its own."""

from __future__ import annotations

import threading

from rclpy.executors import Executor

_SPIN_S = 0.5


class SpinningThread:
    """Spins an executor until it is stopped.

    `Executor.spin` in a thread fails now and then when another one shuts the executor down: rclpy
    7.1 takes the guard condition away that the thread is about to wait for.
    """

    def __init__(self, executor: Executor, name: str) -> None:
        """Start.

        Args:
            executor: With its nodes, or with nodes to come.
            name: Name of the thread.
        """
        self._executor = executor
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._spin, name=name, daemon=True)
        self._thread.start()

    def stop(self, timeout_s: float) -> bool:
        """End the thread after the callback in hand, then shut the executor down.

        Returns:
            Whether it ended in time.
        """
        self._stopping.set()
        if self._thread.is_alive():
            self._executor.wake()
        self._thread.join(timeout_s)
        self._executor.shutdown(timeout_s)
        return not self._thread.is_alive()

    def _spin(self) -> None:
        while not self._stopping.is_set():
            self._executor.spin_once(timeout_sec=_SPIN_S)
