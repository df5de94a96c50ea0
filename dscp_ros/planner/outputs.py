"""The node's topics: latched, so that whoever comes later sees the last plan and reports."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from dscp_core.problem.trajectory import Plan
from msg_adapters.diagnostics import Health, message_from_health
from msg_adapters.drawing import Drawing, no_markers
from msg_adapters.layout import StateLayout
from msg_adapters.report import PlanReport
from msg_adapters.report_message import message_from_report
from msg_adapters.trajectory import TrajectoryEncoder
from msg_adapters.validity import Validity, message_from_validity

_REPORT_DEPTH = 50
"""Reports kept for late and slow subscribers: every attempt has its report, in bursts too."""


def latched(depth: int) -> QoSProfile:
    """Reliable, and kept for subscribers that come later."""
    return QoSProfile(
        depth=depth,
        reliability=QoSReliabilityPolicy.RELIABLE,
        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
    )


class PlanOutputs:
    """Publishers of plans, reports and health."""

    def __init__(self, node: Node, layout: StateLayout, *, frame: str, draws: bool) -> None:
        """Create the publishers.

        Args:
            node: Node to publish from.
            layout: Names and order of the problem's state.
            frame: Frame of states and plans.
            draws: Whether there are drawings; without, nobody is offered any.
        """
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._layout = layout
        self._frame = frame
        self._encoder: TrajectoryEncoder | None = None
        self._trajectory = node.create_publisher(JointTrajectory, "~/trajectory", latched(1))
        self._path = node.create_publisher(Path, "~/path", latched(1)) if draws else None
        self._markers = (
            node.create_publisher(MarkerArray, "~/markers", latched(1)) if draws else None
        )
        self._best_effort = node.create_publisher(JointTrajectory, "~/best_effort", latched(1))
        self._validity = node.create_publisher(DiagnosticArray, "~/validity", latched(1))
        self._report = node.create_publisher(DiagnosticArray, "~/report", latched(_REPORT_DEPTH))
        self._health = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def publish_trajectory(self, plan: Plan, stamp_ns: int) -> None:
        """Publish what a controller follows. Not for several threads at once.

        Raises:
            RejectedInputError: The plan holds NaN; nothing is published.
        """
        self._trajectory.publish(self._encoded(plan, stamp_ns))

    def publish_best_effort(self, plan: Plan, stamp_ns: int) -> None:
        """Publish what violates least. Not for several threads at once.

        Raises:
            RejectedInputError: The plan holds NaN; nothing is published.
        """
        self._best_effort.publish(self._encoded(plan, stamp_ns))

    def publish_validity(self, validity: Validity) -> None:
        """Publish whether the last trajectory may be followed."""
        message = message_from_validity(validity, node=self._name, problem=self._layout.problem)
        self._validity.publish(message)

    def _encoded(self, plan: Plan, stamp_ns: int) -> JointTrajectory:
        nodes = len(plan.times_s)
        if self._encoder is None or self._encoder.nodes != nodes:
            self._encoder = TrajectoryEncoder(self._layout, nodes, frame=self._frame)
        return self._encoder.encode(plan, stamp_ns)

    def publish_drawing(self, plan: Plan, stamp_ns: int, drawing: Drawing | None) -> None:
        """Publish what people look at, if there is anything.

        Raises:
            InvalidInputError: The problem's scene is none; nothing is published.
        """
        if drawing is None or self._path is None or self._markers is None:
            return
        path, markers = drawing.draw(plan, stamp_ns, frame=self._frame)
        self._path.publish(path)
        self._markers.publish(markers)

    def clear_drawing(self, stamp_ns: int) -> None:
        """Remove every marker: there is no plan."""
        if self._markers is not None:
            self._markers.publish(no_markers(stamp_ns, frame=self._frame))

    def publish_report(self, report: PlanReport) -> None:
        """Publish what became of an input or attempt."""
        self._report.publish(message_from_report(report, node=self._name, frame=self._frame))

    def publish_health(self, health: Health, stamp_ns: int) -> None:
        """Publish the node's health."""
        message = message_from_health(
            health, stamp_ns, node=self._name, problem=self._layout.problem
        )
        self._health.publish(message)
