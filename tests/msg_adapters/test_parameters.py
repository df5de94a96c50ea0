from __future__ import annotations

import pytest
from adapter_cases import LAYOUT

from msg_adapters.layout import StateLayout
from msg_adapters.parameters import parameter_to_core_axes, parameter_to_message_axes


@pytest.mark.parametrize(
    ("core", "message"),
    [
        ([100.0, 1.0, 2.0], [1.0, 2.0, 100.0]),
        ([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0], [2.0, 3.0, 1.0, 5.0, 6.0, 4.0, 7.0]),
        ([1.0, 2.0], [1.0, 2.0]),
    ],
)
def test_vectors_follow_axes_or_state(core, message):
    assert parameter_to_message_axes(LAYOUT, core) == message
    assert parameter_to_core_axes(LAYOUT, message) == core


def test_vectors_of_other_problems_stay_as_they_are():
    names = ("r", "longitude", "latitude", "speed")
    layout = StateLayout("orbit", names, names, names)
    assert parameter_to_message_axes(layout, [1.0, 2.0, 3.0]) == [1.0, 2.0, 3.0]
    assert parameter_to_core_axes(layout, [1.0, 2.0, 3.0, 4.0]) == [1.0, 2.0, 3.0, 4.0]
