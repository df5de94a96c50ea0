"""Status and force of a guidance node, there and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dscp_core import problems
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.guidance import (
    GuidanceStatus,
    guidance_status_from_message,
    message_from_guidance_status,
    wrench_from_force,
)
from msg_adapters.layout import problem_layout

LAYOUT = problem_layout(problems.get("powered_descent"))
STATUS = GuidanceStatus(
    5_000_000_001, 1, "commands nothing: no state", "none", False, 3, 4, 5, 6, 7
)


@pytest.mark.parametrize(
    "status",
    [STATUS, replace(STATUS, state_age_s=0.25, plan_stamp_ns=4_000_000_000, asked_stamp_ns=7)],
)
def test_a_status_is_read_as_it_was_written(status: GuidanceStatus) -> None:
    message = message_from_guidance_status(status, node="guidance", problem="landing")
    assert message.status[0].name == "guidance: status"
    assert guidance_status_from_message(message) == status


def test_a_status_with_a_hole_is_refused() -> None:
    message = message_from_guidance_status(STATUS, node="guidance", problem="landing")
    message.status[0].values = [v for v in message.status[0].values if v.key != "ticks"]
    with pytest.raises(RejectedInputError, match="'ticks'") as refused:
        guidance_status_from_message(message)
    assert refused.value.code is InputCode.REPORT_MISSING_KEY


def test_a_force_is_told_in_the_axes_of_messages() -> None:
    message = wrench_from_force(np.array([3.0, 1.0, 2.0]), 5_000_000_001, LAYOUT)
    force = message.wrench.force
    assert (force.x, force.y, force.z) == (1.0, 2.0, 3.0)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (5, 1)
    assert message.header.frame_id == "landing_site"


@pytest.mark.parametrize("part", [np.nan, np.inf])
def test_a_force_that_is_no_number_is_refused(part: float) -> None:
    with pytest.raises(RejectedInputError, match=r"force\.z") as refused:
        wrench_from_force(np.array([part, 1.0, 2.0]), 0, LAYOUT)
    assert refused.value.code is InputCode.NOT_FINITE
