"""A worker thread with a one-slot mailbox: the latest job wins, the ones it replaces are counted.

Planning takes milliseconds to seconds. In a callback it would hold up the node's clock, services
and diagnostics; in a queue it would plan from states that are long past.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Generic, TypeVar

Job = TypeVar("Job")


class MailboxWorker(Generic[Job]):
    """Runs a handler on the latest job, and short commands between jobs, all in one thread."""

    def __init__(self, handle: Callable[[Job], None], *, name: str) -> None:
        """Start the thread.

        Args:
            handle: Called in the thread with each job; it must not raise.
            name: Name of the thread.
        """
        self._handle = handle
        self._ready = threading.Condition()
        self._slot: Job | None = None
        self._commands: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._stopping = False
        self._drops = 0
        # A daemon, so that a solver that does not return cannot keep the process alive.
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def drops(self) -> int:
        """Jobs that a newer one replaced before they were started."""
        return self._drops

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def submit(self, job: Job) -> None:
        """Put a job into the slot; one that still waits there is dropped and counted."""
        with self._ready:
            if self._slot is not None:
                self._drops += 1
            self._slot = job
            self._ready.notify()

    def clear(self) -> None:
        """Take a waiting job out of the slot, without counting it."""
        with self._ready:
            self._slot = None

    def call(self, command: Callable[[], Any]) -> Future[Any]:
        """Run a command in the worker's thread, before the next job.

        Returns:
            Its result or exception; cancelled if the worker stops first.
        """
        future: Future[Any] = Future()
        with self._ready:
            if self._stopping:
                future.cancel()
            else:
                self._commands.append((future, command))
                self._ready.notify()
        return future

    def stop(self, timeout_s: float) -> bool:
        """Drop what waits and end the thread after the job in hand.

        Returns:
            Whether the thread ended in time.
        """
        with self._ready:
            self._stopping = True
            self._slot = None
            while self._commands:
                self._commands.popleft()[0].cancel()
            self._ready.notify()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._ready:
                self._ready.wait_for(
                    lambda: self._stopping or self._commands or self._slot is not None
                )
                if self._stopping:
                    return
                if self._commands:
                    future, command = self._commands.popleft()
                    job = None
                else:
                    job, self._slot = self._slot, None
            if job is None:
                _settle(future, command)
            else:
                self._handle(job)


def _settle(future: Future[Any], command: Callable[[], Any]) -> None:
    """Run a command and put what comes of it into its future."""
    if not future.set_running_or_notify_cancel():
        return
    try:
        result = command()
    except Exception as error:  # noqa: BLE001 - handed to the caller, who waits for it
        future.set_exception(error)
    else:
        future.set_result(result)
