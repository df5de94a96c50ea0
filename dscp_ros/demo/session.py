"""The live part: the planner node as a process, bags replayed into it, its output recorded."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from dscp_core.errors import InvalidInputError
from dscp_ros.bag import BagReader
from dscp_ros.demo.listening import Listener, listening
from dscp_ros.demo.processes import Child, child

INPUTS = ("/planner/vehicle_state", "/planner/mass", "/planner/state")
"""Topics that the planner node listens to; a bag's other topics are not replayed."""
REPORT, TRAJECTORY = "/planner/report", "/planner/trajectory"
OUTPUTS = (REPORT, TRAJECTORY, "/planner/path", "/planner/markers", "/diagnostics")

_CLOCK_HZ = 50
_START_S = 20.0
_SUBSCRIBERS = "1/20"
_QUIET_S = 1.0
"""No report for so long after a replay: the node is done with what it was sent."""
_PROGRESS_S = 2.0


@dataclass(frozen=True)
class InputBag:
    """A bag to replay.

    Attributes:
        path: The bag.
        start_ns: Its first log time.
        end_ns: Its last log time.
        topics: Its topics that the planner listens to.
        states: States on them.
    """

    path: Path
    start_ns: int
    end_ns: int
    topics: tuple[str, ...]
    states: int

    @property
    def name(self) -> str:
        """Its folder or file."""
        return self.path.name

    @property
    def seconds(self) -> float:
        """Length in recorded time."""
        return (self.end_ns - self.start_ns) / 1e9


def open_input(path: Path) -> InputBag:
    """Looks into a bag.

    Raises:
        BagError: It cannot be read.
        InvalidInputError: The planner listens to none of its topics.
    """
    with BagReader(path) as reader:
        topics = tuple(name for name in INPUTS if name in reader.topics)
        if not topics:
            bound = f"a bag with one of {', '.join(INPUTS)}"
            raise InvalidInputError("bag", str(path), bound)
        states = sum(reader.topics[n].message_count for n in topics if n != "/planner/mass")
        return InputBag(path, reader.start_ns, reader.end_ns, topics, states)


def run_session(
    bags: Sequence[InputBag],
    folder: Path,
    *,
    rate: float,
    timeout_s: float,
    say: Callable[[str], None],
    node_arguments: Sequence[str] = (),
) -> Path:
    """Replays bags into a planner node and records what it publishes.

    Args:
        bags: In order of their recorded time.
        folder: Gets the recording and the processes' logs.
        rate: Recorded seconds per second.
        timeout_s: Longest time for everything.
        say: Is told what happens.
        node_arguments: Of the node's command line.

    Returns:
        The recording.

    Raises:
        ChildFailedError: A process died or did not end.
        DemoTimeoutError: Time is up.
        BagError: The recording cannot be written.
    """
    with live_planner(
        folder, timeout_s=timeout_s, say=say, node_arguments=node_arguments
    ) as planner:
        for bag in bags:
            planner.replay(bag, rate)
    return planner.recording


class LivePlanner:
    """The planner node in a process of its own, and this process recording what it publishes.

    Attributes:
        recording: Bag that is whole when the block of `live_planner` has ended.
        listener: Records into it.
    """

    def __init__(
        self,
        node: Child,
        listener: Listener,
        recording: Path,
        deadline_s: float,
        say: Callable[[str], None],
    ) -> None:
        self._node = node
        self._deadline_s = deadline_s
        self._say = say
        self.listener = listener
        self.recording = recording

    def replay(self, bag: InputBag, rate: float) -> None:
        """Replays a bag and waits until the node is done with it.

        Raises:
            ChildFailedError: A process died or did not end.
            DemoTimeoutError: Time is up.
        """
        self._say(f"replaying {bag.name}: {bag.states} states in {bag.seconds / rate:.0f} s")
        log = self.recording.parent / f"{bag.name}.log"
        with child("the replay", _replay(bag, rate), log) as replay:
            _follow(self._node, replay, self.listener, self._deadline_s, self._say)
        _await_quiet(self._node, self.listener, self._deadline_s)

    def listen_until(self, condition: Callable[[], bool], waiting_for: str) -> None:
        """Records until a condition holds.

        Raises:
            ChildFailedError: The node has ended.
            DemoTimeoutError: Time is up.
        """

        def holds() -> bool:
            self._node.require_running()
            return condition()

        self.listener.listen_until(holds, self._deadline_s, lambda: waiting_for)


@contextmanager
def live_planner(
    folder: Path, *, timeout_s: float, say: Callable[[str], None], node_arguments: Sequence[str]
) -> Iterator[LivePlanner]:
    """Runs a planner node for the length of the block, and records what it publishes.

    Args:
        folder: Gets the recording and the processes' logs.
        timeout_s: Longest time for everything.
        say: Is told what happens.
        node_arguments: Of the node's command line.

    Raises:
        ChildFailedError: The node died or did not end.
        DemoTimeoutError: Time is up.
        BagError: The recording cannot be written.
    """
    deadline_s = time.monotonic() + timeout_s
    output = folder / "planner_output"
    separator = () if "--ros-args" in node_arguments else ("--ros-args",)
    # The bags' clock is the node's: stamps keep their meaning, and so does the age of a stale one.
    command = [
        *(sys.executable, "-m", "dscp_ros.planner.main", *node_arguments, *separator),
        *("-p", "use_sim_time:=true"),
    ]
    say("starting the planner node")
    with (
        child("the planner node", command, folder / "planner.log") as node,
        listening(output, OUTPUTS) as listener,
    ):
        _await_node(node, listener, min(deadline_s, time.monotonic() + _START_S))
        say(f"the node is up; recording to {output}")
        yield LivePlanner(node, listener, output, deadline_s, say)
        say("stopping the planner node")
        node.stop()


def _replay(bag: InputBag, rate: float) -> list[str]:
    return [
        *(sys.executable, "-m", "dscp_ros.replay", str(bag.path)),
        *("--rate", str(rate), "--clock", str(_CLOCK_HZ)),
        *("--wait-for-subscribers", _SUBSCRIBERS, "--no-progress"),
        *("--topics", *bag.topics),
    ]


def _await_node(planner: Child, listener: Listener, deadline_s: float) -> None:
    def up() -> bool:
        planner.require_running()
        return not listener.waiting_for

    listener.listen_until(
        up, deadline_s, lambda: f"the planner node to offer {', '.join(listener.waiting_for)}"
    )


def _follow(
    planner: Child,
    replay: Child,
    listener: Listener,
    deadline_s: float,
    say: Callable[[str], None],
) -> None:
    """Records while the replay runs, and says now and then how it goes."""
    before = {topic: listener.count(topic) for topic in (REPORT, TRAJECTORY)}
    said_s = time.monotonic()

    def done() -> bool:
        nonlocal said_s
        planner.require_running()
        if time.monotonic() > said_s + _PROGRESS_S:
            said_s = time.monotonic()
            reports, plans = (listener.count(t) - before[t] for t in (REPORT, TRAJECTORY))
            say(f"  {reports} reports, {plans} certified plans")
        return replay.finished()

    listener.listen_until(done, deadline_s, lambda: "the replay to end")


def _await_quiet(planner: Child, listener: Listener, deadline_s: float) -> None:
    heard, heard_s = listener.count(REPORT), time.monotonic()

    def quiet() -> bool:
        nonlocal heard, heard_s
        planner.require_running()
        if listener.count(REPORT) != heard:
            heard, heard_s = listener.count(REPORT), time.monotonic()
        return time.monotonic() > heard_s + _QUIET_S

    listener.listen_until(quiet, deadline_s, lambda: "the planner to finish its last plan")
