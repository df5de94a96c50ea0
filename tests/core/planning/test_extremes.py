from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from dscp_core.planning.extremes import Piece, first_rise, highest, peak_bounds

Array = NDArray[np.float64]
Curve = tuple[Callable[[float], float], Callable[[float], float]]


def piece(curve: Curve, start: float, end: float) -> Piece:
    value, rate = curve
    return Piece(start, end, (value(start), rate(start)), (value(end), rate(end)))


def pairs(curve: Curve) -> Callable[[float], tuple[float, float]]:
    return lambda at: (curve[0](at), curve[1](at))


def narrow(centre: float, width: float) -> Curve:
    """A hill 1 high over straight slopes of 1, its top rounded over a width."""

    def size(at: float) -> float:
        return math.hypot(at - centre, width)

    return (lambda at: 1.0 + width - size(at), lambda at: -(at - centre) / size(at))


@pytest.mark.parametrize("width", [1e-3, 0.1, 1.0])
def test_a_narrow_peak_between_points_is_found(width: float) -> None:
    curve = narrow(3.3, width)
    around = piece(curve, 0.0, 8.0)
    assert around.bound >= 1.0
    top, at, which = highest(
        [(around, pairs(curve))], max(around.low[0], around.high[0]), lambda _: 1e-6
    )
    assert which == 0
    assert top == pytest.approx(1.0, abs=1e-6)
    assert top >= 1.0 - 1e-15  # from above
    assert at == pytest.approx(3.3, abs=math.sqrt(2e-6 * width) + 1e-6)


def test_the_higher_of_two_peaks() -> None:
    low, high = narrow(1.0, 0.3), narrow(2.0, 0.3)
    raised: Curve = (lambda at: high[0](at) + 0.1, high[1])
    pieces = [(piece(c, 0.0, 3.0), pairs(c)) for c in (low, raised, low)]
    top, at, which = highest(pieces, -10.0, lambda _: 1e-9)
    assert (which, top) == (1, pytest.approx(1.1, abs=1e-9))
    assert at == pytest.approx(2.0, abs=1e-3)


def test_no_evaluation_where_the_ends_say_enough() -> None:
    def never(at: float) -> tuple[float, float]:
        raise AssertionError("not needed")

    rising = Piece(0.0, 1.0, (0.0, 1.0), (1.0, 1.0))
    constant = Piece(0.0, 1.0, (1.0, 0.0), (1.0, 0.0))
    assert highest([(rising, never), (constant, never)], 1.0, lambda _: 0.0) == (
        1.0,
        pytest.approx(np.nan, nan_ok=True),
        -1,
    )


def test_a_wave_between_rising_ends_is_seen() -> None:
    # Both slopes are positive, and still there is a peak between them.
    curve: Curve = (lambda at: math.sin(at) + 0.01 * at, lambda at: math.cos(at) + 0.01)
    wave = piece(curve, 0.0, 2.0 * math.pi)
    top, at, _ = highest([(wave, pairs(curve))], max(wave.low[0], wave.high[0]), lambda _: 1e-6)
    assert at == pytest.approx(math.acos(-0.01), abs=1e-2)
    assert top == pytest.approx(curve[0](math.acos(-0.01)), abs=2e-6)


def test_bounds_of_arrays_are_those_of_pieces() -> None:
    rng = np.random.default_rng(3)
    low, high, low_rate, high_rate = rng.standard_normal((4, 1000))
    lengths = rng.uniform(0.1, 2.0, 1000)
    low_rate[::10] = high_rate[::10] = 0.0
    found = peak_bounds(low, high, low_rate, high_rate, lengths)
    singly = [
        Piece(0.0, h, (a, c), (b, d)).bound
        for a, b, c, d, h in zip(low, high, low_rate, high_rate, lengths, strict=True)
    ]
    np.testing.assert_allclose(found, singly, rtol=1e-12)
    # No cubic through the same ends is higher.
    shares = np.linspace(0.0, 1.0, 101)[:, None]
    d0, d1, rise = low_rate * lengths, high_rate * lengths, high - low
    cubic = low + shares * (d0 + shares * (3 * rise - 2 * d0 - d1 + shares * (d0 + d1 - 2 * rise)))
    assert np.all(cubic.max(axis=0) <= found + 1e-9)


@pytest.mark.parametrize(("start", "acceleration"), [(-5.0, 9.8), (-1e-7, 1e-6), (-1.0, 0.0)])
def test_a_zero_is_found_to_rounding(start: float, acceleration: float) -> None:
    curve: Curve = (
        lambda at: start + 0.5 * at + acceleration / 2 * at**2 + 0.1 * math.sin(at),
        lambda at: 0.5 + acceleration * at + 0.1 * math.cos(at),
    )
    at = first_rise(piece(curve, 0.0, 3.0), pairs(curve), 1e-12)
    assert abs(curve[0](at)) < 1e-10


def test_a_tangential_zero_is_found() -> None:
    # As a landing at rest: the value and its rate vanish together.
    curve: Curve = (lambda at: -6.0 * (1.0 - at) ** 2 + 1e-9, lambda at: 12.0 * (1.0 - at))
    at = first_rise(piece(curve, 0.0, 1.0), pairs(curve), 1e-12)
    assert at == pytest.approx(1.0 - math.sqrt(1e-9 / 6.0), abs=1e-9)
