"""Sets up ROS for a replay, and takes it down again."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dscp_core.errors import InvalidInputError
from dscp_ros.bag import BagFormatError, BagReader, RecoveryReport
from dscp_ros.replay.player import Player
from dscp_ros.replay.progress import Progress
from dscp_ros.replay.publishers import create_publishers, selected_topics
from dscp_ros.replay.schedule import replay_window
from dscp_ros.replay.wake import Wake, stop_signals
from dscp_ros.spinning import SpinningThread

if TYPE_CHECKING:
    from dscp_ros.replay.options import ReplayOptions
    from dscp_ros.replay.result import ReplayResult

NODE_NAME = "dscp_replay"
_SHUTDOWN_S = 5.0


def replay(
    options: ReplayOptions,
    *,
    show_progress: bool | None = None,
    ros_args: Sequence[str] = (),
    say: Callable[[str], None] = lambda line: None,
) -> tuple[ReplayResult, RecoveryReport]:
    """Replays a bag. Must be called in the main thread: SIGINT and SIGTERM end the replay.

    Args:
        options: What to replay and how.
        show_progress: Whether to show a progress bar; None where stderr is a terminal.
        ros_args: Arguments for ROS, without `--ros-args`.
        say: Is told what a user should know before the replay starts.

    Returns:
        What was done, and what was found damaged in the bag.

    Raises:
        BagError: If the bag cannot be replayed.
        InvalidInputError: If an option does not fit the bag.
        SubscriberTimeoutError: If the subscribers that were asked for did not come.
    """
    with BagReader(options.bag) as reader:
        topics, skipped = selected_topics(reader, options)
        if reader.message_count == 0:
            damages = "".join(f"; {damage}" for damage in reader.report.damages)
            raise BagFormatError(f"{options.bag}: there is no message in it{damages}")
        window = replay_window(
            reader.start_ns, reader.end_ns, options.start_offset_s, options.duration_s
        )
        for line in (
            *(f"damaged bag: {damage}" for damage in reader.report.damages),
            *(f"topic {name} is left out: {reason}" for name, reason in skipped.items()),
        ):
            say(line)
        with closing(Wake()) as wake, stop_signals(wake) as stopping, _node(ros_args) as node:
            publishers = create_publishers(node, topics, options)
            if options.restamp:
                for entry in publishers.values():
                    if not entry.stamped:
                        say(f"topic {entry.topic.name} has no leading header: it is not restamped")
            # A collection of everything imported so far would delay messages by milliseconds.
            gc.collect()
            gc.freeze()
            with wake.keyboard() as has_keys, Progress(window.length_s, show_progress) as progress:
                if has_keys:
                    say("space or s pauses and resumes, Ctrl-C stops")
                player = Player(node, reader, publishers, window, options, wake, stopping, progress)
                result = player.run()
        report = reader.report
        if not (result.message_count or result.interrupted or report.intact):
            raise BagFormatError(f"{options.bag}: no message can be read: {report.damages[0]}")
        return replace(result, skipped=skipped), report


@contextmanager
def _node(ros_args: Sequence[str]) -> Iterator[Node]:
    """A node in a context of its own, spun by a thread of its own."""
    context = Context()
    try:
        rclpy.init(
            context=context,
            args=["--ros-args", *ros_args] if ros_args else [],
            signal_handler_options=SignalHandlerOptions.NO,
        )
    except RuntimeError as error:  # RCLError and UnknownROSArgsError
        if not ros_args:
            raise
        given = " ".join(ros_args)
        raise InvalidInputError(
            "--ros-args", given, f"arguments that ROS knows ({error})"
        ) from error
    try:
        node = Node(NODE_NAME, context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        thread = SpinningThread(executor, "replay-services")
        try:
            yield node
        finally:
            thread.stop(_SHUTDOWN_S)
            node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
