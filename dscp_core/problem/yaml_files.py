"""YAML that people write by hand, read so that nothing in it is misread without a word."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from dscp_core.errors import InvalidInputError


class _Loader(yaml.SafeLoader):
    """Numbers as in YAML 1.2, where 8e5 is one and 1:30 is none; every name once."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping, refused where one of its own names is given twice."""
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for name in names:
            if names.count(name) > 1:
                problem = f"{name} is given twice"
                raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in pairs if not tag.endswith((":int", ":float"))]
    for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_constructor("tag:yaml.org,2002:int", lambda _, node: int(node.value))
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:int", re.compile(r"^[-+]?[0-9]+$"), list("-+0123456789")
)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$"
        r"|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"
    ),
    list("-+0123456789."),
)


def read_yaml(field: str, path: str | Path) -> Any:
    """What a YAML file holds.

    Args:
        field: What the file is, as messages call it.
        path: The file.

    Raises:
        InvalidInputError: It cannot be read, is no YAML, or gives a name twice.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, ValueError) as error:  # no text, or no path
        raise InvalidInputError(field, str(path), f"a readable file ({error})") from None
    try:
        return yaml.load(text, Loader=_Loader)
    # PyYAML lets through what its constructors raise, of dates and of numbers with 5000 digits.
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InvalidInputError(field, str(path), f"valid YAML ({error})") from None
