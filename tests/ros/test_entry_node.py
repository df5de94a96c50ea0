"""The planner node flying entry, on real topics."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros.entry_support import (
    LAYOUT,
    STATE,
    local_entry_planner,
    running_entry_planner,
)
from ros.planner_support import ROOT, now_ns
from sensor_msgs.msg import JointState

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.planning.certificate import PlanVerifier
from dscp_core.planning.plan import PlanStatus
from dscp_core.problems.entry.messages import PLANET_FRAME
from dscp_core.problems.entry.planet import planet_fixed
from dscp_ros.planner.node import PlannerNode
from dscp_ros.planner.parameter_files import ParameterArguments
from dscp_ros.planner.parameters import parameter_table
from msg_adapters.errors import InputCode
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.path import poses_from_path
from msg_adapters.state import StampedState
from msg_adapters.trajectory import plan_from_trajectory

CONFIG = ROOT / "config" / "entry.yaml"
RADIUS_M = 6371.1e3
PATH_CHECKS = {"dynamic_pressure_max", "heat_rate_max", "load_factor_max", "bank_angle_max"}


def decoded(message):
    return plan_from_trajectory(message, LAYOUT, frame=PLANET_FRAME)


def test_an_entry_state_becomes_a_certified_trajectory(ros):
    with running_entry_planner(ros, ["--params-file", str(CONFIG)]) as (client, process):
        stamp_ns = client.send()
        report = client.report_of(stamp_ns)
        assert (report.code, report.code_name) == (PlanStatus.CERTIFIED, "CERTIFIED"), report
        assert report.published
        assert report.problem == "entry"
        assert report.mass_source is None
        assert report.state == dict(zip(LAYOUT.message_names, STATE.tolist(), strict=True))
        assert report.certificate.passed
        assert {check.name for check in report.certificate.checks} >= PATH_CHECKS

        client.wait_for(lambda: client.trajectories and client.paths and client.markers)
        trajectory = client.trajectories[-1]
        assert trajectory.header.frame_id == PLANET_FRAME
        plan, start_ns = decoded(trajectory)
        assert start_ns == stamp_ns
        # The solver satisfies the initial condition to its own accuracy.
        assert np.allclose(plan.states[0], STATE, rtol=1e-7, atol=1e-7)
        # The paper's nominal flight takes 2713 s on this mesh; where the iterations stop moves it
        # by less than a second.
        assert math.isclose(plan.terminal_time_s, 2713.0, abs_tol=2.0)
        # The controls are the rates of the two angles: integrated by the trapezoid rule of the
        # discretisation, they give these angles.
        steps = np.diff(plan.times_s)[:, np.newaxis]
        means = 0.5 * (plan.controls[1:] + plan.controls[:-1])
        assert np.allclose(np.diff(plan.states[:, 6:], axis=0), steps * means, atol=1e-5)

        # The published plan, flown again, passes: what was sent is what was certified.
        problem = problems.get("entry")
        verifier = PlanVerifier(problem, len(plan.times_s) - 1)
        again = verifier.certify(plan.times_s, plan.states, plan.controls, problem.table.pack())
        assert again.passed, again.reasons
        assert again.value("heat_rate_max") == pytest.approx(
            next(c.worst_value for c in report.certificate.checks if c.name == "heat_rate_max"),
            abs=1.0,  # W/m^2, of 2.5e6: times are rounded to the nanosecond
        )

        positions, _ = poses_from_path(client.paths[-1], frame=PLANET_FRAME)
        flight = planet_fixed(plan.state_names, plan.states)
        assert np.allclose(positions, flight.positions_m, rtol=0.0, atol=1e-6)
        end = positions[-1] / np.linalg.norm(positions[-1])
        latitude, longitude = math.asin(end[2]), math.atan2(end[1], end[0])
        assert np.degrees([latitude, longitude]) == pytest.approx([12.0, 120.0], abs=0.001)
        namespaces = {m.ns for m in client.markers[-1].markers}
        assert namespaces == {"path", "ground_track", "lift", "planet"}

        # Odometry cannot tell an entry state, so nobody listens to it.
        for topic, listeners in (("vehicle_state", 1), ("state", 0), ("mass", 0)):
            assert client.node.count_subscribers(f"/planner/{topic}") == listeners, topic

        answer = client.call("reload")
        assert answer.success, answer.message
        assert "torch" not in Path(f"/proc/{process.pid}/maps").read_text()


def test_the_shipped_file_holds_the_defaults_of_entry():
    document = yaml.safe_load(CONFIG.read_text())["/**"]["ros__parameters"]
    own = {f"parameters.{name}": value for name, value in document.pop("parameters").items()}
    assert document.pop("problem") == "entry"
    defaults = {p.name: p.default for p in parameter_table(problems.get("entry"))}
    for name, value in {**document, **own}.items():
        if name in ("state_max_age_s", "future_tolerance_s"):
            assert value > defaults[name], name  # for fast replays, as the file says
        else:
            assert value == defaults[name], name


def bad_states() -> dict[str, tuple[JointState, InputCode]]:
    """Message and expected code by name; stamps differ so that reports can be told apart."""
    base_ns = now_ns()
    stamps = iter(range(base_ns, base_ns + 1000))
    names = list(LAYOUT.message_names)
    cases: dict[str, tuple[JointState, InputCode]] = {}

    def case(label: str, code: InputCode, **changes: float) -> JointState:
        message = joint_state_from_state(
            StampedState(next(stamps), STATE), LAYOUT, frame=PLANET_FRAME
        )
        for name, value in changes.items():
            message.position[names.index(name)] = value
        cases[label] = (message, code)
        return message

    case("NaN", InputCode.NOT_FINITE, bank_angle=math.nan)
    case("infinite radius", InputCode.NOT_FINITE, r=math.inf)
    case("altitude for radius", InputCode.BELOW_GROUND, r=78e3)
    case("below ground", InputCode.BELOW_GROUND, r=RADIUS_M - 1.0)
    case("above the air", InputCode.OUT_OF_RANGE, r=RADIUS_M + 151e3)
    case("standing still", InputCode.OUT_OF_RANGE, speed=0.0)
    case("backwards", InputCode.OUT_OF_RANGE, speed=-6700.0)
    case("too fast", InputCode.OUT_OF_RANGE, speed=13e3)
    case("bank", InputCode.OUT_OF_RANGE, bank_angle=math.radians(61.0))
    case("angle of attack", InputCode.OUT_OF_RANGE, angle_of_attack=math.radians(-1.0))
    case("degrees", InputCode.OUT_OF_RANGE, heading=90.0)
    case("pole", InputCode.OUT_OF_RANGE, latitude=math.radians(90.0))
    case("dive", InputCode.OUT_OF_RANGE, flight_path_angle=math.radians(-90.0))
    case("landing frame", InputCode.WRONG_FRAME).header.frame_id = "landing_site"
    case("no frame", InputCode.EMPTY_FRAME).header.frame_id = ""
    case("twice", InputCode.DUPLICATE_NAME).name = [*names[:-1], "r"]
    case("core's name", InputCode.UNKNOWN_NAME).name = ["radius", *names[1:]]
    missing = case("missing", InputCode.MISSING_NAME)
    missing.name, missing.position = names[:-1], missing.position[:-1]
    extra = case("extra", InputCode.UNKNOWN_NAME)
    extra.name, extra.position = [*names, "mass"], [*STATE, 900.0]
    case("short", InputCode.WRONG_ARRAY_LENGTH).position = STATE[:-1].tolist()
    return cases


def test_bad_states_have_their_numbered_reports_and_the_node_lives_on(ros):
    with local_entry_planner(ros) as (client, _):
        got, expected = {}, {}
        for known, (name, (message, code)) in enumerate(bad_states().items()):
            client.vehicle_state.publish(message)
            report = client.next_report(known)
            got[name], expected[name] = report.code, int(code)
            assert report.source == "vehicle_state"
            assert not report.published
            assert report.rejection.bound in report.message
        assert got == expected
        # 360 degrees more is the same place.
        turned = STATE + np.array([0.0, 2.0 * math.pi, 0.0, 0.0, 0.0, -2.0 * math.pi, 0.0, 0.0])
        report = client.send_and_report(turned)
        assert report.published, report
        assert report.state["longitude"] == pytest.approx(0.0, abs=1e-15)
        assert report.state["heading"] == pytest.approx(math.pi / 2.0, abs=1e-15)


def test_plans_in_flight_start_from_the_last_and_keep_the_arrival(ros):
    with local_entry_planner(ros, future_tolerance_s=1e4) as (client, _):
        first_ns = client.send()
        cold = client.report_of(first_ns)
        assert cold.published, cold
        assert not cold.attempt.warm_started
        client.wait_for(lambda: client.trajectories)
        plan, _ = decoded(client.trajectories[-1])
        # On the plan's nodes; off them, the angles would be interpolated over half a minute.
        for node in (10, 40, 80):
            elapsed_s = plan.times_s[node]
            stamp_ns = first_ns + round(elapsed_s * 1e9)
            warm = client.report_of(client.send(plan.states[node], stamp_ns))
            assert warm.published, warm
            assert warm.attempt.warm_started
            assert warm.attempt.iterations < cold.attempt.iterations
            arrival_s = elapsed_s + warm.attempt.terminal_time_used_s
            # The mesh of what is left is finer: a few seconds of the flight's 2720.
            assert arrival_s == pytest.approx(plan.terminal_time_s, abs=10.0)
        # Without memory, as after a restart in flight.
        assert client.call("reset").success
        again = client.report_of(client.send(plan.states[40], stamp_ns + 1))
        assert again.published, again
        assert not again.attempt.warm_started
        arrival_s = plan.times_s[40] + again.attempt.terminal_time_used_s
        assert arrival_s == pytest.approx(plan.terminal_time_s, abs=10.0)


def test_a_state_without_a_way_to_the_target_is_reported(ros):
    with local_entry_planner(ros) as (client, _):
        slow = STATE.copy()
        slow[3] = 3000.0  # a fifth of the energy
        report = client.send_and_report(slow)
        assert report.code in (
            PlanStatus.INFEASIBLE,
            PlanStatus.ITERATION_LIMIT,
            PlanStatus.SOLVER_FAILURE,
        ), report
        assert not report.published
        assert not client.trajectories
        assert client.send_and_report().published


@pytest.mark.parametrize(
    "name", ["landing_frame", "mass_fallback_kg", "ground_tolerance_m", "thrust_arrow_m"]
)
def test_parameters_of_landings_are_refused(ros, name):
    value = "map" if name == "landing_frame" else 1.0
    node = Node(
        "planner",
        context=ros.context,
        parameter_overrides=[Parameter("problem", value="entry"), Parameter(name, value=value)],
    )
    ros.add_node(node)
    with pytest.raises(InvalidInputError, match=name):
        PlannerNode(node, ParameterArguments((), frozenset(), ()))
