"""Problems by name. This is the only place that knows the names of the shipped ones.

Example:
    >>> from dscp_core import problems
    >>> problems.names()[:2]
    ('powered_descent', 'entry')
    >>> problems.get("entry").default_intervals
    100
    >>> problems.get("entry", "printed").formulation  # or problems.get("FILE.py:NAME")
    'printed'
"""

from __future__ import annotations

from importlib import import_module

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problems.loading import (
    FILE_MARK,
    ProblemFamily,
    family_of,
    from_entry_point,
    from_file,
    installed,
)

_SHIPPED = {
    "powered_descent": "dscp_core.problems.powered_descent",
    "entry": "dscp_core.problems.entry",
}
"""Name to module; each has a `FAMILY`."""

DEFAULT = "powered_descent"
"""The problem where none is asked for."""


def names() -> tuple[str, ...]:
    """Names of the known problems: the shipped ones, then those of installed packages."""
    return (*_SHIPPED, *(name for name in installed() if name not in _SHIPPED))


def family(text: str) -> ProblemFamily:
    """A problem with its formulations.

    Args:
        text: A known name, or ``FILE.py:NAME`` for a variable or function of a Python file. The
            file is run.

    Raises:
        InvalidInputError: Nothing is known by that name, or what was found is no problem.
    """
    if text in _SHIPPED:
        found = import_module(_SHIPPED[text]).FAMILY
    elif FILE_MARK in text:
        found = from_file(text)
    elif text in installed():
        found = from_entry_point(text)
    else:
        raise InvalidInputError("problem", text, f"one of {', '.join(names())}, or FILE.py:NAME")
    return family_of(text, found)


def formulations(text: str) -> tuple[str, ...]:
    """Formulations of a problem, the default first; none for a problem that has one form only.

    Raises:
        InvalidInputError: See `family`.
    """
    return family(text).formulations


def get(text: str, formulation: str | None = None) -> OptimalControlProblem:
    """Declaration of a problem.

    Args:
        text: A known name, or ``FILE.py:NAME``; see `family`.
        formulation: One of `formulations`; None for the default.

    Raises:
        InvalidInputError: Unknown problem or formulation.
    """
    found = family(text)
    known = found.formulations
    if formulation is not None and formulation not in known:
        bound = f"one of {', '.join(known)}" if known else f"none: {text} has one form only"
        raise InvalidInputError("formulation", formulation, bound)
    return found.make(formulation or (known[0] if known else ""))
