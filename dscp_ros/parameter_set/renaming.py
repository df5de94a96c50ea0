"""Exchanging two directories in one step, where the file system can."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
from pathlib import Path

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
_NOT_SUPPORTED = (errno.ENOSYS, errno.EINVAL, errno.EXDEV)


def exchange(source: Path, target: Path) -> None:
    """Swap two directories.

    In one step by renameat2(2). On a file system that cannot, in three: a process that is killed
    between them leaves the target's name free and both directories whole, the old one as
    ``.NAME.replaced-PID``.

    Raises:
        OSError: Renaming failed; both are as they were.
    """
    try:
        _renameat2(source, target, _RENAME_EXCHANGE)
    except OSError as error:
        if error.errno not in _NOT_SUPPORTED:
            raise
        exchange_in_steps(source, target)


def exchange_in_steps(source: Path, target: Path) -> None:
    """Swap two directories by three renames; see `exchange`.

    Raises:
        OSError: Renaming failed; both are as they were.
    """
    aside = target.with_name(f".{target.name}.replaced-{os.getpid()}")
    os.rename(target, aside)
    try:
        os.rename(source, target)
    except OSError:
        os.rename(aside, target)
        raise
    # The swap is complete for whoever looks at the target; the old content may keep its odd name.
    with contextlib.suppress(OSError):
        os.rename(aside, source)


def _renameat2(source: Path, target: Path, flags: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    function = getattr(libc, "renameat2", None)
    if function is None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    if function(_AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(target), flags) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), str(source), None, str(target))
