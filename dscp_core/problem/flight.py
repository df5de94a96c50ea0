"""How planned controls are flown between the nodes, and how a subproblem sees that flight."""

from __future__ import annotations

from enum import Enum


class ControlHold(Enum):
    """How the planned controls are flown between nodes.

    MEAN: constant over each interval at the mean of its two nodes, which is what the midpoint
    rule assumes. LINEAR: linear between the nodes.

    Example:
        >>> from dscp_core import ControlHold, Planner, problems
        >>> planner = Planner(problems.get("powered_descent"), hold=ControlHold.LINEAR)
        >>> planner.plan().certificate.hold.value
        'linear'
    """

    MEAN = "mean"
    LINEAR = "linear"


class Discretisation(Enum):
    """What the dynamics of a subproblem's intervals are.

    PROPAGATED: every interval is integrated from its first node under the declared hold, so that
    a converged plan flies as planned. MIDPOINT: the paper's rule (eq. ch2-disdy), whose plans miss
    by its error when they are flown.

    Example:
        >>> from dscp_core import Discretisation, PlannerSettings
        >>> PlannerSettings().discretisation is Discretisation.PROPAGATED
        True
    """

    PROPAGATED = "propagated"
    MIDPOINT = "midpoint"
