"""What all engines have in common.

Results come in the order of the items and do not depend on how many workers there are, nor on
which of them die, as long as an item's result depends on nothing but the item.
"""

# No numeric library is imported here: a worker reads this module before its threads are limited.
from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol, TypeVar

from dscp_core.errors import DscpError

ItemIn = TypeVar("ItemIn", contravariant=True)
ResultOut = TypeVar("ResultOut", covariant=True)

ONE_NUMERIC_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"), "1"
)
"""Environment of a worker: more threads than cores cost time, and sum in another order."""


class WorkerLostError(DscpError):
    """Workers keep dying on the same items."""


class Engine(Protocol[ItemIn, ResultOut]):
    """Evaluates items with a function that was made once per worker."""

    @property
    def workers(self) -> int:
        """How many items are evaluated at the same time."""
        ...

    def map(self, items: Sequence[ItemIn]) -> Iterator[ResultOut]:
        """Results in the order of the items.

        Raises:
            WorkerLostError: Workers keep dying.
        """
        ...

    def close(self) -> None:
        """End the workers."""
        ...
