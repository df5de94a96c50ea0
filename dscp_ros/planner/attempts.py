"""One planning attempt after the other, in the worker's thread: plan, publish, report."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Collection
from concurrent.futures import Future
from dataclasses import dataclass, replace

from dscp_core.planning.plan import BestEffort, PlanOutcome, PlanStatus
from dscp_core.problem.trajectory import Plan
from dscp_ros.planner.health import HealthMonitor
from dscp_ros.planner.input_checks import AcceptedState
from dscp_ros.planner.outputs import PlanOutputs
from dscp_ros.planner.parameters import NodeSettings
from dscp_ros.planner.session import PlanningSession
from dscp_ros.planner.validity import ValidityKeeper
from msg_adapters.drawing import Drawing
from msg_adapters.layout import StateLayout
from msg_adapters.report import (
    BestEffortFigures,
    NodeCode,
    PlanReport,
    attempt_from_outcome,
    figures_from_certificate,
)


@dataclass(frozen=True)
class PlanJob:
    """A state to plan from.

    Attributes:
        accepted: The state.
        source: Input that it came by.
        arrived_s: When it arrived, by ``time.perf_counter``.
        epoch: Epoch in which it arrived; see `AttemptRunner.new_epoch`.
    """

    accepted: AcceptedState
    source: str
    arrived_s: float
    epoch: int


@dataclass(frozen=True)
class Surroundings:
    """What an attempt asks the node for; each is called in the worker's thread.

    Attributes:
        now_ns: ROS time.
        settings: Current settings.
        drops: States dropped so far.
        rejected: Inputs refused so far.
        log_error: Writes an error line.
        log_warning: Writes a warning line of a cause, throttled.
    """

    now_ns: Callable[[], int]
    settings: Callable[[], NodeSettings]
    drops: Callable[[], int]
    rejected: Callable[[], int]
    log_error: Callable[[str], None]
    log_warning: Callable[[int, str], None]


class AttemptRunner:
    """Runs jobs. `run` belongs to the worker's thread, the rest may be called from any."""

    def __init__(
        self,
        session: PlanningSession,
        outputs: PlanOutputs,
        health: HealthMonitor,
        validity: ValidityKeeper,
        layout: StateLayout,
        surroundings: Surroundings,
        misses: Collection[str] = (),
    ) -> None:
        """Start in epoch 0.

        Args:
            session: The planner.
            outputs: Publishers.
            health: Is told of every attempt.
            validity: Is told of every plan, and of every attempt without one.
            layout: Names and order of the problem's state.
            surroundings: What else an attempt needs.
            misses: Names of the problem's misses.
        """
        self._session = session
        self._outputs = outputs
        self._health = health
        self._validity = validity
        self._layout = layout
        self._around = surroundings
        self._misses = frozenset(misses)
        self._lock = threading.Lock()
        self._waiters: list[Future[PlanReport]] = []
        self._epoch = 0

    @property
    def epoch(self) -> int:
        """Current epoch."""
        return self._epoch

    def new_epoch(self) -> None:
        """Begin a new epoch: plans of jobs from earlier ones are not published any more."""
        with self._lock:
            self._epoch += 1
            waiters, self._waiters = self._waiters, []
        for waiter in waiters:
            waiter.cancel()

    def next_report(self) -> Future[PlanReport]:
        """Report of the next attempt; cancelled by a new epoch."""
        waiter: Future[PlanReport] = Future()
        with self._lock:
            self._waiters.append(waiter)
        return waiter

    def run(self, job: PlanJob) -> None:
        """Plan, publish a certified plan, and report, whatever happens."""
        with self._lock:
            waiters, self._waiters = self._waiters, []
        try:
            report, *events = self._attempt(job)
        except Exception as error:  # noqa: BLE001 - the node outlives any error of an attempt
            report, events = self._internal_error(job, error), []
        self._health.note_attempt(report)
        for told in (report, *events):
            self._outputs.publish_report(told)
        for waiter in waiters:
            waiter.set_result(report)

    def _attempt(self, job: PlanJob) -> list[PlanReport]:
        """Report of the attempt, then those of what else came of it."""
        settings = self._around.settings()
        state = job.accepted.state
        outcome = self._session.plan(state, settings.deadline_s)
        code: PlanStatus | NodeCode = outcome.status
        message = outcome.message
        if outcome.status in (PlanStatus.CERTIFIED, PlanStatus.NOT_CERTIFIED):
            message = f"{outcome.headline}; {message}"
        published, effort = False, None
        if job.epoch != self._epoch:
            code, message = NodeCode.SUPERSEDED, f"not published after a reset: {message}"
        elif outcome.status is PlanStatus.CERTIFIED and outcome.plan is not None:
            self._outputs.publish_trajectory(outcome.plan, state.stamp_ns)
            self._validity.note_trajectory(outcome.plan, state.stamp_ns)
            published = True
        else:
            effort = outcome.best_effort
            if effort is not None:
                self._outputs.publish_best_effort(effort.plan, state.stamp_ns)
            self._validity.note_outcome(
                outcome, state.stamp_ns, self._session.least_time_s, effort is not None
            )
        latency_ms = 1e3 * (time.perf_counter() - job.arrived_s)
        if published and outcome.plan is not None:
            self._draw(outcome.plan, state.stamp_ns, settings.drawing)
        else:
            self._around.log_warning(int(code), f"no plan: {code.name} ({int(code)}): {message}")
        reports = [self._report(job, code, message, published, latency_ms, outcome)]
        if effort is not None:
            reports.append(self._effort_report(reports[0], effort))
        return reports

    def _effort_report(self, attempt: PlanReport, effort: BestEffort) -> PlanReport:
        """What the best effort of an attempt is worth; the attempt has its own report."""
        code = NodeCode.BEST_EFFORT
        violations = "; ".join(effort.violations)
        self._around.log_warning(int(code), f"best effort, NOT CERTIFIED: {violations}")
        return replace(
            attempt,
            code=int(code),
            code_name=code.name,
            message=f"NOT CERTIFIED, published on ~/best_effort: {violations}",
            attempt=None,
            certificate=figures_from_certificate(effort.certificate, self._misses),
            best_effort=BestEffortFigures(effort.violations, effort.steps),
        )

    def _draw(self, plan: Plan, stamp_ns: int, drawing: Drawing | None) -> None:
        """Publish the drawing; a scene that fails costs the picture, not the plan's report."""
        try:
            self._outputs.publish_drawing(plan, stamp_ns, drawing)
        except Exception as error:  # noqa: BLE001 - a problem's scene is anybody's code
            self._around.log_error(f"no drawing: {type(error).__name__}: {error}")

    def _internal_error(self, job: PlanJob, error: Exception) -> PlanReport:
        self._session.forget()
        message = f"{type(error).__name__}: {error}"
        trace = "".join(traceback.format_exception(error))
        self._around.log_error(f"planning failed, the node lives on: {message}\n{trace}")
        latency_ms = 1e3 * (time.perf_counter() - job.arrived_s)
        return self._report(job, NodeCode.INTERNAL_ERROR, message, False, latency_ms, None)

    def _report(
        self,
        job: PlanJob,
        code: PlanStatus | NodeCode,
        message: str,
        published: bool,
        latency_ms: float,
        outcome: PlanOutcome | None,
    ) -> PlanReport:
        state = job.accepted.state
        named = zip(
            self._layout.message_names, self._layout.to_message_order(state.values), strict=True
        )
        attempt = certificate = None
        if outcome is not None:
            attempt = attempt_from_outcome(outcome, self._around.settings().deadline_s)
            certificate = figures_from_certificate(outcome.certificate, self._misses)
        return PlanReport(
            stamp_ns=self._around.now_ns(),
            source=job.source,
            code=int(code),
            code_name=code.name,
            message=message,
            problem=self._layout.problem,
            published=published,
            drops=self._around.drops(),
            rejected=self._around.rejected(),
            input_stamp_ns=state.stamp_ns,
            latency_ms=latency_ms,
            mass_source=job.accepted.mass_source,
            parameter_set=self._session.parameter_set,
            state={name: float(value) for name, value in named},
            attempt=attempt,
            certificate=certificate,
        )
