"""The optimum by a nonlinear solver, to check labels against.

The same declaration of the problem and the same midpoint rule, but nothing linearised and another
algorithm: IPOPT on the whole nonlinear program.
"""

from __future__ import annotations

import itertools
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.declaration import (
    TERMINAL_TIME,
    ConeConstraint,
    Constraint,
    OptimalControlProblem,
    StagePoint,
    Where,
    named,
)
from dscp_core.problem.flight import ControlHold
from dscp_core.transcription.imposed import held, imposed
from dscp_core.transcription.layout import TrajectoryLayout
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

_OPTIONS: dict[str, Any] = {
    "tol": 1e-11,
    "acceptable_tol": 1e-11,
    "constr_viol_tol": 1e-9,
    "compl_inf_tol": 1e-9,
    "dual_inf_tol": 1e-9,
    "bound_relax_factor": 0.0,
    "nlp_scaling_method": "none",
    "max_iter": 300,
    "print_level": 0,
    "sb": "yes",
}
_SHAKE = 0.01
_STARTS = 4


class NonlinearProgram:
    """The problem with free terminal time as one nonlinear program."""

    def __init__(self, problem: OptimalControlProblem, intervals: int, parameters: Array) -> None:
        """Build the solver.

        Args:
            problem: Its declaration.
            intervals: Number of intervals, over which controls are held at their means.
            parameters: Packed, SI; what has no bound with these is left out.
        """
        problem = held(imposed(problem, parameters), ControlHold.MEAN)
        self._transcription = Transcription(problem, intervals, free_terminal_time=True)
        layout = self._transcription.layout
        z = ca.SX.sym("z", layout.reference_size)
        packed = ca.SX.sym("p", problem.table.size)
        p = named(problem, packed)
        points = _points(layout, z)
        means = [
            StagePoint((a.x + b.x) / 2, (a.u + b.u) / 2, a.step)
            for a, b in itertools.pairwise(points)
        ]
        equalities = [(points[0].x - problem.initial_state(p)) / layout.state_scale]
        for (a, b), mean in zip(itertools.pairwise(points), means, strict=True):
            defect = b.x - a.x - mean.step * problem.dynamics(mean.x, mean.u, p)
            equalities.append(defect / layout.state_scale)
        names = [state.name for state in problem.states]
        for name, value in problem.final_state.items():
            index = names.index(name)
            equalities.append((points[-1].x[index] - value(p)) / layout.state_scale[index])
        inequalities = []
        for constraint in (*problem.path_constraints, *problem.cone_constraints):
            places = points if constraint.where is Where.NODE else means
            for place in constraint.places(len(places)):
                inequalities += _inequalities(constraint, places[place], p)
        cost = self._transcription.cost_function(z, packed)
        equal, unequal = ca.vertcat(*equalities), ca.vertcat(*inequalities)
        self._bounds = {
            "lbg": np.concatenate([np.zeros(equal.numel()), np.full(unequal.numel(), -np.inf)]),
            "ubg": np.zeros(equal.numel() + unequal.numel()),
        }
        self._solver = ca.nlpsol(
            "optimum",
            "ipopt",
            {"x": z, "p": packed, "f": cost / 1e4, "g": ca.vertcat(equal, unequal)},
            {"ipopt": _OPTIONS, "print_time": False, "error_on_fail": False},
        )

    def best_time(self, parameters: Array) -> tuple[float, float] | None:
        """Optimal terminal time in seconds and final value of the last state.

        Args:
            parameters: Packed, SI; the terminal time among them is the first guess.

        Returns:
            None when IPOPT found no optimum.
        """
        layout = self._transcription.layout
        guess = self._transcription.initial_guess(parameters)
        guess[0] = parameters[self._transcription.table.slice(TERMINAL_TIME)][0] / layout.time_scale
        for seed in range(_STARTS):
            # A guess in a plane of symmetry would never leave it.
            noise = np.random.default_rng(seed).standard_normal(guess.size)
            noise[0] = 0.0
            found = self._solver(x0=guess + _SHAKE * noise, p=parameters, **self._bounds)
            if self._solver.stats()["return_status"] == "Solve_Succeeded":
                z = np.array(found["x"]).ravel()
                return float(z[0] * layout.time_scale), float(layout.states(z)[-1, -1])
        return None


def _points(layout: TrajectoryLayout, z: ca.SX) -> list[StagePoint]:
    step = z[0] * layout.time_scale / layout.intervals
    points = []
    for node in range(layout.intervals + 1):
        x = layout.state_index(node, 0)
        u = layout.control_index(node, 0)
        points.append(
            StagePoint(
                z[x : x + layout.nx] * layout.state_scale,
                z[u : u + layout.nu] * layout.control_scale,
                step,
            )
        )
    return points


def _inequalities(constraint: Constraint, place: StagePoint, p: dict[str, ca.SX]) -> list[ca.SX]:
    """Expressions that are at most zero."""
    value = constraint.expression(place, p) / constraint.scale
    if not isinstance(constraint, ConeConstraint):
        return [value]
    # Squared, the cone is smooth at its apex; the square needs the sign of its axis.
    return [ca.sumsqr(value[1:]) - value[0] ** 2, -value[0]]
