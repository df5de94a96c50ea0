"""Range limits of a problem's state where nobody sets others."""

from __future__ import annotations

from collections.abc import Callable

from msg_adapters.entry_state import EntryLimits
from msg_adapters.frames import ENTRY
from msg_adapters.state import InputLimits, StateLimits

_LIMITS: dict[str, Callable[[], StateLimits]] = {ENTRY: EntryLimits}


def default_limits(problem: str) -> StateLimits:
    """Default limits of a problem by name."""
    return _LIMITS.get(problem, InputLimits)()
