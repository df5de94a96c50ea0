"""Entry states in messages: names, limits, branches of angles, axes, trajectories, drawings."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.problem.trajectory import Plan
from dscp_core.problems.entry.messages import PLANET_FRAME, EntryLimits, turned
from dscp_core.problems.entry.planet import planet_fixed
from dscp_core.problems.entry.scene import EntryStyle, entry_scene
from msg_adapters.drawing import Drawing
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.joint_state import joint_state_from_state, state_from_joint_state
from msg_adapters.layout import ControlForm, problem_layout
from msg_adapters.path import poses_from_path
from msg_adapters.state import StampedState
from msg_adapters.trajectory import plan_from_trajectory, trajectory_from_plan

STATE_NAMES = (
    "radius",
    "longitude",
    "latitude",
    "speed",
    "flight_path_angle",
    "heading",
    "angle_of_attack",
    "bank_angle",
)
MESSAGE_NAMES = ("r", *STATE_NAMES[1:])
CONTROL_NAMES = ("angle_of_attack_rate", "bank_rate")
CONTROL_STATES = (6, 7)
LAYOUT = problem_layout(problems.get("entry"))
STAMP_NS = 12_000_000_345
RADIUS_M = 6371.1e3
LIMITS = EntryLimits()
STYLE = EntryStyle()
# All angles differ, so that a swapped name shows.
STATE = np.array([RADIUS_M + 60e3, 0.7, 0.1, 6000.0, -0.02, 1.4, 0.35, -0.6])

STATES = st.tuples(
    st.floats(RADIUS_M, RADIUS_M + 150e3),
    st.floats(-2.0 * math.pi, 2.0 * math.pi),
    st.floats(-1.2, 1.2),
    st.floats(100.0, 12e3),
    st.floats(-1.2, 1.2),
    st.floats(-2.0 * math.pi, 2.0 * math.pi),
    st.floats(0.0, math.radians(40.0)),
    st.floats(-math.radians(60.0), math.radians(60.0)),
).map(np.array)


def joint_state(values: np.ndarray = STATE) -> JointState:
    return joint_state_from_state(StampedState(STAMP_NS, values), LAYOUT, frame=PLANET_FRAME)


def decode(message: JointState, limits: EntryLimits | None = None) -> np.ndarray:
    admit = (limits or LIMITS).admit
    return state_from_joint_state(message, LAYOUT, frame=PLANET_FRAME, limits=admit).values


def refusal(message: JointState) -> RejectedInputError:
    with pytest.raises(RejectedInputError) as caught:
        decode(message)
    return caught.value


def with_value(name: str, value: float) -> JointState:
    message = joint_state()
    message.position[message.name.index(name)] = value
    return message


def through_the_wire(message):
    return deserialize_message(serialize_message(message), type(message))


# --- States


@given(STATES, st.permutations(range(8)))
def test_states_come_back_in_any_order_with_their_angles_turned(values, order):
    message = joint_state(values)
    assert list(message.name) == list(MESSAGE_NAMES)
    message.name = [message.name[i] for i in order]
    message.position = [message.position[i] for i in order]
    result = decode(through_the_wire(message))
    angles = [1, 5]
    others = [0, 2, 3, 4, 6, 7]
    assert np.array_equal(result[others], values[others])
    # A turn is added in floating point: a rounding of 8 rad.
    assert np.allclose(np.exp(1j * result[angles]), np.exp(1j * values[angles]), atol=4e-15)
    centres = np.array([LIMITS.longitude_centre_rad, LIMITS.heading_centre_rad])
    assert np.all(np.abs(result[angles] - centres) <= math.pi + 4e-15)


@given(st.floats(-2.0 * math.pi, 2.0 * math.pi), st.floats(-math.pi, math.pi))
def test_an_angle_on_its_branch_keeps_its_bits(angle, centre):
    once = turned(angle, centre)
    if abs(angle - centre) <= math.pi:
        assert once == angle
    assert math.isclose(math.cos(once), math.cos(angle), abs_tol=4e-15)
    assert turned(once, centre) == pytest.approx(once, abs=4e-15)


def test_a_longitude_beyond_the_date_line_is_turned_towards_the_target():
    limits = replace(LIMITS, longitude_centre_rad=math.radians(-170.0))
    east = math.radians(175.0)
    assert decode(with_value("longitude", east), limits)[1] == pytest.approx(east - 2.0 * math.pi)
    assert decode(with_value("longitude", math.radians(359.0)))[1] == pytest.approx(
        math.radians(-1.0)
    )


@pytest.mark.parametrize(
    ("name", "value", "code"),
    [
        ("r", math.nan, InputCode.NOT_FINITE),
        ("bank_angle", math.inf, InputCode.NOT_FINITE),
        ("r", RADIUS_M - 1.0, InputCode.BELOW_GROUND),
        ("r", 78e3, InputCode.BELOW_GROUND),  # an altitude
        ("r", 6449.1, InputCode.BELOW_GROUND),  # km
        ("r", RADIUS_M + 150e3 + 1.0, InputCode.OUT_OF_RANGE),
        ("speed", 0.0, InputCode.OUT_OF_RANGE),
        ("speed", 6.7, InputCode.OUT_OF_RANGE),  # km/s
        ("speed", -6000.0, InputCode.OUT_OF_RANGE),
        ("speed", 13e3, InputCode.OUT_OF_RANGE),
        ("latitude", math.pi / 2.0, InputCode.OUT_OF_RANGE),
        ("latitude", 12.0, InputCode.OUT_OF_RANGE),  # degrees
        ("flight_path_angle", -math.pi / 2.0, InputCode.OUT_OF_RANGE),
        ("longitude", 119.0, InputCode.OUT_OF_RANGE),  # degrees
        ("heading", 90.0, InputCode.OUT_OF_RANGE),  # degrees
        ("bank_angle", math.radians(61.0), InputCode.OUT_OF_RANGE),
        ("bank_angle", -math.radians(61.0), InputCode.OUT_OF_RANGE),
        ("angle_of_attack", math.radians(41.0), InputCode.OUT_OF_RANGE),
        ("angle_of_attack", -math.radians(1.0), InputCode.OUT_OF_RANGE),
    ],
)
def test_a_state_outside_the_model_is_refused_by_its_number(name, value, code):
    error = refusal(with_value(name, value))
    assert error.code is code
    assert math.isnan(error.value) or error.value == value
    assert code is InputCode.NOT_FINITE or error.field == name
    assert error.bound in str(error)


def test_noise_beyond_the_bounds_of_the_angles_is_within_the_tolerance():
    for name, value in (("bank_angle", 60.2), ("angle_of_attack", -0.2)):
        angle = math.radians(value)
        assert decode(with_value(name, angle))[STATE_NAMES.index(name)] == angle


@pytest.mark.parametrize(
    ("names", "code"),
    [
        (MESSAGE_NAMES[:-1], InputCode.MISSING_NAME),
        ((*MESSAGE_NAMES[:-1], "r"), InputCode.DUPLICATE_NAME),
        ((*MESSAGE_NAMES, "mass"), InputCode.UNKNOWN_NAME),
        (("radius", *MESSAGE_NAMES[1:]), InputCode.UNKNOWN_NAME),
    ],
)
def test_missing_duplicate_and_extra_names_are_refused(names, code):
    message = joint_state()
    message.name = list(names)
    message.position = [*STATE, 1.0][: len(names)]
    assert refusal(message).code is code


@pytest.mark.parametrize(
    ("frame", "code"),
    [("", InputCode.EMPTY_FRAME), ("landing_site", InputCode.WRONG_FRAME)],
)
def test_only_the_planets_frame_is_accepted(frame, code):
    message = joint_state()
    message.header.frame_id = frame
    assert refusal(message).code is code


@given(st.tuples(*[st.floats(width=64)] * 8))
def test_no_floats_get_past_the_checks(numbers):
    message = joint_state()
    message.position = list(numbers)
    try:
        result = decode(message)
    except RejectedInputError:
        return
    assert np.all(np.isfinite(result))
    assert RADIUS_M <= result[0] <= RADIUS_M + 150e3
    assert 100.0 <= result[3] <= 12e3
    assert np.all(np.abs(result[[2, 4]]) <= 1.2)


# --- Axes


@given(STATES)
def test_positions_are_spherical_coordinates(values):
    (position,) = planet_fixed(STATE_NAMES, values[np.newaxis]).positions_m
    radius, longitude, latitude = values[:3]
    expected = radius * np.array(
        [
            math.cos(latitude) * math.cos(longitude),
            math.cos(latitude) * math.sin(longitude),
            math.sin(latitude),
        ]
    )
    # Products of a few rounded cosines: some 1e-16 of the radius.
    assert np.allclose(position, expected, rtol=0.0, atol=1e-8)


@given(STATES)
def test_without_angle_of_attack_the_nose_points_along_the_velocity(values):
    values[6] = 0.0
    radius, _longitude, latitude, _speed, climb, heading = values[:6]
    # The kinematics of the equations of motion at unit speed, by a central difference.
    rates = np.array(
        [
            math.sin(climb),
            math.cos(climb) * math.sin(heading) / (radius * math.cos(latitude)),
            math.cos(climb) * math.cos(heading) / radius,
        ]
    )
    step_s = 1.0
    ends = np.array([values, values])
    ends[:, :3] += np.outer([-step_s, step_s], rates)
    before, after = planet_fixed(STATE_NAMES, ends).positions_m
    velocity = (after - before) / (2.0 * step_s)
    flight = planet_fixed(STATE_NAMES, values[np.newaxis])
    nose = Rotation.from_quat(flight.attitudes[0]).apply([1.0, 0.0, 0.0])
    # Rounding of 6.5e6 m over 2 m: 1e-9; curvature adds 1e-13.
    assert np.allclose(nose, velocity, rtol=0.0, atol=5e-9)


def test_lift_is_up_without_bank_and_to_the_right_with_a_positive_one():
    # Eastwards along the equator, at longitude zero: forward y, up x, right (south) -z.
    level = np.array([RADIUS_M, 0.0, 0.0, 5e3, 0.0, math.pi / 2.0, 0.3, 0.0])
    banked = level.copy()
    banked[7] = math.radians(30.0)
    flight = planet_fixed(STATE_NAMES, np.array([level, banked]))
    right = [math.cos(math.radians(30.0)), 0.0, -math.sin(math.radians(30.0))]
    assert np.allclose(flight.lift, [[1.0, 0.0, 0.0], right], atol=1e-15)
    nose, left = (
        Rotation.from_quat(flight.attitudes[0]).apply(axis)
        for axis in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    )
    # The angle of attack lifts the nose.
    assert np.allclose(nose, [math.sin(0.3), math.cos(0.3), 0.0], atol=1e-15)
    assert np.allclose(left, [0.0, 0.0, 1.0], atol=1e-15)


def test_axes_of_another_problem_are_refused():
    with pytest.raises(InvalidInputError, match="bank_angle"):
        planet_fixed(STATE_NAMES[:-1], STATE[np.newaxis, :-1])


# --- Plans


def example_plan(nodes: int = 7) -> Plan:
    times = np.linspace(0.0, 1000.0 / 3.0, nodes)
    controls = np.outer(np.linspace(-1.0, 1.0, nodes), [1e-3, -2e-3])
    rates = np.tile([-50.0, 9e-4, 1e-5, -0.7, 1e-5, 2e-5, 0.0, 0.0], (nodes, 1))
    rates[:, list(CONTROL_STATES)] = controls
    return Plan(
        problem="entry",
        state_names=STATE_NAMES,
        control_names=CONTROL_NAMES,
        control_states=CONTROL_STATES,
        times_s=times,
        states=STATE + times[:, None] * [-50.0, 9e-4, 1e-5, -0.7, 1e-5, 2e-5, 1e-4, 2e-4],
        controls=controls,
        state_rates=rates,
        terminal_time_s=float(times[-1]),
    )


def draw(
    plan: Plan, style: EntryStyle = STYLE, stamp_ns: int = STAMP_NS
) -> tuple[Path, MarkerArray]:
    drawing = Drawing(lambda plan, *_: entry_scene(plan, style), {}, {})
    return drawing.draw(plan, stamp_ns, frame=PLANET_FRAME)


def decode_trajectory(message: JointTrajectory) -> tuple[Plan, int]:
    return plan_from_trajectory(message, LAYOUT, frame=PLANET_FRAME)


def trajectory() -> JointTrajectory:
    return trajectory_from_plan(example_plan(), STAMP_NS, LAYOUT, frame=PLANET_FRAME)


def test_a_trajectory_comes_back_through_the_wire():
    plan = example_plan()
    decoded, stamp_ns = decode_trajectory(through_the_wire(trajectory()))
    assert stamp_ns == STAMP_NS
    for field in ("states", "controls", "state_rates"):
        assert np.array_equal(getattr(decoded, field), getattr(plan, field)), field
    # Times are rounded to the nanosecond.
    assert np.allclose(decoded.times_s, plan.times_s, rtol=0.0, atol=0.5e-9)
    for field in ("problem", "state_names", "control_names", "control_states"):
        assert getattr(decoded, field) == getattr(plan, field), field


def test_the_rates_of_the_angles_are_the_controls():
    assert LAYOUT.control_form is ControlForm.VELOCITIES
    plan = example_plan()
    # The rates that are computed may differ from the controls by a rounding: the controls count.
    message = trajectory_from_plan(
        replace(plan, state_rates=plan.state_rates * (1.0 + 1e-12)),
        STAMP_NS,
        LAYOUT,
        frame=PLANET_FRAME,
    )
    first = message.points[0]
    assert list(message.joint_names) == list(MESSAGE_NAMES)
    assert list(first.velocities[6:]) == list(plan.controls[0])
    assert len(first.effort) == len(first.accelerations) == 0


def test_a_trajectory_with_efforts_is_refused():
    message = trajectory()
    message.points[2].effort = [0.0] * 8
    with pytest.raises(RejectedInputError, match="effort") as caught:
        decode_trajectory(message)
    assert caught.value.code is InputCode.WRONG_ARRAY_LENGTH


def test_the_path_holds_positions_and_attitudes():
    plan = example_plan()
    path = through_the_wire(draw(plan)[0])
    assert isinstance(path, Path)
    assert path.header.frame_id == path.poses[-1].header.frame_id == "earth"
    last = path.poses[-1].header.stamp
    assert (last.sec, last.nanosec) == (345, 333_333_678)
    positions, attitudes = poses_from_path(path, frame=PLANET_FRAME)
    flight = planet_fixed(STATE_NAMES, plan.states)
    assert np.array_equal(positions, flight.positions_m)
    assert np.allclose(attitudes, flight.attitudes, rtol=0.0, atol=1e-15)


def test_markers_show_the_path_the_ground_track_the_lift_and_the_planet():
    plan = example_plan()
    style = EntryStyle(lift_arrow_m=1e5)
    first, second = (draw(plan, style, STAMP_NS + k)[1] for k in range(2))
    keys = [(marker.ns, marker.id) for marker in first.markers]
    assert len(set(keys)) == len(keys) == len(plan.times_s) + 3
    assert keys == [(marker.ns, marker.id) for marker in second.markers]
    decoded = through_the_wire(first)
    assert isinstance(decoded, MarkerArray)
    assert {marker.action for marker in decoded.markers} == {Marker.ADD}
    by_name = {marker.ns: marker for marker in decoded.markers}
    track = np.array([[p.x, p.y, p.z] for p in by_name["ground_track"].points])
    assert np.linalg.norm(track, axis=1) == pytest.approx(RADIUS_M, rel=1e-15)
    assert by_name["planet"].scale.x == 2.0 * RADIUS_M
    tail, head = by_name["lift"].points
    # Coordinates of 6e6 m carry 1e-9 of rounding.
    assert math.dist((tail.x, tail.y, tail.z), (head.x, head.y, head.z)) == pytest.approx(
        1e5, abs=1e-8
    )


def test_nan_is_never_drawn():
    plan = example_plan()
    states = plan.states.copy()
    states[2, 0] = math.nan
    broken = replace(plan, states=states)
    with pytest.raises(RejectedInputError) as caught:
        draw(broken)
    assert caught.value.code is InputCode.NOT_FINITE
