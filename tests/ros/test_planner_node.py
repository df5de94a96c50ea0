"""The planner node on real topics, as its own process where that matters."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
from adapter_cases import points_from_path
from geometry_msgs.msg import InertiaStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.qos import qos_profile_sensor_data
from ros.planner_support import (
    LATCHED,
    LAYOUT,
    ROOT,
    STATE,
    UNREACHABLE,
    local_planner,
    now_ns,
    running_planner,
)
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker

from dscp_core.planning.plan import PlanStatus
from msg_adapters.diagnostics import health_from_message
from msg_adapters.errors import InputCode
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.mass import inertia_from_mass
from msg_adapters.odometry import odometry_from_kinematics
from msg_adapters.state import Kinematics, StampedMass, StampedState
from msg_adapters.trajectory import plan_from_trajectory

MEMORY_LIMIT_MB = 200


def odometry(stamp_ns: int) -> Odometry:
    """The paper's state with a tilted vehicle, so that body and landing axes differ."""
    position, velocity = STATE[[1, 2, 0]], STATE[[4, 5, 3]]
    attitude = Rotation.from_euler("xyz", [20.0, -35.0, 130.0], degrees=True).as_quat()
    return odometry_from_kinematics(
        Kinematics(stamp_ns, position, velocity), frame=LAYOUT.frame, attitude=attitude
    )


def test_a_state_becomes_a_certified_trajectory(ros):
    with running_planner(ros) as (client, process):
        stamp_ns = client.send()
        report = client.report_of(stamp_ns)
        assert (report.code, report.code_name) == (PlanStatus.CERTIFIED, "CERTIFIED")
        assert report.published
        assert report.source == "vehicle_state"
        assert report.attempt.iterations >= 1
        assert report.attempt.solve_time_ms > report.attempt.solver_time_ms > 0.0
        assert report.attempt.deadline_ms == 15_000.0
        assert report.certificate.passed
        assert {check.name for check in report.certificate.checks} >= {"glideslope", "pointing"}
        assert report.state["z"] == 5000.0

        client.wait_for(lambda: client.trajectories and client.paths and client.markers)
        trajectory = client.trajectories[-1]
        plan, start_ns = plan_from_trajectory(trajectory, LAYOUT)
        assert start_ns == stamp_ns
        # The solver satisfies the initial condition to its own accuracy.
        assert np.allclose(plan.states[0], STATE, rtol=1e-6, atol=1e-3)
        # The certificate allows a miss; the plan's own end is the target, to solver accuracy.
        assert np.allclose(plan.states[-1][:6], 0.0, atol=0.01)
        # The published optimum of the paper's case, to the nanosecond rounding and convergence.
        assert math.isclose(plan.terminal_time_s, 32.81, abs_tol=0.005)
        assert report.attempt.terminal_time_used_s == plan.terminal_time_s or math.isclose(
            report.attempt.terminal_time_used_s, plan.terminal_time_s, abs_tol=1e-9
        )
        positions, _ = points_from_path(client.paths[-1])
        assert np.array_equal(positions, plan.states[:, [1, 2, 0]])
        assert {m.ns for m in client.markers[-1].markers} == {"path", "thrust", "glideslope"}

        # A subscriber that comes later still gets the plan.
        late: list[JointTrajectory] = []
        client.node.create_subscription(
            JointTrajectory, "/planner/trajectory", late.append, LATCHED
        )
        client.wait_for(lambda: late)
        assert late[-1] == trajectory

        status = Path(f"/proc/{process.pid}/status").read_text()
        resident_mb = int(re.search(r"VmRSS:\s+(\d+) kB", status)[1]) / 1024
        assert resident_mb < MEMORY_LIMIT_MB
        assert "torch" not in Path(f"/proc/{process.pid}/maps").read_text()


def test_odometry_is_completed_by_the_mass(ros):
    with running_planner(ros) as (client, _):
        lonely_ns = now_ns()
        client.state.publish(odometry(lonely_ns))
        assert client.report_of(lonely_ns).code == InputCode.MASS_MISSING

        mass_ns = now_ns()
        client.mass.publish(inertia_from_mass(StampedMass(mass_ns, STATE[6])))
        rejected = InertiaStamped()
        rejected.inertia.m = -1.0
        rejected.header.stamp.sec = 1
        client.mass.publish(rejected)
        # The refusal of the second mass says that the first was taken.
        assert client.report_of(1_000_000_000).code == InputCode.MASS_NOT_POSITIVE

        stamp_ns = now_ns()
        client.state.publish(odometry(stamp_ns))
        report = client.report_of(stamp_ns)
        assert report.code == PlanStatus.CERTIFIED
        assert (report.source, report.mass_source) == ("state", "message")
        planned_from = [report.state[name] for name in LAYOUT.message_names]
        # Rotated into body axes and back.
        assert np.allclose(planned_from, LAYOUT.to_message_order(STATE), rtol=1e-12, atol=1e-9)


def test_mass_fallback_is_used_and_said(ros):
    with local_planner(ros, mass_fallback_kg=37000.0) as (client, _):
        lines: list[Log] = []
        client.node.create_subscription(Log, "/rosout", lines.append, LATCHED)
        stamp_ns = now_ns()
        client.state.publish(odometry(stamp_ns))
        report = client.report_of(stamp_ns)
        assert (report.mass_source, report.state["mass"]) == ("parameter", 37000.0)
        client.wait_for(lambda: any("mass_fallback_kg" in line.msg for line in lines))


def whole_state(stamp_ns: int, values=STATE) -> JointState:
    return joint_state_from_state(StampedState(stamp_ns, np.asarray(values)), LAYOUT)


def changed(message, path: str, value):
    *parents, last = path.split(".")
    target = message
    for name in parents:
        target = getattr(target, name)
    setattr(target, last, value)
    return message


def bad_inputs() -> dict[str, tuple[str, object, InputCode]]:
    """Publisher, message and expected code by name; stamps differ so that reports can be told."""
    base_ns = now_ns()
    stamps = iter(range(base_ns, base_ns + 1000))
    hour_ns = 3600 * 10**9
    position = list(whole_state(0).position)
    cases: dict[str, tuple[str, object, InputCode]] = {}

    def joint(name: str, code: InputCode, path: str, value: object) -> None:
        message = changed(whole_state(next(stamps)), path, value)
        cases[name] = ("vehicle_state", message, code)

    def odom(name: str, code: InputCode, path: str, value: object) -> None:
        message = changed(odometry(next(stamps)), path, value)
        cases[name] = ("state", message, code)

    joint("NaN", InputCode.NOT_FINITE, "position", [math.nan, *position[1:]])
    joint("infinity", InputCode.NOT_FINITE, "position", [math.inf, *position[1:]])
    joint("no frame", InputCode.EMPTY_FRAME, "header.frame_id", "")
    joint("wrong frame", InputCode.WRONG_FRAME, "header.frame_id", "map")
    joint("short array", InputCode.WRONG_ARRAY_LENGTH, "position", position[:-1])
    joint("zero mass", InputCode.MASS_NOT_POSITIVE, "position", [*position[:-1], 0.0])
    joint("negative mass", InputCode.MASS_NOT_POSITIVE, "position", [*position[:-1], -5.0])
    joint("below ground", InputCode.BELOW_GROUND, "position", [0.0, 0.0, -50.0, *position[3:]])
    joint("far away", InputCode.OUT_OF_RANGE, "position", [1e9, *position[1:]])
    names = list(LAYOUT.message_names)
    joint("duplicate", InputCode.DUPLICATE_NAME, "name", [*names[:-1], "x"])
    joint("unknown", InputCode.UNKNOWN_NAME, "name", [*names[:-1], "fuel"])
    odom("NaN velocity", InputCode.NOT_FINITE, "twist.twist.linear.x", math.nan)
    odom("no child frame", InputCode.EMPTY_FRAME, "child_frame_id", "")
    odom("quaternion", InputCode.NON_UNIT_QUATERNION, "pose.pose.orientation.w", 3.0)
    missing = whole_state(next(stamps))
    missing.name, missing.position = missing.name[:-1], missing.position[:-1]
    cases["missing name"] = ("vehicle_state", missing, InputCode.MISSING_NAME)
    cases["stale"] = ("vehicle_state", whole_state(base_ns - hour_ns), InputCode.STALE_STAMP)
    cases["future"] = ("vehicle_state", whole_state(base_ns + hour_ns), InputCode.FUTURE_STAMP)
    return cases


def test_bad_inputs_have_their_numbered_reports_and_the_node_lives_on(ros):
    with running_planner(ros) as (client, process):
        first_ns = client.send()
        assert client.report_of(first_ns).published
        known = len(client.report_messages)
        got, expected = {}, {}
        for name, (topic, message, code) in bad_inputs().items():
            getattr(client, topic).publish(message)
            report = client.next_report(known)
            known += 1
            got[name], expected[name] = report.code, int(code)
            assert report.source == topic
            assert not report.published
            assert report.rejected == known - 1
            assert report.rejection.bound in report.message
            assert report.code_name in report.message
        assert got == expected

        client.send(stamp_ns=first_ns - 1)
        backward = client.report_of(first_ns - 1)
        assert backward.code == InputCode.STAMP_BACKWARD
        client.send(stamp_ns=first_ns)
        assert client.report_of(first_ns, count=2).code == InputCode.STAMP_BACKWARD

        assert process.poll() is None
        assert client.send_and_report().published
        total = len(expected) + 2

        def healths():
            return [
                health_from_message(message, node="planner")[0] for message in client.diagnostics
            ]

        client.wait_for(lambda: any(sum(h.rejected.values()) == total for h in healths()))
        health = healths()[-1]
        assert health.rejected["NOT_FINITE"] == 3
        assert health.certified == 2


def test_an_unreachable_state_is_reported_and_nothing_is_published(ros):
    with local_planner(ros) as (client, _):
        report = client.send_and_report(UNREACHABLE)
        assert report.code in (PlanStatus.INFEASIBLE, PlanStatus.SOLVER_FAILURE)
        assert not report.published
        assert report.message
        good_ns = client.send()
        assert client.report_of(good_ns).published
        client.wait_for(lambda: client.trajectories)
        stamps = [t.header.stamp.sec * 10**9 + t.header.stamp.nanosec for t in client.trajectories]
        assert stamps == [good_ns]


def test_a_deadline_that_is_too_short_is_a_status(ros):
    with local_planner(ros, deadline_s=0.001) as (client, _):
        report = client.send_and_report()
        assert report.code == PlanStatus.DEADLINE
        assert report.attempt.deadline_ms == 1.0
        assert not client.trajectories


def test_the_next_plan_starts_from_the_last(ros):
    with local_planner(ros) as (client, _):
        first_ns = client.send()
        cold = client.report_of(first_ns)
        assert not cold.attempt.warm_started
        client.wait_for(lambda: client.trajectories)
        plan, _ = plan_from_trajectory(client.trajectories[-1], LAYOUT)
        second_ns = now_ns()
        elapsed_s = (second_ns - first_ns) / 1e9
        state = [np.interp(elapsed_s, plan.times_s, column) for column in plan.states.T]
        warm = client.report_of(client.send(np.array(state), second_ns))
        assert warm.code == PlanStatus.CERTIFIED
        assert warm.attempt.warm_started
        assert warm.attempt.iterations < cold.attempt.iterations


def test_the_latest_state_wins_and_drops_are_counted(ros):
    with local_planner(ros) as (client, _):
        assert client.send_and_report().published
        stamps = []
        for _ in range(60):
            stamps.append(client.send())
            # Let the node take each one: DDS itself keeps only the newest.
            before = len(client.report_messages)
            ros.wait_for(lambda before=before: len(client.report_messages) > before, 0.004)
        last = client.report_of(stamps[-1])
        planned = [r.input_stamp_ns for r in client.reports[1:]]
        assert planned == sorted(planned)
        assert len(planned) < len(stamps)
        assert last.drops > 0
        assert len(planned) + last.drops <= len(stamps)


def test_shipped_parameter_file_holds_the_defaults(ros):
    path = ROOT / "config" / "powered_descent.yaml"
    with running_planner(ros, ["--params-file", str(path)]) as (client, _):
        assert client.send_and_report().published
        answer = client.call("reload")
        assert answer.success, answer.message


def test_best_effort_publishers_are_heard_when_asked_for(ros):
    with local_planner(ros, state_reliability="best_effort") as (client, _):
        sensor = client.node.create_publisher(
            JointState, "/planner/vehicle_state", qos_profile_sensor_data
        )
        client.wait_for(lambda: sensor.get_subscription_count() > 0)

        def heard() -> bool:
            # Best effort: a message may be lost, the first ones before the two have met.
            sensor.publish(whole_state(now_ns()))
            return bool(client.reports)

        client.wait_for(heard)
        assert client.reports[0].published


def test_no_plan_means_no_markers(ros):
    with local_planner(ros) as (client, _):
        assert client.send_and_report().published
        client.wait_for(lambda: client.markers)
        assert client.call("reset").success
        client.wait_for(lambda: client.markers[-1].markers[0].action == Marker.DELETEALL)
