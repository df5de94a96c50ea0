"""Problem parameters as ROS users give them: in the axes and the order of messages.

Scalars are the same on both sides. Vectors as long as the state follow its order in messages; those
of length 3 follow the axes of messages, where the problem has such.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from msg_adapters.frames import Array
from msg_adapters.layout import StateLayout


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
        array = layout.to_message_axes(array)
    return [float(value) for value in array]


def parameter_to_core_axes(layout: StateLayout, values: Sequence[float]) -> list[float]:
    """Inverse of `parameter_to_message_axes`."""
    array = np.asarray(values, dtype=np.float64)
    if _follows_state(layout, array):
        array = layout.to_core_order(array)
    elif _follows_axes(layout, array):
        array = layout.to_core_axes(array)
    return [float(value) for value in array]


def _follows_state(layout: StateLayout, array: Array) -> bool:
    return array.shape == (len(layout.state_names),)


def _follows_axes(layout: StateLayout, array: Array) -> bool:
    return layout.axes is not None and array.shape == (3,)
