"""Dataclasses of documented numbers: every field declared as a parameter is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, field, fields
from typing import Any

from dscp_core.problem.parameters import Parameter

_DECLARED = "declared"


def option(
    default: float,
    unit: str,
    description: str,
    *,
    lower: float = 0.0,
    upper: float = math.inf,
    source: str = "chosen",
    infinite: bool = False,
) -> Any:
    """A field of a frozen dataclass, as a `Parameter` declares it."""
    declared = {
        "unit": unit,
        "description": description,
        "lower": lower,
        "upper": upper,
        "source": source,
        "infinite": infinite,
    }
    return field(default=default, metadata={_DECLARED: declared})


def declared(options: Any) -> tuple[Parameter, ...]:
    """The declarations of a dataclass's options."""
    return tuple(
        Parameter(f.name, f.default, **f.metadata[_DECLARED])
        for f in fields(options)
        if _DECLARED in f.metadata and f.default is not MISSING
    )


def validate(options: Any) -> None:
    """Check every option of a dataclass, and keep it as a float.

    Raises:
        InvalidInputError: With the first one that violates its declaration.
    """
    for parameter in declared(options):
        value = parameter.validate(getattr(options, parameter.name))
        object.__setattr__(options, parameter.name, float(value[0]))


def values(options: Any) -> Mapping[str, float]:
    """Every option's value by its name."""
    return {p.name: getattr(options, p.name) for p in declared(options)}
