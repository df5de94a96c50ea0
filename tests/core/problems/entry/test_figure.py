"""The figure of an entry plan holds the plan, its flight and its limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.planning.histories import plan_figure
from dscp_core.planning.planner import Planner, PlannerSettings, TerminalTime
from dscp_core.problems.entry.figure import entry_figure


@pytest.fixture(scope="module")
def planned():
    """A plan on a coarse mesh, its certificate and its parameters."""
    planner = Planner(
        problems.get("entry"), PlannerSettings(intervals=60, terminal_time=TerminalTime.FREE)
    )
    outcome = planner.plan(planner.initial_state)
    assert outcome.plan is not None
    assert outcome.certificate is not None
    return outcome.plan, outcome.certificate, planner.problem.table.unpack(planner.parameters)


def test_the_figure_shows_the_flight_below_its_limits(planned, tmp_path):
    plan, certificate, parameters = planned
    figure = plan_figure(problems.get("entry"), plan, certificate, parameters)
    track, corridor, loads, climb, attack, bank = figure.axes
    flown, nodes, target = track.get_lines()
    assert np.array_equal(flown.get_xdata(), np.degrees(certificate.states[:, 1]))
    assert np.array_equal(nodes.get_ydata(), np.degrees(plan.states[:, 2]))
    assert target.get_xydata()[0] == pytest.approx([120.0, 12.0], abs=1e-6)
    assert corridor.get_lines()[1].get_ydata()[0] == pytest.approx(78.0, abs=1e-6)
    # What the certificate says of a limit is what is drawn against it.
    shares = {line.get_label(): line.get_ydata().max() for line in loads.get_lines()[:3]}
    excess = certificate.value("heat_rate_max") / parameters["heat_rate_max"]
    assert shares["heat rate"] == pytest.approx(1.0 + excess, abs=1e-9)
    assert [axes.get_title(loc="left").split(" [")[0] for axes in (climb, attack, bank)] == [
        "flight-path angle",
        "angle of attack",
        "bank angle",
    ]
    figure.savefig(tmp_path / "entry.png")
    assert (tmp_path / "entry.png").stat().st_size > 20_000


def test_another_problem_is_refused(planned):
    plan, certificate, parameters = planned
    with pytest.raises(InvalidInputError, match="problem"):
        entry_figure(replace(plan, problem="orbit"), certificate, parameters)
