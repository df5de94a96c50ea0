"""Asks a planner node for plans: parameters, a state, and whatever comes of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from dscp_core.planning.plan import PlanStatus
from dscp_core.problem.guidance import Request
from dscp_core.problem.trajectory import Plan
from dscp_ros.flights.telling import differing
from dscp_ros.planner.outputs import latched
from msg_adapters.errors import RejectedInputError
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import StateLayout
from msg_adapters.report import NodeCode, PlanReport
from msg_adapters.report_message import report_from_message
from msg_adapters.stamps import nanoseconds_from_stamp
from msg_adapters.state import StampedState
from msg_adapters.trajectory import plan_from_trajectory
from msg_adapters.validity import Validity, validity_from_message

_QUEUE = 10
_REPORTS = 50
_FOUND = frozenset(int(status) for status in PlanStatus)
"""Codes that say something about a state; the others say that there was no answer."""
_OWN_DOING = NodeCode.RELOADED
"""Every request with other parameters revokes the trajectory before it by this code."""


@dataclass(frozen=True)
class PlannerAnswer:
    """What the planner answered, as `dscp_core.problem.guidance.Answer` has it.

    Attributes:
        request: What it was asked.
        stamp_ns: Start of the plan that was asked for.
        certified: Whether there is a certified plan that was not revoked meanwhile.
        plan: That plan; None without one.
    """

    request: Request
    stamp_ns: int
    certified: bool
    plan: Plan | None


@dataclass
class _Pending:
    """A request that waits for its answer."""

    request: Request
    state: StampedState
    report: PlanReport | None = None
    trajectory: JointTrajectory | None = None


class PlannerLink:
    """Topics and services of one planner node. For the executor's thread.

    Attributes:
        trouble: Why the last request was not answered; empty if it was, or still may be.
    """

    def __init__(
        self,
        node: Node,
        planner: str,
        layout: StateLayout,
        frame: str,
        *,
        on_answer: Callable[[], None],
        refuse: Callable[[str, RejectedInputError], None],
    ) -> None:
        """Open the topics.

        Args:
            node: Node to live on.
            planner: Name of the planner node.
            layout: Names and order of the problem's state.
            frame: Frame of states and plans.
            on_answer: Called when an answer has come, or will not come.
            refuse: Is told of messages that cannot be read, with the topic.
        """
        self._layout, self._frame = layout, frame
        self._on_answer, self._refuse = on_answer, refuse
        self._name = planner
        self._told: dict[str, Any] = {}
        self._pending: _Pending | None = None
        self._answer: PlannerAnswer | None = None
        self._validity: Validity | None = None
        self.trouble = ""
        self._states = node.create_publisher(JointState, f"{planner}/vehicle_state", _QUEUE)
        self._parameters = node.create_client(
            SetParametersAtomically, f"{planner}/set_parameters_atomically"
        )
        for kind, topic, callback, depth in (
            (JointTrajectory, "trajectory", self._on_trajectory, 1),
            (DiagnosticArray, "validity", self._on_validity, 1),
            (DiagnosticArray, "report", self._on_report, _REPORTS),
        ):
            node.create_subscription(kind, f"{planner}/{topic}", callback, latched(depth))

    @property
    def asked_stamp_ns(self) -> int | None:
        """Start of the plan that is waited for; None if none is."""
        return None if self._pending is None else self._pending.state.stamp_ns

    def forget(self) -> None:
        """Wait for nothing any more."""
        self._pending = self._answer = None
        self.trouble = ""

    def take_answer(self) -> PlannerAnswer | None:
        """The answer that has come since the last call."""
        answer, self._answer = self._answer, None
        if answer is not None and answer.certified and self.revoked(answer.stamp_ns) is not None:
            return PlannerAnswer(answer.request, answer.stamp_ns, False, None)
        return answer

    def revoked(self, stamp_ns: int) -> Validity | None:
        """Why the trajectory with this stamp may not be followed any more; None if it may.

        That its planner was rebuilt since is no reason: each request does that.
        """
        last = self._validity
        if last is None or last.valid or last.trajectory_stamp_ns != stamp_ns:
            return None
        return None if last.code == _OWN_DOING else last

    def ask(self, request: Request, stamp_ns: int, parameters: Mapping[str, Any]) -> None:
        """Have a plan made; an earlier request that still waits is given up.

        Args:
            request: What is asked for.
            stamp_ns: When the plan is to begin.
            parameters: The node's parameters that it is to be made with; only what was not told
                before is sent.
        """
        self._pending = pending = _Pending(request, StampedState(stamp_ns, request.state))
        changed = differing(parameters, self._told)
        if not self._parameters.service_is_ready():
            self._give_up(f"there is no planner node {self._name}")
        elif not changed:
            self._send(pending)
        else:
            wanted = SetParametersAtomically.Request()
            wanted.parameters = [
                Parameter(name, value=value).to_parameter_msg() for name, value in changed.items()
            ]
            self._parameters.call_async(wanted).add_done_callback(
                lambda future: self._on_told(pending, changed, future)
            )

    def _on_told(self, pending: _Pending, changed: dict[str, Any], future: Future) -> None:
        error = future.exception()
        response = None if error is not None else future.result()
        if response is not None and response.result.successful:
            self._told |= changed
            if self._pending is pending:
                self._send(pending)
        elif self._pending is pending:
            reason = error if response is None else response.result.reason
            self._give_up(f"{self._name} refuses the parameters of a plan: {reason}")

    def _send(self, pending: _Pending) -> None:
        self._states.publish(joint_state_from_state(pending.state, self._layout, frame=self._frame))

    def _give_up(self, trouble: str) -> None:
        """No answer will come; guidance asks again when it has waited long enough."""
        self._pending, self.trouble = None, trouble
        self._on_answer()

    # What the planner tells

    def _on_report(self, message: DiagnosticArray) -> None:
        try:
            report = report_from_message(message)
        except RejectedInputError as error:
            self._refuse("report", error)
            return
        pending = self._pending
        first = pending is not None and pending.report is None  # a best effort has a second one
        if pending is not None and first and report.input_stamp_ns == pending.state.stamp_ns:
            pending.report = report
            self._settle(pending)

    def _on_trajectory(self, message: JointTrajectory) -> None:
        pending = self._pending
        try:
            stamp_ns = nanoseconds_from_stamp(message.header.stamp)
        except RejectedInputError as error:
            self._refuse("trajectory", error)
            return
        if pending is not None and stamp_ns == pending.state.stamp_ns:
            pending.trajectory = message
            self._settle(pending)

    def _on_validity(self, message: DiagnosticArray) -> None:
        try:
            self._validity = validity_from_message(message)
        except RejectedInputError as error:
            self._refuse("validity", error)
            return
        if self._validity.code == NodeCode.NO_TRAJECTORY:  # a node that was just started
            self._told.clear()

    def _settle(self, pending: _Pending) -> None:
        """Make an answer of what has come, once all of it has; topics overtake one another."""
        report = pending.report
        if report is None or (report.published and pending.trajectory is None):
            return
        if not report.published and report.code not in _FOUND:
            self._give_up(f"{self._name} did not plan: {report.code_name}: {report.message}")
            return
        plan = None
        if report.published and pending.trajectory is not None:
            try:
                plan, _ = plan_from_trajectory(pending.trajectory, self._layout, frame=self._frame)
            except RejectedInputError as error:
                self._refuse("trajectory", error)
                self._give_up(f"the trajectory of {self._name} cannot be read: {error}")
                return
        stamp_ns = pending.state.stamp_ns
        self._answer = PlannerAnswer(pending.request, stamp_ns, plan is not None, plan)
        self._pending, self.trouble = None, "" if plan is not None else report.message
        self._on_answer()
