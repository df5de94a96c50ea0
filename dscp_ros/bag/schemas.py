"""Message classes, definitions and type hashes of the installed ROS packages.

The definitions come from the files that every ROS message package installs:
`share/<package>/msg/<Name>.msg`, and `<Name>.json` with the type description and the RIHS01 hashes
of REP-2016.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from dscp_ros.bag.errors import UnknownMessageTypeError

_SEPARATOR = "\n" + "=" * 80 + "\nMSG: "


@dataclass(frozen=True)
class MessageDefinition:
    """What a bag stores about a message type.

    Attributes:
        type_name: Full name, such as `nav_msgs/msg/Odometry`.
        text: The definition and, after it, those of all types that it contains.
        encoding: How `text` is written: `ros2msg` or `ros2idl`.
        type_hash: REP-2016 hash such as `RIHS01_3cc9...`, or empty when unknown.
    """

    type_name: str
    text: str
    encoding: str = "ros2msg"
    type_hash: str = ""


def split_type_name(type_name: str) -> tuple[str, str]:
    """Splits `package/msg/Name` into package and name.

    Raises:
        UnknownMessageTypeError: If the name has another form.
    """
    match type_name.split("/"):
        case [package, "msg", name] if package.isidentifier() and name.isidentifier():
            return package, name
    raise UnknownMessageTypeError(type_name, "is not of the form package/msg/Name")


@cache
def message_class(type_name: str) -> type[Any]:
    """Imports the Python class of a message type.

    Raises:
        UnknownMessageTypeError: If the package or the message is not installed.
    """
    package, name = split_type_name(type_name)
    try:
        module = importlib.import_module(f"{package}.msg")
    except ModuleNotFoundError as error:
        raise UnknownMessageTypeError(
            type_name, f"ROS package {package} is not installed ({error})"
        ) from error
    found = getattr(module, name, None)
    if not isinstance(found, type):
        raise UnknownMessageTypeError(type_name, f"ROS package {package} has no message {name}")
    return found


def type_name_of(message_type: type[Any]) -> str:
    """Returns the ROS name of a message class, such as `nav_msgs/msg/Odometry`.

    Raises:
        UnknownMessageTypeError: If the class is not a ROS message.
    """
    package, separator, _ = message_type.__module__.partition(".msg")
    if not separator or not hasattr(message_type, "get_fields_and_field_types"):
        raise UnknownMessageTypeError(message_type.__qualname__, "is not a ROS message class")
    return f"{package}/msg/{message_type.__name__}"


@cache
def type_description(type_name: str) -> dict[str, Any]:
    """Reads the description file of an installed message type: fields and hashes (REP-2016).

    Raises:
        UnknownMessageTypeError: If the file is missing.
    """
    content: dict[str, Any] = json.loads(
        _definition_path(type_name, ".json").read_text(encoding="utf-8")
    )
    return content


@cache
def message_definition(type_name: str) -> MessageDefinition:
    """Collects the definition of an installed message type and of all types it contains.

    Raises:
        UnknownMessageTypeError: If a definition file is missing or unreadable.
    """
    description = type_description(type_name)
    contained = [
        entry["type_name"]
        for entry in description["type_description_msg"]["referenced_type_descriptions"]
    ]
    parts = [_read_text(type_name)]
    for name in contained:
        package, message = split_type_name(name)
        parts.append(f"{package}/{message}\n{_read_text(name)}")
    return MessageDefinition(
        type_name, _SEPARATOR.join(parts), type_hash=_hash_of(description, type_name)
    )


def installed_type_hash(type_name: str) -> str:
    """Returns the REP-2016 hash of an installed message type.

    Raises:
        UnknownMessageTypeError: If the type is not installed.
    """
    return _hash_of(type_description(type_name), type_name)


def _hash_of(description: dict[str, Any], type_name: str) -> str:
    for entry in description["type_hashes"]:
        if entry["type_name"] == type_name:
            return str(entry["hash_string"])
    raise UnknownMessageTypeError(type_name, "its description file holds no hash of it")


def _read_text(type_name: str) -> str:
    return _definition_path(type_name, ".msg").read_text(encoding="utf-8")


def _definition_path(type_name: str, suffix: str) -> Path:
    """Finds a definition file from where the Python package of the messages is installed.

    The share directory is looked for above the Python package, which works for wheels, for
    `/opt/ros`, and for colcon workspaces, with or without AMENT_PREFIX_PATH.
    """
    package, name = split_type_name(type_name)
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise UnknownMessageTypeError(type_name, f"ROS package {package} is not installed")
    for prefix in Path(spec.origin).parents:
        path = prefix / "share" / package / "msg" / (name + suffix)
        if path.is_file():
            return path
    raise UnknownMessageTypeError(
        type_name, f"share/{package}/msg/{name}{suffix} is not installed above {spec.origin}"
    )
