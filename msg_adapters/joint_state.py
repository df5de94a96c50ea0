"""sensor_msgs/JointState: a whole state in one message, as named scalars in any order."""

from __future__ import annotations

import array

import numpy as np
from sensor_msgs.msg import JointState

from msg_adapters.checks import require_finite, require_frame, require_length, require_names
from msg_adapters.layout import StateLayout
from msg_adapters.limits import StateLimits, admitted
from msg_adapters.stamps import nanoseconds_from_stamp, stamp_from_nanoseconds
from msg_adapters.state import StampedState


def state_from_joint_state(
    message: JointState,
    layout: StateLayout,
    *,
    frame: str | None = None,
    limits: StateLimits | None = None,
) -> StampedState:
    """State whose entries are ``position[i]`` of ``name[i]``, in any order.

    Args:
        message: The message; ``velocity`` and ``effort`` are not used, but their length has to be
            zero or that of ``name``.
        layout: Names and order of the problem's state.
        frame: Expected ``header.frame_id``; that of the layout if None.
        limits: Range limits; those of the layout if None.

    Raises:
        RejectedInputError: NOT_FINITE, EMPTY_FRAME, WRONG_FRAME, WRONG_ARRAY_LENGTH,
            DUPLICATE_NAME, UNKNOWN_NAME, MISSING_NAME, OUT_OF_RANGE, BELOW_GROUND,
            MASS_NOT_POSITIVE or INVALID_STAMP, checked in this order.
    """
    require_finite((f"position[{index}]", value) for index, value in enumerate(message.position))
    require_frame("header.frame_id", message.header.frame_id, frame or layout.frame)
    require_length("position", len(message.position), len(message.name))
    require_length("velocity", len(message.velocity), len(message.name), empty_allowed=True)
    require_length("effort", len(message.effort), len(message.name), empty_allowed=True)
    require_names("name", message.name, layout.message_names)
    named = {name: float(v) for name, v in zip(message.name, message.position, strict=True)}
    passed = admitted(limits or layout.limits, named)
    stamp_ns = nanoseconds_from_stamp(message.header.stamp)
    ordered = np.array([passed[name] for name in layout.message_names], dtype=np.float64)
    return StampedState(stamp_ns, layout.to_core_order(ordered))


def joint_state_from_state(
    state: StampedState, layout: StateLayout, *, frame: str | None = None
) -> JointState:
    """Message of a state, in message order; in the layout's frame if none is given.

    Raises:
        RejectedInputError: NOT_FINITE.
    """
    ordered = layout.to_message_order(state.values)
    require_finite(
        (name, float(value)) for name, value in zip(layout.message_names, ordered, strict=True)
    )
    message = JointState()
    message.header.stamp = stamp_from_nanoseconds(state.stamp_ns)
    message.header.frame_id = frame or layout.frame
    message.name = list(layout.message_names)
    message.position = array.array("d", ordered.tolist())
    return message
