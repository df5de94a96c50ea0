"""The `dscp` command line: one module per command, imported only when that command runs.

A command module offers `add_parser(subparsers)`, which sets `run=function` as a default of its
parser; `run(args)` returns an exit code.
"""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """What the exit code of `dscp` means.

    An error of the program itself keeps Python's own code, 1, with its traceback.
    """

    OK = 0
    BAD_INPUT = 2
    NO_PLAN = 3
    NOT_BETTER = 4
    INTERRUPTED = 130  # 128 + SIGINT, the shells' convention
    BROKEN_PIPE = 141  # 128 + SIGPIPE
