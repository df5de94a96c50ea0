"""The planner node as a process of its own, fed over ROS topics."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

# Read when rclpy is imported; other machines must not hear a benchmark. Child processes inherit it.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from benchmarks.cases import Array
from dscp_core.problems import get
from dscp_ros.spinning import SpinningThread
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import problem_layout
from msg_adapters.report_message import report_from_message
from msg_adapters.stamps import nanoseconds_from_stamp
from msg_adapters.state import StampedState

STATE_TOPIC, TRAJECTORY_TOPIC = "/planner/vehicle_state", "/planner/trajectory"
REPORT_TOPIC = "/planner/report"
_WAIT_S = 30.0
_LAST_ANSWER_S = 2.0
_REPORTS = 50


@dataclass(frozen=True)
class NodeFigures:
    """What was measured of the node.

    Attributes:
        latencies_s: From publishing each state to its trajectory's callback.
        plan_s: The planner's part of each, as the node reports it.
        inside_s: From the arrival of each state in the node to the publication of its plan.
        unanswered: States without a trajectory.
        resident_mb: Resident memory at the end.
        start_s: Median time from launch to the discovery of the state subscription.
        starts: How many starts that is the median of.
    """

    latencies_s: list[float]
    plan_s: list[float]
    inside_s: list[float]
    unanswered: int
    resident_mb: float
    start_s: float
    starts: int


def fly_past(states: Array, times_s: Array, *, starts: int) -> NodeFigures:
    """Start the node, publish states (M, 7) in real time, and collect its trajectories."""
    with _Client() as client:
        start_s = []
        for _ in range(starts):
            with _planner() as process:
                start_s.append(client.wait_for_planner(process))
                if len(start_s) == starts:
                    client.publish_all(states, times_s)
                    resident_mb = _resident_mb(process.pid)
            client.wait_until_gone()
        return NodeFigures(
            latencies_s=list(client.latencies_s.values()),
            plan_s=client.plan_s,
            inside_s=client.inside_s,
            unanswered=len(states) - len(client.latencies_s),
            resident_mb=resident_mb,
            start_s=float(np.median(start_s)),
            starts=starts,
        )


@contextmanager
def _planner() -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([sys.executable, "-m", "dscp_ros.planner.main"])
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(_WAIT_S)


class _Client:
    """Publishes states and notes when their trajectories arrive."""

    def __init__(self) -> None:
        self.latencies_s: dict[int, float] = {}
        self.plan_s: list[float] = []
        self.inside_s: list[float] = []
        self._sent_s: dict[int, float] = {}
        self._layout = problem_layout(get("powered_descent"))
        self._context = Context()
        rclpy.init(context=self._context, args=[])
        self._node = Node("benchmark", context=self._context)
        newest = QoSProfile(depth=1)
        self._publisher = self._node.create_publisher(JointState, STATE_TOPIC, newest)
        self._node.create_subscription(
            JointTrajectory, TRAJECTORY_TOPIC, self._on_trajectory, newest
        )
        self._node.create_subscription(DiagnosticArray, REPORT_TOPIC, self._on_report, _REPORTS)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = SpinningThread(self._executor, "benchmark")

    def __enter__(self) -> _Client:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._thread.stop(_WAIT_S)
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def wait_for_planner(self, process: subprocess.Popen[bytes]) -> float:
        """Seconds from now until the node's state subscription is discovered."""
        launched = time.perf_counter()
        while not self._publisher.get_subscription_count():
            if process.poll() is not None or time.perf_counter() - launched > _WAIT_S:
                raise RuntimeError(f"no subscription to {STATE_TOPIC} within {_WAIT_S:g} s")
            time.sleep(0.002)
        found_s = time.perf_counter() - launched
        time.sleep(0.5)  # the trajectory's publisher is matched a moment later
        return found_s

    def wait_until_gone(self) -> None:
        """Wait until the node that was stopped is no longer known."""
        deadline = time.perf_counter() + _WAIT_S
        while self._publisher.get_subscription_count() and time.perf_counter() < deadline:
            time.sleep(0.01)

    def publish_all(self, states: Array, times_s: Array) -> None:
        """Publish every state at its time of flight, stamped with the clock."""
        began = time.perf_counter()
        for state, moment_s in zip(states, times_s, strict=True):
            time.sleep(max(0.0, began + float(moment_s) - time.perf_counter()))
            stamp_ns = self._node.get_clock().now().nanoseconds
            message = joint_state_from_state(StampedState(stamp_ns, state), self._layout)
            self._sent_s[stamp_ns] = time.perf_counter()
            self._publisher.publish(message)
        time.sleep(_LAST_ANSWER_S)

    def _on_trajectory(self, message: JointTrajectory) -> None:
        arrived_s = time.perf_counter()
        stamp_ns = nanoseconds_from_stamp(message.header.stamp)
        if stamp_ns in self._sent_s:
            self.latencies_s[stamp_ns] = arrived_s - self._sent_s[stamp_ns]

    def _on_report(self, message: DiagnosticArray) -> None:
        report = report_from_message(message)
        plan_ms = None if report.attempt is None else report.attempt.solve_time_ms
        if report.published and plan_ms is not None and report.latency_ms is not None:
            self.plan_s.append(1e-3 * plan_ms)
            self.inside_s.append(1e-3 * report.latency_ms)


def _resident_mb(pid: int) -> float:
    """Resident memory of a process, in units of 10^6 bytes."""
    for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise RuntimeError(f"no resident memory in /proc/{pid}/status")
