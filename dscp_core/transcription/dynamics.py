"""Residual of the dynamics over one interval: propagated, or by the midpoint rule."""

from __future__ import annotations

import casadi as ca

from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.flight import ControlHold, Discretisation
from dscp_core.transcription.stage import Symbols

_STEPS = 4
"""Runge-Kutta steps per interval: at N = 50, landings of 7 to 512 s are off by less than 0.01 mm;
at N = 100, a global entry by 20 mm."""


def defect(
    problem: OptimalControlProblem,
    symbols: Symbols,
    discretisation: Discretisation,
    hold: ControlHold,
) -> ca.SX:
    """Second state minus where the interval leads from the first, (nx, 1), SI.

    Args:
        problem: The declaration.
        symbols: Of a stage with two nodes; the residual is that of its reference.
        discretisation: How the interval is integrated.
        hold: How the controls are flown; the midpoint rule knows only their mean.
    """
    first, second = symbols.nodes(symbols.reference)

    def rates(x: ca.SX, u: ca.SX) -> ca.SX:
        return symbols.trace(
            "dynamics", problem.dynamics, x, u, symbols.parameters, rows=len(problem.states)
        )

    if discretisation is Discretisation.MIDPOINT:
        mean = symbols.mean(symbols.reference)
        return second.x - first.x - mean.step * rates(mean.x, mean.u)

    def control(elapsed: float) -> ca.SX:
        """Control after this part of the interval."""
        if hold is ControlHold.MEAN:
            return (first.u + second.u) / 2
        return first.u + elapsed * (second.u - first.u)

    x, step = first.x, first.step / _STEPS
    for k in range(_STEPS):
        # Kutta's method of order 4.
        before, middle, after = (control((k + part) / _STEPS) for part in (0.0, 0.5, 1.0))
        slope_1 = rates(x, before)
        slope_2 = rates(x + step / 2 * slope_1, middle)
        slope_3 = rates(x + step / 2 * slope_2, middle)
        slope_4 = rates(x + step * slope_3, after)
        x = x + step / 6 * (slope_1 + 2 * slope_2 + 2 * slope_3 + slope_4)
    return second.x - x
