"""Evaluating many independent items in this process, or in worker processes."""

# No numeric library is imported here: a worker reads this module before its threads are limited.
from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, Generic, TypeVar

from dscp_core.errors import InvalidInputError
from dscp_core.workers.engine import ONE_NUMERIC_THREAD, WorkerLostError

Item = TypeVar("Item")
Result = TypeVar("Result")

_IN_FLIGHT_PER_WORKER = 3
_MAX_LOSSES = 3


@dataclass
class _UnderWay(Generic[Item, Result]):
    """An item that a worker has; the future is None when the worker died."""

    number: int
    item: Item
    future: Future[Result] | None = None

    def result(self) -> Result:
        """The item's result, when it is there."""
        if self.future is None:
            raise RuntimeError("item was never submitted")
        return self.future.result()


class SerialEngine(Generic[Item, Result]):
    """Evaluates in this process, one item after another."""

    def __init__(self, setup: Callable[[], Callable[[Item], Result]]) -> None:
        """Make the function.

        Args:
            setup: Makes the function that evaluates an item.
        """
        self._function = setup()

    @property
    def workers(self) -> int:
        """One."""
        return 1

    def map(self, items: Sequence[Item]) -> Iterator[Result]:
        """See `Engine.map`."""
        return (self._function(item) for item in items)

    def close(self) -> None:
        """Nothing to end."""


class ProcessEngine(Generic[Item, Result]):
    """Evaluates in spawned processes of one numeric thread each; replaces those that die."""

    def __init__(self, setup: Callable[[], Callable[[Item], Result]], workers: int) -> None:
        """Start the workers.

        Args:
            setup: Makes the function that evaluates an item, in each worker; picklable, as are
                items and results.
            workers: How many processes.

        Raises:
            InvalidInputError: Fewer than one worker.
        """
        if workers < 1:
            raise InvalidInputError("workers", workers, ">= 1")
        self._setup = setup
        self._workers = workers
        self._pool = self._start()

    @property
    def workers(self) -> int:
        """How many processes."""
        return self._workers

    def map(self, items: Sequence[Item]) -> Iterator[Result]:
        """See `Engine.map`; only a few items per worker are under way at any time."""
        waiting = iter(enumerate(items))
        under_way: deque[_UnderWay[Item, Result]] = deque()
        losses = 0
        try:
            while True:
                try:
                    self._fill(under_way, waiting)
                    if not under_way:
                        return
                    result = under_way[0].result()
                except BrokenProcessPool:
                    losses += 1
                    if losses > _MAX_LOSSES:
                        raise WorkerLostError(
                            f"workers died {losses} times near item {under_way[0].number} of "
                            f"{len(items)}"
                        ) from None
                    self._restart()
                    for entry in under_way:
                        entry.future = None
                    continue
                losses = 0
                under_way.popleft()
                yield result
        finally:
            for entry in under_way:
                if entry.future is not None:
                    entry.future.cancel()

    def _fill(
        self, under_way: deque[_UnderWay[Item, Result]], waiting: Iterator[tuple[int, Item]]
    ) -> None:
        """Give the workers what they have lost, then new items."""
        for entry in under_way:
            if entry.future is None:
                entry.future = self._pool.submit(_evaluate, entry.item)
        while len(under_way) < _IN_FLIGHT_PER_WORKER * self._workers:
            following = next(waiting, None)
            if following is None:
                return
            under_way.append(_UnderWay(*following))
            under_way[-1].future = self._pool.submit(_evaluate, following[1])

    def close(self) -> None:
        """End the workers; items under way are finished first."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _restart(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._pool = self._start()

    def _start(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(
            self._workers,
            mp_context=_Context(),
            initializer=_initialise,
            initargs=(self._setup,),
        )


class _WorkerProcess(SpawnProcess):
    """The numeric libraries of a process read the environment that it is started with."""

    def start(self) -> None:
        """Start with one numeric thread."""
        with _environment(ONE_NUMERIC_THREAD):
            super().start()


class _Context(SpawnContext):
    Process = _WorkerProcess


_setup: Callable[[], Callable[[Any], Any]] | None = None
_function: Callable[[Any], Any] | None = None


def _initialise(setup: Callable[[], Callable[[Any], Any]]) -> None:
    global _setup
    # Ctrl-C reaches the whole process group; the parent decides what to do about it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _setup = setup


def _end_with_parent() -> None:
    """A worker would wait for items for ever if its parent were killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _evaluate(item: Any) -> Any:
    global _function
    if _function is None:
        if _setup is None:
            raise RuntimeError("worker without a setup")
        # Here and not in the initialiser: its errors only say that the pool is broken.
        _function = _setup()
    return _function(item)


@contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
