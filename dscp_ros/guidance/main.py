"""Entry point of the guidance node."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from dscp_core.errors import DscpError
from dscp_ros.cli import ExitCode
from dscp_ros.planner.main import RunningNode, add_ros_arguments, ros_arguments, run_node

if TYPE_CHECKING:
    from rclpy.node import Node

    from dscp_ros.planner.parameter_files import ParameterArguments

NODE_NAME = "guidance"

DESCRIPTION = """\
Run guidance as a ROS 2 node (default name: /guidance), beside a planner node, which it asks for
plans. Problems that bring guidance along only.

in   ~/vehicle_state       sensor_msgs/JointState           every state as a named scalar
     /planner/trajectory, /planner/validity, /planner/report
out  ~/thrust              geometry_msgs/WrenchStamped      the commanded force, at every tick
     ~/status              diagnostic_msgs/DiagnosticArray  phase, and why nothing is commanded
     /planner/vehicle_state, /planner/set_parameters_atomically
srv  ~/reset               std_srvs/Trigger                 begin another flight
"""

EPILOG = """\
examples:
  dscp guide
  dscp guide --params-file landing.yaml --ros-args -r '~/vehicle_state:=/navigation/state'
  dscp guide --ros-args -p guidance.replan_s:=2.0 -p guidance.known_planning_latency_s:=0.2

exit codes: 0 ended by SIGINT or SIGTERM, 2 bad arguments or parameters.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument(
        "problem", nargs="?", metavar="PROBLEM", help="a known name, or FILE.py:NAME"
    )
    add_ros_arguments(parser)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until a signal ends it.

    Args:
        argv: Arguments after the program's name; the process's own by default.

    Returns:
        Exit code.
    """
    parser = argparse.ArgumentParser(
        prog=NODE_NAME,
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_arguments(parser)
    try:
        return run(ros_arguments(parser.parse_args(argv)))
    except DscpError as error:
        print(f"{NODE_NAME}: error: {error}", file=sys.stderr)
        return ExitCode.BAD_INPUT


def run(arguments: Sequence[str]) -> int:
    """Run guidance with a ROS command line, as the last thing that a process does.

    Returns:
        Exit code 0, after SIGINT or SIGTERM.

    Raises:
        InvalidInputError: Bad arguments or parameters.
    """
    return run_node(arguments, NODE_NAME, _guidance_node)


def _guidance_node(node: Node, sources: ParameterArguments) -> RunningNode:
    from dscp_ros.guidance.node import GuidanceNode

    return GuidanceNode(node, sources)


if __name__ == "__main__":
    sys.exit(main())
