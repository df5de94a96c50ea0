"""Reading states out of logs, message by message, through the planner node's own checks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_ros.bag import BagReader, MessageDecodeError
from dscp_ros.planner.input_checks import AcceptedState, InputGate, InputSettings
from dscp_ros.tuning.reports import ReportSummary
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.layout import StateLayout
from msg_adapters.report import NodeCode, PlanReport
from msg_adapters.report_message import report_from_message
from msg_adapters.stamps import nanoseconds_from_stamp

Array = NDArray[np.float64]

STATE, VEHICLE_STATE, MASS, REPORT = "state", "vehicle_state", "mass", "report"
_CLOCK = "/clock"
_TYPES = {
    STATE: "nav_msgs/msg/Odometry",
    VEHICLE_STATE: "sensor_msgs/msg/JointState",
    MASS: "geometry_msgs/msg/InertiaStamped",
    REPORT: "diagnostic_msgs/msg/DiagnosticArray",
    _CLOCK: "rosgraph_msgs/msg/Clock",
}
UNDECODABLE = "UNDECODABLE"
OTHER_PROBLEM = "OTHER_PROBLEM"


@dataclass
class LoggedState:
    """A state that may be planned from.

    Attributes:
        log_time_ns: When it was recorded.
        stamp_ns: Its own time.
        values: (nx,), SI, in the core's order and axes.
        terminal_time_s: Terminal time that the planner reported for it, or None.
    """

    log_time_ns: int
    stamp_ns: int
    values: Array
    terminal_time_s: float | None = None


@dataclass
class LogContent:
    """What was read of one log.

    Attributes:
        path: The log.
        start_ns: First log time.
        end_ns: Last log time.
        messages: Messages on the topics that were read.
        states: The accepted states by log time.
        refused: How many others there were, by the name of the reason.
        reports: What the planner reported.
        damage: What could not be read, one text per place.
    """

    path: Path
    start_ns: int
    end_ns: int
    messages: int = 0
    states: list[LoggedState] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    reports: ReportSummary = field(default_factory=ReportSummary)
    damage: tuple[str, ...] = ()

    def require_states(self) -> None:
        """Check that there is something to tune on.

        Raises:
            InvalidInputError: No state was accepted.
        """
        if self.states:
            return
        reasons = ", ".join(f"{name} {count}" for name, count in self.refused.most_common())
        found = f"; refused: {reasons}" if reasons else ""
        lost = f"; damaged: {'; '.join(self.damage)}" if self.damage else ""
        raise InvalidInputError(
            "log", str(self.path), f"a log with at least one usable state{found}{lost}"
        )


def topics_of_node(node: str, renamed: Mapping[str, str], layout: StateLayout) -> dict[str, str]:
    """Topics to read, by what they hold.

    Args:
        node: Name of the planner node.
        renamed: Topics that stand in the log under other names, by what they hold.
        layout: Names and order of the problem's state.

    Raises:
        InvalidInputError: Something that the node does not listen to or publish.
    """
    odometry = layout.odometry
    heard = {STATE: odometry is not None, MASS: odometry is not None and odometry.mass is not None}
    known = [name for name in (STATE, VEHICLE_STATE, MASS, REPORT) if heard.get(name, True)]
    for name in renamed:
        if name not in known:
            raise InvalidInputError("--topic", name, f"one of {', '.join(known)}")
    return {name: renamed.get(name, f"{node.rstrip('/')}/{name}") for name in known}


def read_log(
    path: Path,
    layout: StateLayout,
    settings: InputSettings,
    topics: Mapping[str, str],
) -> LogContent:
    """Read one log; memory holds its states, not its messages.

    A damaged log is read as far as it goes. Ages are judged by the clock that the node had: that
    of ``/clock``, else that of the reports, else the log's own.

    Args:
        path: The bag.
        layout: Names and order of the problem's state.
        settings: What inputs have to satisfy.
        topics: From `topics_of_node`.

    Raises:
        BagError: The log cannot be read at all, or a type is not installed as it was recorded.
        InvalidInputError: It has none of the topics, one of another type, or no message.
    """
    with BagReader(path) as reader:
        found = _found_topics(reader, path, topics)
        content = LogContent(path, reader.start_ns, reader.end_ns)
        pass_through = _Reading(content, layout, settings)
        pass_through.set_clock(reader, found)
        for message in reader.messages(found):
            content.messages += 1
            pass_through.take(found[message.topic.name], message.log_time_ns, message.decode)
        content.damage = tuple(str(damage) for damage in reader.report.damages)
    if not content.messages and not content.damage:
        raise InvalidInputError("log", str(path), f"a log with messages on {', '.join(found)}")
    return content


def _found_topics(reader: BagReader, path: Path, topics: Mapping[str, str]) -> dict[str, str]:
    """What the log's topics hold, by topic name."""
    found = {topic: kind for kind, topic in topics.items() if topic in reader.topics}
    if not any(kind in (STATE, VEHICLE_STATE, REPORT) for kind in found.values()):
        kinds = (STATE, VEHICLE_STATE, REPORT)
        wanted = ", ".join(topics[kind] for kind in kinds if kind in topics)
        has = ", ".join(reader.topics) or "no topics"
        raise InvalidInputError("log", str(path), f"a log with one of {wanted}; it has: {has}")
    if _CLOCK in reader.topics:
        found[_CLOCK] = _CLOCK
    for topic, kind in found.items():
        info = reader.topics[topic]
        if info.type_name != _TYPES[kind]:
            raise InvalidInputError(f"{path}: type of {topic}", info.type_name, _TYPES[kind])
        info.installed_class()
    return found


class _Reading:
    """One pass through a log."""

    def __init__(self, content: LogContent, layout: StateLayout, settings: InputSettings) -> None:
        self._content = content
        self._layout = layout
        self._settings = settings
        self._gate = InputGate(layout)
        self._by_stamp: dict[int, LoggedState] = {}
        self._clock_kind: str | None = None
        self._clock_minus_log_ns = 0
        self._last_clock_ns = 0

    def set_clock(self, reader: BagReader, found: Mapping[str, str]) -> None:
        """Find the clock that ages are judged by, as it was at the beginning."""
        for kind in (_CLOCK, REPORT):
            names = [topic for topic, held in found.items() if held == kind]
            for message in reader.messages(names) if names else ():
                try:
                    self._follow(kind, message.decode(), message.log_time_ns)
                except (MessageDecodeError, RejectedInputError):
                    continue  # counted when its turn comes
                self._clock_kind = kind
                return

    def take(self, kind: str, log_time_ns: int, decode: Callable[[], Any]) -> None:
        """Take the next message."""
        try:
            message = decode()
            if kind == self._clock_kind:
                self._follow(kind, message, log_time_ns)
            now_ns = log_time_ns + self._clock_minus_log_ns
            if kind == MASS:
                self._gate.accept_mass(message, now_ns, self._settings)
            elif kind == STATE:
                self._keep(self._gate.accept_odometry(message, now_ns, self._settings), log_time_ns)
            elif kind == VEHICLE_STATE:
                self._keep(
                    self._gate.accept_joint_state(message, now_ns, self._settings), log_time_ns
                )
            elif kind == REPORT:
                self._take_report(message, log_time_ns)
        except RejectedInputError as error:
            self._content.refused[error.code.name] += 1
        except MessageDecodeError:
            self._content.refused[UNDECODABLE] += 1

    def _follow(self, kind: str, message: Any, log_time_ns: int) -> None:
        """Set the clock by a message that tells its time."""
        stamp = message.clock if kind == _CLOCK else message.header.stamp
        clock_ns = nanoseconds_from_stamp(stamp)
        if clock_ns < self._last_clock_ns and kind == _CLOCK:
            self._forget()
        self._last_clock_ns = clock_ns
        self._clock_minus_log_ns = clock_ns - log_time_ns

    def _forget(self) -> None:
        """Do what the node does when its clock jumps back."""
        self._gate.forget()
        self._by_stamp.clear()

    def _keep(self, accepted: AcceptedState, log_time_ns: int) -> None:
        state = accepted.state
        if state.stamp_ns not in self._by_stamp:  # else a report has told of it
            self._add(LoggedState(log_time_ns, state.stamp_ns, state.values))

    def _add(self, state: LoggedState) -> None:
        self._content.states.append(state)
        self._by_stamp[state.stamp_ns] = state

    def _take_report(self, message: DiagnosticArray, log_time_ns: int) -> None:
        """Count a report, and take the state that it tells of unless it is there already."""
        report = report_from_message(message)
        if report.problem != self._layout.problem:
            self._content.refused[OTHER_PROBLEM] += 1
            return
        self._content.reports.count(report)
        if report.code == NodeCode.CLOCK_JUMPED_BACK:
            self._forget()
        if report.attempt is None or report.input_stamp_ns is None:
            return
        state = self._by_stamp.get(report.input_stamp_ns)
        if state is None:
            state = LoggedState(
                log_time_ns, report.input_stamp_ns, _state_of_report(report, self._layout)
            )
            self._add(state)
        state.terminal_time_s = report.attempt.terminal_time_used_s


def _state_of_report(report: PlanReport, layout: StateLayout) -> Array:
    """State that a report's attempt began from, (nx,), SI, in the core's order.

    Raises:
        RejectedInputError: REPORT_MISSING_KEY.
    """
    named = [report.state.get(name, math.nan) for name in layout.message_names]
    if not np.all(np.isfinite(named)):
        bound = f"a state of {', '.join(layout.message_names)}"
        raise RejectedInputError(InputCode.REPORT_MISSING_KEY, "state", sorted(report.state), bound)
    return layout.to_core_order(np.array(named))
