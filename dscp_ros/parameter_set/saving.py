"""Writing a parameter set: whole, or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dscp_core.errors import DscpError
from dscp_core.files import replace_file
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_ros.parameter_set.errors import ParameterSetError
from dscp_ros.parameter_set.format import (
    FORMAT,
    NETWORK_FILE,
    PARAMETERS_FILE,
    PROVENANCE_FILE,
    VERSION,
    file_digest,
    parameters_text,
    provenance_text,
)
from dscp_ros.parameter_set.loading import ParameterSet, load
from dscp_ros.parameter_set.renaming import exchange
from dscp_ros.parameter_set.values import check_values, chosen_names
from dscp_ros.planner.choice import ProblemChoice
from dscp_ros.planner.parameters import NETWORK

_FILES = frozenset({PARAMETERS_FILE, NETWORK_FILE, PROVENANCE_FILE})


def save(
    directory: str | Path,
    values: Mapping[str, Any],
    network: TerminalTimeNetwork | None = None,
    provenance: Mapping[str, Any] | None = None,
    *,
    choice: ProblemChoice | None = None,
    overwrite: bool = False,
) -> ParameterSet:
    """Write a set; at any moment the old set, the new one or none is there, never a part.

    What a killed process leaves is a hidden directory ``.NAME.partial-*`` beside it.

    Args:
        directory: Where it will be.
        values: Node parameters by flat name, in message axes; ``terminal_time_network`` is added
            where there is a network.
        network: Terminal-time network of the set, or None.
        provenance: What it comes from, for JSON; format, problem, vehicle and checksums are added.
        choice: The problem, where it is not the values that choose it.
        overwrite: Whether to replace a set that is there.

    Returns:
        The set, read back.

    Raises:
        InvalidInputError: A value is refused.
        ParameterSetError: The directory is taken, or cannot be written; what was there stays.
    """
    directory = Path(directory)
    check_target(directory, overwrite=overwrite)
    given = {k: v for k, v in values.items() if k != NETWORK}
    if network is not None:
        given[NETWORK] = NETWORK_FILE
    checked = check_values(given, choice)
    complete = {**chosen_names(checked.choice, checked.formulation), **given}
    document = {
        **(provenance or {}),
        "format": FORMAT,
        "version": VERSION,
        "problem": checked.problem.name,
        "formulation": checked.formulation,
        "vehicle": checked.vehicle,
    }
    partial: Path | None = None
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        prefix = f".{directory.name}.partial-"
        partial = Path(tempfile.mkdtemp(prefix=prefix, dir=directory.parent))
        _write(partial, complete, network, document)
        load(partial, choice)
        _move_into_place(partial, directory, overwrite=overwrite)
    except (OSError, DscpError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise ParameterSetError(f"{directory}: not written: {reason}") from error
    finally:
        # After an exchange this is the old set.
        if partial is not None and partial.exists():
            shutil.rmtree(partial)
    return load(directory, choice)


def check_target(directory: Path, *, overwrite: bool) -> None:
    """Check that a set may be written to a path.

    Raises:
        ParameterSetError: It is taken by a set that may not be replaced, or by something else.
    """
    if not os.path.lexists(directory):
        return
    if directory.is_symlink() or not directory.is_dir():
        raise ParameterSetError(f"{directory} is not replaced: it is no directory")
    found = {entry.name for entry in directory.iterdir()}
    if others := sorted(found - _FILES):
        raise ParameterSetError(
            f"{directory} is not replaced: it holds more than a parameter set ({', '.join(others)})"
        )
    if found and not overwrite:
        raise ParameterSetError(f"{directory} exists and is not overwritten")


def _write(
    partial: Path,
    values: Mapping[str, Any],
    network: TerminalTimeNetwork | None,
    document: dict[str, Any],
) -> None:
    """Write the files, the provenance last: without it, the rest is no set."""
    replace_file(partial / PARAMETERS_FILE, parameters_text(values).encode())
    names = [PARAMETERS_FILE]
    if network is not None:
        network.save(partial / NETWORK_FILE)
        names.append(NETWORK_FILE)
    document["files"] = {name: file_digest(partial / name) for name in names}
    replace_file(partial / PROVENANCE_FILE, provenance_text(document).encode())
    # mkdtemp's directories are for their owner only; the node may be another user.
    partial.chmod(0o755)
    _sync(partial)


def _move_into_place(partial: Path, directory: Path, *, overwrite: bool) -> None:
    """Give the complete set its name.

    Raises:
        ParameterSetError: The name was taken meanwhile.
        OSError: Renaming failed; what was there is there again.
    """
    check_target(directory, overwrite=overwrite)
    if directory.exists() and any(directory.iterdir()):
        exchange(partial, directory)
    else:
        os.rename(partial, directory)
    _sync(directory.parent)


def _sync(directory: Path) -> None:
    """Have the names in a directory survive a power failure."""
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
