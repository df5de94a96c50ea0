"""What the costs of a declaration are, found out by evaluating their derivatives at some points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.convexity import NotConvexError, require_convex
from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import (
    TERMINAL_TIME,
    OptimalControlProblem,
    StagePoint,
    Where,
    named,
)
from dscp_core.problem.tracing import Tracer

Array = NDArray[np.float64]

_POINTS = 3
_ATTEMPTS = 24
_DEVIATION = 0.1  # of a point from the guess, in units of the scales
_ZERO = 1e-9
_EQUAL = 1e-6


class CostForm(Enum):
    """What a subproblem minimises of a true cost.

    NONE: There is no such cost. DECLARED: The cost terms that model it. EXACT: The cost itself,
    which is at most quadratic, and convex at the default parameters. CONVEXIFIED: Its second-order
    expansion at the reference, made convex where it is not.
    """

    NONE = "none"
    DECLARED = "declared cost terms"
    EXACT = "exact"
    CONVEXIFIED = "second-order expansion, convexified"


@dataclass(frozen=True)
class CostAnalysis:
    """What was found out.

    Attributes:
        running: Form of the running cost.
        terminal: Form of the terminal cost.
        models: Names of the cost terms that model the running cost.
        where: Where the running cost is summed.
    """

    running: CostForm
    terminal: CostForm
    models: frozenset[str]
    where: Where


@dataclass(frozen=True)
class _Samples:
    """Derivatives at several points (x, u, T), in scaled units.

    Attributes:
        terms: (points, terms, nx + nu + 1) gradient of every cost term at its own reference.
        elsewhere: The same away from the reference.
        running: (points, nx + nu + 1) gradient of T times the running cost.
        terminal: (points, nx + nu + 1) gradient of the terminal cost.
        held: (points, nu) second derivatives of all terms by the controls.
        running_hessians: (nx + nu, nx + nu) of the running cost at every point.
        terminal_hessians: (nx + 1, nx + 1) of the terminal cost by state and T.
    """

    terms: Array
    elsewhere: Array
    running: Array
    terminal: Array
    held: Array
    running_hessians: list[Array]
    terminal_hessians: list[Array]


def analyse(
    problem: OptimalControlProblem,
    intervals: int,
    guess: Callable[[Array], tuple[Array, Array]],
    *,
    free: bool,
) -> CostAnalysis:
    """Find out what the costs are.

    Args:
        problem: The declaration.
        intervals: Number N.
        guess: States (N+1, nx) and controls (N+1, nu) of the initial guess, SI, by parameters.
        free: Whether the terminal time is a decision: then the interval length is one too.

    Raises:
        InvalidInputError: Cost terms that are no model of the running cost, or no cost at all and
            nothing else that fixes the controls.
    """
    symbolic = _Symbolic(problem, intervals)
    samples = symbolic.sample(guess)
    decided = slice(None) if free else slice(-1)
    found = np.abs(samples.terms[:, :, decided]).max(axis=2)
    sizes = np.maximum(np.abs(samples.elsewhere[:, :, decided]).max(axis=2), found)
    steep = (found > _ZERO * sizes).any(axis=0)
    models = [term for term, is_steep in zip(problem.cost_terms, steep, strict=True) if is_steep]
    running = CostForm.DECLARED
    if models:
        gradients = samples.terms.sum(axis=1)[:, decided], samples.running[:, decided]
        _require_model(problem, [m.name for m in models], *gradients)
    elif problem.running_cost is None:
        running = CostForm.NONE
    else:
        running = _form(symbolic.running_is_quadratic, samples.running_hessians)
    terminal = CostForm.NONE
    if problem.terminal_cost is not None:
        terminal = _form(symbolic.terminal_is_quadratic, samples.terminal_hessians)
    if not models and not samples.running.any() and not samples.terminal.any():
        _require_held(problem, samples)
    places = {term.where for term in models} or {Where.NODE}
    if len(places) > 1:
        bound = "those of the running cost all at nodes, or all at interval means"
        raise InvalidInputError("cost_terms", [m.name for m in models], bound)
    return CostAnalysis(running, terminal, frozenset(m.name for m in models), places.pop())


def _form(is_quadratic: bool, hessians: list[Array]) -> CostForm:
    if not is_quadratic:
        return CostForm.CONVEXIFIED
    try:
        for hessian in hessians:
            require_convex("", hessian)
    except NotConvexError:
        return CostForm.CONVEXIFIED
    return CostForm.EXACT


def _require_model(
    problem: OptimalControlProblem, names: list[str], found: Array, running: Array
) -> None:
    """Refuse cost terms whose gradients at their references are not those of the running cost."""
    size = max(float(np.abs(found).max()), float(np.abs(running).max()))
    off = np.abs(found - running)
    if float(off.max()) <= _EQUAL * size:
        return
    point, index = np.unravel_index(int(np.argmax(off)), off.shape)
    expected = "0: no running_cost is declared"
    if problem.running_cost is not None:
        expected = f"that of T times the running_cost, {running[point, index]:.6g}"
    along = [v.name for v in (*problem.states, *problem.controls)]
    component = along[index] if index < len(along) else "the interval length"
    raise InvalidInputError(
        f"cost_terms {', '.join(names)}",
        f"gradient {found[point, index]:.6g} along {component} at the reference",
        expected,
    )


def _require_held(problem: OptimalControlProblem, samples: _Samples) -> None:
    """Refuse a problem without a cost where a control has no curvature from anything else."""
    weights = problem.trust_region_control or (0.0,) * len(problem.controls)
    for control, weight, curvature in zip(
        problem.controls, weights, samples.held.min(axis=0), strict=True
    ):
        if weight == 0.0 and curvature <= 0.0:
            raise InvalidInputError(
                "terminal_cost, running_cost and cost_terms",
                "no cost at all",
                f"one of them, or trust_region_control > 0 for {control.name}: without, any "
                "feasible controls solve a subproblem",
            )


class _Symbolic:
    """Derivatives of the costs as functions of a point, its reference and the parameters.

    Attributes:
        running_is_quadratic: Whether the running cost's Hessian is the same at every point.
        terminal_is_quadratic: Whether the terminal cost's is.
    """

    def __init__(self, problem: OptimalControlProblem, intervals: int) -> None:
        self._problem = problem
        nx, nu = len(problem.states), len(problem.controls)
        step = float(np.ravel(problem.table[TERMINAL_TIME].default)[0]) / intervals
        self._scale = np.array([*(v.scale for v in (*problem.states, *problem.controls)), step])
        size = self._scale.size
        at, reference = ca.SX.sym("at", size), ca.SX.sym("reference", size)
        packed = ca.SX.sym("p", problem.table.size)
        p = named(problem, packed)
        trace = Tracer(problem.table, at, reference, packed)
        here, there = (
            StagePoint(v[:nx], v[nx:-1], v[-1])
            for v in (ca.DM(self._scale) * at, ca.DM(self._scale) * reference)
        )
        terms = [
            trace(f"cost term {t.name}", t.expression, here, there, p) for t in problem.cost_terms
        ]
        running = terminal = ca.SX(0)
        if problem.running_cost is not None:
            running = trace("running_cost", problem.running_cost, here.x, here.u, p)
        if problem.terminal_cost is not None:
            time = here.step * intervals
            terminal = trace("terminal_cost", problem.terminal_cost, here.x, time, p)
        costs = [*terms, here.step * running, terminal]
        self._names = [f"cost term {t.name}" for t in problem.cost_terms]
        self._names += ["running_cost", "terminal_cost"]
        gradients = [ca.gradient(cost / problem.cost_scale, at) for cost in costs]
        along = sum(gradients[:-2], ca.SX(size, 1))
        held = ca.vertcat(*(ca.jacobian(along[i], at[i]) for i in range(nx, nx + nu)))
        hessians = [ca.hessian(cost, at)[0] for cost in (running, terminal)]
        self.running_is_quadratic, self.terminal_is_quadratic = (
            not ca.depends_on(hessian, at) for hessian in hessians
        )
        self._function = ca.Function(
            "costs", [at, reference, packed], [ca.horzcat(*gradients), held, *hessians]
        )

    def sample(self, guess: Callable[[Array], tuple[Array, Array]]) -> _Samples:
        """Derivatives near the initial guess, at the default parameters and near them.

        Raises:
            InvalidInputError: They are not finite at any point that was tried.
        """
        random = np.random.default_rng(0)
        parameters = self._problem.pack()
        nodes = np.hstack([*guess(parameters)])
        nodes = np.hstack([nodes, np.full((len(nodes), 1), self._scale[-1])]) / self._scale
        if not np.all(np.isfinite(nodes)):
            nodes = np.ones_like(nodes)  # the guess itself is refused where it is used
        found: list[tuple[list[Array], list[Array]]] = []
        unusable = ""
        for _ in range(_ATTEMPTS):
            reference = nodes[random.integers(len(nodes))] * (
                1.0 + _DEVIATION * random.uniform(-1.0, 1.0, nodes.shape[1])
            )
            reference += _DEVIATION * random.uniform(-1.0, 1.0, nodes.shape[1])
            away = reference + _DEVIATION * random.uniform(-1.0, 1.0, nodes.shape[1])
            pair = [self._at(at, reference, parameters) for at in (reference, away)]
            finite = np.all(np.isfinite(np.vstack([pair[0][0], pair[1][0]])), axis=0)
            finite[-2:] &= np.array([np.isfinite(h).all() for h in pair[0][2:]])
            if finite.all():
                found.append((pair[0], pair[1]))
                parameters = self._near(random)
            else:
                unusable = self._names[int(np.argmin(finite))]
            if len(found) == _POINTS:
                break
        else:
            if not found:
                bound = f"finite at one of {_ATTEMPTS} points near the initial guess"
                raise InvalidInputError(unusable, "a derivative that is not", bound)
        gradients = np.array([here[0].T for here, _ in found])
        return _Samples(
            terms=gradients[:, :-2],
            elsewhere=np.array([there[0].T for _, there in found])[:, :-2],
            running=gradients[:, -2],
            terminal=gradients[:, -1],
            held=np.array([here[1].ravel() for here, _ in found]),
            running_hessians=[here[2] for here, _ in found],
            terminal_hessians=[here[3] for here, _ in found],
        )

    def _at(self, at: Array, reference: Array, parameters: Array) -> list[Array]:
        return [ca.DM(part).full() for part in self._function(at, reference, parameters)]

    def _near(self, random: np.random.Generator) -> Array:
        """Parameters near the defaults, none of them zero where that is allowed."""
        table = self._problem.table
        values = {}
        for parameter in table.parameters:
            default = np.atleast_1d(np.asarray(parameter.default, dtype=np.float64))
            size = np.where(default == 0.0, 1.0, np.abs(default))
            moved = default + _DEVIATION * size * random.uniform(0.1, 1.0, default.size)
            values[parameter.name] = np.clip(moved, parameter.lower, parameter.upper)
        return np.concatenate([values[name] for name in table.names])
