"""A ROS 2 node as a process: arguments, signals, the executor's loop, a clean end."""

from __future__ import annotations

import argparse
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import TYPE_CHECKING, Any, Protocol

from dscp_core.errors import DscpError, InvalidInputError
from dscp_ros.cli import ExitCode

if TYPE_CHECKING:
    from rclpy.executors import Executor
    from rclpy.node import Node

    from dscp_ros.planner.parameter_files import ParameterArguments

_SPIN_S = 0.1
"""Longest wait for work; a signal is noticed no later than this."""

_STOP_S = 3.0
"""Longest wait for the attempt in hand at the end; launch files send SIGKILL after 5 to 10 s."""


class RunningNode(Protocol):
    """What lives on a node."""

    def close(self, timeout_s: float) -> bool:
        """End it; whether that took no longer."""
        ...

    def report_internal_error(self, error: Exception) -> None:
        """Report an exception that a callback let through."""
        ...


if TYPE_CHECKING:
    MakeNode = Callable[[Node, ParameterArguments], RunningNode]


@dataclass(frozen=True)
class NodeCommand:
    """A node as a program of its own and as a command of `dscp`.

    Attributes:
        name: Name of the node.
        description: What the help says first.
        epilog: What it says last.
        add_arguments: Declares what the node has beside `add_ros_arguments`; ``problem`` is one.
        make: Brings it to life.
    """

    name: str
    description: str
    epilog: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    make: MakeNode

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run the node until a signal ends it.

        Args:
            argv: Arguments after the program's name; the process's own by default.

        Returns:
            Exit code.
        """
        parser = argparse.ArgumentParser(
            prog=self.name,
            description=self.description,
            epilog=self.epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        self._declare(parser)
        try:
            return self.run(parser.parse_args(argv))
        except DscpError as error:
            print(f"{self.name}: error: {error}", file=sys.stderr)
            return ExitCode.BAD_INPUT

    def add_parser(self, subparsers: Any, command: str, summary: str) -> None:
        """Declare the command of `dscp`."""
        parser = subparsers.add_parser(
            command, help=summary, description=self.description, epilog=self.epilog
        )
        self._declare(parser)
        parser.set_defaults(run=self.run)

    def run(self, args: argparse.Namespace) -> int:
        """Run the node with parsed arguments, as the last thing that a process does.

        Returns:
            Exit code 0, after SIGINT or SIGTERM.

        Raises:
            InvalidInputError: Bad arguments or parameters.
        """
        return run_node(ros_arguments(args), self.name, self.make)

    def _declare(self, parser: argparse.ArgumentParser) -> None:
        self.add_arguments(parser)
        add_ros_arguments(parser)


def add_ros_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what is for ROS."""
    parser.add_argument(
        "--params-file",
        metavar="FILE",
        action="append",
        default=[],
        help="ROS parameter file (YAML); may be given several times, later ones win",
    )
    parser.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        default=[],
        help="everything that follows is for ROS: remappings (-r), parameters (-p), log level",
    )


def ros_arguments(args: argparse.Namespace) -> list[str]:
    """ROS command line of parsed arguments."""
    files = [word for path in args.params_file for word in ("--params-file", path)]
    words = [*files, *args.ros_args]
    if args.problem is not None:
        quoted = args.problem.replace("'", "''")  # rcl reads YAML
        words += ["-p", f"problem:='{quoted}'"]
    return ["--ros-args", *words] if words else []


def run_node(arguments: Sequence[str], name: str, make: MakeNode) -> int:
    """Run a node with a ROS command line, as the last thing that a process does.

    Args:
        arguments: The command line.
        name: Name of the node.
        make: Brings it to life.

    Returns:
        Exit code 0, after SIGINT or SIGTERM.

    Raises:
        InvalidInputError: Bad arguments or parameters.
    """
    stop = threading.Event()

    def request_stop(_signal: int, _frame: FrameType | None) -> None:
        stop.set()

    # Before the imports below, which take most of a second; rclpy's own handlers end the context
    # under the worker's feet, and lose a SIGTERM that comes to an idle executor.
    previous = {
        number: signal.signal(number, request_stop) for number in (signal.SIGINT, signal.SIGTERM)
    }
    after: dict[signal.Signals, Any] = previous
    try:
        code = _run(arguments, stop, name, make)
        # A second Ctrl-C must not turn a clean end into a killed process.
        after = dict.fromkeys(previous, signal.SIG_IGN)
        return code
    finally:
        for number, handler in after.items():
            signal.signal(number, handler)


def _run(arguments: Sequence[str], stop: threading.Event, name: str, make: MakeNode) -> int:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import try_shutdown

    from dscp_ros.planner.parameter_files import check_files, parameter_arguments

    sources = parameter_arguments(arguments)
    check_files(sources)
    try:
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise InvalidInputError("ROS arguments", list(arguments), f"rcl: {error}") from None
    try:
        executor = SingleThreadedExecutor()
        node = Node(name)
        running = make(node, sources)
        executor.add_node(node)
        # Otherwise the collector walks all that was imported so far, for milliseconds, again and
        # again while plans are made.
        gc.collect()
        gc.freeze()
        _spin(executor, running, stop)
        if not running.close(_STOP_S):
            node.get_logger().warning(f"a plan is left after {_STOP_S:g} s, unfinished")
            # Tearing ROS and Python down under a running solver may crash either.
            os._exit(ExitCode.OK)
        executor.shutdown()
        node.destroy_node()
    finally:
        try_shutdown()
    return ExitCode.OK


def _spin(executor: Executor, running: RunningNode, stop: threading.Event) -> None:
    """Serve callbacks until told to stop; an exception in one of them does not end the node."""
    from rclpy.executors import ExternalShutdownException

    while not stop.is_set():
        try:
            executor.spin_once(timeout_sec=_SPIN_S)
        except ExternalShutdownException:
            return
        except Exception as error:  # noqa: BLE001 - reported; the node lives on
            running.report_internal_error(error)
