"""The planner node: topics, services and the clock. It wires; it decides nothing numerical.

Everything here runs in the executor's thread and returns at once; plans are made by a worker.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from typing import Any

from geometry_msgs.msg import InertiaStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.task import Future as RosFuture
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from dscp_core.errors import DscpError
from dscp_core.planning.planner import Planner
from dscp_ros.planner.attempts import AttemptRunner, PlanJob, Surroundings
from dscp_ros.planner.events import ThrottledLog, event_report, refusal_report
from dscp_ros.planner.health import HealthMonitor
from dscp_ros.planner.input_checks import FROM_PARAMETER, AcceptedState, InputGate, InputSettings
from dscp_ros.planner.outputs import PlanOutputs
from dscp_ros.planner.parameter_files import ParameterArguments
from dscp_ros.planner.parameter_server import FileChange, ParameterServer
from dscp_ros.planner.parameters import NodeSettings
from dscp_ros.planner.session import PlannerSetup, PlanningSession
from dscp_ros.planner.validity import ValidityKeeper
from dscp_ros.planner.wiring import input_quality, on_clock_set_back
from dscp_ros.planner.worker import MailboxWorker
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.layout import StateLayout, problem_layout
from msg_adapters.report import NodeCode, PlanReport
from msg_adapters.stamps import nanoseconds_from_stamp

_HEALTH_PERIOD_S = 1.0
_VALIDITY_PERIOD_S = 0.05
_MASS_DEPTH = 10
"""Masses come seldom and in bursts with states; unlike states, none should be skipped."""

Accept = Callable[[Any, int, InputSettings], AcceptedState]


class PlannerNode:
    """Has states planned from, and serves ``~/plan``, ``~/reset``, ``~/reload``."""

    def __init__(self, node: Node, arguments: ParameterArguments) -> None:
        """Declare parameters, compile the problem, and open the topics.

        Args:
            node: Node to live on.
            arguments: Where the command line takes parameters from.

        Raises:
            InvalidInputError: A parameter is misspelt or out of range.
        """
        self._node = node
        self._parameters = ParameterServer(node, arguments)
        settings = self._parameters.settings
        problem = self._parameters.problem
        layout = problem_layout(problem)
        frame = settings.inputs.frame or layout.frame
        self._problem = layout.problem
        self._session = PlanningSession(self._parameters.setup)
        self._requested: PlannerSetup | None = self._parameters.setup
        self._gate = InputGate(layout)
        self._health = HealthMonitor()
        self._warnings = ThrottledLog(node.get_logger().warning)
        self._outputs = PlanOutputs(
            node, layout, frame=frame, draws=problem.extras.scene is not None
        )
        self._validity = ValidityKeeper(self._outputs.publish_validity, self._now_ns)
        self._last: AcceptedState | None = None
        surroundings = Surroundings(
            now_ns=self._now_ns,
            settings=lambda: self._parameters.settings,
            drops=lambda: self._worker.drops,
            rejected=lambda: self._gate.rejected.total(),
            log_error=node.get_logger().error,
            log_warning=self._warn,
        )
        self._runner = AttemptRunner(
            self._session,
            self._outputs,
            self._health,
            self._validity,
            layout,
            surroundings,
            [miss.name for miss in problem.end_checks],
        )
        self._worker: MailboxWorker[PlanJob] = MailboxWorker(self._runner.run, name="planner")
        self._parameters.on_change(self._on_settings)
        self._open(settings, layout)
        node.get_logger().info(
            f"planning {self._problem} with {settings.planner.options.solver}, "
            f"{settings.planner.intervals} intervals, from states in {frame}, "
            f"{settings.planner.terminal_time.value} terminal time, "
            f"parameter set {self._parameters.setup.parameter_set}"
        )

    def close(self, timeout_s: float) -> bool:
        """End the worker after the attempt in hand.

        Returns:
            Whether it ended in time.
        """
        self._runner.new_epoch()
        self._jump_handle.unregister()
        return self._worker.stop(timeout_s)

    def report_internal_error(self, error: Exception) -> None:
        """Report an exception that a callback let through."""
        message = f"{type(error).__name__}: {error}"
        trace = "".join(traceback.format_exception(error))
        self._warn(NodeCode.INTERNAL_ERROR, f"a callback failed, the node lives on: {trace}")
        self._outputs.publish_report(self._event(NodeCode.INTERNAL_ERROR, message, "callback"))

    def _open(self, settings: NodeSettings, layout: StateLayout) -> None:
        """Create subscriptions, services and the health timer."""
        node = self._node
        newest = input_quality(settings.state_reliability, 1)
        few = input_quality(settings.state_reliability, _MASS_DEPTH)
        if layout.odometry is not None:
            node.create_subscription(Odometry, "~/state", self._on_state, newest)
            if layout.odometry.mass is not None:
                node.create_subscription(InertiaStamped, "~/mass", self._on_mass, few)
        node.create_subscription(JointState, "~/vehicle_state", self._on_vehicle_state, newest)
        # Services wait for the worker; in a group of their own they hold up nothing else.
        group = ReentrantCallbackGroup()
        for name, callback in (
            ("~/plan", self._on_plan),
            ("~/reset", self._on_reset),
            ("~/reload", self._on_reload),
        ):
            node.create_service(Trigger, name, callback, callback_group=group)
        # Health is told by a steady clock: a simulation that stands still is still alive.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(_HEALTH_PERIOD_S, self._publish_health, clock=steady)
        node.create_timer(_VALIDITY_PERIOD_S, self._check_validity, clock=steady)
        self._jump_handle = on_clock_set_back(node, self._on_clock_set_back)

    # Inputs

    def _on_state(self, message: Odometry) -> None:
        self._take("state", message, self._gate.accept_odometry)

    def _on_vehicle_state(self, message: JointState) -> None:
        self._take("vehicle_state", message, self._gate.accept_joint_state)

    def _on_mass(self, message: InertiaStamped) -> None:
        self._gate.received += 1
        try:
            self._gate.accept_mass(message, self._now_ns(), self._parameters.settings.inputs)
        except RejectedInputError as error:
            self._refuse(error, "mass", message.header)

    def _take(self, source: str, message: Any, accept: Accept) -> None:
        arrived_s = time.perf_counter()
        self._gate.received += 1
        try:
            accepted = accept(message, self._now_ns(), self._parameters.settings.inputs)
        except RejectedInputError as error:
            self._refuse(error, source, message.header)
            return
        if accepted.mass_source == FROM_PARAMETER:
            self._warn(InputCode.MASS_STALE, "no fresh mass message: using mass_fallback_kg")
        self._last = accepted
        self._health.note_input()
        self._validity.note_state()
        self._worker.submit(PlanJob(accepted, source, arrived_s, self._runner.epoch))

    def _refuse(self, error: RejectedInputError, source: str, header: Header | None) -> None:
        self._gate.rejected[error.code] += 1
        self._warn(error.code, f"{source} refused: {error}")
        report = refusal_report(
            error,
            stamp_ns=self._now_ns(),
            source=source,
            problem=self._problem,
            drops=self._worker.drops,
            rejected=self._gate.rejected.total(),
            input_stamp_ns=_stamp_or_none(header),
        )
        self._outputs.publish_report(report)

    # Services

    async def _on_plan(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Plan now from the last accepted state, and answer with what became of it."""
        try:
            last = self._fresh_state()
        except RejectedInputError as error:
            self._refuse(error, "plan", None)
            return _answer(response, False, str(error))
        report = self._runner.next_report()
        self._worker.submit(PlanJob(last, "plan", time.perf_counter(), self._runner.epoch))
        await self._finished(report)
        if report.cancelled():
            return _answer(response, False, "reset before the plan was made")
        result = report.result()
        return _answer(response, result.published, f"{result.code_name}: {result.message}")

    def _fresh_state(self) -> AcceptedState:
        if self._last is None:
            raise RejectedInputError(
                InputCode.STATE_MISSING, "state", None, "a state on one of the input topics"
            )
        inputs = self._parameters.settings.inputs
        self._gate.check_still_fresh(self._last.state, self._now_ns(), inputs)
        return self._last

    async def _on_reset(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Forget warm start, stamps and mass."""
        await self._finished(self._forget(NodeCode.RESET, "the node was reset"))
        return _answer(response, True, "warm start, stamps and mass forgotten")

    async def _on_reload(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Read the parameter files again and rebuild the planner; on failure keep the old one."""
        try:
            change = self._parameters.reread_files()
            built = self._worker.call(change.setup.planner)
            await self._finished(built)
            planner = built.result()
            self._commit(change)
            setup = self._parameters.setup
            installed = self._worker.call(lambda: self._install(setup, planner, change.setup))
            await self._finished(installed)
            installed.result()
        except (DscpError, CancelledError) as error:
            self._node.get_logger().error(f"reload refused: {error}")
            return _answer(response, False, f"the old parameters stay: {error}")
        self._health.note_configuration(None)
        done = f"{len(change.values)} parameters read, planner rebuilt"
        self._node.get_logger().info(f"{done}, parameter set {setup.parameter_set}")
        return _answer(response, True, f"{done}; parameter set: {setup.parameter_set}")

    def _commit(self, change: FileChange) -> None:
        """Take the parameters over; their planner is there already."""
        before, self._requested = self._requested, change.setup
        try:
            self._parameters.commit(change)
        except DscpError:
            self._requested = before
            raise

    def _install(self, setup: PlannerSetup, planner: Planner, built_of: PlannerSetup) -> None:
        """Swap the planner between two attempts, unless a parameter has changed meanwhile."""
        if setup.plans_like(built_of):
            self._session.install(setup, planner)
            self._clear("the parameter files were read again")
        else:
            self._change(setup)

    async def _finished(self, future: Future[Any]) -> None:
        """Let the executor go on until a future of the worker is settled."""
        executor = self._node.executor
        assert executor is not None  # it is the executor that runs this
        settled = RosFuture(executor=executor)

        def settle(_future: Future[Any]) -> None:
            settled.set_result(None)
            executor.wake()

        future.add_done_callback(settle)
        await settled

    # Parameters, clock, health

    def _on_settings(self) -> None:
        """Rebuild the planner where a changed parameter concerns it."""
        setup = self._parameters.setup
        if setup == self._requested:
            return
        self._requested = setup
        self._worker.call(lambda: self._change(setup)).add_done_callback(self._note_rebuild)

    def _change(self, setup: PlannerSetup) -> bool:
        rebuilt = self._session.change(setup)
        if rebuilt:
            self._clear("the planner was rebuilt with other parameters")
        return rebuilt

    def _clear(self, reason: str) -> None:
        """Take back the last plan: another planner made it."""
        self._validity.revoke(NodeCode.RELOADED, reason)
        # A plan with fewer intervals would leave arrows of the old one standing.
        self._outputs.clear_drawing(self._now_ns())

    def _note_rebuild(self, rebuilt: Future[Any]) -> None:
        if rebuilt.cancelled():
            return
        error = rebuilt.exception()
        if error is None:
            if rebuilt.result():
                self._node.get_logger().info("planner rebuilt with the new parameters")
            self._health.note_configuration(None)
            return
        self._requested = None
        self._node.get_logger().error(f"new parameters refused, the old planner stays: {error}")
        self._health.note_configuration(str(error))

    def _on_clock_set_back(self, cause: str) -> None:
        """Begin anew."""
        message = f"the clock {cause}: warm start, stamps and mass forgotten"
        self._forget(NodeCode.CLOCK_JUMPED_BACK, message)
        self._node.get_logger().warning(message)
        self._outputs.publish_report(self._event(NodeCode.CLOCK_JUMPED_BACK, message, "clock"))

    def _event(self, code: NodeCode, message: str, source: str) -> PlanReport:
        return event_report(
            code, message, stamp_ns=self._now_ns(), source=source, problem=self._problem
        )

    def _forget(self, code: NodeCode, reason: str) -> Future[Any]:
        """Forget everything that belongs to the time before now."""
        self._runner.new_epoch()
        self._validity.revoke(code, reason)
        self._worker.clear()
        self._gate.forget()
        self._last = None
        return self._worker.call(lambda: self._forget_plan(code, reason))

    def _forget_plan(self, code: NodeCode, reason: str) -> None:
        self._session.forget()
        self._validity.revoke(code, reason)  # a plan may just have slipped through
        self._outputs.clear_drawing(self._now_ns())

    def _check_validity(self) -> None:
        self._validity.check_time(self._parameters.settings.silence_max_s)

    def _publish_health(self) -> None:
        health = self._health.health(
            received=self._gate.received,
            rejected=self._gate.rejected,
            drops=self._worker.drops,
            worker_alive=self._worker.alive,
            max_age_s=self._parameters.settings.inputs.state_max_age_s,
        )
        self._outputs.publish_health(health, self._now_ns())

    def _warn(self, cause: int, text: str) -> None:
        self._warnings.write(cause, text, self._parameters.settings.log_period_s)

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)


def _answer(response: Trigger.Response, success: bool, message: str) -> Trigger.Response:
    response.success = success
    response.message = message
    return response


def _stamp_or_none(header: Header | None) -> int | None:
    """Stamp of a refused input, where it has a valid one."""
    if header is None:
        return None
    try:
        return nanoseconds_from_stamp(header.stamp)
    except RejectedInputError:
        return None
