"""A node that plans a stranger's problem, and a client for it."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from ros.planner_support import (
    LATCHED,
    PLAN_TIMEOUT_S,
    START_TIMEOUT_S,
    Harness,
    end,
    start,
)
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from dscp_core import problems
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_ros.bag import BagWriter, Qos
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import problem_layout
from msg_adapters.report import PlanReport
from msg_adapters.report_message import report_from_message
from msg_adapters.state import StampedState

STRANGER = Path(__file__).with_name("stranger.py")
STRANGER_IN_SPACE = Path(__file__).with_name("stranger_in_space.py")
STATE = np.array([0.5, 1.0, 0.2, -0.3])
TOPIC = "/planner/vehicle_state"
START_NS = 1_700_000_000_000_000_000
PATIENT = ("-p", "state_max_age_s:=60.0", "-p", "deadline_s:=15.0")


def stranger(folder: Path) -> str:
    """The problem as the command line names it, from a copy of its file."""
    return f"{shutil.copy(STRANGER, folder / 'puck.py')}:puck"


class AnyClient:
    """Publishes states of any problem, collects trajectories and reports, calls services."""

    def __init__(self, ros: Harness, problem: OptimalControlProblem) -> None:
        self._ros = ros
        self.layout = problem_layout(problem)
        self.node = ros.create_node("client")
        self._state = self.node.create_publisher(JointState, TOPIC, 10)
        self.trajectories: list[JointTrajectory] = []
        self._messages: list[DiagnosticArray] = []
        for kind, name, store in (
            (JointTrajectory, "trajectory", self.trajectories),
            (DiagnosticArray, "report", self._messages),
        ):
            self.node.create_subscription(kind, f"/planner/{name}", store.append, LATCHED)
        self._clients = {
            name: self.node.create_client(Trigger, f"/planner/{name}")
            for name in ("plan", "reset", "reload")
        }

    @property
    def reports(self) -> list[PlanReport]:
        return [report_from_message(message) for message in list(self._messages)]

    def connect(self, process: subprocess.Popen[str]) -> None:
        def connected() -> bool:
            if process.poll() is not None:
                raise AssertionError(f"the node has ended: {process.communicate()}")
            return (
                self._state.get_subscription_count() > 0
                and all(
                    self.node.count_publishers(f"/planner/{t}") for t in ("trajectory", "report")
                )
                and all(client.service_is_ready() for client in self._clients.values())
            )

        assert self._ros.wait_for(connected, START_TIMEOUT_S)

    def report(self, values: np.ndarray = STATE) -> PlanReport:
        """Publish a state of now and wait for its report."""
        stamp_ns = time.time_ns()
        state = StampedState(stamp_ns, values)
        self._state.publish(joint_state_from_state(state, self.layout))
        return self.report_of(stamp_ns)

    def report_of(self, stamp_ns: int) -> PlanReport:
        def found() -> list[PlanReport]:
            return [report for report in self.reports if report.input_stamp_ns == stamp_ns]

        assert self._ros.wait_for(lambda: bool(found()), PLAN_TIMEOUT_S), self.reports
        return found()[-1]

    def call(self, service: str) -> Trigger.Response:
        future = self._clients[service].call_async(Trigger.Request())
        assert self._ros.wait_for(future.done, PLAN_TIMEOUT_S)
        return future.result()


@contextmanager
def running(
    ros: Harness, problem: OptimalControlProblem, *arguments: str, before: Sequence[str] = ()
) -> Iterator[tuple[AnyClient, subprocess.Popen[str]]]:
    """A connected client and the node's process with ROS arguments, ended at the end."""
    process = start(ros, [*before, "--ros-args", *PATIENT, *arguments])
    try:
        client = AnyClient(ros, problem)
        client.connect(process)
        yield client, process
    finally:
        end(process)


def write_log(path: Path, name: str, states: Sequence[np.ndarray]) -> Path:
    """A bag of states, one per 50 ms."""
    layout = problem_layout(problems.get(name))
    with BagWriter(path) as bag:
        bag.add_topic(TOPIC, JointState, Qos())
        for k, values in enumerate(states):
            stamp_ns = START_NS + k * 50_000_000
            message = joint_state_from_state(StampedState(stamp_ns, values), layout)
            bag.write(TOPIC, message, stamp_ns)
    return path
