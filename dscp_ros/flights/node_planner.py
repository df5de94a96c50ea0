"""A planner whose plans the planner node makes: a process of its own, over real topics."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from dscp_core.errors import HelperLostError, InvalidInputError
from dscp_core.planning.attempt import Attempt
from dscp_core.planning.plan import PlanOutcome, PlanStatus
from dscp_core.planning.planner import Planner, PlannerSettings
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.trajectory import Plan
from dscp_ros.demo.processes import Child, child
from dscp_ros.flights.telling import differing, told_parameters
from dscp_ros.planner.parameters import parameter_table
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import problem_layout
from msg_adapters.report import PlanReport
from msg_adapters.report_message import report_from_message
from msg_adapters.stamps import nanoseconds_from_seconds, stamp_from_nanoseconds
from msg_adapters.state import StampedState
from msg_adapters.trajectory import plan_from_trajectory

Array = NDArray[np.float64]

_START_S, _ANSWER_S = 30.0, 60.0
"""Wall time that the node may take to start, and to answer."""
_SPIN_S = 0.02
_BETWEEN_FLIGHTS_NS = nanoseconds_from_seconds(3600.0)
_FIRST_STAMP_NS = nanoseconds_from_seconds(1e6)
_QUEUE = 10


class NodeSilentError(HelperLostError):
    """The planner node did not answer in time."""


class NodeLink:
    """Topics and services to a planner node, which lives on simulated time.

    Time stands still while the node plans: what a plan takes is an option of the simulation.

    Attributes:
        told: Parameters that the node has, by name.
        stamp_ns: Of the last state.
        starts: The last plans with the stamp of their start, by identity.
    """

    def __init__(self, node: Node, executor: SingleThreadedExecutor, process: Child) -> None:
        """Open the topics.

        Args:
            node: Node to live on.
            executor: That spins it.
            process: The planner node's.
        """
        self.told: dict[str, Any] = {}
        self.stamp_ns = _FIRST_STAMP_NS
        self.starts: dict[int, tuple[Plan, int]] = {}
        self._executor, self._process = executor, process
        self._clock = node.create_publisher(Clock, "/clock", _QUEUE)
        self._states = node.create_publisher(JointState, "/planner/vehicle_state", _QUEUE)
        self._parameters = node.create_client(
            SetParametersAtomically, "/planner/set_parameters_atomically"
        )
        self._reports: dict[int, PlanReport] = {}
        self._trajectories: dict[int, JointTrajectory] = {}
        node.create_subscription(DiagnosticArray, "/planner/report", self._on_report, _QUEUE)
        node.create_subscription(
            JointTrajectory, "/planner/trajectory", self._on_trajectory, _QUEUE
        )
        self._topics: Callable[[], tuple[int, ...]] = lambda: (
            node.count_subscribers("/planner/vehicle_state"),
            node.count_publishers("/planner/report"),
            node.count_publishers("/planner/trajectory"),
        )

    def await_node(self) -> None:
        """Wait until the node is there.

        Raises:
            NodeSilentError: It does not come.
            ChildFailedError: Its process ended.
        """
        self._until(
            lambda: all(self._topics()) and self._parameters.service_is_ready(),
            _START_S,
            "come up",
        )

    def set(self, values: dict[str, Any]) -> None:
        """Change parameters of the node.

        Raises:
            InvalidInputError: It refuses them.
            NodeSilentError: It does not answer.
        """
        request = SetParametersAtomically.Request()
        request.parameters = [Parameter(n, value=v).to_parameter_msg() for n, v in values.items()]
        answer = self._parameters.call_async(request)
        self._until(answer.done, _ANSWER_S, "take parameters")
        response = answer.result()
        assert response is not None
        if not response.result.successful:
            raise InvalidInputError("parameters of the node", values, response.result.reason)

    def ask(self, state: JointState, stamp_ns: int) -> tuple[PlanReport, JointTrajectory | None]:
        """Have a state planned from.

        Args:
            state: The message.
            stamp_ns: Its stamp, which the clock is set to.

        Returns:
            The node's report, and the trajectory where it published one.

        Raises:
            NodeSilentError: It does not answer.
        """
        clock = Clock(clock=stamp_from_nanoseconds(stamp_ns))
        self._clock.publish(clock)
        self._states.publish(state)

        def answered() -> bool:
            report = self._reports.get(stamp_ns)
            return report is not None and (not report.published or stamp_ns in self._trajectories)

        self._until(answered, _ANSWER_S, "plan")
        return self._reports.pop(stamp_ns), self._trajectories.pop(stamp_ns, None)

    def _until(self, condition: Any, longest_s: float, what: str) -> None:
        end_s = time.monotonic() + longest_s
        while not condition():
            self._process.require_running()
            if time.monotonic() > end_s:
                raise NodeSilentError(f"the planner node did not {what} within {longest_s:g} s")
            self._executor.spin_once(timeout_sec=_SPIN_S)

    def _on_report(self, message: DiagnosticArray) -> None:
        report = report_from_message(message)
        if report.input_stamp_ns is not None:
            self._reports[report.input_stamp_ns] = report

    def _on_trajectory(self, message: JointTrajectory) -> None:
        stamp = message.header.stamp
        self._trajectories[stamp.sec * 10**9 + stamp.nanosec] = message


class NodePlanner(Planner):
    """Plans by asking a planner node; all else is done here."""

    def __init__(
        self, problem: OptimalControlProblem, settings: PlannerSettings, link: NodeLink
    ) -> None:
        """Compile the problem here too.

        Args:
            problem: What the node plans.
            settings: As the node was started with.
            link: To the node.
        """
        super().__init__(problem, settings)
        self._link = link
        self._layout = problem_layout(problem)
        if not link.told:
            link.told = {p.name: p.default for p in parameter_table(problem)}

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy asks the same node."""
        return NodePlanner, (self.problem, self.settings, self._link)

    def plan(
        self,
        state: Array | Sequence[float] | None = None,
        *,
        deadline_s: float | None = None,
        warm_start: Plan | None = None,
        elapsed_s: float = 0.0,
    ) -> PlanOutcome:
        """See `Planner.plan`; the node has its own deadline and its own warm start."""
        started_s = time.perf_counter()
        state = self.initial_state if state is None else np.asarray(state, dtype=np.float64)
        source = self.settings.terminal_time
        attempt = Attempt(self.problem, self._verifier, time.perf_counter, deadline_s)
        try:
            packed = self.check_state(state)
        except InvalidInputError as error:
            return attempt.invalid(str(error), self.parameters, source)
        self._tell_parameters(warm_start, elapsed_s)
        self._link.stamp_ns = self._next_stamp_ns(warm_start, elapsed_s)
        message = joint_state_from_state(StampedState(self._link.stamp_ns, state), self._layout)
        report, trajectory = self._link.ask(message, self._link.stamp_ns)
        empty = attempt.invalid(report.message, packed, source)
        if trajectory is None or report.attempt is None:
            known = {int(status): status for status in PlanStatus}
            status = known.get(report.code, PlanStatus.INVALID_STATE)
            return replace(empty, status=status)
        plan, _ = plan_from_trajectory(trajectory, self._layout)
        latest = dict(list(self._link.starts.items())[-3:])
        self._link.starts = {**latest, id(plan): (plan, self._link.stamp_ns)}
        figures = report.attempt
        return replace(
            empty,
            status=PlanStatus.CERTIFIED,
            converged=bool(figures.converged),
            plan=plan,
            iterations=figures.iterations,
            solve_time_s=time.perf_counter() - started_s,
            cost=math.nan if figures.cost is None else figures.cost,
            terminal_time_used_s=plan.terminal_time_s,
            warm_started=figures.warm_started,
        )

    def _tell_parameters(self, warm_start: Plan | None, elapsed_s: float) -> None:
        """Set what the node's parameters differ in.

        A changed parameter makes the node forget its warm start; what is left of the time is told.
        """
        values = self.problem.table.unpack(self.parameters)
        wanted = told_parameters(self.problem, self._layout, values, warm_start, elapsed_s)
        changed = differing(wanted, self._link.told)
        if changed:
            self._link.set(changed)
            self._link.told |= changed

    def _next_stamp_ns(self, warm_start: Plan | None, elapsed_s: float) -> int:
        """Stamp of the next state: simulated time goes on in flight, and never back."""
        known = None if warm_start is None else self._link.starts.get(id(warm_start))
        if known is None:
            return self._link.stamp_ns + _BETWEEN_FLIGHTS_NS
        return max(known[1] + nanoseconds_from_seconds(elapsed_s), self._link.stamp_ns + 1)


@contextmanager
def node_planner(
    problem: str, declared: OptimalControlProblem, settings: PlannerSettings, log: Path
) -> Iterator[NodePlanner]:
    """Runs a planner node for the length of the block.

    Args:
        problem: As the node's parameter names it.
        declared: The same.
        settings: How to plan; the terminal time is free.
        log: What the node says.

    Raises:
        ChildFailedError: The node died or did not end.
        NodeSilentError: It does not come up.
    """
    arguments = {
        "problem": problem,
        "intervals": settings.intervals,
        "terminal_time_source": settings.terminal_time.value,
        "control_hold": settings.hold.value,
        "discretisation": settings.discretisation.value,
        "solver": settings.options.solver,
        "deadline_s": 10.0,
        "state_max_age_s": 1e6,
        "future_tolerance_s": 1e6,
        "use_sim_time": "true",
    }
    words = [word for name, value in arguments.items() for word in ("-p", f"{name}:={value}")]
    command = [sys.executable, "-m", "dscp_ros.planner.main", "--ros-args", *words]
    context = Context()
    rclpy.init(context=context, args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node("dscp_flights", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        with child("the planner node", command, log) as process:
            link = NodeLink(node, executor, process)
            link.await_node()
            yield NodePlanner(declared, settings, link)
            process.stop()
        executor.shutdown()
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
