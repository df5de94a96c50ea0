"""Quality of service in every form in which bags hold it."""

from __future__ import annotations

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

from dscp_core.errors import InvalidInputError
from dscp_ros.bag.qos import Qos, dump_offers, parse_offers, publisher_qos, subscription_qos

INFINITE_NS = 2**63 - 1

# As `ros2 bag record` of Foxy to Iron writes it: rmw's numbers, in one string.
NUMBERED = """\
- history: 3
  depth: 0
  reliability: 1
  durability: 1
  deadline:
    sec: 2147483647
    nsec: 4294967295
  lifespan:
    sec: 10
    nsec: 5
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""

profiles = st.builds(
    Qos,
    history=st.sampled_from(["keep_last", "keep_all", "system_default", "unknown"]),
    depth=st.integers(1, 2**31 - 1),
    reliability=st.sampled_from(["reliable", "best_effort", "system_default", "best_available"]),
    durability=st.sampled_from(["volatile", "transient_local", "unknown"]),
    deadline_ns=st.integers(0, INFINITE_NS),
    lifespan_ns=st.integers(0, INFINITE_NS),
    liveliness=st.sampled_from(["automatic", "manual_by_topic", "system_default"]),
    liveliness_lease_duration_ns=st.integers(0, INFINITE_NS),
    avoid_ros_namespace_conventions=st.booleans(),
)


@given(st.lists(profiles, max_size=3))
def test_what_is_written_is_read_back(offers: list[Qos]) -> None:
    assert list(parse_offers(dump_offers(offers))) == offers


@given(profiles)
def test_rclpy_keeps_every_policy(qos: Qos) -> None:
    assert Qos.from_rclpy(qos.to_rclpy()) == qos


def test_rclpy_names_and_numbers_agree() -> None:
    profile = Qos("keep_all", 7, "best_effort", "transient_local", 5, 6, "manual_by_topic", 8)
    assert profile.to_rclpy() == QoSProfile(
        history=HistoryPolicy.KEEP_ALL,
        depth=7,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
        deadline=Duration(nanoseconds=5),
        lifespan=Duration(nanoseconds=6),
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
        liveliness_lease_duration=Duration(nanoseconds=8),
    )


def test_numbered_form_of_older_bags() -> None:
    (qos,) = parse_offers(NUMBERED)
    assert qos == Qos(
        history="unknown",
        depth=0,
        reliability="reliable",
        durability="transient_local",
        deadline_ns=INFINITE_NS,
        lifespan_ns=10_000_000_005,
        liveliness="automatic",
        liveliness_lease_duration_ns=INFINITE_NS,
    )


def test_written_form_has_rosbag2s_names() -> None:
    (stored,) = yaml.safe_load(dump_offers([Qos(deadline_ns=1_500_000_000)]))
    assert stored["deadline"] == {"sec": 1, "nsec": 500_000_000}
    assert (stored["history"], stored["depth"]) == ("keep_last", 10)
    assert (stored["reliability"], stored["durability"]) == ("reliable", "volatile")


@pytest.mark.parametrize(
    ("stored", "field"),
    [
        ("[{durability: sometimes}]", "durability"),
        ("[{reliability: 9}]", "reliability"),
        ("[{depth: -1}]", "depth"),
        ("[{depth: true}]", "depth"),
        ("[{deadline: {sec: 1}}]", "deadline"),
        ("[{deadlin: {sec: 1, nsec: 0}}]", "deadlin"),
        ("[{avoid_ros_namespace_conventions: 1}]", "avoid_ros_namespace_conventions"),
        ("{history: keep_last}", "offered_qos_profiles"),
        ("[keep_last]", "offered_qos_profiles"),
        ("[", "offered_qos_profiles"),
    ],
)
def test_wrong_values_are_named(stored: str, field: str) -> None:
    with pytest.raises(InvalidInputError, match="expected") as caught:
        parse_offers(stored)
    assert field in caught.value.field


def test_the_replaying_publisher_makes_the_strongest_recorded_offer() -> None:
    weak = Qos(depth=3, reliability="best_effort", lifespan_ns=7)
    strong = Qos(depth=5, durability="transient_local")
    assert publisher_qos([weak, strong]) == Qos(
        depth=5, reliability="reliable", durability="transient_local", liveliness="automatic"
    )
    assert publisher_qos([weak]).reliability == "best_effort"
    assert publisher_qos([]) == Qos()


def test_what_discovery_hides_becomes_the_default() -> None:
    discovered = Qos(history="unknown", depth=0, durability="transient_local")
    offered = publisher_qos([discovered])
    assert (offered.history, offered.depth, offered.durability) == (
        "keep_last",
        10,
        "transient_local",
    )


def test_the_recorder_asks_for_what_every_publisher_offers() -> None:
    latched, volatile = Qos(durability="transient_local"), Qos(reliability="best_effort")
    assert subscription_qos([latched], 4) == Qos(depth=4, durability="transient_local")
    assert subscription_qos([latched, volatile], 4) == Qos(depth=4, reliability="best_effort")
