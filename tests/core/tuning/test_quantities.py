from __future__ import annotations

import math

import numpy as np
import pytest
from core.whole_runs import difference

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.tuning.quantities import (
    DEFAULT_WEIGHT_START,
    TunedParameter,
    check_corners,
    parse_tuned,
)
from dscp_core.tuning.space import SearchSpace

PROBLEM = problems.get("powered_descent")


def test_list_of_every_kind() -> None:
    text = "trust_region_state.mass, thrust_max=6e5:9e5@7e5,virtual_control_weight,network"
    mass, thrust, virtual, network = parse_tuned(PROBLEM, text)
    assert mass == TunedParameter(
        "trust_region_state", 6, 0.0, math.inf, None, "trust_region_state.mass"
    )
    assert thrust == TunedParameter("thrust_max", None, 6e5, 9e5, 7e5, "thrust_max")
    assert (virtual.component, virtual.upper) == (None, math.inf)
    assert network.is_network


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "one or more of"),
        ("thrust_max=1e5", "NAME"),
        ("thrust_mx=6e5:9e5", "did you mean thrust_max"),
        ("netwrok", "did you mean network"),
        ("network=1:2", "without bounds"),
        ("thrust_max", "thrust_max=LOWER:UPPER"),
        ("thrust_max=9e5:6e5", "LOWER < UPPER"),
        ("thrust_max=0.1:9e5", "within"),
        ("thrust_max=6e5:nan", "finite"),
        ("thrust_max=low:9e5", "a number"),
        ("thrust_max=6e5:9e5@1e6", "start of thrust_max"),
        ("thrust_max.0=6e5:9e5", "scalar"),
        ("final_position.3=0:1", "one of 0, 1, 2"),
        ("trust_region_state.mas", "one of mass"),
        ("trust_region_control@0", "> 0"),
        ("trust_region_control=0:1", "> 0, a weight"),
        ("trust_region_control,trust_region_control.thrust_x", "named once"),
        ("initial_mass=3e4:4e4", "come from the logs"),
    ],
)
def test_bad_lists(text: str, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        parse_tuned(PROBLEM, text)


def test_bounds_that_contradict_each_other() -> None:
    apart = parse_tuned(PROBLEM, "thrust_min=1e5:2e5,thrust_max=6e5:9e5")
    check_corners(PROBLEM, apart, {})
    crossing = parse_tuned(PROBLEM, "thrust_min=1e5:7e5,thrust_max=6e5:9e5")
    with pytest.raises(InvalidInputError, match="bounds of thrust_min and thrust_max"):
        check_corners(PROBLEM, crossing, {})


def space(text: str) -> SearchSpace:
    return SearchSpace(PROBLEM, parse_tuned(PROBLEM, text), PROBLEM.pack())


def test_starts_are_the_present_values() -> None:
    found = space("thrust_max=6e5:9e5,thrust_prox=1e-10:1e-4,virtual_control_weight,network")
    assert found.labels == ("thrust_max", "thrust_prox", "virtual_control_weight")
    np.testing.assert_allclose(found.packed(found.start()), PROBLEM.pack(), rtol=1e-14)
    assert found.notes == ()


def test_weight_that_is_zero_starts_elsewhere_and_says_so() -> None:
    found = space("trust_region_control,trust_region_state.mass=1e-4:1e-2,trust_region_step@3")
    values = found.values(found.start())
    assert values["trust_region_control.thrust_y"] == pytest.approx(DEFAULT_WEIGHT_START)
    assert values["trust_region_state.mass"] == pytest.approx(1e-3)  # the middle of its bounds
    assert values["trust_region_step"] == pytest.approx(3.0)
    assert len(found.notes) == 5
    assert "trust_region_step is 0 now and tuned from 3" in found.notes


def test_present_value_outside_the_bounds() -> None:
    with pytest.raises(InvalidInputError, match="thrust_max@START"):
        space("thrust_max=6e5:8e5")


def test_values_stay_within_bounds_wherever_the_search_goes() -> None:
    found = space("thrust_max=6e5:9e5,thrust_prox=1e-10:1e-4,trust_region_step")
    rng = np.random.default_rng(1)
    for point in rng.normal(scale=20.0, size=(200, 3)):
        values = found.values(point)
        assert 6e5 <= values["thrust_max"] <= 9e5
        assert 1e-10 <= values["thrust_prox"] <= 1e-4
        assert values["trust_region_step"] > 0.0


def test_start_at_a_bound_can_move() -> None:
    found = space("thrust_max=6e5:845.2e3")
    slope = found.pull(found.start(), np.ones(PROBLEM.table.size))[0]
    assert slope > 1e-3 * (845.2e3 - 6e5)
    assert found.values(found.start())["thrust_max"] == pytest.approx(845.2e3, rel=1e-3)


def test_chain_rule_of_every_kind_of_coordinate() -> None:
    found = space("thrust_max=6e5:9e5,thrust_prox=1e-10:1e-4,trust_region_control")
    rng = np.random.default_rng(2)
    weights = rng.normal(size=PROBLEM.table.size)
    point = rng.normal(size=found.size)
    gradient = found.pull(point, weights)
    for number in range(found.size):
        direction = np.eye(found.size)[number]

        def value(size: float, direction: np.ndarray = direction) -> float:
            # Without the other entries, whose size would hide the change.
            moved, at = found.packed(point + size * direction), found.packed(point)
            finite = np.isfinite(at)
            return float(weights[finite] @ (moved - at)[finite])

        # The functions are smooth; fourth order with a step of 1e-3 leaves 1e-12, and rounding
        # of the large parameters 1e-10.
        assert gradient[number] == pytest.approx(difference(value, 1e-3), rel=1e-8)
