"""Messages of problems that no package knows: forms of controls, limits, scenes, reports."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from core.toy_problems import cart
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker

from dscp_core.errors import InvalidInputError
from dscp_core.planning.certificate import Check, ControlHold, PlanCertificate
from dscp_core.problem.extras import Extras
from dscp_core.problem.messages import Messages, StateLimit, StateLimitError
from dscp_core.problem.scene import Arrows, Line, Scene, Sphere, Triangles
from dscp_core.problem.trajectory import Plan
from msg_adapters.drawing import Drawing
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.joint_state import joint_state_from_state, state_from_joint_state
from msg_adapters.layout import ControlForm, StateLayout, problem_layout
from msg_adapters.parameters import follows_message_axes
from msg_adapters.report import figures_from_certificate, key_of
from msg_adapters.state import StampedState
from msg_adapters.trajectory import plan_from_trajectory, trajectory_from_plan

STAMP_NS = 3_000_000_001
GREY = (0.5, 0.5, 0.5, 1.0)


def layout_of(states: int, controls: int, control_states: tuple[int, ...] = (), **more: object):
    names = tuple(f"s{k}" for k in range(states))
    return StateLayout(
        "any", names, names, names, tuple(f"c{k}" for k in range(controls)), control_states, **more
    )


def plan_of(layout: StateLayout, nodes: int = 4) -> Plan:
    random = np.random.default_rng(3)
    nx, nu = len(layout.state_names), len(layout.control_names)
    times = np.linspace(0.0, 2.0, nodes)
    return Plan(
        problem="any",
        state_names=layout.state_names,
        control_names=layout.control_names,
        control_states=layout.control_states,
        times_s=times,
        states=random.normal(size=(nodes, nx)),
        controls=random.normal(size=(nodes, nu)),
        state_rates=random.normal(size=(nodes, nx)),
        terminal_time_s=2.0,
    )


# --- Controls


@given(st.integers(1, 4), st.integers(0, 6), st.randoms())
def test_controls_with_names_of_their_own_come_back_in_any_order(states, controls, random):
    layout = layout_of(states, controls)
    plan = plan_of(layout)
    message = trajectory_from_plan(plan, STAMP_NS, layout)
    assert list(message.joint_names) == [*layout.state_names, *layout.control_names]
    order = random.sample(range(states + controls), states + controls)
    message.joint_names = [message.joint_names[i] for i in order]
    for point in message.points:
        assert len(point.effort) == len(point.accelerations) == 0
        point.positions = [point.positions[i] for i in order]
        point.velocities = [point.velocities[i] for i in order]
    wired = deserialize_message(serialize_message(message), JointTrajectory)
    decoded, stamp_ns = plan_from_trajectory(wired, layout)
    assert stamp_ns == STAMP_NS
    for field in ("states", "controls", "state_rates"):
        assert np.array_equal(getattr(decoded, field), getattr(plan, field)), field
    assert decoded.control_names == layout.control_names


def test_where_controls_stand_follows_from_the_declaration():
    one = cart()
    assert problem_layout(one).control_form is ControlForm.NAMED
    assert problem_layout(replace(one, control_states=(1,))).control_form is ControlForm.EFFORT
    rates = Extras(messages=Messages(controls_are_rates=True))
    rated = replace(one, control_states=(1,), extras=rates)
    assert problem_layout(rated).control_form is ControlForm.VELOCITIES
    two = replace(one, controls=(*one.controls, replace(one.controls[0], name="brake")))
    shared = problem_layout(replace(two, control_states=(1, 1)))
    assert shared.control_form is ControlForm.NAMED
    assert shared.joint_names == ("position", "speed", "force", "brake")


def test_a_name_in_messages_that_a_control_has_is_refused():
    clash = Messages(states=(("force", "position"), ("speed", "speed")))
    with pytest.raises(InvalidInputError, match=r"names in messages of cart.*force"):
        problem_layout(replace(cart(), extras=Extras(messages=clash)))


def test_vectors_in_space_are_told_by_the_problem_alone():
    assert not follows_message_axes(layout_of(4, 1), [1.0, 2.0, 3.0])
    assert follows_message_axes(layout_of(4, 1, axes=(1, 2, 0)), [1.0, 2.0, 3.0])
    assert follows_message_axes(layout_of(4, 1), [1.0, 2.0, 3.0, 4.0])


# --- States and their limits


def decode(problem, values):
    layout = problem_layout(problem)
    message = joint_state_from_state(StampedState(STAMP_NS, np.array(values)), layout)
    return state_from_joint_state(message, layout).values


def bounded_cart(**changes: object):
    one = cart()
    table = tuple(
        replace(p, lower=-5.0, upper=5.0) if p.name == "start" else p for p in one.parameters
    )
    return replace(one, parameters=table, initial_state_parameters=("start",), **changes)


def refusal(problem, values) -> RejectedInputError:
    with pytest.raises(RejectedInputError) as caught:
        decode(problem, values)
    return caught.value


def test_the_declaration_bounds_states_by_their_names():
    assert decode(bounded_cart(), [5.0, -5.0]).tolist() == [5.0, -5.0]
    for values, name in (([5.1, 0.0], "position"), ([0.0, -6.0], "speed")):
        error = refusal(bounded_cart(), values)
        assert (error.code, error.field) == (InputCode.OUT_OF_RANGE, name)
        assert "[-5, 5]" in error.bound


def test_what_the_problem_checks_is_checked_with_its_parameters():
    def check_state(state, values):
        if state[0] > values["target"][0]:
            raise InvalidInputError("position", float(state[0]), f"<= {values['target'][0]} m")

    problem = bounded_cart(check_state=check_state)
    assert decode(problem, [1.0, 0.0]).tolist() == [1.0, 0.0]
    assert refusal(problem, [1.5, 0.0]).code is InputCode.OUT_OF_RANGE


@pytest.mark.parametrize("kind", list(StateLimit))
def test_what_the_problem_brings_decides_with_its_own_code(kind):
    def admit(named, parameters, settings):
        if named["position"] > parameters["mass"]:
            raise StateLimitError(kind, "position", named["position"], "less")
        return {**named, "speed": named["speed"] % 1.0}

    problem = replace(cart(), extras=Extras(messages=Messages(admit=admit)))
    assert decode(problem, [1.0, 2.25]).tolist() == [1.0, 0.25]
    assert refusal(problem, [9.0, 0.0]).code.name == kind.name


def test_a_limit_comes_through_to_another_process():
    error = pickle.loads(pickle.dumps(StateLimitError(StateLimit.BELOW_GROUND, "z", -1.0, ">= 0")))
    assert (error.kind, error.field, error.value, error.bound) == (
        StateLimit.BELOW_GROUND,
        "z",
        -1.0,
        ">= 0",
    )


# --- Scenes


def draw(scene: Scene):
    plan = plan_of(layout_of(2, 1))
    return Drawing(lambda *_: scene, {}, {}).draw(plan, STAMP_NS, frame="map")


def test_every_shape_becomes_its_markers():
    places = np.arange(12.0).reshape(4, 3)
    shapes = (
        Line("line", places, 0.1),
        Arrows("arrows", places[:2], places[2:], 0.1),
        Sphere("ball", places[1], 2.0, GREY),
        Triangles("roof", places[:3], GREY),
    )
    path, markers = draw(Scene(places, shapes=shapes))
    assert isinstance(path, Path)
    assert [p.pose.orientation.w for p in path.poses] == [1.0] * 4
    found = [(m.ns, m.id, m.type) for m in markers.markers]
    assert found == [
        ("line", 0, Marker.LINE_STRIP),
        ("arrows", 0, Marker.ARROW),
        ("arrows", 1, Marker.ARROW),
        ("ball", 0, Marker.SPHERE),
        ("roof", 0, Marker.TRIANGLE_LIST),
    ]
    ball = markers.markers[3]
    assert (ball.pose.position.x, ball.scale.z) == (3.0, 4.0)
    assert {m.header.frame_id for m in markers.markers} == {"map"}


@pytest.mark.parametrize(
    ("scene", "field"),
    [
        (Scene(np.zeros((3, 3))), "scene.positions"),
        (Scene(np.zeros((4, 3)), np.zeros((4, 3))), "scene.attitudes"),
        (Scene(np.zeros((4, 3)), shapes=(Line("l", np.zeros((2, 2)), 1.0),)), "l.points"),
        (
            Scene(np.zeros((4, 3)), shapes=(Arrows("a", np.zeros((2, 3)), np.ones(3), 1.0),)),
            "a.vectors",
        ),
        (Scene(np.full((4, 3), math.nan)), "scene.positions"),
        (Scene(np.zeros((4, 3)), shapes=(Sphere("s", [math.inf] * 3, 1.0, GREY),)), "s.centre"),
    ],
)
def test_a_scene_that_is_none_is_refused_by_name(scene, field):
    with pytest.raises(InvalidInputError) as caught:
        draw(scene)
    assert caught.value.field == field


# --- Reports


def certificate(*checks: Check, used: float | None = None) -> PlanCertificate:
    none = np.zeros((1, 1))
    return PlanCertificate(
        passed=True,
        reasons=(),
        checks=checks,
        unchecked=(),
        times_s=np.zeros(1),
        states=none,
        controls=none,
        hold=ControlHold.MEAN,
        contact_time_s=None,
        mass_used_kg=used,
        propellant_left_kg=None,
    )


def test_values_of_a_certificate_are_those_of_the_problem():
    checks = (
        Check("miss_place", 0.5, 1.0, "m", 2.0, True),
        Check("miss_heading", 0.1, 1.0, "rad/s^2", 2.0, True),
        Check("share", 0.2, 1.0, "1", 2.0, True),
        Check("push_max", -0.1, 0.0, "N", 1.0, True),
    )
    figures = figures_from_certificate(
        certificate(*checks), ("miss_place", "miss_heading", "share")
    )
    assert figures.values == {"miss_place_m": 0.5, "miss_heading_rad_s_2": 0.1, "share": 0.2}
    assert [check.name for check in figures.checks] == [check.name for check in checks]


def test_a_flight_that_ended_early_has_no_misses():
    figures = figures_from_certificate(certificate(used=3.0), ("miss_position",))
    assert figures.values == {"mass_used_kg": 3.0}
    assert key_of("miss_speed", "m/s") == "miss_speed_m_s"
