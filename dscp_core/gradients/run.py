"""Differentiable sequential convex programming: the backward pass (section 3.2.2).

`unrolled` walks the iterations backwards and is the exact derivative of the K-step map, whatever
K. `implicit` differentiates the fixed point that the iterations converge to. `tangent` is the
forward mode of the unrolled map.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import scipy.sparse.linalg
from numpy.typing import NDArray

from dscp_core.cone.derivative.sensitivity import Linearisation
from dscp_core.cone.derivative.verdict import GradientVerdict
from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.gradients.losses import Loss
from dscp_core.scp.scp import Iteration, Scp, ScpResult, ScpStatus

Array = NDArray[np.float64]


class DifferentiationError(DscpError):
    """A trace that cannot be differentiated."""


class Method(Enum):
    """How a gradient was computed."""

    UNROLLED = "unrolled"
    IMPLICIT = "implicit"


@dataclass(frozen=True)
class Gradient:
    """Gradient of a loss with respect to every parameter.

    Attributes:
        value: The loss.
        parameters: (P,) gradient with respect to the packed parameters, per SI unit.
        initial_reference: Gradient with respect to the scaled reference vector that the run
            started from; zero for the implicit method. When the problem's own guess was the
            start, its dependence on the parameters is already in ``parameters``.
        trusted: Whether the gradient can be relied upon.
        reasons: Why not, in words with numbers.
        verdicts: Verdict of every differentiated iteration, first iteration first.
        method: How it was computed.
    """

    value: float
    parameters: Array
    initial_reference: Array
    trusted: bool
    reasons: tuple[str, ...]
    verdicts: tuple[GradientVerdict, ...]
    method: Method


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
    return Gradient(
        value=loss.value(transcription, trace),
        parameters=parameters,
        initial_reference=carried,
        trusted=not reasons,
        reasons=reasons,
        verdicts=tuple(verdicts),
        method=Method.UNROLLED,
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
    # Where the cost is flat it converges long before the trajectory does.
    drift = float(np.max(np.abs(reference - solution.z[:size])))
    if drift > 1e-5:
        reasons += (f"not settled: another iteration moves it by {drift:.1e} (scaled)",)
    return Gradient(
        value=loss.value(transcription, trace),
        parameters=parameters,
        initial_reference=np.zeros(size),
        trusted=not reasons,
        reasons=reasons,
        verdicts=(linearisation.verdict,),
        method=Method.IMPLICIT,
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
