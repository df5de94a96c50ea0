from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.problem.messages import Odometry
from dscp_core.problem.scene import quaternion_from_z_axis
from dscp_core.problems.powered_descent.messages import message_from_core
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.frames import rotate, unit_quaternion
from msg_adapters.layout import StateLayout, problem_layout

DESCENT = problems.get("powered_descent")
LAYOUT = problem_layout(DESCENT)

# Two ulps of numbers of order one, a few operations deep.
ROUNDING = 1e-14

components = st.floats(-1e3, 1e3, allow_subnormal=False)
vectors = st.tuples(components, components, components).map(np.array)


def orbit(*names: str, **changes: object) -> StateLayout:
    return StateLayout("orbit", names, names, names, ("thrust",), **changes)


def test_core_up_is_ros_z():
    for to_messages in (LAYOUT.to_message_axes, message_from_core):
        assert to_messages(np.array([1.0, 2.0, 3.0])).tolist() == [2.0, 3.0, 1.0]
    assert LAYOUT.to_core_axes(np.array([1.0, 2.0, 3.0])).tolist() == [3.0, 1.0, 2.0]


def test_axes_mapping_is_a_rotation():
    matrix = LAYOUT.to_message_axes(np.eye(3)).T
    assert np.linalg.det(matrix) == pytest.approx(1.0)


def test_axes_mapping_round_trip():
    block = np.arange(12.0).reshape(4, 3)
    assert np.array_equal(LAYOUT.to_core_axes(LAYOUT.to_message_axes(block)), block)


@given(vectors, vectors)
def test_rotate_agrees_with_scipy(rotation_vector, vector):
    rotation = Rotation.from_rotvec(rotation_vector / 100.0)
    rotated = rotate(rotation.as_quat(), vector)
    scale = 1.0 + np.linalg.norm(vector)
    assert np.allclose(rotated, rotation.apply(vector), rtol=0.0, atol=ROUNDING * scale)


@given(vectors)
def test_quaternion_from_z_axis_points_there(direction):
    quaternion = quaternion_from_z_axis(direction)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=ROUNDING)
    norm = math.hypot(*direction)
    expected = direction / norm if norm > 0.0 else np.array([0.0, 0.0, 1.0])
    pointed = Rotation.from_quat(quaternion).apply([0.0, 0.0, 1.0])
    # 1 + z cancels near straight down: the square root of the rounding remains.
    assert np.allclose(pointed, expected, rtol=0.0, atol=5e-8)


def test_straight_down_is_half_a_turn():
    pointed = rotate(quaternion_from_z_axis(np.array([0.0, 0.0, -5.0])), np.array([0, 0, 1.0]))
    assert pointed.tolist() == [0.0, 0.0, -1.0]


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.01), (1e308,) * 4])
def test_non_unit_quaternion_is_refused(quaternion):
    with pytest.raises(RejectedInputError) as caught:
        unit_quaternion("q", quaternion)
    assert caught.value.code is InputCode.NON_UNIT_QUATERNION


def test_single_precision_quaternion_is_normalised():
    quaternion = np.float32([0.1, 0.2, 0.3, 0.9]) / np.linalg.norm([0.1, 0.2, 0.3, 0.9])
    unit = unit_quaternion("q", [float(q) for q in quaternion])
    assert np.linalg.norm(unit) == pytest.approx(1.0, abs=ROUNDING)


def test_powered_descent_layout_permutes_axes():
    layout = LAYOUT
    assert layout.message_names == ("x", "y", "z", "vx", "vy", "vz", "mass")
    core = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    ordered = layout.to_message_order(core)
    assert ordered.tolist() == [2.0, 3.0, 1.0, 5.0, 6.0, 4.0, 7.0]
    assert np.array_equal(layout.to_core_order(ordered), core)


def test_layout_follows_the_core_order():
    names = ("mass", "vz", "vy", "vx", "z", "y", "x")
    layout = replace(LAYOUT, state_names=names)
    named = dict(zip(layout.message_names, layout.to_message_order(np.arange(7.0)), strict=True))
    assert named == {"mass": 0.0, "vy": 1.0, "vx": 2.0, "vz": 3.0, "y": 4.0, "x": 5.0, "z": 6.0}


def test_layout_refuses_other_states():
    with pytest.raises(InvalidInputError, match="powered_descent"):
        replace(LAYOUT, state_names=("x", "y"))


def test_other_problems_keep_their_names():
    layout = orbit("r", "longitude")
    assert layout.joint_names == ("r", "longitude", "thrust")
    assert layout.to_message_order(np.array([[1.0, 2.0]])).tolist() == [[1.0, 2.0]]


def test_a_name_for_two_things_is_refused():
    with pytest.raises(InvalidInputError, match=r"names in messages of orbit.*thrust"):
        orbit("r", "thrust")


def test_odometry_has_to_be_the_state():
    with pytest.raises(InvalidInputError, match="odometry of orbit"):
        orbit("x", "y", "z", "vx", "vy", "vz", "charge", odometry=Odometry())
