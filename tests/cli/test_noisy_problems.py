"""Problems whose own code prints, or ends in ways that are not its business."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dscp_ros.cli import ExitCode
from dscp_ros.cli.main import main

EXAMPLES = Path(__file__).parents[2] / "examples"
NOISY = f"""
import sys
from dataclasses import replace

sys.path.append({str(EXAMPLES)!r})
print("on import")
from double_integrator import double_integrator as problem


def dynamics(x, u, p):
    print("in dynamics")
    return problem.dynamics(x, u, p)


def noisy():
    print("in factory")
    return replace(problem, dynamics=dynamics)
"""


@pytest.mark.parametrize(
    "command",
    [
        ["plan"],
        ["plan", "--list-parameters"],
        ["plan", "--set", "nope=1"],
        ["gradient", "--of", "cost", "--wrt", "terminal_time"],
    ],
)
def test_json_on_stdout_is_the_result_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    file = tmp_path / "noisy.py"
    file.write_text(NOISY, encoding="utf-8")
    main([command[0], f"{file}:noisy", *command[1:], "--json"])
    printed = capsys.readouterr()
    assert isinstance(json.loads(printed.out), dict)
    assert "in factory" in printed.err
    main([command[0], f"{file}:noisy", *command[1:]])
    assert "in factory" in capsys.readouterr().out


@pytest.mark.parametrize("where", ["{}", "def name():\n    {}"])
@pytest.mark.parametrize("what", ["BaseException('enough')", "SystemExit(0)", "GeneratorExit"])
def test_whatever_a_file_raises_is_bad_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], where: str, what: str
) -> None:
    file = tmp_path / "raises.py"
    file.write_text(where.format(f"raise {what}"), encoding="utf-8")
    assert main(["plan", f"{file}:name"]) == ExitCode.BAD_INPUT
    assert what.partition("(")[0] in capsys.readouterr().err
