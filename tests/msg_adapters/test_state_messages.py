"""Odometry, InertiaStamped and JointState: round trips, rotations, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from adapter_cases import LAYOUT
from builtin_interfaces.msg import Time
from geometry_msgs.msg import InertiaStamped
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState

from dscp_core.problems.powered_descent.messages import LANDING_FRAME, DescentLimits
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.joint_state import joint_state_from_state, state_from_joint_state
from msg_adapters.mass import inertia_from_mass, mass_from_inertia
from msg_adapters.odometry import kinematics_from_odometry, odometry_from_kinematics
from msg_adapters.state import Kinematics, StampedMass, StampedState, state_from_kinematics

STAMP_NS = 7_000_000_123
ALL_FLOATS = st.floats(width=64)
FINITE = st.floats(-1e3, 1e3)
STAMPS = st.integers(0, 2**31 * 1_000_000_000 - 1)


def kinematics(position=(10.0, -20.0, 300.0), velocity=(1.0, 2.0, -30.0)) -> Kinematics:
    return Kinematics(STAMP_NS, np.array(position), np.array(velocity))


def odometry() -> Odometry:
    return odometry_from_kinematics(kinematics(), frame=LANDING_FRAME)


def joint_state() -> JointState:
    return joint_state_from_state(
        StampedState(STAMP_NS, np.array([300.0, 10.0, -20.0, -30.0, 1.0, 2.0, 1500.0])), LAYOUT
    )


def refusal(convert, *args, **kwargs) -> RejectedInputError:
    with pytest.raises(RejectedInputError) as caught:
        convert(*args, **kwargs)
    return caught.value


def through_the_wire(message):
    return deserialize_message(serialize_message(message), type(message))


# --- Odometry


@given(
    st.tuples(FINITE, FINITE, st.floats(0.0, 1e3)),
    st.tuples(FINITE, FINITE, FINITE),
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    STAMPS,
)
def test_odometry_round_trip(position, velocity, rotation_vector, stamp_ns):
    given_kinematics = Kinematics(stamp_ns, np.array(position), np.array(velocity))
    attitude = Rotation.from_rotvec(rotation_vector).as_quat()
    message = through_the_wire(
        odometry_from_kinematics(given_kinematics, frame=LANDING_FRAME, attitude=attitude)
    )
    result = kinematics_from_odometry(message, LAYOUT)
    assert result.stamp_ns == stamp_ns
    assert np.array_equal(result.position_m, given_kinematics.position_m)
    # There and back by two rotations: a few roundings of the largest component.
    assert np.allclose(result.velocity_m_s, velocity, rtol=0.0, atol=1e-11)


def test_twist_is_rotated_from_the_child_frame():
    message = odometry()
    # Body x is the landing frame's z: nose up, a quarter turn about -y.
    x, y, z, w = Rotation.from_matrix([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]).as_quat()
    orientation = message.pose.pose.orientation
    orientation.x, orientation.y, orientation.z, orientation.w = map(float, (x, y, z, w))
    linear = message.twist.twist.linear
    linear.x, linear.y, linear.z = -50.0, 3.0, 4.0
    velocity = kinematics_from_odometry(message, LAYOUT).velocity_m_s
    assert velocity == pytest.approx([-4.0, 3.0, -50.0], abs=1e-12)


def test_twist_in_the_landing_frame_is_taken_as_it_is():
    message = odometry()
    message.child_frame_id = "landing_site"
    message.pose.pose.orientation.w = 0.0  # no attitude at all: it is not needed
    linear = message.twist.twist.linear
    linear.x, linear.y, linear.z = 1.0, 2.0, 3.0
    assert kinematics_from_odometry(message, LAYOUT).velocity_m_s.tolist() == [1.0, 2.0, 3.0]


def test_odometry_becomes_a_core_state():
    state = state_from_kinematics(kinematics_from_odometry(odometry(), LAYOUT), 1500.0, LAYOUT)
    assert state.values.tolist() == [300.0, 10.0, -20.0, -30.0, 1.0, 2.0, 1500.0]


def set_path(message, path, value):
    *parents, last = path.split(".")
    for name in parents:
        message = getattr(message, name)
    setattr(message, last, value)


@pytest.mark.parametrize(
    ("path", "value", "code"),
    [
        ("pose.pose.position.x", math.nan, InputCode.NOT_FINITE),
        ("pose.pose.position.z", math.inf, InputCode.NOT_FINITE),
        ("pose.pose.orientation.w", math.nan, InputCode.NOT_FINITE),
        ("twist.twist.linear.y", -math.inf, InputCode.NOT_FINITE),
        ("header.frame_id", "", InputCode.EMPTY_FRAME),
        ("child_frame_id", "", InputCode.EMPTY_FRAME),
        ("header.frame_id", "map", InputCode.WRONG_FRAME),
        ("pose.pose.orientation.w", 0.5, InputCode.NON_UNIT_QUATERNION),
        ("pose.pose.position.z", -1.5, InputCode.BELOW_GROUND),
        ("pose.pose.position.x", 2e6, InputCode.OUT_OF_RANGE),
        ("twist.twist.linear.x", 1e308, InputCode.OUT_OF_RANGE),
        ("header.stamp", Time(sec=-1, nanosec=0), InputCode.INVALID_STAMP),
        ("header.stamp", Time(sec=1, nanosec=1_000_000_000), InputCode.INVALID_STAMP),
    ],
)
def test_bad_odometry_is_refused_by_its_number(path, value, code):
    message = odometry()
    set_path(message, path, value)
    error = refusal(kinematics_from_odometry, message, LAYOUT)
    assert error.code is code
    assert path.split(".")[-1] in error.field or path.split(".")[-2] in error.field
    assert str(code.value) in str(error)
    assert error.bound in str(error)


def test_finite_comes_before_frame_before_range():
    message = odometry()
    message.header.frame_id = "map"
    message.pose.pose.position.z = -100.0
    assert refusal(kinematics_from_odometry, message, LAYOUT).code is InputCode.WRONG_FRAME
    message.twist.twist.linear.x = math.nan
    assert refusal(kinematics_from_odometry, message, LAYOUT).code is InputCode.NOT_FINITE


def test_noise_below_ground_is_within_the_tolerance():
    message = odometry()
    message.pose.pose.position.z = -0.4
    assert kinematics_from_odometry(message, LAYOUT).position_m[2] == -0.4
    strict = DescentLimits(ground_tolerance_m=0.1)
    error = refusal(kinematics_from_odometry, message, LAYOUT, limits=strict.admit)
    assert error.code is InputCode.BELOW_GROUND
    assert error.value == -0.4


@given(
    st.tuples(*[ALL_FLOATS] * 10),
    st.sampled_from(["", "landing_site", "map"]),
    st.sampled_from(["", "landing_site", "base_link"]),
)
def test_no_float_gets_past_the_checks_of_odometry(numbers, frame, child_frame):
    message = odometry()
    message.header.frame_id, message.child_frame_id = frame, child_frame
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    linear = message.twist.twist.linear
    position.x, position.y, position.z = numbers[:3]
    linear.x, linear.y, linear.z = numbers[3:6]
    orientation.x, orientation.y, orientation.z, orientation.w = numbers[6:]
    try:
        result = kinematics_from_odometry(message, LAYOUT)
    except RejectedInputError:
        return
    assert np.all(np.isfinite(result.position_m))
    assert np.linalg.norm(result.velocity_m_s) <= DescentLimits().speed_max_m_s * (1 + 1e-12)


def test_a_broken_velocity_is_not_written():
    bad = kinematics(velocity=(0.0, math.nan, 0.0))
    assert refusal(odometry_from_kinematics, bad, frame=LANDING_FRAME).code is InputCode.NOT_FINITE


# --- InertiaStamped


@given(st.floats(1e-3, 1e9), STAMPS)
def test_mass_round_trip(mass_kg, stamp_ns):
    mass = StampedMass(stamp_ns, mass_kg)
    assert mass_from_inertia(through_the_wire(inertia_from_mass(mass))) == mass


@given(ALL_FLOATS)
def test_only_positive_masses_pass(mass_kg):
    message = InertiaStamped()
    message.inertia.m = mass_kg
    if math.isfinite(mass_kg) and mass_kg > 0.0:
        assert mass_from_inertia(message).mass_kg == mass_kg
    else:
        expected = InputCode.MASS_NOT_POSITIVE if math.isfinite(mass_kg) else InputCode.NOT_FINITE
        assert refusal(mass_from_inertia, message).code is expected


# --- JointState


@given(st.permutations(range(7)), STAMPS)
def test_joint_state_round_trip_in_any_order(order, stamp_ns):
    values = np.array([300.0, 10.0, -20.0, -30.0, 1.0, 2.0, 1500.0])
    message = joint_state_from_state(StampedState(stamp_ns, values), LAYOUT)
    message.name = [message.name[i] for i in order]
    message.position = [message.position[i] for i in order]
    result = state_from_joint_state(through_the_wire(message), LAYOUT)
    assert result.stamp_ns == stamp_ns
    assert np.array_equal(result.values, values)


def test_joint_state_is_z_up():
    message = joint_state()
    named = dict(zip(message.name, message.position, strict=True))
    assert named["z"] == 300.0
    assert named["vz"] == -30.0
    assert message.header.frame_id == "landing_site"


@pytest.mark.parametrize(
    ("field", "value", "code"),
    [
        ("name", ["x", "y", "z", "vx", "vy", "vz"], InputCode.WRONG_ARRAY_LENGTH),
        ("name", ["x", "y", "z", "vx", "vy", "vz", "x"], InputCode.DUPLICATE_NAME),
        ("name", ["x", "y", "z", "vx", "vy", "vz", "fuel"], InputCode.UNKNOWN_NAME),
        ("position", [0.0] * 8, InputCode.WRONG_ARRAY_LENGTH),
        ("position", [], InputCode.WRONG_ARRAY_LENGTH),
        ("velocity", [0.0] * 3, InputCode.WRONG_ARRAY_LENGTH),
        ("effort", [0.0], InputCode.WRONG_ARRAY_LENGTH),
        ("position", [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0], InputCode.MASS_NOT_POSITIVE),
        ("position", [0.0, 0.0, -9.0, 0.0, 0.0, 0.0, 5.0], InputCode.BELOW_GROUND),
        ("position", [2e6, 0.0, 1.0, 0.0, 0.0, 0.0, 5.0], InputCode.OUT_OF_RANGE),
        ("position", [0.0, 0.0, 1.0, 2e4, 0.0, 0.0, 5.0], InputCode.OUT_OF_RANGE),
        ("position", [0.0, 0.0, math.nan, 0.0, 0.0, 0.0, 5.0], InputCode.NOT_FINITE),
    ],
)
def test_bad_joint_state_is_refused_by_its_number(field, value, code):
    message = joint_state()
    setattr(message, field, value)
    assert refusal(state_from_joint_state, message, LAYOUT).code is code


def test_missing_names_are_named():
    message = joint_state()
    message.name, message.position = list(message.name[:-1]), message.position[:-1]
    error = refusal(state_from_joint_state, message, LAYOUT)
    assert error.code is InputCode.MISSING_NAME
    assert "mass" in error.bound


@given(
    st.lists(st.sampled_from(["x", "y", "z", "vx", "vy", "vz", "mass", "", "q"]), max_size=9),
    st.lists(ALL_FLOATS, max_size=9),
)
def test_no_names_or_floats_get_past_the_checks_of_joint_state(names, numbers):
    message = joint_state()
    message.name, message.position = names, numbers
    try:
        result = state_from_joint_state(message, LAYOUT)
    except RejectedInputError:
        return
    assert sorted(names) == sorted(LAYOUT.message_names)
    assert np.all(np.isfinite(result.values))


@given(st.tuples(*[ALL_FLOATS] * 7))
def test_joint_state_with_any_floats(numbers):
    message = joint_state()
    message.position = list(numbers)
    try:
        result = state_from_joint_state(message, LAYOUT)
    except RejectedInputError:
        return
    assert sorted(result.values) == sorted(numbers)
