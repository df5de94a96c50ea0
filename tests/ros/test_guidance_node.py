"""Guidance node and planner node, each a process of its own, land a vehicle over real topics."""

from __future__ import annotations

import array
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from ros.planner_support import (
    LATCHED,
    LAYOUT,
    START_TIMEOUT_S,
    STATE,
    UNREACHABLE,
    Harness,
    end,
    start,
)
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from dscp_core import problems
from dscp_core.problems.powered_descent.motion import TrueMotion
from dscp_core.problems.powered_descent.truth import TruthSettings, World
from dscp_ros.cli import ExitCode
from dscp_ros.cli.main import main
from msg_adapters.guidance import GuidanceStatus, guidance_status_from_message
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.report import NodeCode
from msg_adapters.stamps import (
    nanoseconds_from_seconds,
    nanoseconds_from_stamp,
    stamp_from_nanoseconds,
)
from msg_adapters.state import StampedState
from msg_adapters.validity import validity_from_message

START_S = 1000.0
TICK_S = 0.1
WAIT_S = 20.0
SIMULATED = ["--ros-args", "-p", "use_sim_time:=true"]
PLANNER = [*SIMULATED, "-p", "deadline_s:=15.0"]
OK, WARN = (
    int.from_bytes(level, "little") for level in (DiagnosticStatus.OK, DiagnosticStatus.WARN)
)


class Vehicle:
    """What stands around guidance: time, navigation, and the engine that hears the commands."""

    def __init__(self, ros: Harness) -> None:
        self._ros = ros
        node = ros.create_node("vehicle")
        self._clock = node.create_publisher(Clock, "/clock", 10)
        self.states = node.create_publisher(JointState, "/guidance/vehicle_state", 10)
        self._status: list[DiagnosticArray] = []
        self._thrusts: list[WrenchStamped] = []
        self.validities: list[DiagnosticArray] = []
        for kind, topic, store, qos in (
            (DiagnosticArray, "/guidance/status", self._status, LATCHED),
            (WrenchStamped, "/guidance/thrust", self._thrusts, 100),
            (DiagnosticArray, "/planner/validity", self.validities, LATCHED),
        ):
            node.create_subscription(kind, topic, store.append, qos)
        self._services = {
            name: node.create_client(Trigger, name)
            for name in ("/planner/reset", "/guidance/reset")
        }
        self._node = node
        self.planner = start(ros, PLANNER)
        self.ticks = 0

    @property
    def status(self) -> GuidanceStatus:
        return guidance_status_from_message(self._status[-1])

    @property
    def forces(self) -> list[np.ndarray]:
        forces = [message.wrench.force for message in self._thrusts]
        return [np.array([f.z, f.x, f.y]) for f in forces]  # x up, as the core has it

    def wait_for(self, predicate: Any) -> None:
        assert self._ros.wait_for(lambda: bool(predicate()), WAIT_S), self._status[-1:]

    def wait_until_connected(self) -> None:
        def connected() -> bool:
            return (
                self.states.get_subscription_count() > 0
                and self._node.count_publishers("/planner/report") > 0
                and self._node.count_subscribers("/planner/vehicle_state") > 0
                and self._node.count_publishers("/guidance/thrust") > 0
                and self._clock.get_subscription_count() >= 2
                and all(client.service_is_ready() for client in self._services.values())
                and bool(self._status)
                and bool(self.validities)
            )

        assert self._ros.wait_for(connected, START_TIMEOUT_S)

    def call(self, service: str) -> None:
        future = self._services[service].call_async(Trigger.Request())
        self.wait_for(future.done)
        assert future.result().success

    def tell_time(self, time_s: float) -> None:
        stamp_ns = nanoseconds_from_seconds(time_s)
        self._clock.publish(Clock(clock=stamp_from_nanoseconds(stamp_ns)))

    def tell_state(self, state: np.ndarray, time_s: float) -> None:
        stamp_ns = nanoseconds_from_seconds(time_s)
        self.states.publish(joint_state_from_state(StampedState(stamp_ns, state), LAYOUT))

    def tell_until(self, time_s: float) -> None:
        """Tell the time until guidance knows it."""
        stamp_ns = nanoseconds_from_seconds(time_s)

        def told() -> bool:
            self.tell_time(time_s)
            return self.status.stamp_ns == stamp_ns

        self.wait_for(told)

    def begin(self, state: np.ndarray, time_s: float) -> None:
        """Tell the time, then a state of then, until a flight has begun."""
        self.tell_until(time_s)
        self.tell_state(state, time_s)
        self.wait_for(lambda: self.status.phase == "waiting")
        self.ticks = self.status.ticks

    def tick(self, state: np.ndarray | None, measured_s: float, time_s: float) -> np.ndarray | None:
        """One tick of guidance: what it commands. Time stands still while a plan is made."""
        known = len(self._thrusts)
        if state is not None:
            self.tell_state(state, measured_s)
        self.tell_time(time_s)
        self.ticks += 1
        self.wait_for(lambda: self.status.ticks >= self.ticks)
        assert self.status.ticks == self.ticks
        self.wait_for(lambda: self.status.asked_stamp_ns is None)
        if not self.status.commanding:
            return None
        self.wait_for(lambda: len(self._thrusts) > known)
        assert len(self._thrusts) == known + 1
        stamp = self._thrusts[-1].header.stamp
        assert nanoseconds_from_stamp(stamp) == nanoseconds_from_seconds(time_s)
        assert self._thrusts[-1].header.frame_id == LAYOUT.frame
        return self.forces[-1]


@contextmanager
def nodes(ros: Harness, *guidance: str) -> Iterator[Vehicle]:
    """A vehicle, with both nodes in processes of their own."""
    process = start(ros, [*SIMULATED, *guidance], "dscp_ros.guidance.main")
    try:
        vehicle = Vehicle(ros)
        try:
            vehicle.wait_until_connected()
            yield vehicle
        finally:
            end(vehicle.planner)
    finally:
        end(process)


@pytest.fixture(autouse=True)
def _fields_are_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_PYTHON_CHECK_FIELDS", "1")


def test_a_vehicle_lands(ros: Harness) -> None:
    problem = problems.get("powered_descent")
    values = problem.table.unpack(problem.pack({}))
    truth = TruthSettings.suited(values)
    world = World(TrueMotion(), values, truth, seed=7)
    phases: list[str] = []
    with nodes(ros, "-p", "guidance.replan_s:=3.0") as vehicle:
        vehicle.begin(world.measure(world.before_start(TICK_S)), START_S - TICK_S)
        sample = world.before_start(truth.delay_s)
        tick = 0
        while not world.landed and tick < 600:
            at_s = tick * TICK_S  # of the flight's first command
            time_s = START_S + at_s
            force = vehicle.tick(world.measure(sample), time_s - truth.delay_s, time_s)
            phases.append(vehicle.status.phase)
            if tick == 100:
                vehicle.call("/planner/reset")
                last = validity_from_message(vehicle.validities[-1])
                assert (last.valid, last.code) == (False, NodeCode.RESET)
            if tick == 101:  # it goes on along the plan that it has, and says so
                assert force is not None
                assert "which was revoked: RESET" in vehicle.status.message, vehicle.status
                assert vehicle.status.level == WARN
            world.fly(at_s + truth.command_latency_s)
            world.set_command(force)
            world.fly(at_s + TICK_S - truth.delay_s)
            sample = world.state[:7].copy()
            world.blow(TICK_S)
            world.fly(at_s + TICK_S)
            tick += 1
        status = vehicle.status
        forces = np.array(vehicle.forces)
    state, direction = world.state[:7], world.state[8:11]
    assert world.landed
    assert np.linalg.norm(state[3:6]) < 0.5
    assert np.linalg.norm(state[0:3]) < 1.0
    assert math.atan2(np.hypot(direction[1], direction[2]), direction[0]) < math.radians(5.0)
    assert [p for p, before in zip(phases, ["", *phases], strict=False) if p != before] == [
        "waiting",
        "tracking",
        "profile",
    ]
    assert (status.level, status.message, status.rejected) == (OK, "profile", 0)
    assert status.plans_flown >= 8
    assert np.all(np.isfinite(forces))
    sizes = np.linalg.norm(forces, axis=1)
    assert np.all(sizes >= 169e3 * (1.0 - 1e-9))
    assert np.all(sizes <= 845.2e3 * (1.0 + 1e-9))


def coasting(after_s: float) -> np.ndarray:
    """The paper's start, falling for so long."""
    state = STATE.copy()
    state[0:3] += after_s * STATE[3:6]
    state[0] -= 0.5 * 9.80655 * after_s**2
    state[3] -= 9.80655 * after_s
    return state


def stamped(position: np.ndarray, time_s: float) -> JointState:
    """A message of a state, which may hold NaN."""
    message = joint_state_from_state(StampedState(nanoseconds_from_seconds(time_s), STATE), LAYOUT)
    message.position = array.array("d", LAYOUT.to_message_order(position).tolist())
    return message


def test_whatever_comes_it_says_why_it_commands_nothing(ros: Harness) -> None:
    broken = np.where(np.arange(7) == 2, math.nan, STATE)
    with nodes(ros) as vehicle:
        assert vehicle.status.message == "commands nothing: no state"
        vehicle.tell_until(START_S)
        vehicle.states.publish(stamped(broken, START_S))
        vehicle.wait_for(lambda: "refused: NOT_FINITE" in vehicle.status.message)
        vehicle.tell_state(UNREACHABLE, START_S)
        vehicle.wait_for(lambda: "no plan to the pad" in vehicle.status.message)
        assert (vehicle.status.phase, vehicle.status.commanding) == ("none", False)

        def tick(at_s: float, *, told: bool = True) -> np.ndarray | None:
            time_s = START_S + at_s
            return vehicle.tick(coasting(at_s) if told else None, time_s, time_s)

        vehicle.begin(coasting(2.0), START_S + 2.0)
        assert tick(2.1) is None
        assert vehicle.status.message == "commands nothing: no plan yet"
        assert tick(2.2) is not None

        refused = vehicle.status.rejected
        for message in (stamped(broken, START_S + 2.2), stamped(STATE, START_S + 1.0)):
            refused += 1
            vehicle.states.publish(message)  # not a number; too old
            vehicle.wait_for(lambda count=refused: vehicle.status.rejected == count)
        for number in range(3, 8):  # it goes on with what it expects, for a while
            assert tick(2.0 + 0.1 * number, told=False) is not None
        assert tick(2.8, told=False) is None
        assert "the last state is 0.60 s old, more than 0.5 s" in vehicle.status.message
        assert tick(2.9) is not None

        # The planner ends, and another one comes, which was told nothing yet.
        end(vehicle.planner)
        tenths = iter(range(30, 100))
        while "there is no planner node" not in vehicle.status.message:
            assert tick(0.1 * next(tenths)) is not None
        assert "flies on the last plan" in vehicle.status.message
        flown, vehicle.planner = vehicle.status.plans_flown, start(ros, PLANNER)
        vehicle.wait_until_connected()
        while vehicle.status.plans_flown == flown:
            assert tick(0.1 * next(tenths)) is not None
        assert vehicle.status.level == OK

        vehicle.tell_until(START_S - 500.0)
        vehicle.wait_for(lambda: "the clock jumped by" in vehicle.status.message)
        # The same again, with a hole in time: what was known is worth nothing any more.
        for start_s in (START_S - 500.0, START_S):
            vehicle.begin(STATE, start_s)
            assert vehicle.tick(STATE, start_s + 0.1, start_s + 0.1) is None
            assert vehicle.tick(STATE, start_s + 0.2, start_s + 0.2) is not None
        vehicle.call("/guidance/reset")
        vehicle.wait_for(lambda: "reset: begins anew" in vehicle.status.message)
        assert np.all(np.isfinite(vehicle.forces))


def test_settings_are_checked(ros: Harness) -> None:
    process = start(ros, [*SIMULATED, "-p", "guidance.replan_s:=-1.0"], "dscp_ros.guidance.main")
    output, _ = process.communicate(timeout=START_TIMEOUT_S)
    assert process.returncode == ExitCode.BAD_INPUT
    assert "guidance.replan_s: got -1.0" in output


def test_without_a_problem_that_can_be_guided(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["guide", "entry"]) == ExitCode.BAD_INPUT
    assert (
        "problem: got 'entry', expected one that brings guidance along" in capsys.readouterr().err
    )
