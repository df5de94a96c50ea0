"""One recorded plan: read back, flown again, and checked against what was reported with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dscp_core import problems
from dscp_core.planning.certificate import PlanCertificate, PlanVerifier
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.trajectory import Plan
from dscp_ros.bag import BagReader
from dscp_ros.demo.session import TRAJECTORY
from dscp_ros.demo.summary import Figures
from msg_adapters.layout import problem_layout
from msg_adapters.report import PlanReport
from msg_adapters.stamps import nanoseconds_from_stamp
from msg_adapters.trajectory import plan_from_trajectory


@dataclass(frozen=True)
class RecordedPlan:
    """A published plan.

    Attributes:
        problem: What was planned.
        plan: As published.
        report: As published.
        certificate: Of the plan as it was read back.
        parameters: Vehicle and mission that it was made for, SI, by name.
    """

    problem: OptimalControlProblem
    plan: Plan
    report: PlanReport
    certificate: PlanCertificate
    parameters: Mapping[str, Any]


def recorded_plan(
    recording: Path, parts: Sequence[Figures], problem_name: str, frame: str
) -> RecordedPlan | None:
    """The first plan that was published for the last bag with plans; None without any.

    Args:
        recording: What the node published.
        parts: Figures of the replayed bags, in order.
        problem_name: What was planned for, with its default vehicle.
        frame: Frame of the trajectories.

    Raises:
        BagError: The recording cannot be read.
        RejectedInputError: A trajectory cannot be understood.
    """
    published = [[r for r in part.attempts if r.published] for part in parts]
    reports = {r.input_stamp_ns: r for r in next((p for p in reversed(published) if p), [])}
    problem = problems.get(problem_name)
    layout = problem_layout(problem)
    with BagReader(recording) as reader:
        for _, message in reader.decoded_messages([TRAJECTORY]):
            report = reports.get(nanoseconds_from_stamp(message.header.stamp))
            if report is None:
                continue
            plan, _ = plan_from_trajectory(message, layout, frame=frame)
            packed = problem.table.pack()
            verifier = PlanVerifier(problem, len(plan.times_s) - 1)
            certificate = verifier.certify(plan.times_s, plan.states, plan.controls, packed)
            return RecordedPlan(problem, plan, report, certificate, problem.table.unpack(packed))
    return None
