"""The loop closed: plan, tune on the log, reload while the node runs, plan what it has not seen."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dscp_core.errors import DscpError
from dscp_ros.demo.comparison import comparison
from dscp_ros.demo.processes import child
from dscp_ros.demo.session import InputBag, LivePlanner, live_planner
from dscp_ros.demo.summary import Figures, figures_of, read_reports
from dscp_ros.parameter_set import PARAMETERS_FILE, ParameterSet, load, save
from dscp_ros.planner.parameter_files import ParameterArguments, read_parameters

ITERATIONS = 2
"""What the flight computer of the demonstration has time for."""

_NODE = "/planner"
_DSCP = "from dscp_ros.cli.main import main; raise SystemExit(main())"
_NODE_PARAMETERS = {"max_iterations": ITERATIONS, "deadline_s": 10.0}


class LoopError(DscpError):
    """The node did not do what it was asked for."""


@dataclass(frozen=True)
class LoopSettings:
    """What is shown.

    Attributes:
        vehicle: The node's parameter file at first.
        log: Bag that is planned from and tuned on.
        unseen: Bag that is planned from before and after.
        folder: Gets everything that is written.
        epochs: Of the tuning.
        rate: Recorded seconds per second.
        timeout_s: Longest time for everything.
    """

    vehicle: Path
    log: InputBag
    unseen: InputBag
    folder: Path
    epochs: int
    rate: float
    timeout_s: float


def run_loop(settings: LoopSettings, say: Callable[[str], None]) -> list[Figures]:
    """Runs it, and prints the tuning's and the node's own table.

    Returns:
        What became of the unseen states before and after.

    Raises:
        ChildFailedError: A process died or did not end.
        DemoTimeoutError: Time is up.
        LoopError: The node refused the new parameter set.
        BagError: The recording cannot be written or read.
        ParameterSetError: A set cannot be written.
    """
    folder = settings.folder / "parameter_set"
    first = save(
        folder,
        read_parameters(ParameterArguments((str(settings.vehicle),), frozenset(), ()), _NODE),
        provenance={"origin": f"the demonstration, from {settings.vehicle.name}"},
        overwrite=True,
    )
    overrides = [w for name, value in _NODE_PARAMETERS.items() for w in ("-p", f"{name}:={value}")]
    node_arguments = ["--params-file", str(folder / PARAMETERS_FILE), "--ros-args", *overrides]
    with live_planner(
        settings.folder, timeout_s=settings.timeout_s, say=say, node_arguments=node_arguments
    ) as planner:
        say(f"the node plans with parameter set {first.label}, {ITERATIONS} iterations per start")
        planner.replay(settings.log, settings.rate)
        planner.replay(settings.unseen, settings.rate)
        _tune(planner, settings, folder, say)
        second = load(folder)
        answer = planner.listener.call(f"{_NODE}/reload")
        planner.listen_until(answer.done, "the node to reload its parameters")
        response = answer.result()
        assert response is not None  # it is done
        if not response.success:
            raise LoopError(f"the node did not reload: {response.message}")
        say(f"reloaded while the node runs: {response.message}")
        planner.replay(settings.unseen, settings.rate)
    reports = figures_of(settings.unseen, read_reports(planner.recording))
    parts = [_made_with(one, reports) for one in (first, second)]
    print(f"\n{comparison(*parts)}\n", flush=True)
    return parts


def _tune(
    planner: LivePlanner, settings: LoopSettings, folder: Path, say: Callable[[str], None]
) -> None:
    """Tunes the network on the log; the node runs on."""
    command = [
        *(sys.executable, "-c", _DSCP, "tune", str(settings.log.path)),
        *("--parameters", "network", "--params-file", str(folder / PARAMETERS_FILE)),
        *("--output", str(folder), "--overwrite", "--epochs", str(settings.epochs)),
        # The prediction has to change by 0.3 s in few steps; the default rate is for fine tuning.
        *("--batch", "8", "--network-learning-rate", "4e-4"),
    ]
    say(f"tuning the network on {settings.log.name}; the node runs on")
    log = settings.folder / "tune.log"
    with child("the tuning", command, log) as tuning:
        planner.listen_until(tuning.finished, "the tuning to end")
    print(log.read_text(encoding="utf-8"), flush=True)


def _made_with(parameter_set: ParameterSet, figures: Figures) -> Figures:
    """The attempts that were made with a set."""
    label = parameter_set.label  # and what the node's command line changed of the set
    attempts = tuple(r for r in figures.attempts if (r.parameter_set or "").startswith(label))
    return Figures(figures.name, figures.states, attempts, ())
