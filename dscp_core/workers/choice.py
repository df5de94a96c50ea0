"""Which engine: worker processes of this machine, or a Ray cluster where an address is given."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeVar

from dscp_core.errors import DscpError
from dscp_core.workers.engine import Engine
from dscp_core.workers.processes import ProcessEngine

Item = TypeVar("Item")
Result = TypeVar("Result")


class RayMissingError(DscpError):
    """A Ray cluster is asked for, and Ray is not installed."""


def make_engine(
    setup: Callable[[], Callable[[Item], Result]],
    workers: int | None = None,
    ray_address: str | None = None,
) -> Engine[Item, Result]:
    """An engine of worker processes, or of a Ray cluster where an address is given.

    One worker is a process too: this process may have more numeric threads, which sum in another
    order, and results must not depend on the number of workers.

    Args:
        setup: Makes the function that evaluates an item, in each worker; picklable, as are items
            and results.
        workers: How many; None for one per processor, of this machine or of the cluster.
        ray_address: HOST:PORT of the cluster's head, or "auto" for the one that this machine
            belongs to.

    Raises:
        InvalidInputError: Fewer than one worker, or no address of a cluster.
        RayMissingError: An address is given, and Ray is not installed.
        RayClusterError: There is no usable cluster at the address.
    """
    if ray_address is None:
        return ProcessEngine(setup, available_cores() if workers is None else workers)
    try:
        from dscp_core.workers.ray import RayEngine
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise RayMissingError("a cluster needs Ray: pip install 'dscp[ray]'") from None
    return RayEngine(setup, workers, ray_address)


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))
