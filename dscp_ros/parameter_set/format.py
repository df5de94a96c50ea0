"""The files of a parameter set, as texts and checksums."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from dscp_ros.parameter_set.errors import ParameterSetError

PARAMETERS_FILE = "parameters.yaml"
NETWORK_FILE = "terminal_time.safetensors"
PROVENANCE_FILE = "provenance.json"

FORMAT = "dscp_parameter_set"
VERSION = 1
IDENTIFIER_DIGITS = 12

_HEADER = (
    "# Parameter set of the planner node: `dscp planner --params-file FILE`. SI units, axes and\n"
    "# order as in messages. provenance.json has its checksum: an edited set is refused.\n"
)


class _Quoted(str):
    """A text that is written in quotes: rcl takes more plain words for numbers than PyYAML."""


class _Dumper(yaml.SafeDumper):
    """Writes `_Quoted` in quotes."""


_Dumper.add_representer(
    _Quoted, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style="'")
)


def parameters_text(values: Mapping[str, Any]) -> str:
    """ROS 2 parameter file of flat names and values, for nodes of any name.

    Args:
        values: Numbers, texts and lists of floats by name; dots make levels.
    """
    nested: dict[str, Any] = {}
    for name, value in values.items():
        *levels, last = name.split(".")
        place = nested
        for level in levels:
            place = place.setdefault(level, {})
        place[last] = _Quoted(value) if isinstance(value, str) else value
    document = {"/**": {"ros__parameters": nested}}
    text = yaml.dump(document, Dumper=_Dumper, sort_keys=False, default_flow_style=None)
    return _HEADER + text


def provenance_text(document: Mapping[str, Any]) -> str:
    """JSON text with the document's own checksum."""
    signed = {**document, "sha256": _digest(document)}
    return json.dumps(signed, indent=1, allow_nan=False) + "\n"


def read_provenance(path: Path) -> dict[str, Any]:
    """Provenance of a set, without its checksum.

    Raises:
        ParameterSetError: The file is missing, damaged or changed, or of another format.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterSetError(f"{path}: not readable ({_reason(error)})") from None
    except json.JSONDecodeError as error:
        raise ParameterSetError(f"{path}: no JSON ({error})") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ParameterSetError(f"{path}: no provenance of a parameter set")
    if document.get("version") != VERSION:
        raise ParameterSetError(
            f"{path}: version {document.get('version')!r} of the format, {VERSION} expected"
        )
    if document.pop("sha256", None) != _digest(document):
        raise ParameterSetError(f"{path}: content and checksum differ; the file was changed")
    return document


def file_digest(path: Path) -> str:
    """SHA-256 of a file in hexadecimal digits.

    Raises:
        ParameterSetError: The file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ParameterSetError(f"{path}: not readable ({_reason(error)})") from None


def identifier(digests: Mapping[str, str]) -> str:
    """Short name of a content: equal for sets that make a node plan the same.

    Args:
        digests: SHA-256 of every file but the provenance, by name.
    """
    lines = "".join(f"{name} {digests[name]}\n" for name in sorted(digests))
    return hashlib.sha256(lines.encode()).hexdigest()[:IDENTIFIER_DIGITS]


def _digest(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _reason(error: OSError | UnicodeDecodeError) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
