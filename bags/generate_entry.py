"""Makes the entry bags of this folder: `python bags/generate_entry.py`.

The same numbers come out each time; README.md tells what they are.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from bag_parts import (
    RELIABLE,
    STORY_TOPIC,
    VEHICLE_STATE_TOPIC,
    Fault,
    Spoil,
    set_value,
    shuffle_names,
    write_bags,
)
from entry_flight import SEED, entry_planner, fly
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from dscp_core import problems
from dscp_core.planning.plan import PlanOutcome
from dscp_ros.bag import BagWriter
from msg_adapters.errors import InputCode
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import StateLayout, problem_layout
from msg_adapters.stamps import nanoseconds_from_seconds, stamp_from_nanoseconds
from msg_adapters.state import StampedState

NOMINAL, DISPERSED = "entry_nominal", "entry_dispersed"

DISPERSED_START_NS = nanoseconds_from_seconds(datetime(2026, 3, 4, 9, 0, tzinfo=UTC).timestamp())
NOMINAL_START_NS = nanoseconds_from_seconds(datetime(2026, 3, 4, 10, 0, tzinfo=UTC).timestamp())
"""Later than the other bag, so that the clock moves forward when both are replayed in turn."""

LEAD_S = 100.0
"""Story before the first state: a second of a replay a hundred times as fast."""
LATENCY_S = 0.015
"""From stamp to log time: what sensors and transport take."""

DISPERSED_SEED = 11
DISPERSED_STATES, DISPERSED_PERIOD_S = 24, 60.0
_DEGREE = math.radians(1.0)
DISPERSED_SPREAD = (
    *(2e3, 1.0 * _DEGREE, 1.0 * _DEGREE, 50.0),
    *(0.2 * _DEGREE, 1.0 * _DEGREE, 2.0 * _DEGREE, 5.0 * _DEGREE),
)
"""Half widths: radius, longitude, latitude, speed, flight-path angle, heading, angle of attack,
bank."""


def write_nominal(folder: Path) -> Path:
    """Writes one closed-loop entry; returns the bag."""
    flight = fly(SEED)
    layout = _layout()
    bag = folder / NOMINAL
    errors = ", ".join(f"{name} {100 * e:+.2f} %" for name, e in flight.vehicle.items())
    with BagWriter(bag, overwrite=True) as writer:
        writer.add_topic(STORY_TOPIC, String, RELIABLE)
        writer.add_topic(VEHICLE_STATE_TOPIC, JointState, RELIABLE)

        def tell(time_s: float, text: str) -> None:
            stamp_ns = NOMINAL_START_NS + nanoseconds_from_seconds(time_s)
            writer.write(STORY_TOPIC, String(data=text), stamp_ns)

        tell(-LEAD_S, f"closed-loop entry, seed {SEED}; the vehicle's errors: {errors}")
        for measurement in flight.measurements:
            if measurement.outcome is not None:
                tell(measurement.time_s, _replan_text(measurement.time_s, measurement.outcome))
            stamp_ns = NOMINAL_START_NS + nanoseconds_from_seconds(measurement.time_s)
            message = _message(StampedState(stamp_ns, measurement.state), layout)
            writer.write(
                VEHICLE_STATE_TOPIC, message, stamp_ns + nanoseconds_from_seconds(LATENCY_S)
            )
        tell(
            flight.measurements[-1].time_s + 2.0 * LATENCY_S,
            f"{flight.measurements[-1].time_s:.2f} s: end of the last plan, "
            f"{flight.miss_position_m:.0f} m off the target, at {flight.end[3]:.0f} m/s",
        )
    return bag


def _replan_text(time_s: float, outcome: PlanOutcome) -> str:
    return (
        f"{time_s:.0f} s: onboard guidance {outcome.status.name}, "
        f"{outcome.terminal_time_used_s:.1f} s to go"
    )


def _rename(old: str, new: str) -> Spoil:
    def spoil(message: JointState) -> None:
        message.name[message.name.index(old)] = new

    return spoil


def _add_mass(message: JointState) -> None:
    message.name = [*message.name, "mass"]
    message.position = [*message.position, 907.186]


def _set_frame(message: JointState) -> None:
    message.header.frame_id = "landing_site"


def _make_old(message: JointState) -> None:
    message.header.stamp = stamp_from_nanoseconds(
        message.header.stamp.sec * 10**9 - nanoseconds_from_seconds(600.0)
    )


FAULTS: dict[int, Fault] = {
    3: Fault("the bank angle is NaN", InputCode.NOT_FINITE, set_value("bank_angle", math.nan)),
    5: Fault("the altitude in place of the radius", InputCode.BELOW_GROUND, set_value("r", 78e3)),
    7: Fault("160 km up", InputCode.OUT_OF_RANGE, set_value("r", 6371.1e3 + 160e3)),
    9: Fault("the speed is zero", InputCode.OUT_OF_RANGE, set_value("speed", 0.0)),
    11: Fault("the heading is in degrees", InputCode.OUT_OF_RANGE, set_value("heading", 90.0)),
    13: Fault(
        "banked by 75 degrees", InputCode.OUT_OF_RANGE, set_value("bank_angle", math.radians(75.0))
    ),
    15: Fault("r twice, no latitude", InputCode.DUPLICATE_NAME, _rename("latitude", "r")),
    17: Fault("a mass as well", InputCode.UNKNOWN_NAME, _add_mass),
    19: Fault("the frame is landing_site", InputCode.WRONG_FRAME, _set_frame),
    21: Fault("the stamp is 10 minutes old", InputCode.STALE_STAMP, _make_old),
}
"""Bad states by their index among the states."""

TURNED = 2
"""This state's longitude is given a turn further: a good state all the same."""


def write_dispersed(folder: Path) -> Path:
    """Writes a series of unrelated initial states, some of them bad; returns the bag."""
    random = np.random.default_rng(DISPERSED_SEED)
    layout = _layout()
    centre = entry_planner().initial_state
    bag = folder / DISPERSED
    with BagWriter(bag, overwrite=True) as writer:
        writer.add_topic(STORY_TOPIC, String, RELIABLE)
        writer.add_topic(VEHICLE_STATE_TOPIC, JointState, RELIABLE)
        opening = f"{DISPERSED_STATES} unrelated initial states, seed {DISPERSED_SEED}"
        opening_ns = DISPERSED_START_NS - nanoseconds_from_seconds(LEAD_S)
        writer.write(STORY_TOPIC, String(data=opening), opening_ns)
        for index in range(DISPERSED_STATES):
            stamp_ns = DISPERSED_START_NS + nanoseconds_from_seconds(index * DISPERSED_PERIOD_S)
            state = centre + random.uniform(-1.0, 1.0, 8) * DISPERSED_SPREAD
            text = f"state {index}"
            if index == TURNED:
                state[1] += 2.0 * math.pi
                text += ": its longitude is a turn further, which is the same place"
            message = _message(StampedState(stamp_ns, state), layout)
            shuffle_names(message, random)
            if (fault := FAULTS.get(index)) is not None:
                fault.spoil(message)
                text += f": {fault.announcement}"
            writer.write(STORY_TOPIC, String(data=text), stamp_ns)
            log_ns = stamp_ns + nanoseconds_from_seconds(LATENCY_S)
            writer.write(VEHICLE_STATE_TOPIC, message, log_ns)
    return bag


def _layout() -> StateLayout:
    return problem_layout(problems.get("entry"))


def _message(state: StampedState, layout: StateLayout) -> JointState:
    return joint_state_from_state(state, layout)


if __name__ == "__main__":
    write_bags(__doc__, lambda folder: (write_nominal(folder), write_dispersed(folder)))
