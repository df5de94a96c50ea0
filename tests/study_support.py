"""What worker processes of the studies' tests import."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dscp_core.workers.grid import Item, Row


@dataclass(frozen=True)
class Counting:
    """Squares the second part of an item, and notes in a file that it did.

    Attributes:
        log: The file.
        seconds: How long an item takes.
    """

    log: Path
    seconds: float = 0.0

    def __call__(self) -> Callable[[Item], Row]:
        """Make the function."""
        return self.evaluate

    def evaluate(self, item: Item) -> Row:
        """Square."""
        number = int(item[1])
        time.sleep(self.seconds)
        descriptor = os.open(self.log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        os.write(descriptor, f"{number}\n".encode())
        os.close(descriptor)
        return {"square": number**2, "third": item[2], "none": None}
