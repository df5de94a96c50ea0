"""Entry point of the planner node."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from dscp_ros.node_process import NodeCommand, RunningNode

if TYPE_CHECKING:
    from rclpy.node import Node

    from dscp_ros.planner.parameter_files import ParameterArguments

DESCRIPTION = """\
Run the planner as a ROS 2 node (default name: /planner).

in   ~/vehicle_state  sensor_msgs/JointState       every state as a named scalar
     ~/state          nav_msgs/Odometry            or, of landings and their like: position,
                                                   velocity (twist in the child frame), and
     ~/mass           geometry_msgs/InertiaStamped the mass that completes them
out  ~/trajectory     trajectory_msgs/JointTrajectory   certified plans only
     ~/best_effort    trajectory_msgs/JointTrajectory   violates least; only if asked for
     ~/validity       diagnostic_msgs/DiagnosticArray   whether the last trajectory still holds
     ~/path           nav_msgs/Path                     of problems that bring drawings
     ~/markers        visualization_msgs/MarkerArray    likewise
     ~/report         diagnostic_msgs/DiagnosticArray   one per attempt or refused input
     /diagnostics     diagnostic_msgs/DiagnosticArray   health, once a second
srv  ~/plan, ~/reset, ~/reload                     std_srvs/Trigger
"""

EPILOG = """\
examples:
  dscp planner
  dscp planner --params-file config/powered_descent.yaml
  dscp planner --params-file config/entry.yaml
  dscp planner --problem my_problem.py:NAME
  dscp planner --ros-args -p deadline_s:=0.1 -r '~/state:=/vehicle/odometry'

exit codes: 0 ended by SIGINT or SIGTERM, 2 bad arguments or parameters.
"""


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--problem",
        metavar="PROBLEM",
        help="a known name, or FILE.py:NAME for a problem in a Python file, which is run; the same "
        "as -p problem:=PROBLEM",
    )


def _planner_node(node: Node, sources: ParameterArguments) -> RunningNode:
    from dscp_ros.planner.node import PlannerNode

    return PlannerNode(node, sources)


COMMAND = NodeCommand("planner", DESCRIPTION, EPILOG, _add_arguments, _planner_node)

if __name__ == "__main__":
    sys.exit(COMMAND.main())
