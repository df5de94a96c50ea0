"""Problem parameters as ROS users give them: vectors in the landing frame, z up.

Scalars are the same on both sides. Of a landing problem's vectors, those of length 3 follow the
axes and those as long as the state follow its order in messages.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from msg_adapters.frames import (
    POWERED_DESCENT,
    Array,
    StateLayout,
    core_from_ros,
    ros_from_core,
)


def follows_message_axes(layout: StateLayout, values: Sequence[float]) -> bool:
    """Whether a vector parameter has axes, or the state's order."""
    array = np.asarray(values, dtype=np.float64)
    return _follows_state(layout, array) or _follows_axes(layout, array)


def parameter_to_message_axes(layout: StateLayout, values: Sequence[float]) -> list[float]:
    """Vector parameter from the core's axes and order to those of messages."""
    array = np.asarray(values, dtype=np.float64)
    if _follows_state(layout, array):
        array = layout.to_message_order(array)
    elif _follows_axes(layout, array):
        array = ros_from_core(array)
    return [float(value) for value in array]


def parameter_to_core_axes(layout: StateLayout, values: Sequence[float]) -> list[float]:
    """Inverse of `parameter_to_message_axes`."""
    array = np.asarray(values, dtype=np.float64)
    if _follows_state(layout, array):
        array = layout.to_core_order(array)
    elif _follows_axes(layout, array):
        array = core_from_ros(array)
    return [float(value) for value in array]


def _follows_state(layout: StateLayout, array: Array) -> bool:
    return array.shape == (len(layout.state_names),)


def _follows_axes(layout: StateLayout, array: Array) -> bool:
    return layout.problem == POWERED_DESCENT and array.shape == (3,)
