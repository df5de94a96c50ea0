"""Waiting that a signal, another thread or a key can end, and the keys themselves."""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_KEY_BYTES = 64


class Wake:
    """Sleeps until a deadline, or until somebody calls `set`.

    `set` may be called from any thread and from a signal handler.
    """

    def __init__(self) -> None:
        self._receiver, self._sender = socket.socketpair()
        self._receiver.setblocking(False)
        self._sender.setblocking(False)
        self._keyboard: int | None = None

    def close(self) -> None:
        """Releases the sockets."""
        self._receiver.close()
        self._sender.close()

    def set(self) -> None:
        """Ends the current wait, or else the next one."""
        try:
            self._sender.send(b"\0")
        except BlockingIOError:
            return  # the buffer is full of wake-up calls already

    def wait(self, timeout_s: float | None) -> str:
        """Waits, and returns the keys pressed, if any.

        Args:
            timeout_s: How long at most; None without end.
        """
        sources: list[Any] = [self._receiver]
        if self._keyboard is not None:
            sources.append(self._keyboard)
        ready, _, _ = select.select(sources, [], [], timeout_s)
        if self._receiver in ready:
            self._receiver.recv(4096)
        if self._keyboard is not None and self._keyboard in ready:
            keys = os.read(self._keyboard, _KEY_BYTES)
            if not keys:  # the terminal is gone
                self._keyboard = None
            return keys.decode(errors="replace")
        return ""

    @contextmanager
    def keyboard(self) -> Iterator[bool]:
        """Delivers single keys while it is active; yields whether there is a terminal for that."""
        if not _owns_terminal():
            yield False
            return
        terminal = sys.stdin.fileno()
        saved = termios.tcgetattr(terminal)
        try:
            tty.setcbreak(terminal)
            self._keyboard = terminal
            yield True
        finally:
            self._keyboard = None
            termios.tcsetattr(terminal, termios.TCSADRAIN, saved)


@contextmanager
def stop_signals(wake: Wake) -> Iterator[list[int]]:
    """Collects SIGINT and SIGTERM in the list that it yields, and wakes up on each.

    Must be used in the main thread; the previous handlers come back at the end.
    """
    received: list[int] = []

    def handler(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        wake.set()

    previous = {
        number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield received
    finally:
        for number, former in previous.items():
            signal.signal(number, former)


def _owns_terminal() -> bool:
    """Whether stdin is a terminal whose keys go to this process.

    A background process that touches its terminal is stopped by the kernel.
    """
    if sys.stdin is None or not sys.stdin.isatty():
        return False
    return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
