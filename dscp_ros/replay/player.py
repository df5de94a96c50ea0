"""The replay itself: one thread that sleeps until the next message, tick or key is due."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from builtin_interfaces.msg import Time
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from dscp_core.errors import DscpError, InvalidInputError
from dscp_ros.bag import BagMessage, BagReader
from dscp_ros.replay.options import ReplayOptions
from dscp_ros.replay.progress import Progress
from dscp_ros.replay.publishers import ACKNOWLEDGE_S, CLOCK_TOPIC, TopicPublisher
from dscp_ros.replay.result import Lateness, ReplayResult
from dscp_ros.replay.schedule import NANOSECONDS, PlaybackClock, Ticker, Window
from dscp_ros.replay.stamping import with_stamp
from dscp_ros.replay.wake import Wake

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.publisher import Publisher

_PAUSE_KEYS = frozenset(" sS")
_PROGRESS_PERIOD_NS = NANOSECONDS // 5
_SUBSCRIBER_POLL_S = 0.02
_SETTLE_NS = NANOSECONDS // 5
"""A publisher sees a subscriber before the subscriber can receive: discovery has two directions."""
_GRACE_S = 0.2
"""For the last messages to leave. Confirmation can take seconds, which few care to wait for."""
_KEEP_ALL_DEPTH = 1000
"""Latched messages from before the start that are sent where the history keeps all."""


class SubscriberTimeoutError(DscpError):
    """The subscribers that the replay was to wait for did not come in time."""


class Player:
    """Publishes a window of a bag.

    Args:
        node: The node that gets the services `~/pause`, `~/resume` and `~/toggle_paused`.
        reader: The open bag.
        publishers: The publishers by recorded topic name.
        window: The part of the bag to play.
        options: How to play it.
        wake: What ends the player's sleep.
        stopping: Not empty as soon as the replay is to stop.
        progress: Where to show the state.
    """

    def __init__(
        self,
        node: Node,
        reader: BagReader,
        publishers: Mapping[str, TopicPublisher],
        window: Window,
        options: ReplayOptions,
        wake: Wake,
        stopping: Sequence[int],
        progress: Progress,
    ) -> None:
        if options.loop and window.end_ns - window.start_ns <= 1:
            raise InvalidInputError("--loop", options.loop, "a window that is longer than 0 s")
        self._reader = reader
        self._publishers = publishers
        self._window = window
        self._options = options
        self._wake = wake
        self._stopping = stopping
        self._progress = progress
        self._lock = threading.Lock()  # of the playback clock, which services change
        now_ns = time.monotonic_ns()
        self._playback = PlaybackClock(options.rate, window.start_ns, now_ns, paused=options.paused)
        self._position_ns = window.start_ns  # bag time of what was published last
        self._passes = 0
        self._lateness = Lateness()
        self._progress_ticker = Ticker(_PROGRESS_PERIOD_NS, now_ns)
        self._clock_ticker: Ticker | None = None
        self._clock_publisher: Publisher | None = None
        if options.clock_hz is not None:
            self._clock_publisher = node.create_publisher(Clock, CLOCK_TOPIC, QoSProfile(depth=1))
        for name, new_state in (
            ("~/pause", lambda _: True),
            ("~/resume", lambda _: False),
            ("~/toggle_paused", lambda paused: not paused),
        ):
            node.create_service(Trigger, name, self._pause_service(new_state))

    def run(self) -> ReplayResult:
        """Plays until the end, or until it is to stop.

        Raises:
            SubscriberTimeoutError: If the subscribers that were asked for did not come.
            MessageDecodeError: If a message is too short to be stamped.
        """
        begun_ns = time.monotonic_ns()
        self._await_subscribers()
        latched = self._latched_before_start()
        start_ns = time.monotonic_ns()
        while not self._stopping:
            self._passes += 1
            start_ns = self._play_once(start_ns, latched)
            if not self._options.loop:
                break
        self._show(time.monotonic_ns())
        confirmed = self._options.as_fast_as_possible and not self._stopping
        for entry in self._publishers.values():
            entry.await_acknowledgement(ACKNOWLEDGE_S if confirmed else _GRACE_S)
        return ReplayResult(
            published={name: entry.published for name, entry in self._publishers.items()},
            passes=self._passes,
            seconds=(time.monotonic_ns() - begun_ns) / NANOSECONDS,
            interrupted=bool(self._stopping),
            lateness_max_s=self._lateness.max_ns / NANOSECONDS,
            lateness_mean_s=self._lateness.mean_ns / NANOSECONDS,
            unacknowledged=tuple(
                name for name, entry in self._publishers.items() if confirmed and entry.silent
            ),
        )

    def _play_once(self, end_of_last_ns: int, latched: list[BagMessage]) -> int:
        """Plays the window once.

        Args:
            end_of_last_ns: Real time at which the last pass ended.
            latched: What latched topics hold at the start.

        Returns:
            Real time at which this pass ended by the bag's timing.
        """
        window, fast = self._window, self._options.as_fast_as_possible
        start_ns = end_of_last_ns + round(self._options.delay_s * NANOSECONDS)
        self._sleep_through(start_ns)
        self._position_ns = window.start_ns
        with self._lock:
            self._playback.restart(window.start_ns, start_ns)
        if self._options.clock_hz is not None:
            period_ns = round(NANOSECONDS / self._options.clock_hz)
            self._clock_ticker = Ticker(period_ns, window.start_ns if fast else start_ns)
        for message in latched:
            self._publish(message)
        for message in self._reader.messages(
            self._publishers, start_ns=window.start_ns, end_ns=window.end_ns
        ):
            late_ns = self._await_bag_time(message.log_time_ns)
            if late_ns is None:
                break
            self._lateness.add(late_ns)
            self._publish(message)
        self._await_bag_time(window.end_ns)
        with self._lock:
            return time.monotonic_ns() if fast else self._playback.due_ns(window.end_ns)

    def _await_bag_time(self, bag_ns: int) -> int | None:
        """Sleeps until a bag time is reached.

        Returns:
            By how many nanoseconds it is late, or None if the replay is to stop.
        """
        fast = self._options.as_fast_as_possible
        if fast:
            self._position_ns = bag_ns
        self._handle_keys(self._wake.wait(0.0))
        while not self._stopping:
            now_ns = time.monotonic_ns()
            with self._lock:
                paused = self._playback.paused
                due_ns = now_ns if fast else self._playback.due_ns(bag_ns)
            next_tick_ns = self._tick(now_ns)
            if paused:
                self._sleep_until(next_tick_ns, now_ns)
            elif now_ns < due_ns:
                self._sleep_until(min(due_ns, next_tick_ns), now_ns)
            else:
                self._position_ns = bag_ns
                return now_ns - due_ns
        return None

    def _tick(self, now_ns: int) -> int:
        """Does what is due periodically; returns the real time of the next tick."""
        if self._progress_ticker.due(now_ns):
            self._show(now_ns)
        if self._clock_ticker is None or self._clock_publisher is None:
            return self._progress_ticker.next_ns
        fast = self._options.as_fast_as_possible
        if self._clock_ticker.due(self._position_ns if fast else now_ns):
            sec, nanosec = divmod(self._bag_now_ns(now_ns), NANOSECONDS)
            self._clock_publisher.publish(Clock(clock=Time(sec=sec, nanosec=nanosec)))
        if fast:
            return self._progress_ticker.next_ns
        return min(self._progress_ticker.next_ns, self._clock_ticker.next_ns)

    def _bag_now_ns(self, now_ns: int) -> int:
        """Returns the bag time at a real time, within the window."""
        if self._options.as_fast_as_possible:
            return self._position_ns
        with self._lock:
            bag_ns = self._playback.bag_ns(now_ns)
        return min(max(bag_ns, self._window.start_ns), self._window.end_ns)

    def _publish(self, message: BagMessage) -> None:
        entry = self._publishers[message.topic.name]
        data = message.data
        if entry.stamped:
            # Consumers compare stamps with the clock that they follow.
            simulated = self._options.clock_hz is not None
            stamp_ns = self._bag_now_ns(time.monotonic_ns()) if simulated else time.time_ns()
            data = with_stamp(message, stamp_ns)
        entry.publish(data)
        if self._options.as_fast_as_possible and entry.unacknowledged >= entry.qos.depth:
            entry.await_acknowledgement(ACKNOWLEDGE_S)

    def _latched_before_start(self) -> list[BagMessage]:
        """Returns what a subscriber of latched topics would hold at the start of the window."""
        depths = {
            name: _KEEP_ALL_DEPTH if entry.qos.history == "keep_all" else entry.qos.depth
            for name, entry in self._publishers.items()
            if entry.qos.latched
        }
        return self._reader.last_messages(depths, self._window.start_ns) if depths else []

    def _await_subscribers(self) -> None:
        wait = self._options.wait
        if wait is None:
            return
        deadline_ns = time.monotonic_ns() + round(wait.timeout_s * NANOSECONDS)
        while not self._stopping:
            lacking = [
                f"{entry.name} ({entry.publisher.get_subscription_count()})"
                for entry in self._publishers.values()
                if entry.publisher.get_subscription_count() < wait.count
            ]
            if not lacking:
                self._sleep_through(time.monotonic_ns() + _SETTLE_NS)
                return
            if time.monotonic_ns() >= deadline_ns:
                raise SubscriberTimeoutError(
                    f"--wait-for-subscribers: after {wait.timeout_s:g} s, fewer than {wait.count} "
                    f"on {', '.join(lacking)}; --topics or --exclude leave topics out"
                )
            self._handle_keys(self._wake.wait(_SUBSCRIBER_POLL_S))

    def _sleep_through(self, until_ns: int) -> None:
        """Sleeps until a real time, handling keys meanwhile, unless the replay is to stop."""
        while not self._stopping and (now_ns := time.monotonic_ns()) < until_ns:
            self._sleep_until(until_ns, now_ns)

    def _sleep_until(self, until_ns: int, now_ns: int) -> None:
        self._handle_keys(self._wake.wait(max(0, until_ns - now_ns) / NANOSECONDS))

    def _handle_keys(self, keys: str) -> None:
        for key in keys:
            if key in _PAUSE_KEYS:
                self._set_paused(lambda paused: not paused)
                self._show(time.monotonic_ns())

    def _set_paused(self, new_state: Callable[[bool], bool]) -> bool:
        """Pauses or resumes; returns whether the replay is paused now."""
        now_ns = time.monotonic_ns()
        with self._lock:
            paused = new_state(self._playback.paused)
            if paused:
                self._playback.pause(now_ns)
            else:
                self._playback.resume(now_ns)
        return paused

    def _pause_service(
        self, new_state: Callable[[bool], bool]
    ) -> Callable[[Any, Trigger.Response], Trigger.Response]:
        def handle(_request: Any, response: Trigger.Response) -> Trigger.Response:
            paused = self._set_paused(new_state)
            self._wake.set()
            response.success = True
            response.message = "paused" if paused else "playing"
            return response

        return handle

    def _show(self, now_ns: int) -> None:
        published = sum(entry.published for entry in self._publishers.values())
        played_s = (self._bag_now_ns(now_ns) - self._window.start_ns) / NANOSECONDS
        with self._lock:
            paused = self._playback.paused
        self._progress.show(played_s, published, self._passes, paused=paused)
