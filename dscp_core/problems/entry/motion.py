"""Steps of the declared entry dynamics, with the loads on the vehicle."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.declaration import OptimalControlProblem, named
from dscp_core.problems.entry.physics import (
    aerodynamic_accelerations,
    dynamic_pressure,
    heat_rate,
    load_factor,
)
from dscp_core.transcription.compiled import CompiledFunction

Array = NDArray[np.float64]

LIMITED = {
    "dynamic_pressure": dynamic_pressure,
    "heat_rate": heat_rate,
    "load_factor": load_factor,
}


class Motion:
    """One Runge-Kutta step (the classical one, of fourth order), for any vehicle."""

    def __init__(self, problem: OptimalControlProblem) -> None:
        """Compile the equations of motion."""
        x, u = ca.SX.sym("x", 8), ca.SX.sym("u", 2)
        p, step = ca.SX.sym("p", problem.table.size), ca.SX.sym("step")
        values = named(problem, p)
        rate = ca.Function("rate", [x, u, p], [problem.dynamics(x, u, values)])
        k1 = rate(x, u, p)
        k2 = rate(x + 0.5 * step * k1, u, p)
        k3 = rate(x + 0.5 * step * k2, u, p)
        k4 = rate(x + step * k3, u, p)
        after = x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        self._step = CompiledFunction("step", [x, u, p, step], [after])
        loads = ca.vertcat(*(function(x, values) for function in LIMITED.values()))
        aerodynamic = ca.vertcat(*aerodynamic_accelerations(x, values))
        self._loads = CompiledFunction("loads", [x, p], [loads, aerodynamic])

    def step(self, state: Array, rates: Array, parameters: Array, step_s: float) -> Array:
        """State (8,) after a while.

        Args:
            state: (8,).
            rates: (2,) of angle of attack and bank, held.
            parameters: Packed.
            step_s: How long.
        """
        return self._step(state, rates, parameters, np.array([step_s]))[0]

    def loads(self, state: Array, parameters: Array) -> Array:
        """What is limited, (3,), in the order of `LIMITED`."""
        return self._loads(state, parameters)[0]

    def aerodynamic(self, state: Array, parameters: Array) -> Array:
        """Lift and drag over mass, (2,), m/s^2."""
        return self._loads(state, parameters)[1]
