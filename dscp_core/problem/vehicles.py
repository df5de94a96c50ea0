"""Vehicle files: values of parameters, and the tables that stand beside them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dscp_core.errors import InvalidInputError
from dscp_core.problem.parameters import (
    ParameterTable,
    Value,
    load_parameter_file,
    without_infinities,
)

Reader = Callable[[Path], Mapping[str, Value]]


def vehicle_values(
    path: str | Path,
    tables: Mapping[str, Reader],
    silent: Mapping[str, Value],
    given: Collection[str] = (),
) -> dict[str, Value]:
    """Values of a vehicle file, those of the tables that it points to included.

    Args:
        path: The file.
        tables: What it may name besides parameters: name to a reader of the file it points to.
        silent: What holds where the file is silent.
        given: Parameters of which it does not, as they have values already.

    Raises:
        InvalidInputError: The file or a table cannot be used, or both give a value.
    """
    values: dict[str, Any] = dict(load_parameter_file(path))
    for name, read in tables.items():
        if name not in values:
            continue
        table = values.pop(name)
        if not isinstance(table, str):
            raise InvalidInputError(name, table, "the name of a file beside the vehicle's")
        found = read(Path(path).parent / table)
        twice = sorted(set(found) & set(values))
        if twice:
            raise InvalidInputError(name, table, f"no {', '.join(twice)} beside it")
        values.update(found)
    return {**{n: v for n, v in silent.items() if n not in given}, **values}


def as_vehicle(
    table: ParameterTable, others: Collection[str], values: Mapping[str, Any]
) -> dict[str, Any]:
    """The parameters that fix the optimum from a state, as JSON holds them.

    Args:
        table: Parameters of the problem.
        others: Those that belong to the state or the plan.
        values: Every parameter by name, SI.
    """
    return {
        p.name: without_infinities(np.asarray(values[p.name], dtype=np.float64).tolist())
        for p in table.parameters
        if p.fixes_optimum and p.name not in others
    }
