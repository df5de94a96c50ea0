"""The generic figure, of problems that are hard to draw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from core.toy_problems import cart
from matplotlib.backends.backend_agg import FigureCanvasAgg

from dscp_core.planning.histories import box_bounds
from dscp_core.planning.planner import Planner
from dscp_core.problem.declaration import Miss, PathConstraint, Variable


def test_long_names_and_headlines_fit_and_rounding_is_not_a_difference() -> None:
    states = (Variable("position" * 20, "m", 2.0, ""), Variable("speed", "m/s", 0.5, ""))
    still = replace(
        cart(),
        states=states,
        final_state={},
        misses=tuple(Miss(f"miss_{i}", lambda x, p: x[1] ** 2, "m", 1.0) for i in range(12)),
    )
    planner = Planner(still, parameters={"start": (1.0, 0.0)})
    figure = planner.figure(planner.plan())
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    legend = figure.legends[0].get_window_extent(renderer)
    title = figure.texts[0].get_window_extent(renderer)
    assert not title.overlaps(legend)
    assert title.x1 < figure.bbox.x1
    for axes, scale in zip(figure.axes, (3.0, 2.0, 0.5), strict=True):
        assert axes._left_title.get_window_extent(renderer).x1 < figure.bbox.x1  # type: ignore[attr-defined]
        assert np.ptp(axes.get_ylim()) > 0.9e-3 * scale


def test_a_bound_that_depends_on_the_interval_is_not_drawn() -> None:
    rate = PathConstraint("rate", lambda at, p: at.x[1] / at.step - 50.0, 1.0, "m/s^2")
    never = PathConstraint("constant", lambda at, p: -1.0, 1.0, "1")  # type: ignore[arg-type,return-value]
    problem = replace(cart(), path_constraints=(*cart().path_constraints, rate, never))
    bounds = box_bounds(problem, problem.table.unpack(problem.pack()))
    assert bounds["speed"] == (-np.inf, np.inf)
    assert bounds["force"][1] == 2.0
    assert Planner(problem).plan().certified
