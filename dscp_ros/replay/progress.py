"""The progress bar."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager

from tqdm import tqdm

_FORMAT = "{desc}{percentage:3.0f}% |{bar}| {n:.1f}/{total:.1f} s{postfix}"


class Progress(AbstractContextManager["Progress"]):
    """A bar of bag time on stderr; does nothing when it is not shown.

    Args:
        total_s: Length of one pass, seconds of the bag.
        shown: Whether to show it; None where stderr is a terminal.
    """

    def __init__(self, total_s: float, shown: bool | None) -> None:
        self._total_s = total_s
        visible = sys.stderr.isatty() if shown is None else shown
        self._bar = tqdm(
            total=total_s,
            bar_format=_FORMAT,
            file=sys.stderr,
            disable=not visible,
            leave=True,
            mininterval=0.0,  # the caller chooses when to draw
        )

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def show(self, played_s: float, published: int, passes: int, *, paused: bool) -> None:
        """Draws the state.

        Args:
            played_s: Seconds of the bag played in this pass.
            published: Messages sent.
            passes: Which pass this is, from 1.
            paused: Whether the replay is paused.
        """
        if self._bar.disable:
            return
        self._bar.n = min(max(played_s, 0.0), self._total_s)
        self._bar.set_description_str(f"pass {passes} " if passes > 1 else "", refresh=False)
        state = ", paused" if paused else ""
        self._bar.set_postfix_str(f"{published} messages{state}", refresh=False)
        self._bar.refresh()
