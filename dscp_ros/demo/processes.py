"""Child processes that write to a log file and never outlive their block."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from dscp_core.errors import HelperLostError

_STOP_S = 10.0
"""Time to end after SIGINT. A plan in hand is finished first, which its deadline bounds."""
_GRACE_S = 3.0
"""The same when the demonstration itself is ending early."""
_TAIL_LINES = 15


class ChildFailedError(HelperLostError):
    """A child process ended when it should not have, or not as it should have."""


class Child:
    """A running child process."""

    def __init__(self, name: str, process: subprocess.Popen[bytes], log: Path) -> None:
        self.name = name
        self._process = process
        self._log = log

    def finished(self) -> bool:
        """Whether it ended with exit code 0.

        Raises:
            ChildFailedError: It ended with another one.
        """
        code = self._process.poll()
        if code is not None and code != 0:
            raise self._failed(f"ended with {_ending(code)}")
        return code == 0

    def require_running(self) -> None:
        """Check that it has not ended.

        Raises:
            ChildFailedError: It has.
        """
        if self.finished():
            raise self._failed("ended before it was told to")

    def stop(self) -> None:
        """Ask it to end, by SIGINT, and wait until it has.

        Raises:
            ChildFailedError: It does not end, or with another exit code than 0.
        """
        self._process.send_signal(signal.SIGINT)
        try:
            code = self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            raise self._failed(f"did not end within {_STOP_S:g} s of SIGINT") from None
        if code != 0:
            raise self._failed(f"ended with {_ending(code)} after SIGINT")

    def end(self) -> None:
        """End it if it still runs: kindly for a while, then at once."""
        if self._process.poll() is not None:
            return
        self._process.send_signal(signal.SIGINT)
        try:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_GRACE_S)
        finally:  # a second Ctrl-C ends the wait, and leaves no child behind either
            self._process.kill()
            self._process.wait()

    def _failed(self, what: str) -> ChildFailedError:
        lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
        tail = "\n".join(f"  | {line}" for line in lines[-_TAIL_LINES:])
        return ChildFailedError(f"{self.name} {what}; its last words ({self._log}):\n{tail}")


@contextmanager
def child(name: str, arguments: Sequence[str], log: Path) -> Iterator[Child]:
    """Runs a child for the length of the block; one that still runs at its end is ended.

    The child gets a session of its own: Ctrl-C reaches it through `Child.stop` only, so that
    everything ends in the same order as without.
    """
    with log.open("wb") as stream:
        process = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    running = Child(name, process, log)
    try:
        yield running
    finally:
        running.end()


def _ending(code: int) -> str:
    return f"exit code {code}" if code > 0 else f"signal {signal.Signals(-code).name}"
