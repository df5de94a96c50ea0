"""Peaks and zeros of smooth functions between points where value and rate are known."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Evaluate = Callable[[float], tuple[float, float]]
"""Value and rate at a time after the start of a piece."""

_MOST_EVALUATIONS = 200


@dataclass(frozen=True)
class Piece:
    """A function between two times, with its value and rate at both.

    Attributes:
        start: First time.
        end: Last time.
        low: Value and rate at the first.
        high: At the last.
    """

    start: float
    end: float
    low: tuple[float, float]
    high: tuple[float, float]

    @property
    def bound(self) -> float:
        """Upper estimate of the largest value, as `peak_bounds` has it."""
        (low, low_rate), (high, high_rate) = self.low, self.high
        length = self.end - self.start
        most = max(low, high, low + low_rate * length / 3.0, high - high_rate * length / 3.0)
        if not low_rate > 0.0 > high_rate:
            return most
        meet = (high - low - high_rate * length) / (low_rate - high_rate)
        return max(most, low + low_rate * min(max(meet, 0.0), length))

    @property
    def middle(self) -> float:
        """Where to look: the largest value of the cubic through both ends, away from them."""
        length = self.end - self.start
        d0, d1 = self.low[1] * length, self.high[1] * length
        rise = self.high[0] - self.low[0]
        # The cubic's slope: d0 + 2 b s + 3 a s^2.
        a, b = d0 + d1 - 2.0 * rise, 3.0 * rise - 2.0 * d0 - d1
        share = 0.5
        root = b * b - 3.0 * a * d0
        if root >= 0.0:
            below = b - np.sqrt(root) if b < 0.0 else b + np.sqrt(root)
            shares = [-below / (3.0 * a)] if a else []
            shares += [-d0 / below] if below else []
            # A maximum has a falling slope.
            peaks = [s for s in shares if 0.0 < s < 1.0 and 2.0 * b + 6.0 * a * s <= 0.0]
            share = peaks[0] if peaks else 0.5
        return self.start + length * min(max(share, 0.01), 0.99)

    def split(self, at: float, found: tuple[float, float]) -> tuple[Piece, Piece]:
        """Both parts."""
        return (
            Piece(self.start, at, self.low, found),
            Piece(at, self.end, found, self.high),
        )


def peak_bounds(
    low: Array, high: Array, low_rate: Array, high_rate: Array, lengths: Array | float
) -> Array:
    """Upper estimates of the largest values between two points, elementwise.

    Those of the cubic through both ends, by its Bezier points; and where the function rises first
    and falls last, where the tangents of both ends meet: an upper bound if it is concave.
    """
    steps = (low_rate * lengths, high_rate * lengths)
    most = np.maximum(
        np.maximum(low, low + steps[0] / 3.0), np.maximum(high, high - steps[1] / 3.0)
    )
    with np.errstate(all="ignore"):
        meet = (high - low - steps[1]) / (steps[0] - steps[1])
        tangent = low + steps[0] * np.minimum(np.maximum(meet, 0.0), 1.0)
    turning = (low_rate > 0.0) & (high_rate < 0.0)
    return np.where(turning, np.maximum(tangent, most), most)


def highest(
    pieces: list[tuple[Piece, Evaluate]],
    best: float,
    resolution: Callable[[float], float],
    enough: float = np.inf,
) -> tuple[float, float, int]:
    """Upper estimate of the largest value in some pieces, where it is, and in which.

    Args:
        pieces: Where to look, each with its function.
        best: Largest value known elsewhere.
        resolution: By how much the estimate may be above a value that was evaluated.
        enough: A value with which the search may end.

    Returns:
        The estimate, its time, and the piece's number; -1 where ``best`` is not exceeded.
    """
    numbers = itertools.count()  # so that pieces are never compared
    heap = [(-piece.bound, next(numbers), k, piece) for k, (piece, _) in enumerate(pieces)]
    heapq.heapify(heap)
    found, when, where = best, np.nan, -1
    for _ in range(_MOST_EVALUATIONS):
        if not heap or -heap[0][0] <= found + resolution(found) or found >= enough:
            break
        _, _, origin, piece = heapq.heappop(heap)
        at = piece.middle
        value, rate = pieces[origin][1](at)
        if value > found:
            found, when, where = value, at, origin
        for part in piece.split(at, (value, rate)):
            heapq.heappush(heap, (-part.bound, next(numbers), origin, part))
    left = -heap[0][0] if heap else found
    return max(found, min(left, enough)), when, where


def first_rise(piece: Piece, evaluate: Evaluate, resolution_s: float) -> float:
    """Time at which a function that is negative at the start and not at the end reaches zero."""
    at = piece.end
    for _ in range(_MOST_EVALUATIONS):
        before, at = at, _cubic_zero(piece)
        value, rate = evaluate(at)
        head, tail = piece.split(at, (value, rate))
        piece = head if value >= 0.0 else tail
        if abs(at - before) <= resolution_s or piece.end - piece.start <= resolution_s:
            break
    return at


def _cubic_zero(piece: Piece) -> float:
    """Zero of the cubic through both ends, by bisection: strictly between them."""
    length = piece.end - piece.start
    d0, d1 = piece.low[1] * length, piece.high[1] * length
    y0, rise = piece.low[0], piece.high[0] - piece.low[0]
    a, b = d0 + d1 - 2.0 * rise, 3.0 * rise - 2.0 * d0 - d1
    low, high = 0.0, 1.0
    for _ in range(48):
        share = 0.5 * (low + high)
        if y0 + share * (d0 + share * (b + share * a)) < 0.0:
            low = share
        else:
            high = share
    return piece.start + length * min(max(0.5 * (low + high), 1e-9), 1.0 - 1e-9)
