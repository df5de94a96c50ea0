"""The one-slot mailbox."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError

import pytest

from dscp_ros.planner.worker import MailboxWorker

# Far above what a thread switch takes on a busy machine.
TIMEOUT_S = 10.0


class Gated:
    """A handler that notes each job and waits to be let go."""

    def __init__(self) -> None:
        self.done: list[int] = []
        self.started = threading.Semaphore(0)
        self.go = threading.Semaphore(0)

    def __call__(self, job: int) -> None:
        self.started.release()
        assert self.go.acquire(timeout=TIMEOUT_S)
        self.done.append(job)


@pytest.fixture
def handler() -> Gated:
    return Gated()


@pytest.fixture
def worker(handler: Gated) -> Iterator[MailboxWorker[int]]:
    worker = MailboxWorker(handler, name="test")
    yield worker
    handler.go.release(100)
    assert worker.stop(TIMEOUT_S)


def test_the_latest_job_wins_and_the_others_are_counted(worker, handler):
    worker.submit(1)
    assert handler.started.acquire(timeout=TIMEOUT_S)
    for job in (2, 3, 4):
        worker.submit(job)
    assert worker.drops == 2
    handler.go.release(2)
    assert handler.started.acquire(timeout=TIMEOUT_S)
    worker.call(lambda: None).result(TIMEOUT_S)
    assert handler.done == [1, 4]
    assert worker.drops == 2


def test_commands_run_between_jobs_in_order(worker, handler):
    worker.submit(1)
    assert handler.started.acquire(timeout=TIMEOUT_S)
    seen: list[str] = []
    first = worker.call(lambda: seen.append("first"))
    second = worker.call(lambda: seen.append("second"))
    worker.submit(2)
    handler.go.release(1)
    second.result(TIMEOUT_S)
    assert first.done()
    assert seen == ["first", "second"]
    assert handler.done == [1]


def test_a_commands_error_goes_to_its_caller_and_the_worker_lives_on(worker, handler):
    def fail() -> None:
        raise ZeroDivisionError("on purpose")

    with pytest.raises(ZeroDivisionError, match="on purpose"):
        worker.call(fail).result(TIMEOUT_S)
    assert worker.call(lambda: 7).result(TIMEOUT_S) == 7
    assert worker.alive


def test_a_cleared_job_is_not_run_nor_counted(worker, handler):
    worker.submit(1)
    assert handler.started.acquire(timeout=TIMEOUT_S)
    worker.submit(2)
    worker.clear()
    handler.go.release(1)
    worker.call(lambda: None).result(TIMEOUT_S)
    assert handler.done == [1]
    assert worker.drops == 0


def test_stopping_cancels_what_waits_and_refuses_what_comes(handler):
    worker = MailboxWorker(handler, name="test")
    worker.submit(1)
    assert handler.started.acquire(timeout=TIMEOUT_S)
    waiting = worker.call(lambda: None)
    assert not worker.stop(0.01)
    assert waiting.cancelled()
    with pytest.raises(CancelledError):
        worker.call(lambda: None).result(TIMEOUT_S)
    handler.go.release(1)
    assert worker.stop(TIMEOUT_S)
    assert not worker.alive
