"""`ros2 run dscp_ros replay`: the same command as `dscp replay`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from dscp_ros.cli.main import main as run_command


def main(argv: Sequence[str] | None = None) -> int:
    """Replays a bag.

    Args:
        argv: The arguments after the program's name; the process's own by default.

    Returns:
        The exit code: 0 good, 2 bad input.
    """
    arguments = sys.argv[1:] if argv is None else list(argv)
    return run_command(["replay", *arguments])
