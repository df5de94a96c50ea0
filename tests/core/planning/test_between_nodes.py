"""What only a check between the nodes sees, on a problem with a thin obstacle and a ground."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.planning.certificate import PlanCertificate, PlanVerifier
from dscp_core.planning.planner import Planner
from dscp_core.problem.declaration import (
    ConeConstraint,
    EndEvent,
    EventLimit,
    InitialGuess,
    Miss,
    OptimalControlProblem,
    PathConstraint,
    Propellant,
    Variable,
    Where,
)
from dscp_core.problem.flight import ControlHold
from dscp_core.problem.parameters import Parameter

Array = NDArray[np.float64]

INTERVALS = 10
SECONDS = 10.0


def runner() -> OptimalControlProblem:
    """A point that runs over the ground at 100 m/s, past a post, and is pushed up and along."""
    return OptimalControlProblem(
        name="runner",
        states=(
            *(Variable(n, "m", 100.0, "") for n in ("along", "height")),
            *(Variable(n, "m/s", 100.0, "") for n in ("speed", "climb")),
        ),
        controls=tuple(Variable(n, "m/s^2", 10.0, "") for n in ("push", "lift")),
        parameters=(
            Parameter("terminal_time", SECONDS, "s", "Duration."),
            Parameter("start", (0.0, 5.0, 100.0, 0.0), "1", "State at the start."),
            Parameter("post", (512.3, 5.0), "m", "Centre of a post."),
            Parameter("post_radius", 1.0, "m", "Its radius."),
            Parameter("push_rate_max", math.inf, "m/s^3", "Of the controls.", infinite=True),
            Parameter("lands", 0.0, "1", "Whether the run ends in contact."),
            Parameter("patience", 3.0, "s", "Unused."),
        ),
        dynamics=lambda x, u, p: ca.vertcat(x[2:4], u),
        initial_state=lambda p: p["start"],
        final_state={"along": lambda p: 1000.0},
        terminal_cost=lambda x, time, p: x[0],
        cost_scale=1.0,
        initial_guess=lambda p, n: InitialGuess(
            ca.repmat(p["start"], 1, n + 1), ca.MX(ca.DM.zeros(2, n + 1))
        ),
        path_constraints=(
            PathConstraint(
                "post",
                lambda at, p: p["post_radius"] - ca.norm_2(at.x[:2] - p["post"]),
                100.0,
                "m",
                tolerance=0.01,
            ),
            PathConstraint(
                "lift_min", lambda at, p: 9.0 - ca.norm_2(at.u), 10.0, "m/s^2", tolerance=20.0
            ),
        ),
        cone_constraints=(
            ConeConstraint(
                "push_rate",
                lambda at, p: ca.vertcat(
                    ca.if_else(p["push_rate_max"] < math.inf, p["push_rate_max"], 0.0) * at.step
                    + ca.if_else(p["push_rate_max"] < math.inf, 0.0, math.inf),
                    at.u_change,
                ),
                10.0,
                "m/s^2",
                where=Where.MEAN,
                tolerance=1e-6,
            ),
        ),
        misses=(Miss("miss_along", lambda x, p: ca.fabs(x[0] - 1000.0), "m", 500.0),),
        end_event=EndEvent(
            "contact",
            lambda x, p: x[1],
            "height_floor",
            "m",
            tolerance=0.01,
            meant=lambda values: values["lands"] > 0.0,
            after=lambda values: (0.0, -2.0),
            patience_s=3.0,
            limits=(EventLimit("contact_climb", lambda x, u, p: ca.fabs(x[3]), "m/s", 1.0),),
        ),
    )


def run(
    problem: OptimalControlProblem,
    controls: Callable[[Array], Array] | None = None,
    hold: ControlHold = ControlHold.MEAN,
    **values: Any,
) -> PlanCertificate:
    packed = problem.pack(values)
    times = np.linspace(0.0, SECONDS, INTERVALS + 1)
    given = np.zeros((INTERVALS + 1, 2)) if controls is None else controls(times)
    start = packed[problem.table.slice("start")]
    states = np.tile(start, (INTERVALS + 1, 1))
    return PlanVerifier(problem, INTERVALS, hold=hold).certify(times, states, given, packed)


@pytest.mark.parametrize("aside", [0.0, 0.3, 0.9, 0.985])
def test_a_post_between_points_25_metres_apart_is_hit(aside: float) -> None:
    certificate = run(runner(), post=(512.3, 5.0 + aside))
    check = certificate.check("post")
    assert check.worst_value == pytest.approx(1.0 - aside, abs=1e-3)
    assert check.time_s == pytest.approx(5.123, abs=1e-3)
    assert certificate.reasons == (f"post {check.worst_value:.4g} m at 5.12 s exceeds 0.01",)
    assert check.margin == pytest.approx(0.01 - (1.0 - aside), abs=1e-3)


def test_a_post_beside_the_way_is_not_hit() -> None:
    certificate = run(runner(), post=(512.3, 6.0))
    assert certificate.passed
    assert 0.0 <= certificate.value("post") <= 0.01


def test_a_dip_of_the_control_between_nodes_is_seen_if_it_is_flown() -> None:
    def turning(times: Array) -> Array:
        # Every node has 10 m/s^2; half way between two of them there are only 7.07.
        angle = np.where(np.arange(times.size) % 2, math.pi / 4, -math.pi / 4)
        return 10.0 * np.column_stack([np.sin(angle), np.cos(angle)])

    problem = runner()
    tight = replace(
        problem,
        path_constraints=tuple(replace(c, tolerance=1e-3) for c in problem.path_constraints),
    )
    flown = run(tight, turning, ControlHold.LINEAR, post=(512.3, 4000.0))
    assert flown.value("lift_min") == pytest.approx(9.0 - 10.0 / math.sqrt(2.0), rel=1e-6)
    assert any(reason.startswith("lift_min 1.929 m/s^2 at 0.50 s") for reason in flown.reasons)
    nodes = np.linalg.norm(turning(np.zeros(3)), axis=1)
    assert nodes.min() > 9.0


def falling(climb: float, dip: float) -> Callable[[Array], Array]:
    """Controls for a flight that dips to a height and rises again, over the whole time."""
    # h = dip + a (t - t0)^2 / 2 from height 5 with the climb rate given.
    acceleration = climb**2 / (2.0 * (5.0 - dip))
    return lambda times: np.column_stack([np.zeros(times.size), np.full(times.size, acceleration)])


@pytest.mark.parametrize(("dip", "touches"), [(1e-4, False), (-1e-4, True)])
def test_a_dip_below_the_ground_between_points_is_contact(dip: float, touches: bool) -> None:
    # The lowest point is at 1.02 s, between points at 1 s and 1.25 s.
    climb = -2.0 * (5.0 - dip) / 1.02
    certificate = run(runner(), falling(climb, dip), start=(0.0, 5.0, 100.0, climb))
    assert certificate.passed is not touches
    if touches:
        assert certificate.contact_time_s == pytest.approx(
            1.02 * (1 - math.sqrt(1e-4 / 5)), abs=1e-4
        )
        assert certificate.reasons[0] == "contact at 1.02 s, where none is meant to be"
        assert certificate.times_s[-1] == certificate.contact_time_s
        assert certificate.states[-1, 1] == pytest.approx(0.0, abs=1e-9)
    else:
        assert certificate.contact_time_s is None
        assert certificate.value("height_floor") == pytest.approx(-1e-4, rel=0.02)


def test_a_run_that_ends_in_the_air_falls_on_until_contact() -> None:
    certificate = run(runner(), start=(0.0, 0.16, 100.0, 0.0), lands=1.0)
    # 0.16 m at 2 m/s^2: 0.4 s and 0.8 m/s.
    assert certificate.contact_time_s == pytest.approx(SECONDS + 0.4, abs=1e-9)
    assert certificate.value("contact_climb") == pytest.approx(0.8, abs=1e-9)
    assert certificate.states[-1, 0] == pytest.approx(1040.0)
    assert certificate.passed
    assert run(runner(), start=(0.0, 0.26, 100.0, 0.0), lands=1.0).reasons == (
        "contact_climb 1.02 m/s at 10.51 s exceeds 1",
    )


def test_a_run_that_does_not_come_down_has_no_end() -> None:
    certificate = run(runner(), start=(0.0, 40.0, 100.0, 0.0), lands=1.0)
    assert certificate.reasons[0] == "no contact within 3 s of the end of the plan"
    assert certificate.contact_time_s is None
    event = runner().end_event
    assert event is not None
    nothing = replace(runner(), end_event=replace(event, after=None))
    assert run(nothing, lands=1.0).reasons[0] == "no contact at the end of the plan"


@pytest.mark.parametrize(("height", "passes"), [(-0.009, True), (-0.011, False)])
def test_a_start_below_the_ground_is_within_the_floors_tolerance_or_not(
    height: float, passes: bool
) -> None:
    certificate = run(runner(), start=(0.0, height, 100.0, 10.0))
    assert certificate.passed is passes
    assert certificate.value("height_floor") == pytest.approx(-height)
    assert certificate.reasons == (
        () if passes else ("height_floor 0.011 m at 0.00 s exceeds 0.01",)
    )


@pytest.mark.parametrize("seed", range(8))
def test_contact_itself_is_not_below_the_ground(seed: int) -> None:
    height, speed = np.random.default_rng(seed).uniform([10.0, 5.0], [80.0, 20.0])
    event = runner().end_event
    assert event is not None
    exact = replace(runner(), end_event=replace(event, tolerance=0.0))
    certificate = run(exact, start=(0.0, height, 100.0, -speed))
    assert certificate.contact_time_s is not None
    assert certificate.value("height_floor") == 0.0
    assert certificate.check("height_floor").passed


@pytest.mark.parametrize(("rate", "passes"), [(5.001, True), (4.999, False)])
def test_the_rate_of_controls_that_are_held_linearly(rate: float, passes: bool) -> None:
    def pushing(times: Array) -> Array:
        return np.column_stack([np.minimum(5.0 * times, 10.0), np.zeros(times.size)])

    certificate = run(
        runner(), pushing, ControlHold.LINEAR, push_rate_max=rate, start=(0.0, 9.0, 50.0, 0.0)
    )
    assert certificate.value("push_rate") == pytest.approx(5.0 - rate, abs=1e-9)
    assert any(r.startswith("push_rate") for r in certificate.reasons) is not passes
    assert "push_rate" in run(runner(), pushing, ControlHold.LINEAR).unchecked


def test_a_limit_of_the_rate_contradicts_controls_that_jump() -> None:
    with pytest.raises(
        InvalidInputError, match="hold: got 'mean', expected linear where push_rate"
    ):
        run(runner(), push_rate_max=5.0)
    with pytest.raises(
        InvalidInputError, match="hold: got 'mean', expected linear where push_rate"
    ):
        Planner(runner(), parameters={"push_rate_max": 5.0})


def test_a_change_of_the_control_needs_an_interval() -> None:
    wrong = PathConstraint("change", lambda at, p: at.u_change[0], 1.0, "m/s^2")
    with pytest.raises(InvalidInputError, match="u_change: got 'a node', expected an interval"):
        Planner(replace(runner(), path_constraints=(wrong,), cone_constraints=()))


def test_what_cannot_be_followed_is_not_certified() -> None:
    unstable = replace(
        runner(), dynamics=lambda x, u, p: ca.vertcat(x[2:4], 40.0 * ca.sin(900.0 * x[0]), u[1])
    )
    certificate = run(unstable)
    assert not certificate.passed
    assert "integration ended before" in certificate.reasons[0]
    assert "its error is estimated as" in certificate.reasons[0]


def test_steps_are_halved_until_the_error_is_small() -> None:
    swinging = replace(
        runner(), dynamics=lambda x, u, p: ca.vertcat(x[2:4], -30.0 * (x[0] - 1.0), u[1])
    )
    certificate = run(swinging, start=(0.0, 5.0, 0.0, 0.0))
    assert certificate.times_s.size > 4 * INTERVALS + 1
    place = 1.0 - np.cos(math.sqrt(30.0) * certificate.times_s)
    np.testing.assert_allclose(certificate.states[:, 0], place, atol=1e-5)


def test_propellant_has_to_be_a_state_and_a_number() -> None:
    with pytest.raises(InvalidInputError, match="mass of propellant: got 'mass'"):
        replace(runner(), propellant=Propellant("mass"))
    with pytest.raises(InvalidInputError, match="dry_mass of propellant: got 'post'"):
        replace(runner(), propellant=Propellant("height", "post"))
    used = run(replace(runner(), propellant=Propellant("along", "post_radius")))
    assert used.mass_used_kg == pytest.approx(-1000.0)
    assert used.propellant_left_kg == pytest.approx(999.0)
    unknown = run(replace(runner(), propellant=Propellant("along", "lands")))
    assert unknown.propellant_left_kg is None
    assert run(runner()).mass_used_kg is None
