"""Evaluating many independent items on a Ray cluster. Needs the extra `ray`.

Tasks, not actors: Ray runs the task of a dead worker or node again on any other one, also where no
processor is free for a new actor, and computes results that were stored on a dead node again.
"""

# No numeric library is imported here: a worker reads this module when it starts.
from __future__ import annotations

import logging
import socket
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any, Generic, TypeVar

import ray
from ray import exceptions

from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.workers.engine import ONE_NUMERIC_THREAD, WorkerLostError

Item = TypeVar("Item")
Result = TypeVar("Result")

_IN_FLIGHT_PER_PROCESSOR = 3
_REACH_TIMEOUT_S = 5.0


class RayClusterError(DscpError):
    """There is no usable Ray cluster at an address."""


class RayEngine(Generic[Item, Result]):
    """Evaluates on the processors of a cluster, one numeric thread per item.

    The machines of the cluster need this package in the same version, and Python and Ray in the
    same versions; this machine has to be one of them.
    """

    def __init__(
        self,
        setup: Callable[[], Callable[[Item], Result]],
        workers: int | None,
        address: str,
        *,
        most_retries: int = 3,
    ) -> None:
        """Connect to a cluster, unless this process is connected to one already.

        Args:
            setup: Makes the function that evaluates an item, in each worker; picklable, as are
                items and results.
            workers: The most items under way; None for enough to keep the cluster busy.
            address: HOST:PORT of the cluster's head, or "auto" for the one that this machine
                belongs to.
            most_retries: How often an item is evaluated again after its worker or node died.

        Raises:
            InvalidInputError: Fewer than one worker, or an address of another form.
            RayClusterError: The cluster cannot be reached or used.
        """
        if workers is not None and workers < 1:
            raise InvalidInputError("workers", workers, ">= 1")
        self._connected_here = not ray.is_initialized()
        if self._connected_here:
            _connect(address)
        processors = int(ray.cluster_resources().get("CPU", 0))  # type: ignore[no-untyped-call]
        if processors < 1:
            self.close()
            raise RayClusterError(f"the Ray cluster at {address} has no processors")
        self._workers = processors if workers is None else workers
        self._most_under_way = _IN_FLIGHT_PER_PROCESSOR * processors if workers is None else workers
        self._most_retries = most_retries
        self._setup = ray.put(setup)
        self._key = uuid.uuid4().hex
        self._task: Any = ray.remote(
            num_cpus=1,
            max_retries=most_retries,
            runtime_env={"env_vars": ONE_NUMERIC_THREAD},
        )(_evaluate)

    @property
    def workers(self) -> int:
        """How many items may be evaluated at the same time."""
        return self._workers

    def map(self, items: Sequence[Item]) -> Iterator[Result]:
        """See `Engine.map` of `workers.engine`; only a few items are under way at any time."""
        waiting = iter(items)
        # What is left here when nobody asks for more is finished and forgotten: `ray.cancel` would
        # now and then end this process, by a failed check in Ray 2.60.
        under_way: deque[Any] = deque()
        number = 0
        while True:
            for item in islice(waiting, self._most_under_way - len(under_way)):
                under_way.append(self._task.remote(self._key, [self._setup], item))
            if not under_way:
                return
            try:
                result = ray.get(under_way[0])
            except exceptions.RayTaskError as error:
                raise _original(error) from error
            except exceptions.RayError as error:
                raise WorkerLostError(
                    f"a worker died at item {number} of {len(items)}, and at each of "
                    f"{self._most_retries} retries: {type(error).__name__}"
                ) from error
            under_way.popleft()
            number += 1
            yield result

    def close(self) -> None:
        """Disconnect, which ends the workers; a connection made by others is left alone."""
        if self._connected_here:
            ray.shutdown()


def _connect(address: str) -> None:
    if address != "auto":
        _require_listener(address)
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING)
    except (ConnectionError, RuntimeError, ValueError, SystemExit) as error:
        # After minutes without an answer, Ray ends the process.
        reason = "no answer" if isinstance(error, SystemExit) else str(error)
        raise RayClusterError(f"cannot use the Ray cluster at {address}: {reason}") from error


def _require_listener(address: str) -> None:
    """Ray itself would try for minutes."""
    host, colon, port = address.rpartition(":")
    if not (host and colon and port.isdecimal()) or "/" in address or int(port) > 65535:
        raise InvalidInputError(
            "Ray address", address, "HOST:PORT of the cluster's head, as `ray start` prints it"
        )
    try:
        socket.create_connection((host, int(port)), timeout=_REACH_TIMEOUT_S).close()
    except OSError as error:
        raise RayClusterError(f"no Ray cluster at {address}: {error}") from error


def _original(error: exceptions.RayTaskError) -> Exception:
    """What the worker raised; or, of Ray's own, that it could not start."""
    cause = error.cause
    if isinstance(cause, exceptions.RayError):
        # Usually a machine without this package, or with another version of it.
        return RayClusterError(f"a worker of the Ray cluster cannot evaluate: {cause}")
    assert isinstance(cause, Exception)
    return cause


_functions: dict[str, Callable[[Any], Any]] = {}


def _evaluate(key: str, setup: list[Any], item: Any) -> Any:
    """Runs in a worker, which keeps the function that the latest engine's setup made.

    Args:
        key: Of the engine.
        setup: Reference to its setup; in a list, so that Ray does not fetch it for every item.
        item: To evaluate.
    """
    if key not in _functions:
        _functions.clear()
        _functions[key] = ray.get(setup[0])()
    return _functions[key](item)
