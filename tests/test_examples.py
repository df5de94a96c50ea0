"""The examples in the docstrings of all that users import: every name has one, and it runs."""

from __future__ import annotations

import doctest
import inspect

import pytest

import dscp_core

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS | doctest.REPORT_NDIFF


def example_of(value: object) -> str:
    """The section ``Example:`` of a docstring."""
    # Not inherited: a class has to have its own.
    text = inspect.cleandoc(getattr(value, "__doc__", None) or "")
    _, mark, section = text.partition("\nExample:\n")
    return section if mark else ""


@pytest.mark.parametrize("name", [*dscp_core.__all__, "dscp_core"])
def test_the_example_of_a_name_runs(name: str) -> None:
    value = dscp_core if name == "dscp_core" else getattr(dscp_core, name)
    section = example_of(value)
    assert ">>> " in section, f"{name} has no Example:"
    test = doctest.DocTestParser().get_doctest(section, {}, name, None, None)
    said: list[str] = []
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    failed, _ = runner.run(test, out=said.append, clear_globs=False)
    assert failed == 0, "".join(said)
    used = {type(thing).__name__ for thing in test.globs.values()}
    assert name in section or name in used, f"not an example of {name}"
