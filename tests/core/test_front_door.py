"""What can be imported from dscp_core, and what that loads."""

from __future__ import annotations

import subprocess
import sys

import pytest

import dscp_core

HEAVY = ("torch", "rclpy", "casadi", "scipy", "matplotlib", "numpy", "ray")


def loaded_after(code: str) -> set[str]:
    """Which of the heavy modules a fresh interpreter has after running the code."""
    show = f"import sys; print(*(m for m in {HEAVY!r} if m in sys.modules))"
    run = subprocess.run(
        [sys.executable, "-c", f"{code}\n{show}"], capture_output=True, text=True, check=True
    )
    return set(run.stdout.splitlines()[-1].split()) if run.stdout.strip() else set()


def test_importing_it_loads_nothing_heavy() -> None:
    assert loaded_after("import dscp_core; dir(dscp_core); dscp_core.__all__") == set()


def test_errors_load_nothing_heavy() -> None:
    assert loaded_after("from dscp_core import DscpError, InvalidInputError") == set()


def test_a_plan_and_its_gradient_need_neither_torch_nor_ros() -> None:
    code = (
        "from dscp_core import Planner, problems\n"
        "planner = Planner(problems.get('powered_descent'))\n"
        "assert planner.gradient('cost', at=planner.plan()).trusted"
    )
    assert not {"torch", "rclpy", "matplotlib", "ray"} & loaded_after(code)


@pytest.mark.parametrize("name", dscp_core.__all__)
def test_every_name_is_there(name: str) -> None:
    value = getattr(dscp_core, name)
    assert name in dir(dscp_core)
    assert value.__doc__
    # A name means the same in its home, which its pickles and its documentation name.
    if isinstance(value, type):
        assert value.__name__ == name
        assert getattr(sys.modules[value.__module__], name) is value


def test_names_stand_once() -> None:
    assert dscp_core.__all__ == sorted(set(dscp_core.__all__))
    assert set(dscp_core._HOME_OF) == set(dscp_core.__all__) - {"problems"}


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="Planer"):
        _ = dscp_core.Planer  # type: ignore[attr-defined]
