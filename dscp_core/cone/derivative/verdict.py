"""How far the derivatives of a cone program's solution can be trusted, and why not further."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dscp_core.cone.derivative.active_set import ConeRows, ConstraintScales, IndexArray
from dscp_core.cone.derivative.kkt import Conditioning
from dscp_core.cone.derivative.polish import KktPoint
from dscp_core.cone.program import FloatArray

_NAMED_CONSTRAINTS = 3  # more than a few names make a reason unreadable


@dataclass(frozen=True)
class TrustLimits:
    """Bounds beyond which derivatives are not trusted.

    Attributes:
        kkt_residual: Largest relative residual of the optimality conditions.
        weak_margin: Smallest relative multiplier of an active constraint, slack of an inactive
            one, and distance of a cone's slack from its apex. Below, the active set and with it
            the derivative may be different on either side of the point. The residual takes its
            place where that is larger.
        singularity: Largest share of the regularisation in the factored matrix (1: singular).
        solve_residual: Largest relative residual of the solve behind a derivative.
    """

    kkt_residual: float = 1e-6
    weak_margin: float = 2e-11
    singularity: float = 0.1
    solve_residual: float = 1e-8


@dataclass(frozen=True, eq=False)
class Margins:
    """Distance of every constraint from changing sides, relative to its natural size.

    A cone is named by its first row of G.

    Attributes:
        active_rows: (k,) active constraints.
        active_duals: (k,) their relative multipliers; for a cone at its apex the distance of the
            dual from the boundary of the cone.
        inactive_rows: (l,) inactive constraints.
        inactive_slacks: (l,) their relative slacks.
        boundary_rows: (j,) cones on their boundary.
        apex_distances: (j,) relative size of their slack: zero at the apex.
    """

    active_rows: IndexArray
    active_duals: FloatArray
    inactive_rows: IndexArray
    inactive_slacks: FloatArray
    boundary_rows: IndexArray
    apex_distances: FloatArray


@dataclass(frozen=True)
class GradientVerdict:
    """Whether a derivative can be trusted.

    Attributes:
        trusted: True if there are no reasons against.
        reasons: In words, with numbers.
        kkt_residual: Largest relative residual of the optimality conditions at the point.
        min_active_dual: Smallest relative multiplier of an active constraint (inf: none active).
        min_inactive_slack: Smallest relative slack of an inactive one (inf: none inactive).
        condition_estimate: Estimate of |H| |H^-1| from below; saturates near |H| over the
            regularisation for a singular matrix.
        n_active_linear: Active nonnegative rows.
        n_active_soc: Second-order cones on their boundary or at their apex.
        n_apex: Those at their apex.
        polished: Whether the point was improved by Newton steps.
        newton_steps: Newton steps of the polish, or of its second attempt after interior-point
            steps, those after a repair of the active set included.
        repairs: Changes of the active set among them.
    """

    trusted: bool
    reasons: tuple[str, ...]
    kkt_residual: float
    min_active_dual: float
    min_inactive_slack: float
    condition_estimate: float
    n_active_linear: int
    n_active_soc: int
    n_apex: int
    polished: bool
    newton_steps: int
    repairs: int


def margins(rows: ConeRows, scales: ConstraintScales, point: KktPoint) -> Margins:
    """Margins of all constraints at a point."""
    n, active, frame = rows.n_nonnegative, point.active, point.frame
    first_rows = np.concatenate((np.arange(n), rows.starts))
    dual = np.concatenate((point.eta[:n], point.eta[rows.starts]))
    if active.apex.any():
        dual[n:] -= np.where(active.apex, rows.tail_norms(point.eta), 0.0)
    slack = np.concatenate((frame.slack[:n], frame.margin))
    is_active = np.concatenate((active.linear, active.boundary | active.apex))
    is_inactive = ~is_active
    return Margins(
        active_rows=first_rows[is_active],
        active_duals=(dual / scales.dual)[is_active],
        inactive_rows=first_rows[is_inactive],
        inactive_slacks=(slack / scales.slack)[is_inactive],
        boundary_rows=rows.starts[active.boundary],
        apex_distances=(frame.tail_norm / scales.slack[n:])[active.boundary],
    )


def judge(
    limits: TrustLimits,
    point: KktPoint,
    found: Margins,
    conditioning: Conditioning,
    *,
    kkt_residual: float,
    problems: tuple[str, ...],
    polished: bool,
    newton_steps: int,
    repairs: int,
) -> GradientVerdict:
    """Verdict on the derivatives at a point.

    Args:
        limits: Bounds of trust.
        point: Where the derivatives are taken.
        found: Its margins.
        conditioning: Of the KKT matrix there.
        kkt_residual: Largest relative residual of the optimality conditions.
        problems: Reasons known before: solver status, failed polish.
        polished: Whether the point was improved by Newton steps.
        newton_steps: Steps of the polish.
        repairs: Changes of the active set during the polish.
    """
    reasons = list(problems)
    if not kkt_residual <= limits.kkt_residual:
        reasons.append(f"KKT residual {kkt_residual:.1e} exceeds {limits.kkt_residual:.1e}")
    weak = max(limits.weak_margin, kkt_residual)
    reasons += _small(
        "active constraints with a tiny dual", found.active_rows, found.active_duals, weak
    )
    reasons += _small(
        "inactive constraints with a tiny slack", found.inactive_rows, found.inactive_slacks, weak
    )
    reasons += _small(
        "second-order cones close to their apex", found.boundary_rows, found.apex_distances, weak
    )
    if conditioning.singularity > limits.singularity:
        reasons.append(
            f"KKT matrix is singular up to the regularisation (share "
            f"{conditioning.singularity:.1e} exceeds {limits.singularity:.1e}): solution or "
            f"multipliers are not unique"
        )
    active = point.active
    return GradientVerdict(
        trusted=not reasons,
        reasons=tuple(reasons),
        kkt_residual=kkt_residual,
        min_active_dual=float(found.active_duals.min(initial=np.inf)),
        min_inactive_slack=float(found.inactive_slacks.min(initial=np.inf)),
        condition_estimate=conditioning.condition_estimate,
        n_active_linear=int(np.count_nonzero(active.linear)),
        n_active_soc=int(np.count_nonzero(active.boundary | active.apex)),
        n_apex=int(np.count_nonzero(active.apex)),
        polished=polished,
        newton_steps=newton_steps,
        repairs=repairs,
    )


def _small(what: str, rows: IndexArray, sizes: FloatArray, limit: float) -> list[str]:
    """One reason that names the smallest of the sizes below the limit, or none."""
    below = np.flatnonzero(~(sizes >= limit))
    if not below.size:
        return []
    order = below[np.argsort(sizes[below])][:_NAMED_CONSTRAINTS]
    named = ", ".join(f"row {rows[i]} of G: {sizes[i]:.1e}" for i in order)
    more = f" and {below.size - order.size} more" if below.size > order.size else ""
    return [f"{below.size} {what} (relative size below {limit:.1e}; {named}{more})"]
