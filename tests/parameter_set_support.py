"""Forked processes that save parameter sets and are killed, or run out of space, meanwhile.

One process imports everything once and forks a child for each attempt.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from learning_support import network

from dscp_core import problems
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_ros.parameter_set import ParameterSetError, load, save

OLD, NEW = {"intervals": 40}, {"intervals": 41}


def fitting_network() -> TerminalTimeNetwork:
    """A network of the default vehicle."""
    table = problems.get("powered_descent").table
    vehicle = problems.get("powered_descent").vehicle_of(table.unpack(table.pack()))
    return TerminalTimeNetwork(replace(network().data, vehicle=vehicle))


def attempt(directory: Path, prepare: Callable[[], None]) -> int:
    """Overwrite the set in a child; returns its status, as `os.waitpid` does."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        prepare()
        try:
            save(directory, NEW, fitting_network(), overwrite=True)
        except ParameterSetError as error:
            print(f"refused: {error}", flush=True)
            os._exit(3)
        os._exit(0)
    return os.waitpid(child, 0)[1]


def kill_at(event_number: int) -> Callable[[], None]:
    """Has the process kill itself when it touches the file system for the n-th time."""
    counted = 0

    def hook(name: str, _arguments: object) -> None:
        nonlocal counted
        if name in ("open", "ctypes.dlsym") or name.startswith(("os.", "shutil.", "tempfile.")):
            counted += 1
            if counted == event_number:
                os.kill(os.getpid(), signal.SIGKILL)

    return lambda: sys.addaudithook(hook)


def killed(directory: Path) -> None:
    """Kill a save at every moment, one after the other, until one gets through."""
    known = {
        save(directory, OLD).identifier,
        save(directory.with_name("new"), NEW, fitting_network()).identifier,
    }
    number = 0
    while True:
        number += 1
        status = attempt(directory, kill_at(number))
        assert load(directory).identifier in known, number
        for left in directory.parent.glob(f".{directory.name}.*"):
            try:
                assert load(left).identifier in known, number
            except ParameterSetError:
                continue
        if status == 0:
            break
        assert status == signal.SIGKILL, status
    print(f"killed {number - 1} times")


def limited(directory: Path) -> None:
    """Save with ever larger limits of the size of a file, until one suffices."""
    before = save(directory, OLD).identifier
    for limit in (0, 100, 1000, 10_000, 1_000_000):
        bound = (limit, limit)
        status = attempt(directory, lambda b=bound: resource.setrlimit(resource.RLIMIT_FSIZE, b))
        if status == 0:
            break
        assert load(directory).identifier == before
        assert list(directory.parent.glob(f".{directory.name}.*")) == []
    assert load(directory).identifier != before


def replaced(directory: Path) -> None:
    """Load a set again and again while another process replaces it all the time."""
    known = {
        save(directory, OLD).identifier,
        save(directory.with_name("new"), NEW, fitting_network()).identifier,
    }
    child = os.fork()
    if child == 0:
        while True:
            save(directory, NEW, fitting_network(), overwrite=True)
            save(directory, OLD, overwrite=True)
    try:
        seen = [load(directory).identifier for _ in range(80)]
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    assert set(seen) == known, set(seen)
    print("seen both")


if __name__ == "__main__":
    for program in (killed, limited, replaced):
        print(f"== {program.__name__}")
        program(Path(sys.argv[1]) / program.__name__ / "set")
