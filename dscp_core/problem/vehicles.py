"""Vehicle files: values of parameters, and the tables that stand beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dscp_core.errors import InvalidInputError
from dscp_core.problem.parameters import Value, load_parameter_file

Reader = Callable[[Path], Mapping[str, Value]]


def vehicle_values(
    path: str | Path, tables: Mapping[str, Reader], silent: Mapping[str, Value]
) -> dict[str, Value]:
    """Values of a vehicle file, those of the tables that it points to included.

    Args:
        path: The file.
        tables: What it may name besides parameters: name to a reader of the file it points to.
        silent: What holds where the file is silent.

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
    return {**silent, **values}
