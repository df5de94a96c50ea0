"""Logs of simulated flights, read again by another reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from simulation_support import VALUES, CartSimulation, rolling_cart

from dscp_ros.bag import BagReader
from dscp_ros.flights.logs import START_NS, VEHICLE_STATE_TOPIC, write_flight

RECORD = CartSimulation(1.5, VALUES).record(3)


def test_a_flight_of_named_scalars(tmp_path: Path) -> None:
    bag = write_flight(tmp_path / "new" / "cart_3", rolling_cart(), RECORD)
    with BagReader(bag, strict=True) as reader:
        assert reader.verify().intact
        assert set(reader.topics) == {"/story", VEHICLE_STATE_TOPIC}
    with AnyReader([bag]) as reader:
        found = [
            (connection.topic, reader.deserialize(data, connection.msgtype))
            for connection, _, data in reader.messages()
        ]
    states = [message for topic, message in found if topic == VEHICLE_STATE_TOPIC]
    assert np.array_equal([message.position for message in states], RECORD.measured)
    assert states[0].name == ["position", "speed"]
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec - START_NS for m in states]
    assert np.allclose(np.array(stamps) / 1e9, RECORD.measured_at_s)
    story = [message.data for topic, message in found if topic == "/story"]
    assert story == [
        "closed-loop flight, simulation seed 3",
        "0.0 s: pushed off",
        "2.0 s: stopped",
        f"2.00 s: end; {RECORD.summary.story}",
    ]


def test_a_log_that_is_there_is_replaced(tmp_path: Path) -> None:
    for _ in range(2):
        write_flight(tmp_path / "cart", rolling_cart(), RECORD)
    assert [path.name for path in tmp_path.iterdir()] == ["cart"]
