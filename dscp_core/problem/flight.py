"""How planned controls are flown between the nodes, and how a subproblem sees that flight."""

from __future__ import annotations

from enum import Enum


class ControlHold(Enum):
    """How the planned controls are flown between nodes.

    MEAN: constant over each interval at the mean of its two nodes, which is what the midpoint
    rule assumes. LINEAR: linear between the nodes.
    """

    MEAN = "mean"
    LINEAR = "linear"
