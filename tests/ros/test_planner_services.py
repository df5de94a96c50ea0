"""Services, changes of parameters, clock jumps, and errors of the planner itself."""

from __future__ import annotations

from pathlib import Path

import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from ros.planner_support import (
    LAYOUT,
    STATE,
    local_planner,
    now_ns,
)
from rosgraph_msgs.msg import Clock

from dscp_core.errors import InvalidInputError
from dscp_core.planning.plan import PlanStatus
from dscp_ros.planner.parameter_files import ParameterArguments
from msg_adapters.diagnostics import health_from_message
from msg_adapters.errors import InputCode
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.report import NodeCode
from msg_adapters.stamps import stamp_from_nanoseconds
from msg_adapters.state import StampedState

SECOND_NS = 1_000_000_000


# Services


def test_plan_needs_a_state(ros):
    with local_planner(ros) as (client, _):
        answer = client.call("plan")
        assert not answer.success
        assert "STATE_MISSING (703)" in answer.message
        assert client.next_report(0).code == InputCode.STATE_MISSING


def test_plan_answers_with_what_became_of_it(ros):
    with local_planner(ros) as (client, _):
        stamp_ns = client.send()
        client.report_of(stamp_ns)
        answer = client.call("plan")
        assert answer.success
        assert answer.message.startswith("CERTIFIED")
        assert client.report_of(stamp_ns, count=2).source == "plan"


def test_plan_refuses_a_state_that_has_grown_old(ros):
    with local_planner(ros) as (client, planner):
        client.send_and_report()
        planner._node.set_parameters([Parameter("state_max_age_s", value=0.0)])
        answer = client.call("plan")
        assert not answer.success
        assert "STALE_STAMP" in answer.message


def test_reset_forgets_warm_start_and_stamps(ros):
    with local_planner(ros) as (client, _):
        stamp_ns = client.send()
        assert client.report_of(stamp_ns).published
        assert client.call("reset").success
        assert not client.call("plan").success
        earlier_ns = client.send(stamp_ns=stamp_ns - SECOND_NS)
        report = client.report_of(earlier_ns)
        assert report.code == PlanStatus.CERTIFIED
        assert not report.attempt.warm_started


def parameter_file(path: Path, **values: str) -> ParameterArguments:
    lines = "".join(f"    {name}: {value}\n" for name, value in values.items())
    path.write_text(f"/**:\n  ros__parameters:\n{lines}")
    return ParameterArguments((str(path),), frozenset(), ())


def test_reload_takes_the_file_over_as_a_whole(ros, tmp_path):
    path = tmp_path / "vehicle.yaml"
    with local_planner(ros, parameter_file(path, intervals="50"), intervals=50) as (client, _):
        client.send_and_report()
        client.wait_for(lambda: client.trajectories)
        assert len(client.trajectories[-1].points) == 51
        parameter_file(path, intervals="60", deadline_s="0.7")
        answer = client.call("reload")
        assert answer.success, answer.message
        report = client.send_and_report()
        assert report.attempt.deadline_ms == 700.0
        assert not report.attempt.warm_started
        client.wait_for(lambda: len(client.trajectories) == 2)
        assert len(client.trajectories[-1].points) == 61


def test_reload_takes_back_what_the_file_no_longer_says_and_nothing_else(ros, tmp_path):
    path = tmp_path / "vehicle.yaml"
    arguments = parameter_file(path, intervals="60", max_iterations="30")
    with local_planner(ros, arguments, intervals=60, max_iterations=30) as (client, planner):
        node = planner._node
        node.set_parameters([Parameter("max_iterations", value=40)])
        parameter_file(path, cost_tolerance="1.0e-5")
        answer = client.call("reload")
        assert answer.success, answer.message
        assert node.get_parameter("intervals").value == 50
        assert node.get_parameter("max_iterations").value == 40
        assert client.send_and_report().published
        client.wait_for(lambda: client.trajectories)
        assert len(client.trajectories[-1].points) == 51


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"intervals": "1", "deadline_s": "0.7"}, "intervals: got 1"),
        ({"deadline_s": "0.7", "parameters.thrust_max": "-1.0"}, "thrust_max"),
        ({"deadline_s": "0.7", "dedline_s": "1.0"}, "did you mean deadline_s"),
        ({"deadline_s": "1"}, "a number with a point"),
        ({"deadline_s": "0.7", "landing_frame": "map"}, "read-only"),
        ({"deadline_s": "["}, "valid YAML"),
    ],
)
def test_reload_keeps_the_old_parameters_on_failure_and_says_why(ros, tmp_path, values, words):
    path = tmp_path / "vehicle.yaml"
    arguments = parameter_file(path, intervals="50")
    with local_planner(ros, arguments, intervals=50) as (client, _):
        parameter_file(path, **values)
        answer = client.call("reload")
        assert not answer.success
        assert words in answer.message
        report = client.send_and_report()
        assert report.published
        assert report.attempt.deadline_ms == 15_000.0


# Parameters


def test_parameters_change_all_or_none_and_the_reason_names_the_culprit(ros):
    with local_planner(ros) as (client, planner):
        result = planner._node.set_parameters_atomically(
            [
                Parameter("deadline_s", value=0.7),
                Parameter("parameters.final_position", value=[0.0, float("nan"), 0.0]),
            ]
        )
        assert not result.successful
        assert result.reason.startswith("parameters.final_position")
        assert client.send_and_report().attempt.deadline_ms == 15_000.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("problem", "powered_descent"),
        ("deadline_s", float("nan")),
        ("deadline_s", 0.0),
        ("intervals", 4),
        ("terminal_time_source", "sometimes"),
        ("solver", "qoco,simplex"),
        ("parameters.final_velocity", [1.0]),
        ("parameters.thrust_min", -5.0),
    ],
)
def test_a_bad_parameter_is_refused_by_name(ros, name, value):
    with local_planner(ros) as (_, planner):
        (result,) = planner._node.set_parameters([Parameter(name, value=value)])
        assert not result.successful
        assert name in result.reason


def test_a_changed_vehicle_takes_effect_with_the_next_plan(ros):
    with local_planner(ros) as (client, planner):
        before = client.send_and_report()
        (result,) = planner._node.set_parameters(
            # Ten metres up (landing frame, z up) and one to the east.
            [Parameter("parameters.final_position", value=[1.0, 0.0, 10.0])]
        )
        assert result.successful
        after = client.send_and_report()
        assert before.published
        assert after.published
        client.wait_for(lambda: len(client.trajectories) == 2)
        end = dict(
            zip(
                client.trajectories[-1].joint_names,
                client.trajectories[-1].points[-1].positions,
                strict=True,
            )
        )
        # To the accuracy of the solver.
        assert [end["x"], end["y"], end["z"]] == pytest.approx([1.0, 0.0, 10.0], abs=0.01)


def test_a_misspelt_override_is_refused(ros):
    misspelt = local_planner(ros, dedline_s=1.0)
    with pytest.raises(InvalidInputError, match=r"dedline_s \(did you mean deadline_s"):
        misspelt.__enter__()


# Clock


def test_a_clock_that_jumps_back_starts_anew_but_a_stamp_that_does_is_refused(ros):
    with local_planner(ros, use_sim_time=True) as (client, planner):
        clock = client.node.create_publisher(Clock, "/clock", QoSProfile(depth=10))
        client.wait_for(lambda: clock.get_subscription_count() > 0)

        def set_clock(seconds: int) -> None:
            clock.publish(Clock(clock=stamp_from_nanoseconds(seconds * SECOND_NS)))
            client.wait_for(
                lambda: planner._node.get_clock().now().nanoseconds == seconds * SECOND_NS
            )

        set_clock(100)
        client.send(stamp_ns=100 * SECOND_NS)
        assert client.report_of(100 * SECOND_NS).published
        client.send(stamp_ns=100 * SECOND_NS - 1)
        refused = client.report_of(100 * SECOND_NS - 1)
        assert refused.code == InputCode.STAMP_BACKWARD

        set_clock(50)
        client.wait_for(lambda: any(r.code == NodeCode.CLOCK_JUMPED_BACK for r in client.reports))
        client.send(stamp_ns=50 * SECOND_NS)
        again = client.report_of(50 * SECOND_NS)
        assert again.code == PlanStatus.CERTIFIED
        assert not again.attempt.warm_started


# Errors of the planner itself


class FailingPlanner:
    """Raises like a bug would."""

    def plan(self, *_args: object, **_kwargs: object) -> None:
        raise ZeroDivisionError("on purpose")


def test_an_exception_becomes_a_report_and_the_node_lives_on(ros):
    with local_planner(ros) as (client, planner):
        good = planner._session._planner
        planner._session._planner = FailingPlanner()
        report = client.send_and_report()
        assert report.code == NodeCode.INTERNAL_ERROR
        assert report.message == "ZeroDivisionError: on purpose"
        assert not report.published
        healths = client.diagnostics
        client.wait_for(
            lambda: any(health_from_message(m, node="planner")[0].level == 2 for m in healths)
        )
        planner._session._planner = good
        assert client.send_and_report().published
        client.wait_for(lambda: health_from_message(healths[-1], node="planner")[0].level < 2)


def test_a_plan_that_a_reset_overtakes_is_not_published(ros):
    with local_planner(ros) as (client, planner):
        good = planner._session._planner

        class ResetMeanwhile:
            def plan(self, *args: object, **kwargs: object) -> object:
                outcome = good.plan(*args, **kwargs)
                planner._runner.new_epoch()
                return outcome

        planner._session._planner = ResetMeanwhile()
        stamp_ns = now_ns()
        state = StampedState(stamp_ns, STATE)
        client.vehicle_state.publish(joint_state_from_state(state, LAYOUT))
        report = client.report_of(stamp_ns)
        assert report.code == NodeCode.SUPERSEDED
        assert not report.published
        assert not client.trajectories
