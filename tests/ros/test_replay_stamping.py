"""The stamp inside serialised messages."""

from __future__ import annotations

import pytest
from geometry_msgs.msg import InertiaStamped, Point
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from visualization_msgs.msg import MarkerArray

from dscp_ros.bag import BagMessage, MessageDecodeError, TopicInfo
from dscp_ros.bag.cdr import serialise
from dscp_ros.bag.schemas import message_definition
from dscp_ros.replay.stamping import has_leading_header, with_stamp

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"


def recorded(data: bytes) -> BagMessage:
    topic = TopicInfo("/t", JOINT_STATE, 1, (), message_definition(JOINT_STATE))
    return BagMessage(topic, 5, 5, 0, data)


@given(
    time_ns=st.integers(0, 2**31 * 10**9 - 1),
    frame=st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=9),
    big_endian=st.booleans(),
)
def test_only_the_stamp_changes(time_ns: int, frame: str, big_endian: bool) -> None:
    message = JointState(header=Header(frame_id=frame), name=["x"], position=[1.5])
    message.header.stamp.sec, message.header.stamp.nanosec = 7, 8
    data = serialise(message)
    if big_endian:
        decoded = STORE.deserialize_cdr(data, JOINT_STATE)
        data = bytes(STORE.serialize_cdr(decoded, JOINT_STATE, little_endian=False))
    stamped = deserialize_message(with_stamp(recorded(data), time_ns), JointState)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(time_ns, 10**9)
    assert stamped == message


def test_types_with_a_leading_header() -> None:
    assert all(has_leading_header(kind) for kind in (Odometry, JointState, InertiaStamped))
    assert not any(has_leading_header(kind) for kind in (String, Point, MarkerArray, Header))


def test_a_message_without_room_for_a_stamp() -> None:
    with pytest.raises(MessageDecodeError, match="11 bytes are too few for a header"):
        with_stamp(recorded(b"\0\1\0\0" + bytes(7)), 1)
