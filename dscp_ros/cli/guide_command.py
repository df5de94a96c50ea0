"""`dscp guide`: run guidance as a ROS 2 node."""

from __future__ import annotations

import argparse
from typing import Any

from dscp_ros.guidance.main import DESCRIPTION, EPILOG, add_arguments
from dscp_ros.guidance.main import run as run_node
from dscp_ros.planner.main import ros_arguments


def add_parser(subparsers: Any) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        "guide", help="run guidance as a ROS 2 node", description=DESCRIPTION, epilog=EPILOG
    )
    add_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the node until a signal ends it.

    Returns:
        Exit code 0.

    Raises:
        InvalidInputError: Bad arguments or parameters.
    """
    return run_node(ros_arguments(args))
