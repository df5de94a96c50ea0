"""Where a command's result goes: to stdout, which is then nobody else's."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any, TextIO

_kept: list[TextIO] = []


@contextmanager
def results_only() -> Iterator[None]:
    """Keeps stdout for `print_document`; what a problem's own code prints goes to stderr."""
    _kept.append(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _kept.pop()


def print_document(document: Any, *, allow_nan: bool = True) -> None:
    """Prints one JSON document on stdout."""
    text = json.dumps(document, allow_nan=allow_nan)
    print(text, file=_kept[-1] if _kept else sys.stdout)
