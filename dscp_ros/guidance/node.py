"""The guidance node: states in, commanded forces out; plans are made by a planner node.

Everything runs in the executor's thread. Nothing is commanded without a fresh state and a plan,
and the status says why.
"""

from __future__ import annotations

import traceback
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.timer import Timer
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from dscp_core.errors import DscpError
from dscp_core.planning.planner import Planner
from dscp_core.problem.guidance import Array, Guidance, Request
from dscp_ros.flights.telling import told_parameters
from dscp_ros.guidance.parameters import PLANNER, chosen_settings, guidance_parameters
from dscp_ros.guidance.planner_link import PlannerLink
from dscp_ros.planner.events import ThrottledLog
from dscp_ros.planner.input_checks import InputGate
from dscp_ros.planner.outputs import latched
from dscp_ros.planner.parameter_files import ParameterArguments
from dscp_ros.planner.parameter_server import ParameterServer
from dscp_ros.planner.session import PlannerSetup
from dscp_ros.planner.wiring import input_quality, on_clock_set_back
from msg_adapters.errors import RejectedInputError
from msg_adapters.guidance import GuidanceStatus, message_from_guidance_status, wrench_from_force
from msg_adapters.layout import problem_layout
from msg_adapters.stamps import nanoseconds_from_seconds, seconds_from_nanoseconds
from msg_adapters.state import StampedState

_QUEUE = 10
_STATUS_PERIOD_S = 1.0
_OK, _WARN, _ERROR = (
    int.from_bytes(level, "little")
    for level in (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR)
)


class _Flight:
    """One flight: guidance, and what is known of time."""

    def __init__(self, guidance: Guidance, epoch_ns: int) -> None:
        self.guidance, self._epoch_ns = guidance, epoch_ns
        self.measured_ns = self.ticked_ns = -1
        self.plan_stamp_ns: int | None = None

    def time_s(self, now_ns: int) -> float:
        """Flight time."""
        return seconds_from_nanoseconds(now_ns - self._epoch_ns)

    def stamp_ns(self, time_s: float) -> int:
        """The same back."""
        return self._epoch_ns + nanoseconds_from_seconds(time_s)


class GuidanceNode:
    """Guides one flight after another; serves ``~/reset``."""

    def __init__(self, node: Node, arguments: ParameterArguments) -> None:
        """Declare parameters, compile the problem, and open the topics.

        Args:
            node: Node to live on.
            arguments: Where the command line takes parameters from.

        Raises:
            InvalidInputError: A parameter is misspelt or out of range, or the problem brings no
                guidance.
        """
        self._node = node
        self._parameters = ParameterServer(node, arguments, guidance_parameters)
        self._setup: PlannerSetup = self._parameters.setup
        self._planner: Planner = self._setup.planner()
        settings = self._parameters.settings
        self._layout = problem_layout(self._parameters.problem)
        self._frame = settings.inputs.frame or self._layout.frame
        self._gate = InputGate(self._layout)
        self._warnings = ThrottledLog(node.get_logger().warning)
        self._flight: _Flight | None = None
        self._timer: Timer | None = None
        self._newest: StampedState | None = None
        self._tried_ns = 0
        self._ticks = self._flown = self._refused = 0
        self._level, self._message, self._commanding = _WARN, "commands nothing: no state", False
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._thrust = node.create_publisher(WrenchStamped, "~/thrust", _QUEUE)
        self._status = node.create_publisher(DiagnosticArray, "~/status", latched(1))
        planner = self._parameters.values[PLANNER.name]
        self._link = PlannerLink(
            node,
            planner,
            self._layout,
            self._frame,
            on_answer=self._publish_status,
            refuse=self._on_unreadable,
        )
        newest = input_quality(settings.state_reliability, 1)
        node.create_subscription(JointState, "~/vehicle_state", self._on_state, newest)
        node.create_service(Trigger, "~/reset", self._on_reset)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(_STATUS_PERIOD_S, self._publish_status, clock=steady)
        self._jump_handle = on_clock_set_back(node, self._on_clock_set_back)
        node.get_logger().info(
            f"guiding {self._layout.problem} from states in {self._frame}, plans by {planner}"
        )
        self._publish_status()

    def close(self, _timeout_s: float) -> bool:
        """End; there is nothing to wait for."""
        self._jump_handle.unregister()
        return True

    def report_internal_error(self, error: Exception) -> None:
        """Report an exception that a callback let through."""
        trace = "".join(traceback.format_exception(error))
        self._warn("callback", f"a callback failed, the node lives on: {trace}")
        self._nothing(f"{type(error).__name__}: {error}", _ERROR)

    # Inputs

    def _on_state(self, message: JointState) -> None:
        self._gate.received += 1
        inputs = self._parameters.settings.inputs
        try:
            state = self._gate.accept_joint_state(message, self._now_ns(), inputs).state
        except RejectedInputError as error:
            self._gate.rejected[error.code] += 1
            self._warn(error.code, f"vehicle_state refused: {error}")
            if self._flight is None:
                self._nothing(f"no state; the last one was refused: {error}")
            return
        before, self._newest = self._newest, state
        if before is not None and self._flight is not None:
            gap_s = seconds_from_nanoseconds(state.stamp_ns - before.stamp_ns)
            if gap_s > self._parameters.settings.silence_max_s:
                self._forget(f"no state for {gap_s:.2f} s: begins anew")
                self._newest = state
        if self._flight is None:
            self._begin(state)

    def _on_unreadable(self, topic: str, error: RejectedInputError) -> None:
        self._warn((topic, error.code), f"{topic} of the planner refused: {error}")

    def _begin(self, state: StampedState) -> None:
        """Begin a flight from a state; once a second, as it takes a plan to find what suits."""
        since_ns = state.stamp_ns - self._tried_ns
        if self._tried_ns and 0 <= since_ns < nanoseconds_from_seconds(_STATUS_PERIOD_S):
            return
        self._tried_ns = state.stamp_ns
        guided = self._parameters.problem.extras.guidance
        assert guided is not None  # `guidance_parameters` refuses problems without
        try:
            setup = self._parameters.setup
            if not setup.plans_like(self._setup):
                self._planner, self._setup = setup.planner(), setup
            settings = chosen_settings(self._parameters.values)
            guidance = guided(self._planner, state.values, settings)
        except DscpError as error:
            self._nothing(str(error))
            return
        self._flight = _Flight(guidance, state.stamp_ns)
        self._timer = self._node.create_timer(guidance.tick_s, self._tick)
        self._node.get_logger().info(f"a flight begins, ticks of {guidance.tick_s:g} s")
        self._nothing("no plan yet")

    # The tick

    def _tick(self) -> None:
        flight, newest, now_ns = self._flight, self._newest, self._now_ns()
        if flight is None or newest is None or now_ns == flight.ticked_ns:
            return
        if now_ns < flight.ticked_ns:  # the system's clock, whose steps nobody is told
            self._forget("the clock was set back: begins anew with the next state")
            return
        flight.ticked_ns = now_ns
        self._ticks += 1
        age_s = seconds_from_nanoseconds(now_ns - newest.stamp_ns)
        most_s = self._parameters.settings.inputs.state_max_age_s
        if age_s > most_s:
            self._nothing(f"the last state is {age_s:.2f} s old, more than {most_s:g} s")
            return
        guidance, time_s = flight.guidance, flight.time_s(now_ns)
        if newest.stamp_ns > flight.measured_ns:
            guidance.measure(flight.time_s(newest.stamp_ns), newest.values)
            flight.measured_ns = newest.stamp_ns
        answer = self._link.take_answer()
        if answer is not None:
            flown = guidance.take_plan(answer.request, answer, time_s)
            self._flown += flown
            self._refused += not flown
            flight.plan_stamp_ns = answer.stamp_ns if flown else flight.plan_stamp_ns
        force = guidance.command(time_s)
        if not guidance.waits:
            self._command(np.zeros(3) if force is None else force, now_ns)
        request = guidance.plan_request(time_s)
        if request is not None:
            self._ask(flight, request, time_s)
        self._judge(flight)

    def _command(self, force: Array, now_ns: int) -> None:
        wrench = wrench_from_force(force, now_ns, self._layout, frame=self._frame)
        self._thrust.publish(wrench)

    def _ask(self, flight: _Flight, request: Request, time_s: float) -> None:
        inputs = self._parameters.settings.inputs
        table = self._planner.problem.table
        values = table.unpack(table.pack(request.parameters, self._planner.parameters))
        ahead_s = request.start_s - time_s
        wanted: dict[str, Any] = {
            **told_parameters(
                self._planner.problem, self._layout, values, request.warm_start, request.elapsed_s
            ),
            "control_hold": self._planner.settings.hold.value,
            "future_tolerance_s": round(ahead_s + inputs.future_tolerance_s, 6),
        }
        self._link.ask(request, flight.stamp_ns(request.start_s), wanted)

    def _judge(self, flight: _Flight) -> None:
        """Say how the flight is."""
        guidance, stamp_ns = flight.guidance, flight.plan_stamp_ns
        revoked = None if stamp_ns is None else self._link.revoked(stamp_ns)
        trouble = self._link.trouble
        if guidance.waits:
            self._nothing(f"no plan yet{': ' * bool(trouble)}{trouble}")
        elif guidance.follows_plan and revoked is not None:
            reason = f"{revoked.code_name}: {revoked.reason}"
            self._say(_WARN, f"flies on the last plan, which was revoked: {reason}", True)
        elif guidance.follows_plan and trouble:
            self._say(_WARN, f"flies on the last plan: {trouble}", True)
        else:
            self._say(_OK, str(guidance.phase.value), True)

    # Clock, reset, status

    def _on_clock_set_back(self, cause: str) -> None:
        """Begin anew."""
        self._forget(f"the clock {cause}: begins anew with the next state")

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Forget the flight; the next state begins another one."""
        self._forget("reset: begins anew with the next state")
        response.success, response.message = True, "the next state begins another flight"
        return response

    def _forget(self, reason: str) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        self._flight = self._timer = self._newest = None
        self._tried_ns = 0
        self._gate.forget()
        self._link.forget()
        self._node.get_logger().warning(reason)
        self._nothing(reason)

    def _nothing(self, why: str, level: int = _WARN) -> None:
        self._say(level, f"commands nothing: {why}", False)

    def _say(self, level: int, message: str, commanding: bool) -> None:
        self._level, self._message, self._commanding = level, message, commanding
        self._publish_status()

    def _publish_status(self) -> None:
        now_ns, newest, flight = self._now_ns(), self._newest, self._flight
        age_s = None if newest is None else seconds_from_nanoseconds(now_ns - newest.stamp_ns)
        status = GuidanceStatus(
            stamp_ns=now_ns,
            level=self._level,
            message=self._message,
            phase="none" if flight is None else str(flight.guidance.phase.value),
            commanding=self._commanding,
            ticks=self._ticks,
            received=self._gate.received,
            rejected=self._gate.rejected.total(),
            plans_flown=self._flown,
            plans_refused=self._refused,
            state_age_s=age_s,
            plan_stamp_ns=None if flight is None else flight.plan_stamp_ns,
            asked_stamp_ns=self._link.asked_stamp_ns,
        )
        self._status.publish(
            message_from_guidance_status(status, node=self._name, problem=self._layout.problem)
        )

    def _warn(self, cause: Any, text: str) -> None:
        self._warnings.write(cause, text, self._parameters.settings.log_period_s)

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)
