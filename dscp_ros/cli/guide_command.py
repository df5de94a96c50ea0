"""`dscp guide`: run guidance as a ROS 2 node."""

from __future__ import annotations

from typing import Any

from dscp_ros.guidance.main import COMMAND


def add_parser(subparsers: Any) -> None:
    """Declare the command."""
    COMMAND.add_parser(subparsers, "guide", "run guidance as a ROS 2 node")
