"""Initial states to learn from and to test on."""

from __future__ import annotations

import numpy as np
import pytest

from dscp_core.errors import InvalidInputError
from dscp_core.learning.sampling import (
    PAPER_BOX,
    Mixture,
    StateBox,
    horizontal_profile,
    vertical_profile,
)


def test_the_papers_box() -> None:
    lower, upper = PAPER_BOX.bounds()
    np.testing.assert_array_equal(lower, [5000, -600, -600, -150, -30, -30, 38000])
    np.testing.assert_array_equal(upper, [5400, 600, 600, -120, 30, 30, 38000])
    lower, upper = PAPER_BOX.widened(0.1).bounds(1e-3)
    np.testing.assert_allclose(lower, [4980, -660, -660, -151.5, -33, -33, 37962])
    np.testing.assert_allclose(upper, [5420, 660, 660, -118.5, 33, 33, 38038])


@pytest.mark.parametrize("edges", [0.0, 0.3, 1.0])
def test_samples_lie_in_the_box_and_depend_on_the_seed_only(edges: float) -> None:
    first, again, other = (
        PAPER_BOX.spread(300, np.random.default_rng(seed), edges=edges) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    lower, upper = PAPER_BOX.bounds()
    assert first.shape == (300, 7)
    assert np.all((first >= lower) & (first <= upper))


def test_spread_is_even() -> None:
    states = PAPER_BOX.spread(1024, np.random.default_rng(0))
    lower, upper = PAPER_BOX.bounds()
    shares = (states[:, :6] - lower[:6]) / (upper - lower)[:6]
    for column in shares.T:
        # A Sobol sequence puts 64 of 1024 points into every 16th; random ones +- 8.
        counts = np.histogram(column, bins=16, range=(0.0, 1.0))[0]
        assert np.all(np.abs(counts - 64) <= 2)


def test_edges_are_faces_and_the_vertical_axis() -> None:
    states = PAPER_BOX.spread(4000, np.random.default_rng(0), edges=0.5)
    on_axis = np.all(states[:, 4:6] == 0.0, axis=1)
    on_face = np.abs(states[:, 3] + 135.0) == 15.0
    # Half of the states, of which a quarter and a half: 500 and 1000, within five deviations.
    assert 380 <= np.count_nonzero(on_axis) <= 620
    assert 850 <= np.count_nonzero(on_face) <= 1150
    assert not np.any(np.isnan(states))


def test_training_states_are_where_the_mixture_puts_them() -> None:
    mixture = Mixture(outbound=0.3, slow=0.2)
    states = PAPER_BOX.training(2000, np.random.default_rng(0), mixture)
    lower, upper = PAPER_BOX.bounds()
    assert states.shape == (2000, 7)
    assert np.all((states >= lower) & (states <= upper))
    assert len(np.unique(states, axis=0)) == 2000
    still = np.count_nonzero(np.all(states[:, 4:6] == 0.0, axis=1))
    assert 150 <= still <= 250, "half of the slow ones, within five deviations"
    outwards = np.sum(states[:, 1:3] * states[:, 4:6], axis=1) > 8000.0
    even = PAPER_BOX.training(2000, np.random.default_rng(0), Mixture())
    share = np.count_nonzero(np.sum(even[:, 1:3] * even[:, 4:6], axis=1) > 8000.0) / 2000
    # 600 of them, and the share of the box in the 1000 even ones, within five deviations.
    assert np.count_nonzero(outwards) == pytest.approx(600 + 1000 * share, abs=60)
    with pytest.raises(InvalidInputError, match="outbound"):
        Mixture(outbound=0.7, slow=0.7)


def test_profiles() -> None:
    vertical, horizontal = vertical_profile(3), horizontal_profile(5)
    assert vertical.shape == (9, 7)
    np.testing.assert_array_equal(vertical[1], [5000, 100, 100, -135, 0, 0, 38000])
    np.testing.assert_array_equal(vertical[-1], [5400, 100, 100, -120, 0, 0, 38000])
    assert horizontal.shape == (25, 7)
    np.testing.assert_array_equal(horizontal[0], [5200, -600, -600, -135, 0, 0, 38000])
    np.testing.assert_array_equal(horizontal[13], [5200, 0, 300, -135, 0, 0, 38000])


@pytest.mark.parametrize(
    "change", [{"center": (0.0,)}, {"half_width": (-1.0,) * 6}, {"center": (np.nan,) * 6}]
)
def test_bad_boxes(change: dict[str, tuple[float, ...]]) -> None:
    with pytest.raises(InvalidInputError):
        StateBox(**change)  # type: ignore[arg-type]
