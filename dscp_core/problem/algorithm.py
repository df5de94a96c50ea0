"""Parameters of the algorithm (theta_SCP), which every problem has beside its own."""

from __future__ import annotations

from collections.abc import Sequence

from dscp_core.problem.parameters import Parameter

VIRTUAL_CONTROL_WEIGHT = "virtual_control_weight"
TRUST_REGION_STATE = "trust_region_state"
TRUST_REGION_CONTROL = "trust_region_control"
TRUST_REGION_STEP = "trust_region_step"
DERIVED_COSTS = (
    "running_cost",
    "terminal_cost",
    "trust_region",
    "trust_region_step",
    "virtual_control",
)
"""Names of the costs of a subproblem that are no declared terms."""


def algorithm_parameters(
    state_weights: Sequence[float],
    control_weights: Sequence[float],
    step_weight: float,
    virtual_control_weight: float | None,
    unit: str,
) -> tuple[Parameter, ...]:
    """Declarations of the algorithm's parameters.

    Args:
        state_weights: (nx,) default trust-region weights.
        control_weights: (nu,) default trust-region weights.
        step_weight: Default trust-region weight of the terminal time.
        virtual_control_weight: Default penalty, or None where there is no virtual control.
        unit: Unit of the weights of states and controls.
    """
    parameters = (
        Parameter(
            TRUST_REGION_STATE,
            tuple(state_weights),
            unit,
            "Trust-region penalty per state, scaled cost per squared scaled state.",
            lower=0.0,
            fixes_optimum=False,
        ),
        Parameter(
            TRUST_REGION_CONTROL,
            tuple(control_weights),
            unit,
            "Trust-region penalty per control, scaled cost per squared scaled control.",
            lower=0.0,
            fixes_optimum=False,
        ),
        Parameter(
            TRUST_REGION_STEP,
            step_weight,
            "1",
            "Trust-region penalty on the terminal time, when it is free, scaled cost per "
            "squared relative change.",
            lower=0.0,
            fixes_optimum=False,
        ),
    )
    if virtual_control_weight is None:
        return parameters
    return (
        *parameters,
        Parameter(
            VIRTUAL_CONTROL_WEIGHT,
            virtual_control_weight,
            "1",
            "Penalty of the squared virtual control, in units of the cost.",
            lower=0.0,
            fixes_optimum=False,
        ),
    )
