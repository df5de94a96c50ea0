"""A planned trajectory, as data: what figures, scenes and messages of a problem are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """A trajectory in SI; rows are nodes.

    Attributes:
        problem: Name of the problem.
        state_names: Names of the nx states.
        control_names: Names of the nu controls.
        control_states: Index of the state that each control acts on.
        times_s: (N+1,) from the initial state.
        states: (N+1, nx).
        controls: (N+1, nu).
        state_rates: (N+1, nx) time derivative of the states under the nodal controls.
        terminal_time_s: Flight time.

    Example:
        >>> from dscp_core import Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> plan = planner.plan().plan
        >>> plan.states.shape, plan.controls.shape, plan.control_names
        ((51, 7), (51, 3), ('thrust_x', 'thrust_y', 'thrust_z'))
    """

    problem: str
    state_names: tuple[str, ...]
    control_names: tuple[str, ...]
    control_states: tuple[int, ...]
    times_s: Array
    states: Array
    controls: Array
    state_rates: Array
    terminal_time_s: float
