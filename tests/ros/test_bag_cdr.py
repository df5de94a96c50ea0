"""Serialised messages: right for an independent decoder, and the same every time."""

from __future__ import annotations

from pathlib import Path

import nav_msgs
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import ByteMultiArray, Empty, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from dscp_ros.bag.cdr import serialise
from dscp_ros.bag.schemas import message_class, type_name_of

STORE = get_typestore(Stores.ROS2_JAZZY)
PACKAGES = (
    "diagnostic_msgs",
    "geometry_msgs",
    "nav_msgs",
    "sensor_msgs",
    "std_msgs",
    "trajectory_msgs",
    "visualization_msgs",
)
finite = st.floats(allow_nan=False, allow_infinity=False)


def installed_types() -> list[str]:
    # <prefix>/lib/python3.x/site-packages/nav_msgs/__init__.py
    share = Path(nav_msgs.__file__).parents[4] / "share"
    return sorted(
        f"{package}/msg/{path.stem}"
        for package in PACKAGES
        for path in (share / package / "msg").glob("*.json")
    )


def points(numbers: st.SearchStrategy[list[float]]) -> st.SearchStrategy[JointTrajectoryPoint]:
    return st.builds(
        lambda p, v, a, e: JointTrajectoryPoint(
            positions=p, velocities=v, accelerations=a, effort=e
        ),
        numbers,
        numbers,
        numbers,
        numbers,
    )


@given(
    names=st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)),
    rows=st.lists(points(st.lists(finite, max_size=3)), max_size=4),
)
@settings(deadline=None, max_examples=60)
def test_an_independent_decoder_reads_every_field(
    names: list[str], rows: list[JointTrajectoryPoint]
) -> None:
    message = JointTrajectory(joint_names=names, points=rows)
    data = serialise(message)
    assert deserialize_message(data, JointTrajectory) == message
    # rosbags refuses surplus bytes.
    decoded = STORE.deserialize_cdr(data, "trajectory_msgs/msg/JointTrajectory")
    assert decoded.joint_names == names
    for given_row, row in zip(rows, decoded.points, strict=True):
        for field in ("positions", "velocities", "accelerations", "effort"):
            assert list(getattr(row, field)) == list(getattr(given_row, field))


def test_every_common_message_type_survives() -> None:
    names = installed_types()
    assert len(names) > 100
    for name in names:
        message = message_class(name)()
        assert type_name_of(type(message)) == name
        data = serialise(message)
        assert deserialize_message(data, type(message)) == message, name
        if name in STORE.fielddefs:  # which knows no type added within Jazzy's life
            STORE.deserialize_cdr(data, name)


def test_equal_messages_give_equal_bytes() -> None:
    # Strings of odd lengths before doubles: there is padding, which rclpy leaves as it was.
    message = JointTrajectory(
        joint_names=["a", "bcdef"], points=[JointTrajectoryPoint(positions=[1.0])] * 30
    )
    first = serialise(message)
    for filler in range(1, 20):
        serialize_message(String(data=chr(64 + filler) * len(first)))
        assert serialise(message) == first


def test_no_surplus_bytes() -> None:
    message = JointTrajectory(points=[JointTrajectoryPoint(positions=[1.0])])
    # Encapsulation header 4, then: stamp 8, frame 4 + 1, padding 3, number of names 4, number of
    # points 4, number of positions 4, padding 4, position 8, three empty arrays 12, time 8.
    assert len(serialise(message)) == 64
    assert len(serialize_message(message)) > 64


@pytest.mark.parametrize("message", [Empty(), ByteMultiArray(data=[b"\x01", b"\xff"])])
def test_small_types(message: Empty | ByteMultiArray) -> None:
    assert deserialize_message(serialise(message), type(message)) == message
