"""Differentiable sequential convex programming: the backward pass (section 3.2.2).

`unrolled` walks the iterations backwards and is the exact derivative of the K-step map, whatever
K. `implicit` differentiates the fixed point that the iterations converge to. `tangent` is the
forward mode of the unrolled map.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse.linalg
from numpy.typing import NDArray

from dscp_core.cone.derivative.sensitivity import Linearisation
from dscp_core.cone.derivative.verdict import GradientVerdict
from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.gradients.gradient import Gradient, Method
from dscp_core.gradients.losses import Loss
from dscp_core.gradients.quantities import quantity
from dscp_core.problem import checks
from dscp_core.scp.scp import Iteration, Scp, ScpResult, ScpStatus
from dscp_core.transcription.analysis import CostForm

__all__ = [
    "DifferentiationError",
    "Gradient",
    "Method",
    "Tangent",
    "implicit",
    "is_feasible",
    "of_plan",
    "settle",
    "tangent",
    "unrolled",
]

Array = NDArray[np.float64]

_SETTLED = 1e-5
"""Change of the scaled trajectory by one more iteration, below which it is a fixed point."""
_GROWTH = 1.001
"""Growth of a small change per iteration, above which a fixed point repels."""
_SETTLING_ITERATIONS = 10
_MOST_SETTLING_ITERATIONS = 60


class DifferentiationError(DscpError):
    """A trace that cannot be differentiated.

    Example:
        >>> from dscp_core import DifferentiationError, Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> below_ground = planner.plan([-100.0, 0.0, 0.0, 0.0, 0.0, 0.0, 3e4])
        >>> try:
        ...     planner.gradient("cost", at=below_ground)
        ... except DifferentiationError as error:
        ...     print(str(error)[:33])
        there is no plan to differentiate
    """


@dataclass(frozen=True)
class Tangent:
    """Directional derivative of a whole run.

    Attributes:
        decisions: (K, n) change of every iteration's scaled decision vector per unit step.
        active_set_radius: Step length to the first change of an active set, to first order;
            central differences with a longer step cross a kink.
    """

    decisions: Array
    active_set_radius: float


def unrolled(scp: Scp, trace: ScpResult, loss: Loss) -> Gradient:
    """Gradient through all iterations, eqs. d1 to d3.

    Args:
        scp: The loop that made the trace.
        trace: Its result; best made with `ScpOptions.polish`.
        loss: Scalar of the trace.

    Raises:
        DifferentiationError: The trace ended without a usable result, or the gradient overflows.
    """
    _require_usable(trace)
    transcription = scp.transcription
    explicit = loss.gradient(transcription, trace)
    parameters = explicit.parameters.copy()
    size = trace.initial_reference.size
    carried = np.zeros(size)
    verdicts: list[GradientVerdict] = []
    for iteration, direct in zip(
        reversed(trace.iterations), reversed(explicit.decisions), strict=True
    ):
        seed = direct.copy()
        seed[:size] += carried
        if not np.all(np.isfinite(seed)):
            raise DifferentiationError(f"gradient is not finite after {len(verdicts)} iterations")
        linearisation = _linearise(scp, iteration)
        carried, step = transcription.values_pullback(
            iteration.reference, trace.parameters, linearisation.adjoint(seed)
        )
        parameters += step
        verdicts.append(linearisation.verdict)
    if not trace.warm_started:
        parameters += transcription.initial_guess_pullback(trace.parameters, carried)
    verdicts.reverse()
    reasons = _reasons(verdicts) + _non_finite(parameters)
    return _gradient(
        scp, trace, loss, parameters, carried, Method.UNROLLED, reasons, verdicts, settled=None
    )


def implicit(
    scp: Scp, trace: ScpResult, loss: Loss, *, tolerance: float = 1e-11, max_products: int = 60
) -> Gradient:
    """Gradient at the converged point, whatever the number of iterations that led there.

    With the fixed point z = S(z, theta) of the iterations, dL/dtheta = w' dS/dtheta where
    (I - dS/dz)' w = dL/dz; solved by GMRES on vector-Jacobian products, all of which share one
    factorisation.

    Args:
        scp: The loop that made the trace.
        trace: A converged result.
        loss: Scalar of the final iterate only.
        tolerance: Relative residual asked of GMRES.
        max_products: Most vector-Jacobian products.

    Raises:
        DifferentiationError: The trace ended without a usable result.
        InvalidInputError: The loss depends on earlier iterates.
    """
    _require_usable(trace)
    transcription = scp.transcription
    explicit = loss.gradient(transcription, trace)
    if np.any(explicit.decisions[:-1]):
        raise InvalidInputError("loss", type(loss).__name__, "a function of the final iterate only")
    size = trace.initial_reference.size
    solution = trace.iterations[-1].solution
    values = transcription.values(solution.z[:size], trace.parameters)
    linearisation = scp.kkt.linearise(values, scp.solve(values, None))
    reference = linearisation.z[:size]
    direct = explicit.decisions[-1]

    def pull(seed: Array) -> tuple[Array, Array]:
        return transcription.values_pullback(
            reference, trace.parameters, linearisation.adjoint(seed)
        )

    def step(weight: Array) -> Array:
        padded = np.zeros(direct.size)
        padded[:size] = weight
        return np.asarray(weight - pull(padded)[0])

    carried, own = pull(direct)
    operator = scipy.sparse.linalg.LinearOperator((size, size), matvec=step, dtype=np.float64)
    weight, _ = scipy.sparse.linalg.gmres(
        operator, carried, rtol=tolerance, atol=0.0, restart=max_products, maxiter=1
    )
    target = max(float(np.linalg.norm(carried)), np.finfo(float).tiny)
    residual = float(np.linalg.norm(step(weight) - carried)) / target
    padded = np.zeros(direct.size)
    padded[:size] = weight
    parameters = explicit.parameters + own + pull(padded)[1]
    reasons = _reasons([linearisation.verdict]) + _non_finite(parameters)
    if residual > 1e-7:
        reasons += (f"fixed-point equation solved to {residual:.1e} only, above 1e-7",)
    if CostForm.CONVEXIFIED in (transcription.costs.running, transcription.costs.terminal):
        reasons += _no_minimum(lambda weight: weight - step(weight), size)
    # Where the cost is flat it converges long before the trajectory does.
    drift = float(np.max(np.abs(reference - solution.z[:size])))
    if drift > _SETTLED:
        reasons += (f"not settled: another iteration moves it by {drift:.1e} (scaled)",)
    return _gradient(
        scp,
        trace,
        loss,
        parameters,
        np.zeros(size),
        Method.IMPLICIT,
        reasons,
        [linearisation.verdict],
        settled=drift <= _SETTLED,
    )


def of_plan(scp: Scp, trace: ScpResult, loss: Loss, method: Method) -> Gradient:
    """Gradient that is trusted only where the run ended with a plan.

    Args:
        scp: The loop that made the trace.
        trace: Its result.
        loss: Scalar of the trace.
        method: How to differentiate.

    Raises:
        DifferentiationError: The trace ended without a usable result, or the gradient overflows.
        InvalidInputError: The implicit method, and a loss that depends on earlier iterates.
    """
    method = checks.choice("method", method, Method)
    compute = unrolled if method is Method.UNROLLED else implicit
    gradient = compute(scp, trace, loss)
    reasons = gradient.reasons
    if trace.status in (ScpStatus.INFEASIBLE, ScpStatus.SUBPROBLEM_INFEASIBLE) or (
        method is Method.IMPLICIT and not gradient.feasible
    ):
        last, layout = trace.iterations[-1], scp.transcription.layout
        reasons += (
            f"no feasible trajectory: virtual control {layout.relative(last.virtual_control):.1e}, "
            f"defect {layout.relative(last.defects):.1e} (scaled)",
        )
    elif trace.status is ScpStatus.ITERATION_LIMIT:
        reasons += (f"not converged, so not the gradient of an optimum: {trace.message}",)
    return replace(gradient, trusted=not reasons, reasons=reasons)


def settle(scp: Scp, parameters: Array, reference: Array) -> ScpResult:
    """Iterate from a trajectory until it stands still: a fixed point to differentiate.

    Where the cost is flat, the test of convergence ends the iterations long before.

    Args:
        scp: A loop with options for gradients.
        parameters: Packed parameters, SI.
        reference: Scaled reference vector to start from.

    Returns:
        The last run, of a few iterations; `implicit` says whether it settled.
    """
    few = scp.with_options(fixed_iterations=_SETTLING_ITERATIONS, deadline_s=None)
    for _ in range(_MOST_SETTLING_ITERATIONS // _SETTLING_ITERATIONS):
        trace = few.run(parameters, reference)
        if not trace.succeeded:
            break
        reference = trace.final_reference
        if np.max(np.abs(reference - trace.iterations[-1].reference)) <= _SETTLED / 10.0:
            break
    return trace


def is_feasible(scp: Scp, trace: ScpResult) -> bool:
    """Whether a run ended at a trajectory that satisfies the dynamics, without virtual control."""
    if not trace.iterations:
        return False
    last, layout = trace.iterations[-1], scp.transcription.layout
    return (
        layout.relative(last.virtual_control) <= scp.virtual_control_tolerance
        and layout.relative(last.defects) <= 10.0 * scp.defect_tolerance
    )


def _no_minimum(pull: Callable[[Array], Array], size: int) -> tuple[str, ...]:
    """Why a fixed point is none of the convexified cost's minima, as far as curvature tells.

    The subproblem's Hessian M is positive where the constraints leave freedom, and the Lagrangian's
    is M (I - dS/dz) there: it is negative along a direction just where a change of z grows.

    Args:
        pull: Product with the transpose of dS/dz, (size,) to (size,).
        size: Of the reference vector.
    """
    operator = scipy.sparse.linalg.LinearOperator((size, size), matvec=pull, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(size)
    if not np.any(pull(start)):
        return ()  # nothing is free
    try:
        found = scipy.sparse.linalg.eigs(
            operator, k=1, which="LR", tol=1e-4, v0=start, return_eigenvectors=False
        )
    except scipy.sparse.linalg.ArpackError as error:
        return (f"cannot be told from a saddle: {error}",)
    growth = float(found[0].real)
    if growth <= _GROWTH:
        return ()
    return (f"no minimum but a saddle: another iteration takes a small change times {growth:.3g}",)


def _gradient(
    scp: Scp,
    trace: ScpResult,
    loss: Loss,
    parameters: Array,
    initial_reference: Array,
    method: Method,
    reasons: tuple[str, ...],
    verdicts: list[GradientVerdict],
    *,
    settled: bool | None,
) -> Gradient:
    transcription = scp.transcription
    return Gradient(
        value=loss.value(transcription, trace),
        parameters=parameters,
        initial_reference=initial_reference,
        trusted=not reasons,
        reasons=reasons,
        verdicts=tuple(verdicts),
        method=method,
        of=quantity(transcription.problem, loss),
        iterations=len(trace.iterations),
        stopped=trace.status,
        feasible=is_feasible(scp, trace),
        settled=settled,
        terminal_time_s=transcription.terminal_time(trace.final_reference, trace.parameters),
        free_terminal_time=transcription.layout.free_terminal_time,
        problem=transcription.problem,
    )


def tangent(scp: Scp, trace: ScpResult, direction: Array) -> Tangent:
    """Derivative of every iterate along a direction of the packed parameters (forward mode).

    Args:
        scp: The loop that made the trace.
        trace: Its result.
        direction: (P,) direction, SI.

    Raises:
        DifferentiationError: The trace ended without a usable result.
    """
    _require_usable(trace)
    transcription = scp.transcription
    size = trace.initial_reference.size
    carried = np.zeros(size)
    if not trace.warm_started:
        carried = transcription.initial_guess_pushforward(trace.parameters, direction)
    rows, radius = [], np.inf
    for iteration in trace.iterations:
        linearisation = _linearise(scp, iteration)
        change = transcription.values_pushforward(
            iteration.reference, trace.parameters, carried, direction
        )
        radius = min(radius, linearisation.active_set_radius(change))
        moved = linearisation.tangent(change)[0]
        rows.append(moved)
        carried = moved[:size]
    return Tangent(np.array(rows), float(radius))


def _linearise(scp: Scp, iteration: Iteration) -> Linearisation:
    if iteration.linearisation is not None:
        return iteration.linearisation
    return scp.kkt.linearise(iteration.values, iteration.solution)


def _require_usable(trace: ScpResult) -> None:
    usable = (ScpStatus.CONVERGED, ScpStatus.FIXED_ITERATIONS, ScpStatus.ITERATION_LIMIT)
    if trace.status not in (*usable, ScpStatus.INFEASIBLE) or not trace.iterations:
        raise DifferentiationError(f"no gradient of a run that ended with: {trace.message}")


def _reasons(verdicts: list[GradientVerdict]) -> tuple[str, ...]:
    return tuple(
        f"iteration {number}: {reason}"
        for number, verdict in enumerate(verdicts, start=1)
        for reason in verdict.reasons
    )


def _non_finite(gradient: Array) -> tuple[str, ...]:
    return () if np.all(np.isfinite(gradient)) else ("gradient is not finite",)
