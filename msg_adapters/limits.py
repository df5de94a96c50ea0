"""Range limits of a problem's state: what it brings, else the bounds that it declares."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.messages import StateLimitError
from msg_adapters.errors import InputCode, RejectedInputError

StateLimits = Callable[[Mapping[str, float]], Mapping[str, float]]
"""Named scalars, all of them or a group, to the same as they are planned from."""


def unlimited(named: Mapping[str, float]) -> Mapping[str, float]:
    """No limits."""
    return named


def admitted(limits: StateLimits, named: Mapping[str, float]) -> Mapping[str, float]:
    """Scalars that pass their limits.

    Raises:
        RejectedInputError: OUT_OF_RANGE, BELOW_GROUND or MASS_NOT_POSITIVE.
    """
    try:
        return limits(named)
    except StateLimitError as error:
        code = InputCode[error.kind.name]
        raise RejectedInputError(code, error.field, error.value, error.bound) from None
    except InvalidInputError as error:
        raise RejectedInputError(
            InputCode.OUT_OF_RANGE, error.field, error.value, error.bound
        ) from None


def state_limits(
    problem: OptimalControlProblem, parameters: Mapping[str, Any], settings: Mapping[str, Any]
) -> StateLimits:
    """Limits of a problem's state.

    Args:
        problem: The declaration.
        parameters: Every parameter by name, SI.
        settings: Settings that the problem brings, by name.
    """
    admit = problem.extras.messages.admit
    if admit is not None:
        return lambda named: admit(named, parameters, settings)
    return lambda named: _declared(problem, parameters, named)


def _declared(
    problem: OptimalControlProblem, parameters: Mapping[str, Any], named: Mapping[str, float]
) -> Mapping[str, float]:
    """The same scalars, if the planner takes them.

    Raises:
        InvalidInputError: Out of the bounds of the initial state's parameters, or refused by the
            problem.
    """
    own_names = [state.name for state in problem.states]
    pairs = problem.extras.messages.states or zip(own_names, own_names, strict=True)
    message_names = {core_name: message_name for message_name, core_name in pairs}
    declared = [problem.table[name] for name in problem.initial_state_parameters]
    bounds = [parameter for parameter in declared for _ in range(parameter.size)]
    state = np.array([named.get(message_names[name], math.nan) for name in own_names])
    for name, value, bound in zip(own_names, state, bounds, strict=False):
        if value < bound.lower or value > bound.upper:
            interval = f"[{bound.lower:g}, {bound.upper:g}] {bound.unit}"
            raise InvalidInputError(message_names[name], float(value), interval)
    if not np.any(np.isnan(state)):
        base = problem.table.pack(parameters)
        packed = problem.table.pack(problem.initial_state_values(state), base=base)
        problem.require_start(state, packed)
    return named
