"""`~/validity` and `~/best_effort` on real topics: what a tracker hears, and when."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from ros.planner_support import (
    LATCHED,
    LAYOUT,
    STATE,
    UNREACHABLE,
    local_planner,
    now_ns,
    running_planner,
)
from rosgraph_msgs.msg import Clock

from dscp_core import Planner, PlanOutcome, PlanStatus, problems
from dscp_core.planning.plan import BestEffort
from dscp_ros.planner.validity import ValidityKeeper
from msg_adapters.report import NodeCode
from msg_adapters.stamps import nanoseconds_from_stamp, stamp_from_nanoseconds
from msg_adapters.trajectory import plan_from_trajectory
from msg_adapters.validity import Validity, validity_from_message

SECOND_NS = 1_000_000_000
PATIENT_LISTENER = ["--ros-args", "-p", "silence_max_s:=600.0"]


def test_a_tracker_in_another_process_hears_of_every_change(ros):
    with running_planner(ros, PATIENT_LISTENER) as (client, _):
        # Told before this process came.
        first = client.next_validity(0)
        assert (first.valid, first.code) == (False, NodeCode.NO_TRAJECTORY)
        assert first.trajectory_stamp_ns is None

        stamp_ns = client.send()
        valid = client.next_validity(1)
        assert (valid.valid, valid.code, valid.trajectory_stamp_ns) == (True, 0, stamp_ns)
        client.wait_for(lambda: client.trajectories)
        assert nanoseconds_from_stamp(client.trajectories[0].header.stamp) == stamp_ns
        plan, _ = plan_from_trajectory(client.trajectories[0], LAYOUT)
        end_s = (valid.trajectory_end_ns - stamp_ns) / SECOND_NS
        assert end_s == pytest.approx(plan.terminal_time_s, abs=1e-6)
        assert valid.allows(stamp_ns, stamp_ns + SECOND_NS)
        assert not valid.allows(stamp_ns - 1, stamp_ns + SECOND_NS)

        late: list[DiagnosticArray] = []
        client.node.create_subscription(DiagnosticArray, "/planner/validity", late.append, LATCHED)
        client.wait_for(lambda: late)
        assert [validity_from_message(message) for message in late] == [valid]

        report = client.send_and_report(UNREACHABLE)
        assert report.code == PlanStatus.INFEASIBLE
        revoked = client.next_validity(2)
        assert (revoked.valid, revoked.code) == (False, PlanStatus.INFEASIBLE)
        assert revoked.trajectory_stamp_ns == stamp_ns
        assert revoked.reason == report.message

        client.send_and_report()
        assert client.next_validity(3).valid
        assert client.call("reset").success
        assert client.next_validity(4).code == NodeCode.RESET

        client.send_and_report()
        assert client.next_validity(5).valid
        assert client.call("reload").success
        reloaded = client.next_validity(6)
        assert (reloaded.valid, reloaded.code) == (False, NodeCode.RELOADED)
        assert len(client.validities) == 7
        assert not client.best_efforts


def test_states_that_stop_coming_revoke(ros):
    with local_planner(ros, silence_max_s=1.0) as (client, _):
        client.next_validity(0)
        client.send_and_report()
        client.wait_for(lambda: len(client.validities) >= 3)
        _, valid, stale = client.validities
        assert valid.valid
        assert (stale.valid, stale.code) == (False, NodeCode.STATES_STALE)
        assert stale.stamp_ns - valid.trajectory_stamp_ns > SECOND_NS
        assert "more than 1 s" in stale.reason
        client.send_and_report()
        assert client.next_validity(3).valid


def test_a_trajectory_ends(ros):
    with local_planner(ros, silence_max_s=600.0) as (client, _):
        client.next_validity(0)
        # It takes 32.8 s, of which 31 are gone.
        client.report_of(client.send(stamp_ns=now_ns() - 31 * SECOND_NS))
        ended = client.next_validity(2)
        assert (ended.valid, ended.code) == (False, NodeCode.PLAN_ENDED)
        assert ended.stamp_ns > ended.trajectory_end_ns


def test_a_clock_that_jumps_back_revokes(ros):
    with local_planner(ros, use_sim_time=True, silence_max_s=600.0) as (client, _):
        clock = client.node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
        client.wait_for(lambda: clock.get_subscription_count() > 0)

        def tick(seconds: int) -> None:
            clock.publish(Clock(clock=stamp_from_nanoseconds(seconds * SECOND_NS)))

        def planned() -> bool:
            tick(100)
            return any(report.published for report in client.reports)

        tick(100)
        client.wait_for(lambda: (client.send(stamp_ns=100 * SECOND_NS), planned())[1])
        tick(50)
        client.wait_for(lambda: client.validities[-1].code == NodeCode.CLOCK_JUMPED_BACK)
        assert not client.validities[-1].valid


def test_other_parameters_revoke_and_a_deadline_does_not(ros):
    with local_planner(ros, silence_max_s=600.0) as (client, planner):
        client.next_validity(0)
        client.send_and_report()
        assert client.next_validity(1).valid
        planner._node.set_parameters([Parameter("deadline_s", value=0.001)])
        # Far from the last plan, so that it helps nothing.
        other = STATE + np.array([900.0, 400.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        assert client.send_and_report(other).code == PlanStatus.DEADLINE
        assert len(client.validities) == 2
        planner._node.set_parameters([Parameter("intervals", value=40)])
        rebuilt = client.next_validity(2)
        assert (rebuilt.valid, rebuilt.code) == (False, NodeCode.RELOADED)


# The rules, one by one


@pytest.fixture(scope="module")
def certified() -> PlanOutcome:
    return Planner(problems.get("powered_descent")).plan()


class Told(list[Validity]):
    """What a keeper has told; its clock is set by hand."""

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = 0
        self.keeper = ValidityKeeper(self.append, lambda: self.now_ns)


def following(certified: PlanOutcome, stamp_s: float = 100.0) -> Told:
    told = Told()
    told.keeper.note_trajectory(certified.plan, round(stamp_s * SECOND_NS))
    return told


@pytest.mark.parametrize("status", list(PlanStatus)[1:])
@pytest.mark.parametrize("later_s", [-0.1, 0.0, 20.0])
def test_only_a_finding_about_a_newer_state_revokes(certified, status, later_s):
    told = following(certified)
    failed = replace(certified, status=status, message="why")
    told.keeper.note_outcome(failed, round((100.0 + later_s) * SECOND_NS), 1.0, False)
    finding = status in (PlanStatus.INFEASIBLE, PlanStatus.NOT_CERTIFIED)
    assert told[-1].valid is not (finding and later_s >= 0.0)
    if not told[-1].valid:
        assert (told[-1].code, told[-1].reason) == (status, "why")


def test_where_no_plan_is_short_enough_infeasible_says_nothing(certified):
    told = following(certified)
    failed = replace(certified, status=PlanStatus.INFEASIBLE, message="why")
    told.keeper.note_outcome(failed, round(132.0 * SECOND_NS), 1.0, False)
    assert told[-1].valid
    told.keeper.note_outcome(failed, round(131.7 * SECOND_NS), 1.0, False)
    assert not told[-1].valid


def test_it_tells_nothing_twice(certified):
    told = following(certified)
    told.now_ns = 133 * SECOND_NS
    for _ in range(3):
        told.keeper.check_time(1.0)
        told.keeper.revoke(NodeCode.RESET, "again")
    assert [validity.code for validity in told] == [905, 0, NodeCode.PLAN_ENDED]


# Best effort


def node_with_efforts(certified: PlanOutcome, planner) -> None:
    """Make the node's planner return a best effort where it finds nothing feasible."""
    made = planner._session._planner

    class WithEffort(type(made)):
        def plan(self, *args, **kwargs):
            outcome = super().plan(*args, **kwargs)
            if outcome.certified:
                return outcome
            effort = BestEffort(
                certified.plan, certified.certificate, ("contact at 31 m/s",), ("speed 31 m/s",)
            )
            return replace(outcome, best_effort=effort)

    made.__class__ = WithEffort


def test_a_best_effort_has_its_own_topic_and_code(ros, certified):
    with local_planner(ros, silence_max_s=600.0) as (client, planner):
        client.next_validity(0)
        node_with_efforts(certified, planner)
        stamp_ns = client.send()
        client.report_of(stamp_ns)
        assert client.next_validity(1).valid
        unreachable_ns = client.send(UNREACHABLE)
        report = client.report_of(unreachable_ns, count=2)
        attempt = client.reports[-2]
        assert attempt.code == PlanStatus.INFEASIBLE
        assert (report.code, report.code_name) == (904, "BEST_EFFORT")
        assert not report.published
        assert report.message == "NOT CERTIFIED, published on ~/best_effort: contact at 31 m/s"
        assert report.best_effort.violations == ("contact at 31 m/s",)
        assert report.best_effort.steps == ("speed 31 m/s",)
        client.wait_for(lambda: client.best_efforts)
        assert nanoseconds_from_stamp(client.best_efforts[-1].header.stamp) == unreachable_ns
        assert len(client.trajectories) == 1
        revoked = client.next_validity(2)
        assert (revoked.valid, revoked.code) == (False, PlanStatus.INFEASIBLE)
        effort = client.next_validity(3)
        assert effort == replace(
            revoked, stamp_ns=effort.stamp_ns, best_effort_stamp_ns=unreachable_ns
        )
        # A certified plan takes its place.
        client.send_and_report()
        again = client.next_validity(4)
        assert again.valid
        assert again.best_effort_stamp_ns is None


def test_best_efforts_are_made_only_if_asked_for(ros):
    with local_planner(ros) as (client, planner):
        assert planner._session._setup.settings.best_effort is False
        client.send_and_report(UNREACHABLE)
        assert not client.best_efforts
