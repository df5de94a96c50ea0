"""Parameter files and overrides as the command line names them, read to find what ROS ignores.

rcl drops, without a word, the sections of nodes that do not exist and parameters that a node does
not declare: a misspelt name then means a default. Here both are errors. Files are also read again
by ``~/reload``.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from dscp_core.errors import InvalidInputError
from dscp_core.problem.yaml_files import read_yaml

_SECTION_KEY = "ros__parameters"
_NODE_OVERRIDE = re.compile(r"^(?:(?P<node>[^:]+):)?(?P<name>[^:]+):=")
_NEAR = 0.7
"""difflib ratio from which two node names are taken for one with a typing error."""


@dataclass(frozen=True)
class ParameterArguments:
    """Parameter sources on a ROS command line, in order.

    Attributes:
        files: Parameter files.
        names: Names set by ``-p NAME:=VALUE``; they win over the files.
        nodes: Node names given by ``-p NODE:NAME:=VALUE``.
    """

    files: tuple[str, ...]
    names: frozenset[str]
    nodes: tuple[str, ...]


def parameter_arguments(arguments: Sequence[str]) -> ParameterArguments:
    """Find the parameter sources among command-line arguments."""
    files: list[str] = []
    names: list[str] = []
    nodes: list[str] = []
    within_ros = False
    for word, following in pairwise([*arguments, ""]):
        if word == "--ros-args":
            within_ros = True
        elif word == "--":
            within_ros = False
        elif within_ros and word == "--params-file":
            files.append(following)
        elif within_ros and word in ("-p", "--param"):
            match = _NODE_OVERRIDE.match(following)
            if match:
                names.append(match["name"])
                nodes.extend([match["node"]] if match["node"] else [])
    return ParameterArguments(tuple(files), frozenset(names), tuple(nodes))


def check_files(arguments: ParameterArguments) -> None:
    """Check that every file is a parameter file; rcl's own messages on that are hard to read.

    Raises:
        InvalidInputError: A file is missing, no YAML, or no parameter file.
    """
    for path in arguments.files:
        for _ in _sections(path):
            pass


def check_node_names(arguments: ParameterArguments, node_name: str) -> None:
    """Check that every file and override that is meant for a node names it correctly.

    A file may have sections of other nodes, but it must have one that applies to this node, and
    if that one is a wildcard only, no section may nearly have this node's name.

    Args:
        arguments: Parameter sources.
        node_name: Fully qualified name of the node.

    Raises:
        InvalidInputError: A file lacks the node, or a name is nearly the node's.
    """
    for node in arguments.nodes:
        if not _matches(node, node_name):
            raise InvalidInputError("-p node name", node, _did_you_mean(node_name))
    for path in arguments.files:
        found = [section for section, _ in _sections(path)]
        applying = [section for section in found if _matches(section, node_name)]
        if any("*" not in section for section in applying):
            continue
        for section in found:
            if section not in applying and _is_near(section, node_name):
                raise InvalidInputError(f"{path}: node name", section, _did_you_mean(node_name))
        if not applying:
            bound = f"a section for {node_name}"
            raise InvalidInputError(f"{path}: node names", found, bound)


def check_parameter_names(given: Sequence[str], declared: Sequence[str]) -> None:
    """Check that every given parameter is declared.

    Raises:
        InvalidInputError: Unknown names, each with the near ones that exist.
    """
    unknown = [name for name in given if name not in declared]
    if not unknown:
        return
    hints = []
    for name in unknown:
        near = difflib.get_close_matches(name, declared, n=3, cutoff=0.5)
        hints.append(f"{name} (did you mean {', '.join(near)}?)" if near else name)
    raise InvalidInputError("parameters", unknown, f"declared names: {'; '.join(hints)}")


def read_parameters(arguments: ParameterArguments, node_name: str) -> dict[str, Any]:
    """Parameter values of a node in the files as they are now, later ones winning.

    Names that the command line sets itself are left out: it wins over the files.

    Raises:
        InvalidInputError: A file is missing, no YAML, or no parameter file.
    """
    values: dict[str, Any] = {}
    for path in arguments.files:
        values.update(read_file(path, node_name))
    return {name: value for name, value in values.items() if name not in arguments.names}


def read_file(path: str, node_name: str) -> dict[str, Any]:
    """Parameter values of a node in one file.

    Raises:
        InvalidInputError: The file is missing, no YAML, or no parameter file.
    """
    values: dict[str, Any] = {}
    for section, parameters in _sections(path):
        if _matches(section, node_name):
            values.update(_flatten(parameters))
    return values


def _sections(path: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Pairs of node name and parameters in a file."""
    content = read_yaml("parameter file", path)
    if not isinstance(content, dict):
        raise InvalidInputError("parameter file", path, "a mapping of node names")
    yield from _nested_sections(path, "", content)


def _nested_sections(
    path: str, prefix: str, content: Mapping[str, Any]
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for key, value in content.items():
        name = f"{prefix}/{key}".replace("//", "/") if prefix else str(key)
        if not isinstance(value, dict):
            bound = f"a mapping with the key {_SECTION_KEY}"
            raise InvalidInputError(f"{path}: section {name}", value, bound)
        if _SECTION_KEY not in value:
            yield from _nested_sections(path, name, value)
        elif not isinstance(value[_SECTION_KEY], dict):
            raise InvalidInputError(
                f"{path}: {name}.{_SECTION_KEY}", value[_SECTION_KEY], "a mapping of parameters"
            )
        else:
            yield name, value[_SECTION_KEY]


def _flatten(parameters: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in parameters.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _matches(section: str, node_name: str) -> bool:
    """Whether rcl applies a section to a node: ``*`` is one level, ``**`` any number."""
    escaped = re.escape("/" + section.lstrip("/"))
    pattern = escaped.replace(r"/\*\*", r"(?:/[^/]+)*").replace(r"\*", r"[^/]+")
    return re.fullmatch(pattern, node_name) is not None


def _is_near(section: str, node_name: str) -> bool:
    a, b = section.rpartition("/")[2], node_name.rpartition("/")[2]
    return difflib.SequenceMatcher(None, a, b).ratio() >= _NEAR


def _did_you_mean(node_name: str) -> str:
    return f"a name of this node; did you mean {node_name}?"
