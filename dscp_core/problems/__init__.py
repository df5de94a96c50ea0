"""Problems by name."""

from __future__ import annotations

from collections.abc import Callable

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problems import entry, powered_descent

_PROBLEMS: dict[str, Callable[[str], OptimalControlProblem]] = {
    powered_descent.NAME: lambda formulation: powered_descent.powered_descent(
        powered_descent.Formulation(formulation)
    ),
    entry.NAME: lambda formulation: entry.entry(entry.Formulation(formulation)),
}
_FORMULATIONS: dict[str, tuple[str, ...]] = {
    powered_descent.NAME: tuple(f.value for f in reversed(powered_descent.Formulation)),
    entry.NAME: tuple(f.value for f in reversed(entry.Formulation)),
}


def names() -> tuple[str, ...]:
    """Names of the known problems."""
    return tuple(_PROBLEMS)


def formulations(name: str) -> tuple[str, ...]:
    """Formulations of a problem, the default first.

    Raises:
        InvalidInputError: Unknown problem.
    """
    if name not in _FORMULATIONS:
        raise InvalidInputError("problem", name, f"one of {', '.join(_PROBLEMS)}")
    return _FORMULATIONS[name]


def get(name: str, formulation: str | None = None) -> OptimalControlProblem:
    """Declaration of a problem.

    Args:
        name: Name of the problem.
        formulation: One of `formulations`; None for the default.

    Raises:
        InvalidInputError: Unknown problem or formulation.
    """
    known = formulations(name)
    chosen = known[0] if formulation is None else formulation
    if chosen not in known:
        raise InvalidInputError("formulation", formulation, f"one of {', '.join(known)}")
    return _PROBLEMS[name](chosen)
