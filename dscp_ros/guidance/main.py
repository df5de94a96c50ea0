"""Entry point of the guidance node."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from dscp_ros.node_process import NodeCommand, RunningNode

if TYPE_CHECKING:
    from rclpy.node import Node

    from dscp_ros.planner.parameter_files import ParameterArguments

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


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "problem", nargs="?", metavar="PROBLEM", help="a known name, or FILE.py:NAME"
    )


def _guidance_node(node: Node, sources: ParameterArguments) -> RunningNode:
    from dscp_ros.guidance.node import GuidanceNode

    return GuidanceNode(node, sources)


COMMAND = NodeCommand("guidance", DESCRIPTION, EPILOG, _add_arguments, _guidance_node)

if __name__ == "__main__":
    sys.exit(COMMAND.main())
