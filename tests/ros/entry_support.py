"""A planner node that flies entry, and a client that sends it entry states."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros.planner_support import (
    PATIENT,
    PLAN_TIMEOUT_S,
    Harness,
    PlannerClient,
    end,
    now_ns,
    start,
)

from dscp_core import problems
from dscp_core.problems.entry.messages import PLANET_FRAME
from dscp_ros.planner.node import PlannerNode
from dscp_ros.planner.parameter_files import ParameterArguments
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import StateLayout, problem_layout
from msg_adapters.report import PlanReport
from msg_adapters.state import StampedState

LAYOUT: StateLayout = problem_layout(problems.get("entry"))
# The paper's case.
STATE = np.array([6449.1e3, 0.0, 0.0, 6700.0, 0.0, math.radians(90.0), math.radians(30.0), 0.0])
PATIENT_ENTRY = {name: value for name, value in PATIENT.items() if name != "mass_max_age_s"}


class EntryClient(PlannerClient):
    """Publishes entry states; the inputs of landings have nobody who listens."""

    def __init__(self, ros: Harness) -> None:
        super().__init__(ros)
        self.state = self.mass = self.vehicle_state

    def send(self, values: np.ndarray = STATE, stamp_ns: int | None = None) -> int:
        stamp_ns = now_ns() if stamp_ns is None else stamp_ns
        state = StampedState(stamp_ns, np.asarray(values))
        self.vehicle_state.publish(joint_state_from_state(state, LAYOUT, frame=PLANET_FRAME))
        return stamp_ns

    def send_and_report(self, values: np.ndarray = STATE) -> PlanReport:
        return self.report_of(self.send(values))


@contextmanager
def running_entry_planner(
    ros: Harness, arguments: Sequence[str]
) -> Iterator[tuple[EntryClient, subprocess.Popen[str]]]:
    """A connected client and the node's process, which is ended at the end."""
    patience = [
        word for name, value in PATIENT_ENTRY.items() for word in ("-p", f"{name}:={value}")
    ]
    process = start(ros, [*arguments, "--ros-args", *patience])
    try:
        client = EntryClient(ros)
        client.wait_until_connected(process)
        yield client, process
    finally:
        end(process)


@contextmanager
def local_entry_planner(
    ros: Harness, **parameters: object
) -> Iterator[tuple[EntryClient, PlannerNode]]:
    """A connected client and a node in the harness's own executor."""
    chosen = {"problem": "entry", **PATIENT_ENTRY, **parameters}
    overrides = [Parameter(name, value=value) for name, value in chosen.items()]
    node = Node("planner", context=ros.context, parameter_overrides=overrides)
    ros.add_node(node)
    planner = PlannerNode(node, ParameterArguments((), frozenset(), ()))
    try:
        client = EntryClient(ros)
        client.wait_until_connected()
        yield client, planner
    finally:
        assert planner.close(PLAN_TIMEOUT_S)
