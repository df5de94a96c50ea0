"""The frame of `dscp`: what every command shares."""

from __future__ import annotations

import argparse
import importlib
import json
import math
import subprocess
import sys
import types
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest

from dscp_core.errors import DscpError, InvalidInputError
from dscp_ros.cli import ExitCode
from dscp_ros.cli import main as frame

HEAVY_MODULES = ("numpy", "casadi", "matplotlib", "rclpy", "torch")


@pytest.fixture
def install_command(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., int]], None]:
    """Returns a function that makes `dscp probe [--json] [--text TEXT]` run what it is given."""

    def install(run: Callable[[argparse.Namespace], int]) -> None:
        def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
            parser = subparsers.add_parser("probe", help="a command of this test")
            parser.add_argument("--json", action="store_true")
            parser.add_argument("--text")
            parser.set_defaults(run=run)

        module = types.ModuleType("dscp_test_probe_command")
        module.add_parser = add_parser  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setitem(frame.COMMANDS, "probe", frame.Command(module.__name__, "a probe"))

    return install


def raising(error: BaseException) -> Callable[[argparse.Namespace], int]:
    def run(args: argparse.Namespace) -> int:
        raise error

    return run


@pytest.mark.parametrize("command", frame.COMMANDS)
def test_every_command_has_help_and_something_to_run(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert callable(importlib.import_module(frame.COMMANDS[command].module).add_parser)
    with pytest.raises(SystemExit) as stopped:
        frame.main([command, "--help"])
    assert stopped.value.code == ExitCode.OK
    help_text = capsys.readouterr().out
    assert help_text.startswith(f"usage: dscp {command}")
    assert "example" in help_text.lower(), "the help of a command shows how to call it"


def test_help_lists_every_command_and_imports_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from dscp_ros.cli.main import main\n"
        "try:\n"
        "    main(['--help'])\n"
        "finally:\n"
        f"    print('imported:', *(set({HEAVY_MODULES}) & set(sys.modules)))\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == ExitCode.OK, result.stderr
    for command, entry in frame.COMMANDS.items():
        assert f"    {command}" in result.stdout
        assert entry.summary in result.stdout
    assert result.stdout.splitlines()[-1] == "imported:"


def test_version_is_that_of_the_installed_distribution(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        frame.main(["--version"])
    assert stopped.value.code == ExitCode.OK
    assert capsys.readouterr().out == f"dscp {version('dscp')}\n"


def test_exit_code_of_a_command_is_passed_on(install_command: Callable[..., None]) -> None:
    install_command(lambda args: ExitCode.NO_PLAN)
    assert frame.main(["probe"]) == ExitCode.NO_PLAN


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "required: COMMAND"),
        (["fly"], "invalid choice: 'fly'"),
        (["probe", "--speed=3"], "unrecognized arguments: --speed=3"),
        (["probe", "--tex=3"], "unrecognized arguments: --tex=3"),  # no abbreviations
    ],
)
def test_wrong_usage(
    arguments: list[str],
    complaint: str,
    install_command: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    install_command(lambda args: ExitCode.OK)
    assert frame.main(arguments) == ExitCode.BAD_INPUT
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("usage: dscp")
    assert complaint in output.err


def test_wrong_usage_as_json(
    install_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    install_command(lambda args: ExitCode.OK)
    assert frame.main(["probe", "--json", "--text"]) == ExitCode.BAD_INPUT
    error = json.loads(capsys.readouterr().out)["error"]
    assert error == {
        "type": "UsageError",
        "message": "argument --text: expected one argument",
    }


def test_bad_input_names_field_value_and_bound(
    install_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    install_command(raising(InvalidInputError("mass", -1.5, "> 0 kg")))
    assert frame.main(["probe"]) == ExitCode.BAD_INPUT
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err == "dscp: error: mass: got -1.5, expected > 0 kg\n"

    assert frame.main(["probe", "--json"]) == ExitCode.BAD_INPUT
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["type"] == "InvalidInputError"
    assert (error["field"], error["value"], error["bound"]) == ("mass", -1.5, "> 0 kg")


@pytest.mark.parametrize("value", [math.nan, math.inf, [1.0, math.nan], object()])
def test_json_error_is_strict_json_whatever_the_value(
    value: object, install_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    install_command(raising(InvalidInputError("position", value, "finite")))
    frame.main(["probe", "--json"])
    error = json.loads(capsys.readouterr().out, parse_constant=refuse)["error"]
    assert error["value"] == str(value)


def test_missing_file_is_bad_input(
    install_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    install_command(lambda args: len(Path(args.text).read_bytes()))
    assert frame.main(["probe", "--text", "no/such/file"]) == ExitCode.BAD_INPUT
    assert capsys.readouterr().err == "dscp: error: no/such/file: No such file or directory\n"


@pytest.mark.parametrize(
    ("module", "extra"),
    [("rclpy.node", "ros"), ("nav_msgs.msg", "ros"), ("std_srvs", "ros"), ("torch", "learn")],
)
def test_missing_library_names_the_extra(
    module: str,
    extra: str,
    install_command: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    install_command(raising(ModuleNotFoundError(f"No module named {module!r}", name=module)))
    assert frame.main(["probe"]) == ExitCode.BAD_INPUT
    message = capsys.readouterr().err
    assert f"`dscp probe` needs the Python module {module}" in message
    assert f"pip install 'dscp[{extra}]'" in message


@pytest.mark.parametrize(
    "error",
    [RuntimeError("a bug"), ModuleNotFoundError("a bug", name="dscp_core.misspelt"), OSError(5)],
)
def test_an_error_of_the_program_is_not_hidden(
    error: Exception, install_command: Callable[..., None]
) -> None:
    install_command(raising(error))
    with pytest.raises(type(error)) as raised:
        frame.main(["probe"])
    assert raised.value is error


def test_other_own_errors_are_bad_input(
    install_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    install_command(raising(DscpError("the bag holds no message")))
    assert frame.main(["probe", "--json"]) == ExitCode.BAD_INPUT
    assert json.loads(capsys.readouterr().out) == {
        "error": {"type": "DscpError", "message": "the bag holds no message"}
    }


def test_interrupt_leaves_no_traceback(
    install_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    install_command(raising(KeyboardInterrupt()))
    assert frame.main(["probe"]) == ExitCode.INTERRUPTED
    assert capsys.readouterr().err == ""


def test_reader_that_leaves_early_is_no_error() -> None:
    code = (
        "import sys, types\n"
        "from dscp_ros.cli import main as frame\n"
        "def add_parser(subparsers):\n"
        "    parser = subparsers.add_parser('probe')\n"
        "    parser.set_defaults(run=lambda args: print('much output ' * 10_000))\n"
        "sys.modules['probe_command'] = types.SimpleNamespace(add_parser=add_parser)\n"
        "frame.COMMANDS['probe'] = frame.Command('probe_command', '')\n"
        "sys.exit(frame.main(['probe']))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.close()  # before the child has started to write
    _, errors = process.communicate(timeout=60)
    assert errors == ""
    assert process.returncode == ExitCode.BROKEN_PIPE
