"""`dscp planner`: run the planner as a ROS 2 node."""

from __future__ import annotations

from typing import Any

from dscp_ros.planner.main import COMMAND


def add_parser(subparsers: Any) -> None:
    """Declare the command."""
    COMMAND.add_parser(subparsers, "planner", "run the planner as a ROS 2 node")
