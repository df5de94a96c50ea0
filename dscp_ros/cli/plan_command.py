"""`dscp plan`: solve one case, without ROS."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dscp_core.errors import InvalidInputError
from dscp_ros.cli import ExitCode
from dscp_ros.cli.arguments import (
    add_case_arguments,
    case_planner,
    print_json,
    print_parameters,
    print_table,
)
from dscp_ros.cli.best_effort import describe_effort, print_effort
from dscp_ros.cli.output_files import (
    check_output_path,
    complete_file,
    with_unit,
    write_trajectory,
)

if TYPE_CHECKING:
    from dscp_core.planning.certificate import PlanCertificate
    from dscp_core.planning.plan import PlanOutcome
    from dscp_core.planning.planner import Planner
    from dscp_core.problem.declaration import OptimalControlProblem
    from dscp_core.problem.trajectory import Plan

DESCRIPTION = """\
Plans one trajectory and certifies it: the true dynamics are integrated under the planned controls,
and every constraint is checked between the nodes too. Without options it is the problem's own case.

Units are SI and angles are in rad. A plan for which no certificate can be given is no plan: exit
code 3. The first line says three things: whether the plan is certified (it can be flown; each check
follows with its margin), whether its iterations converged and if not why they stopped, and what may
at most be missing to the least cost nearby.
"""

EPILOG = """\
examples:
  dscp plan powered_descent
  dscp plan powered_descent --list-parameters
  dscp plan powered_descent --set terminal_time=33 --set initial_position=5000,500,500
  dscp plan powered_descent --free-terminal-time --solver qoco,clarabel
  dscp plan powered_descent --plot plan.png --output plan.csv
  dscp plan powered_descent --set terminal_time=32 --json    (infeasible: exit code 3)
  dscp plan powered_descent --set initial_velocity=-400,30,-30 --best-effort    (exit code 3)
  dscp plan entry --set surface_to_mass_ratio=0.93 --plot entry.png
  dscp plan entry --formulation printed --intervals 200
  dscp plan my_problem.py:QUADROTOR --plot quadrotor.png

A vehicle file holds lines such as `initial_mass: 25000` and `initial_velocity: [-90, 0, 0]`.

--json prints one object: headline, status (certified, not_certified, infeasible, iteration_limit,
deadline, solver_failure), message, certified, converged, stopped (why the iterations stopped),
cost_to_gain (what the plan costs more than a local optimum, at most, in the cost's unit; an
estimate), terminal_time_s, iterations, cost, cost_unit, subproblem_costs (what the iterations
minimise of the running and the terminal cost), final_STATE_UNIT for every state (such as
final_mass_kg), certificate (with MISS_UNIT for every miss, such as miss_position_m, checks with
name, worst_value, bound, margin, unit, time_s, passed, and unchecked, the limits whose bound is
unknown or infinite), solve_time_ms, solver, virtual_control,
max_defect, least_feasible_terminal_time_s, best_effort (with --best-effort and no certified plan:
violations, steps, terminal_time_s, final_STATE_UNIT, certificate; --plot and --output then draw and
write it). null stands for what does not exist or is unknown.

exit codes: 0 certified plan, 2 bad input, 3 no such plan.
"""

# Of states whose final value is not pinned, this many are printed.
_MOST_FINAL_STATES = 8
_HELD = {"mean": "held at interval means", "linear": "linear between the nodes"}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the command."""
    parser = subparsers.add_parser(
        "plan", help="solve one case, without ROS", description=DESCRIPTION, epilog=EPILOG
    )
    add_case_arguments(parser)
    parser.add_argument(
        "--deadline", type=float, metavar="S", help="wall time for the iterations, in seconds"
    )
    parser.add_argument(
        "--best-effort",
        action="store_true",
        help="where no feasible plan is found, make the one that violates least; NOT CERTIFIED",
    )
    group = parser.add_argument_group("output")
    group.add_argument(
        "--plot", type=Path, metavar="FILE.png", help="draw the plan and the flight that checks it"
    )
    group.add_argument("--output", type=Path, metavar="FILE.csv|.json", help="write the trajectory")
    group.add_argument("--json", action="store_true", help="print the result as JSON on stdout")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Plans, prints, writes.

    Returns:
        The exit code.

    Raises:
        InvalidInputError: A value that cannot be used.
    """
    if args.list_parameters:
        print_parameters(args)
        return ExitCode.OK
    _check(args)
    from dscp_core.planning.plan import PlanStatus
    from dscp_core.planning.planner import TerminalTime
    from dscp_core.scp.scp import ScpOptions

    planner = case_planner(args, ScpOptions(), best_effort=args.best_effort)
    planner.check_state(planner.initial_state)
    outcome = planner.plan(deadline_s=args.deadline)
    least = None
    without_answer = outcome.status not in (PlanStatus.CERTIFIED, PlanStatus.DEADLINE)
    if without_answer and planner.settings.terminal_time is not TerminalTime.FREE:
        least = _least_terminal_time(args, planner)
        outcome = _name_least(outcome, least)
    described = describe(planner, outcome, least)
    written = _write(args, planner, outcome, described)
    if args.json:
        print_json({**described, **written})
    else:
        _print(described, planner, outcome)
        if described["best_effort"] is not None:
            print_effort(described["best_effort"])
    return ExitCode.OK if outcome.status is PlanStatus.CERTIFIED else ExitCode.NO_PLAN


def describe(planner: Planner, outcome: PlanOutcome, least_s: float | None) -> dict[str, Any]:
    """The outcome by name, in the units that the names tell.

    Args:
        planner: What made it.
        outcome: What became of the attempt.
        least_s: Least feasible terminal time, where it was looked for and found.
    """
    problem, settings, plan = planner.problem, planner.settings, _flyable(outcome)
    return {
        "problem": problem.name,
        "formulation": problem.formulation or None,
        "headline": outcome.headline,
        "status": outcome.status,
        "message": outcome.message,
        "certified": outcome.certified,
        "converged": outcome.converged,
        "stopped": None if outcome.stopped is None else outcome.stopped.value,
        "cost_to_gain": outcome.cost_to_gain,
        "terminal_time_s": outcome.terminal_time_used_s,
        "terminal_time_source": settings.terminal_time,
        "least_feasible_terminal_time_s": least_s,
        **{
            with_unit(f"final_{state.name}", state.unit): None
            if plan is None
            else plan.states[-1, index]
            for index, state in enumerate(problem.states)
        },
        "cost": None if plan is None else outcome.cost,
        "cost_unit": problem.cost_unit,
        "subproblem_costs": {
            name: getattr(planner.transcription.costs, name).value
            for name in ("running", "terminal")
        },
        "iterations": outcome.iterations,
        "intervals": settings.intervals,
        "solver": outcome.solver,
        "solve_time_ms": 1e3 * outcome.solve_time_s,
        "solver_time_ms": 1e3 * outcome.solver_time_s,
        "virtual_control": outcome.virtual_control,
        "max_defect": outcome.max_defect,
        "certificate": None
        if outcome.certificate is None
        else _certificate(problem, outcome.certificate),
        "best_effort": describe_effort(problem, outcome.best_effort, _certificate),
        "parameters": outcome.parameters,
    }


def _cost_forms(forms: dict[str, str]) -> str:
    """What the iterations minimise of the costs, where that is not plainly the cost."""
    told = [
        f"{name} cost: {form}"
        for name, form in forms.items()
        if form not in ("none", "exact") or (name == "running" and form == "exact")
    ]
    return "; ".join(told)


def _check(args: argparse.Namespace) -> None:
    """Refuses what can be refused before anything is computed."""
    if args.deadline is not None and not (math.isfinite(args.deadline) and args.deadline > 0.0):
        raise InvalidInputError("--deadline", args.deadline, "finite and > 0 s")
    if args.plot is not None:
        check_output_path("--plot", args.plot, (".png",))
    if args.output is not None:
        check_output_path("--output", args.output, (".csv", ".json"))


def _least_terminal_time(args: argparse.Namespace, planner: Planner) -> float | None:
    """Least feasible terminal time, by the default formulation: the printed one cannot find it."""
    from dscp_core import problems
    from dscp_core.planning.planner import Planner as DefaultPlanner
    from dscp_core.problem.declaration import TERMINAL_TIME

    problem, settings = problems.get(args.problem), planner.settings
    others = {n: v for n, v in settings.parameters.items() if n != TERMINAL_TIME}
    # The case's own time is the first guess; one that is far too short leads nowhere.
    for parameters in (settings.parameters, others):
        search = DefaultPlanner(problem, replace(settings, parameters=parameters))
        least = search.least_terminal_time(search.initial_state)
        if least is not None:
            return least
    return None


def _name_least(outcome: PlanOutcome, least_s: float | None) -> PlanOutcome:
    """Says so where the terminal time is too short, however the iterations ended."""
    from dscp_core.planning.plan import PlanStatus

    used = outcome.terminal_time_used_s
    if least_s is None or used >= least_s:
        return outcome
    message = (
        f"terminal_time {used:g} s is below the least feasible {least_s:.4f} s; {outcome.message}"
    )
    return replace(outcome, status=PlanStatus.INFEASIBLE, message=message)


def _flyable(outcome: PlanOutcome) -> Plan | None:
    """The trajectory, if it satisfies the dynamics."""
    from dscp_core.planning.plan import PlanStatus

    kept = outcome.status in (PlanStatus.CERTIFIED, PlanStatus.NOT_CERTIFIED)
    return outcome.plan if kept else None


def _certificate(problem: OptimalControlProblem, certificate: PlanCertificate) -> dict[str, Any]:
    from dscp_core.planning.plan import flight_figures

    worst = {check.name: check.worst_value for check in certificate.checks}
    # Missing where the flight could not be integrated to its end.
    missed = {with_unit(miss.name, miss.unit): worst.get(miss.name) for miss in problem.end_checks}
    return {
        "passed": certificate.passed,
        "reasons": certificate.reasons,
        **missed,
        **flight_figures(certificate),
        "control_hold": certificate.hold,
        "unchecked": certificate.unchecked,
        "checks": [{**asdict(check), "margin": check.margin} for check in certificate.checks],
    }


def _write(
    args: argparse.Namespace, planner: Planner, outcome: PlanOutcome, described: dict[str, Any]
) -> dict[str, str | None]:
    """Writes the files that were asked for; returns where they are, None for those left out."""
    asked = {name: getattr(args, name) for name in ("output", "plot") if getattr(args, name)}
    effort = outcome.best_effort
    plan = _flyable(outcome) if effort is None else effort.plan
    if plan is None or (outcome.certificate is None and effort is None):
        for name, path in asked.items():
            print(f"dscp plan: --{name}: no trajectory, {path} is not written", file=sys.stderr)
        return dict.fromkeys(asked)
    if args.output is not None:
        write_trajectory(args.output, plan, planner.problem, described)
    if args.plot is not None:
        figure = planner.figure(outcome)
        with complete_file(args.plot) as partial:
            figure.savefig(partial)
    return {name: str(path) for name, path in asked.items()}


def _print(described: dict[str, Any], planner: Planner, outcome: PlanOutcome) -> None:
    from dscp_core.planning.plan import flight_figures

    problem, certificate = planner.problem, described["certificate"]
    form = f"{problem.formulation}, " if problem.formulation else ""
    print(f"{problem.name} ({form}{planner.settings.intervals} intervals): {outcome.headline}")
    source = described["terminal_time_source"].value
    rows = [("terminal time", f"{outcome.terminal_time_used_s:.4f} s", source)]
    if described["least_feasible_terminal_time_s"] is not None:
        rows.append(("least feasible", f"{described['least_feasible_terminal_time_s']:.4f} s", ""))
    plan = _flyable(outcome)
    if plan is not None:
        cost = _quantity(outcome.cost, problem.cost_unit)
        rows.append(("cost", cost, _cost_forms(described["subproblem_costs"])))
        ends = [
            (state, plan.states[0, i], plan.states[-1, i])
            for i, state in enumerate(problem.states)
            if state.name not in problem.final_state
        ]
        rows += [
            (f"final {state.name}", _quantity(end, state.unit), f"{end - start:+.7g} in flight")
            for state, start, end in ends[:_MOST_FINAL_STATES]
        ]
    solver = f", of which {described['solver_time_ms']:.1f} ms in {outcome.solver}"
    time = f"{described['stopped'] or 'none begun'}; {described['solve_time_ms']:.1f} ms"
    rows.append(("iterations", str(outcome.iterations), time + (solver if outcome.solver else "")))
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    for label, value, note in rows:
        print(f"  {label:<{widths[0]}}  {value:>{widths[1]}}  {note}".rstrip())
    if plan is None or outcome.certificate is None:
        return
    print(f"  certificate, flown with the controls {_HELD[outcome.certificate.hold.value]}:")
    checks = [
        (
            check["name"],
            f"{check['worst_value']:.4g}",
            f"{check['bound']:g}",
            f"{check['margin']:.4g}",
            check["unit"],
            f"{check['time_s']:.2f} s",
            "passed" if check["passed"] else "FAILED",
        )
        for check in certificate["checks"]
    ]
    print_table(("check", "worst", "bound", "margin", "unit", "at", ""), checks, indent="    ")
    if certificate["unchecked"]:
        names = ", ".join(certificate["unchecked"])
        print(f"    NOT checked, the bound being unknown or infinite: {names}")
    figures = flight_figures(outcome.certificate)
    if figures:
        print("    flown: " + ", ".join(f"{name} {value:.7g}" for name, value in figures.items()))


def _quantity(value: float, unit: str) -> str:
    return f"{value:.8g}" + ("" if unit in ("", "1") else f" {unit}")
