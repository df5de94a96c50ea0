"""What a subproblem minimises of a cost that the declaration gives as a true, nonlinear one."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.declaration import (
    OptimalControlProblem,
    Quadrature,
    StagePoint,
    Where,
)
from dscp_core.transcription.analysis import CostAnalysis, CostForm
from dscp_core.transcription.stage import Collector, Symbols

Array = NDArray[np.float64]

# With more coupled variables than this, the factorisation would take too many operations.
_MOST_COUPLED = 40
_TINY = 1e-30
# Least pivot, of the largest entry: what is left where a semidefinite matrix cancels is rounding.
_LEAST_PIVOT = 1e-12
# Share of a mean's curvature that is put on the controls' change from node to node.
_MEAN_PROX = 1e-4


def node_weights(quadrature: Quadrature, intervals: int) -> Array:
    """Weight (N+1,) of every node in a sum over the nodes, which T multiplies."""
    weights = np.ones(intervals + 1)
    if quadrature is Quadrature.TRAPEZOID:
        weights[[0, -1]] = 0.5
    return weights


def running_cost(problem: OptimalControlProblem, symbols: Symbols, point: StagePoint) -> ca.SX:
    """The declared running cost at a point, zero where there is none."""
    if problem.running_cost is None:
        return ca.SX(0)
    return symbols.trace("running_cost", problem.running_cost, point.x, point.u, symbols.parameters)


def terminal_cost(problem: OptimalControlProblem, symbols: Symbols, vector: ca.SX) -> ca.SX:
    """The declared terminal cost at a node's local vector, zero where there is none."""
    if problem.terminal_cost is None:
        return ca.SX(0)
    x, time = symbols.node(vector).x, symbols.terminal_time(vector)
    return symbols.trace("terminal_cost", problem.terminal_cost, x, time, symbols.parameters)


def add_running_cost(
    collect: Collector, problem: OptimalControlProblem, symbols: Symbols, form: CostForm
) -> None:
    """Add what a subproblem minimises of the running cost at a node."""
    decided, reference = symbols.node(symbols.decision), symbols.node(symbols.reference)
    here = running_cost(problem, symbols, reference)
    if form is CostForm.EXACT:
        there = running_cost(problem, symbols, decided)
    else:
        own = symbols.reference[symbols.offset :]
        there = expansion(here, own, symbols.decision[symbols.offset :] - own)
    # The product of the changes of step and cost is left out, being no cone.
    cost = reference.step * there + (decided.step - reference.step) * here
    collect.quadratic("running_cost", cost / problem.cost_scale, symbols, weighted=True)


def add_terminal_cost(
    collect: Collector, problem: OptimalControlProblem, symbols: Symbols, form: CostForm
) -> None:
    """Add what a subproblem minimises of the terminal cost."""
    decision, reference = symbols.decision, symbols.reference
    if form is CostForm.EXACT:
        cost = terminal_cost(problem, symbols, decision)
    else:
        here = terminal_cost(problem, symbols, reference)
        cost = expansion(here, reference, decision - reference)
    collect.quadratic("terminal_cost", cost / problem.cost_scale, symbols)


def add_terms(
    collect: Collector,
    problem: OptimalControlProblem,
    symbols: Symbols,
    costs: CostAnalysis,
    where: Where,
) -> None:
    """Add the declared cost terms of a node or an interval."""
    for term in problem.cost_terms:
        if term.where is not where:
            continue
        at, reference = (symbols.at(where, v) for v in (symbols.decision, symbols.reference))
        what = f"cost term {term.name}"
        cost = symbols.trace(what, term.expression, at, reference, symbols.parameters)
        cost = cost / problem.cost_scale
        models = term.name in costs.models
        if models and where is Where.MEAN:
            cost += _MEAN_PROX * _alternation(cost, symbols, len(problem.controls))
        collect.quadratic(term.name, cost, symbols, weighted=models and where is Where.NODE)


def _alternation(cost: ca.SX, symbols: Symbols, controls: int) -> ca.SX:
    """Quadratic of the controls' change over an interval, with the curvature of a cost of means.

    Along an alternation the means do not change, and a cost of them has no curvature.
    """
    size = (symbols.decision.numel() - symbols.offset) // 2
    end = symbols.offset + size
    first, second = symbols.decision[end - controls : end], symbols.decision[-controls:]
    # A mean moves by half of what one node does.
    curvature = 4 * ca.jacobian(ca.gradient(cost, second), second)
    return ca.bilin(curvature, second - first, second - first) / 2


def expansion(here: ca.SX, reference: ca.SX, change: ca.SX) -> ca.SX:
    """Second-order expansion of a cost, convexified.

    Args:
        here: Cost at the reference.
        reference: (n, 1) symbols of the reference.
        change: (n, 1) decision minus reference.
    """
    hessian, gradient = ca.hessian(here, reference)
    curved = ca.bilin(convexified(hessian), change, change)
    return here + ca.dot(gradient, change) + curved / 2


def convexified(hessian: ca.SX) -> ca.SX:
    """A positive semidefinite matrix (n, n) near a symmetric one, which it is where that is one.

    Gill and Murray's modified Cholesky factorisation: a pivot is replaced by its magnitude, and by
    more where the multipliers would grow. With very many coupled variables it is diagonal instead:
    the sums of the magnitudes of the rows, which exceed the matrix.
    """
    size = hessian.shape[0]
    rows, columns = hessian.sparsity().get_triplet()
    coupled = sorted({i for i, j in zip(rows, columns, strict=True) if i != j})
    if len(coupled) > _MOST_COUPLED:
        return ca.diag(ca.sum2(ca.fabs(hessian)))
    result = ca.diag(ca.fabs(ca.diag(hessian)))
    result[coupled, coupled] = 0
    result = ca.sparsify(result)
    work = {(i, j): hessian[i, j] for i, j in zip(rows, columns, strict=True) if i in coupled}
    if not coupled:
        return result
    on = [ca.fabs(value) for (i, j), value in work.items() if i == j]
    off = [ca.fabs(value) for (i, j), value in work.items() if i != j]
    largest = _largest([*on, *(value / math.sqrt(len(coupled) ** 2 - 1) for value in off)])
    bound = largest + _TINY
    for index, j in enumerate(coupled):
        below = [i for i in coupled[index + 1 :] if (i, j) in work]
        pivot = ca.fabs(work.get((j, j), ca.SX(0)))
        column = ca.SX(size, 1)
        column[j] = 1
        if below:
            steepest = _largest([work[i, j] ** 2 for i in below])
            pivot = ca.fmax(ca.fmax(pivot, steepest / bound), _LEAST_PIVOT * bound)
        for i in below:
            column[i] = work[i, j] / pivot
        for i in below:
            for k in below:
                work[i, k] = work.get((i, k), ca.SX(0)) - column[i] * work[k, j]
        result += pivot * ca.mtimes(column, column.T)
    return result


def _largest(values: list[ca.SX]) -> ca.SX:
    largest = values[0]
    for value in values[1:]:
        largest = ca.fmax(largest, value)
    return largest
