"""Entry point of `dscp`: picks the command, runs it, turns errors into exit codes."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from importlib import import_module
from typing import Any, NamedTuple, NoReturn

from dscp_core.errors import DscpError, InvalidInputError
from dscp_ros.cli import ExitCode
from dscp_ros.cli.results import print_document, results_only


class Command(NamedTuple):
    """Where a command lives and what `dscp --help` says about it."""

    module: str
    summary: str


# A table, not imports: the command modules need CasADi, ROS or Matplotlib, `dscp --help` does not.
COMMANDS: dict[str, Command] = {
    "plan": Command("dscp_ros.cli.plan_command", "solve one case, without ROS"),
    "gradient": Command("dscp_ros.cli.gradient_command", "differentiate a plan, without ROS"),
    "simulate": Command("dscp_ros.cli.simulate_command", "fly closed-loop campaigns, without ROS"),
    "study": Command("dscp_ros.cli.study_commands", "reproduce a published result"),
    "train": Command("dscp_ros.cli.train_command", "train the terminal-time network"),
    "tune": Command("dscp_ros.cli.tune_command", "tune parameters on logs"),
    "evaluate": Command("dscp_ros.cli.evaluate_command", "measure a network against brute force"),
    "planner": Command("dscp_ros.cli.planner_command", "run the planner as a ROS 2 node"),
    "guide": Command("dscp_ros.cli.guide_command", "run guidance as a ROS 2 node"),
    "replay": Command("dscp_ros.cli.replay_command", "publish a bag's messages on ROS 2 topics"),
    "bag": Command("dscp_ros.cli.bag_commands", "look into, check and repair MCAP bags"),
}

EPILOG = """\
examples:
  dscp plan powered_descent
  dscp plan powered_descent --set terminal_time=32.81 --set initial_position=5000,500,500
  dscp gradient powered_descent --of final_mass --wrt terminal_time --check
  dscp simulate --flights 20
  dscp planner &
  dscp replay BAG

`dscp COMMAND --help` explains each command and its units (SI).

exit codes: 0 good, 2 bad input, 3 no plan, 4 no better set, 130 interrupted.
With --json, an error is also printed on stdout, as {"error": {"type": ..., "message": ...}}.
"""

# The extra that brings a module which an installation may lack. Message packages: see extra_of.
EXTRA_OF_MODULE = {"rclpy": "ros", "rosgraph_msgs": "ros", "torch": "learn"}
MESSAGE_PACKAGE_ENDINGS = ("_msgs", "_interfaces", "_srvs")


class UsageError(DscpError):
    """The command line cannot be parsed.

    Attributes:
        usage: The usage line of the parser that refused it.
    """

    def __init__(self, message: str, usage: str) -> None:
        super().__init__(message)
        self.usage = usage


class MissingExtraError(DscpError):
    """A command needs a library that comes with an extra of this package."""

    def __init__(self, command: str, module: str, extra: str) -> None:
        remedy = f"pip install 'dscp[{extra}]'"
        if extra == "ros":
            remedy += ", or source the setup file of your ROS 2 installation"
        super().__init__(f"`{command}` needs the Python module {module}: {remedy}")


class FileAccessError(DscpError):
    """A file that was named cannot be read or written."""


class CommandParser(argparse.ArgumentParser):
    """An argument parser that raises `UsageError` and takes options by their full names only."""

    def __init__(self, **kwargs: Any) -> None:
        kwargs.setdefault("allow_abbrev", False)
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(**kwargs)

    def error(self, message: str) -> NoReturn:
        """Raises instead of exiting, so that --json works for these errors too.

        Raises:
            UsageError: Always.
        """
        raise UsageError(message, self.format_usage())


class VersionAction(argparse.Action):
    """Prints the installed version; looks it up only when asked."""

    def __init__(self, option_strings: Sequence[str], dest: str, **kwargs: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, **kwargs)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        """Prints the version and exits."""
        from importlib.metadata import version

        print(f"dscp {version('dscp')}")
        parser.exit()


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one `dscp` command.

    Args:
        argv: The arguments after the program's name; the process's own by default.

    Returns:
        The exit code, see `ExitCode`.

    Raises:
        SystemExit: After --help and --version, as argparse does.
    """
    arguments = sys.argv[1:] if argv is None else list(argv)
    try:
        try:
            return _run(arguments)
        finally:
            sys.stdout.flush()
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    except BrokenPipeError:
        # The reader has left (`dscp ... | head`): nothing to say, and nowhere to say it. The
        # interpreter flushes stdout once more on its way out, hence the other end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitCode.BROKEN_PIPE


def build_parser(command: str | None) -> CommandParser:
    """Returns the parser of `dscp`, in which only one command is complete.

    Args:
        command: The command whose module is imported; the others are listed with their summary.

    Raises:
        MissingExtraError: The command's module needs a library that is not installed.
    """
    parser = CommandParser(
        prog="dscp",
        description="Differentiable sequential convex programming: certified trajectories, "
        "their gradients, and a ROS 2 planner.",
        epilog=EPILOG,
    )
    parser.add_argument("--version", action=VersionAction, help="print the version and exit")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, entry in COMMANDS.items():
        if name == command:
            import_module(entry.module).add_parser(subparsers)
        else:
            subparsers.add_parser(name, help=entry.summary)
    return parser


def extra_of(module: str) -> str | None:
    """Returns the extra of this package that brings a module, None where there is none."""
    root = module.partition(".")[0]
    if root.endswith(MESSAGE_PACKAGE_ENDINGS):
        return "ros"
    return EXTRA_OF_MODULE.get(root)


def _run(arguments: list[str]) -> int:
    command = next((word for word in arguments if not word.startswith("-")), None)
    as_json = "--json" in arguments
    try:
        args = build_parser(command).parse_args(arguments)
        run: Callable[[argparse.Namespace], int] = args.run
        with results_only() if as_json else nullcontext():
            return run(args)
    except ModuleNotFoundError as error:
        extra = extra_of(error.name or "")
        if extra is None:
            raise
        return _report(MissingExtraError(f"dscp {command}", str(error.name), extra), as_json)
    except OSError as error:
        if isinstance(error, BrokenPipeError) or error.strerror is None:
            raise
        where = "" if error.filename is None else f"{error.filename}: "
        return _report(FileAccessError(f"{where}{error.strerror}"), as_json)
    except DscpError as error:
        return _report(error, as_json)


def _report(error: DscpError, as_json: bool) -> int:
    """Prints an error for people on stderr, and for scripts on stdout."""
    if isinstance(error, UsageError):
        print(error.usage, end="", file=sys.stderr)
    print(f"dscp: error: {error}", file=sys.stderr)
    if as_json:
        description: dict[str, object] = {"type": type(error).__name__, "message": str(error)}
        if isinstance(error, InvalidInputError):
            description |= {
                "field": error.field,
                "value": _json_value(error.value),
                "bound": error.bound,
            }
        print_document({"error": description})
    return ExitCode.BAD_INPUT


def _json_value(value: object) -> object:
    """Returns a value that JSON can hold: text for what it cannot, NaN and infinity included."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float) and math.isfinite(value):
        return value
    return str(value)
