"""Entry cases of the paper that several tests use."""

from __future__ import annotations

from typing import Any

from dscp_core.scp.scp import ScpOptions, StoppingRule

CASES = {
    "case1": (1.429, 1.536),
    "case2": (1.333, 0.388),
    "case3": (1.344, -0.199),
    "case4": (1.346, -0.635),
}
"""log10 of w_gamma and w_u (section 4.2.2)."""

PAPERS_RULE = ScpOptions(stopping=StoppingRule.COST_CHANGE, cost_tolerance=1e-3)


def weights(log_gamma: float, log_rates: float) -> dict[str, Any]:
    """Trust-region parameters of the paper's two weights."""
    return {
        "trust_region_state": (0.0,) * 4 + (10.0**log_gamma,) + (0.0,) * 3,
        "trust_region_control": (10.0**log_rates,) * 2,
    }
