"""A planner node, in its own process or in this one, and a client on real topics."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path as FilePath
from typing import Any, Protocol

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped
from nav_msgs.msg import Odometry, Path
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from dscp_core import problems
from dscp_ros.planner.node import PlannerNode
from dscp_ros.planner.parameter_files import ParameterArguments
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import StateLayout, problem_layout
from msg_adapters.report import PlanReport
from msg_adapters.report_message import report_from_message
from msg_adapters.state import StampedState
from msg_adapters.validity import Validity, validity_from_message

ROOT = FilePath(__file__).resolve().parents[2]
LAYOUT: StateLayout = problem_layout(problems.get("powered_descent"))
# The paper's case, core axes (x up).
STATE = np.array([5000.0, 500.0, 500.0, -150.0, 30.0, -30.0, 38000.0])
# 300 m up, falling at 150 m/s: 11 g would be needed, the engine gives 2.
UNREACHABLE = np.array([300.0, 0.0, 0.0, -150.0, 0.0, 0.0, 38000.0])

# Start of the process and discovery, on a machine that also runs other tests.
START_TIMEOUT_S = 30.0
# A plan takes tens of milliseconds; the rest is a busy machine.
PLAN_TIMEOUT_S = 20.0

# No message is too late and no plan too slow because the machine is busy.
PATIENT = {"state_max_age_s": 60.0, "mass_max_age_s": 60.0, "deadline_s": 15.0}

LATCHED = QoSProfile(
    depth=100,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
)


class Harness(Protocol):
    """What these helpers use of the `ros` fixture."""

    context: Context

    def create_node(self, name: str, **kwargs: object) -> Node: ...
    def add_node(self, node: Node) -> Node: ...
    def child_env(self, **extra: str) -> dict[str, str]: ...
    def wait_for(self, predicate: Callable[[], bool], timeout: float = ...) -> bool: ...


def now_ns() -> int:
    """Wall time, which is the node's ROS time unless it uses simulated time."""
    return time.time_ns()


class PlannerClient:
    """Publishes inputs, collects outputs, calls services."""

    def __init__(self, ros: Harness) -> None:
        self._ros = ros
        node = ros.create_node("client")
        self.node = node
        self.state = node.create_publisher(Odometry, "/planner/state", 10)
        self.mass = node.create_publisher(InertiaStamped, "/planner/mass", 10)
        self.vehicle_state = node.create_publisher(JointState, "/planner/vehicle_state", 10)
        self.trajectories: list[JointTrajectory] = []
        self.paths: list[Path] = []
        self.markers: list[MarkerArray] = []
        self.best_efforts: list[JointTrajectory] = []
        self.validity_messages: list[DiagnosticArray] = []
        self.report_messages: list[DiagnosticArray] = []
        self.diagnostics: list[DiagnosticArray] = []
        for kind, topic, store in (
            (JointTrajectory, "/planner/trajectory", self.trajectories),
            (Path, "/planner/path", self.paths),
            (MarkerArray, "/planner/markers", self.markers),
            (DiagnosticArray, "/planner/report", self.report_messages),
            (JointTrajectory, "/planner/best_effort", self.best_efforts),
            (DiagnosticArray, "/planner/validity", self.validity_messages),
        ):
            node.create_subscription(kind, topic, store.append, LATCHED)
        node.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, 10)
        self._clients = {
            name: node.create_client(Trigger, f"/planner/{name}")
            for name in ("plan", "reset", "reload")
        }

    @property
    def reports(self) -> list[PlanReport]:
        """Reports so far."""
        return [report_from_message(message) for message in list(self.report_messages)]

    @property
    def validities(self) -> list[Validity]:
        """What the node has told of its trajectories so far."""
        return [validity_from_message(message) for message in list(self.validity_messages)]

    def next_validity(self, known: int) -> Validity:
        """Wait for validity number ``known`` + 1."""
        assert self._ros.wait_for(lambda: len(self.validity_messages) > known, PLAN_TIMEOUT_S)
        return self.validities[known]

    def wait_until_connected(self, process: subprocess.Popen[str] | None = None) -> None:
        """Wait until the node hears every input and is heard on every output.

        Args:
            process: The node's process, if it has its own: it must not end meanwhile.
        """
        publishers = (self.state, self.mass, self.vehicle_state)

        def connected() -> bool:
            if process is not None and process.poll() is not None:
                raise AssertionError(f"the node has ended: {process.communicate()}")
            topics = ("trajectory", "path", "markers", "report")
            return (
                all(p.get_subscription_count() > 0 for p in publishers)
                and all(self.node.count_publishers(f"/planner/{t}") > 0 for t in topics)
                and all(c.service_is_ready() for c in self._clients.values())
            )

        assert self._ros.wait_for(connected, START_TIMEOUT_S)

    def send(self, values: np.ndarray = STATE, stamp_ns: int | None = None) -> int:
        """Publish a whole state in one message; returns its stamp."""
        stamp_ns = now_ns() if stamp_ns is None else stamp_ns
        state = StampedState(stamp_ns, np.asarray(values))
        self.vehicle_state.publish(joint_state_from_state(state, LAYOUT))
        return stamp_ns

    def report_of(self, stamp_ns: int, *, count: int = 1) -> PlanReport:
        """Wait for the last of ``count`` reports on an input."""

        def found() -> list[PlanReport]:
            return [report for report in self.reports if report.input_stamp_ns == stamp_ns]

        assert self._ros.wait_for(lambda: len(found()) >= count, PLAN_TIMEOUT_S), self.reports
        return found()[-1]

    def next_report(self, known: int) -> PlanReport:
        """Wait for report number ``known`` + 1."""
        assert self._ros.wait_for(lambda: len(self.report_messages) > known, PLAN_TIMEOUT_S)
        return self.reports[known]

    def call(self, service: str) -> Trigger.Response:
        """Call a service and wait for its answer."""
        future = self._clients[service].call_async(Trigger.Request())
        assert self._ros.wait_for(future.done, PLAN_TIMEOUT_S)
        return future.result()

    def send_and_report(self, values: np.ndarray = STATE) -> PlanReport:
        """Publish a state of now and wait for its report."""
        return self.report_of(self.send(values))

    def wait_for(self, predicate: Callable[[], Any]) -> None:
        """Wait for something that a plan brings about."""
        assert self._ros.wait_for(lambda: bool(predicate()), PLAN_TIMEOUT_S)


def start(
    ros: Harness, arguments: Sequence[str] = (), module: str = "dscp_ros.planner.main"
) -> subprocess.Popen[str]:
    """Start the node's process."""
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        cwd=ROOT,
        env=ros.child_env(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def end(process: subprocess.Popen[str]) -> None:
    """End a node's process by SIGTERM; one that does not end in time is killed and an error."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
    try:
        process.communicate(timeout=START_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise


@contextmanager
def running_planner(
    ros: Harness, arguments: Sequence[str] = ()
) -> Iterator[tuple[PlannerClient, subprocess.Popen[str]]]:
    """A connected client and the node's process, which is ended at the end."""
    patience = [word for name, value in PATIENT.items() for word in ("-p", f"{name}:={value}")]
    separator = [] if "--ros-args" in arguments else ["--ros-args"]
    process = start(ros, [*arguments, *separator, *patience])
    try:
        client = PlannerClient(ros)
        client.wait_until_connected(process)
        yield client, process
    finally:
        end(process)


@contextmanager
def local_planner(
    ros: Harness, arguments: ParameterArguments | None = None, **parameters: object
) -> Iterator[tuple[PlannerClient, PlannerNode]]:
    """A connected client and a node in the harness's own executor."""
    overrides = [Parameter(name, value=value) for name, value in (PATIENT | parameters).items()]
    node = Node("planner", context=ros.context, parameter_overrides=overrides)
    ros.add_node(node)
    planner = PlannerNode(node, arguments or ParameterArguments((), frozenset(), ()))
    try:
        client = PlannerClient(ros)
        client.wait_until_connected()
        yield client, planner
    finally:
        assert planner.close(PLAN_TIMEOUT_S)
