"""What `dscp plan` says of a best effort, asked for and made where no feasible plan was found."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from dscp_ros.cli.output_files import with_unit

if TYPE_CHECKING:
    from dscp_core.planning.certificate import PlanCertificate
    from dscp_core.planning.plan import BestEffort
    from dscp_core.problem.declaration import OptimalControlProblem


def describe_effort(
    problem: OptimalControlProblem,
    effort: BestEffort | None,
    certificate: Callable[[OptimalControlProblem, PlanCertificate], dict[str, Any]],
) -> dict[str, Any] | None:
    """A best effort by name, in the units that the names tell; None where there is none.

    Args:
        problem: What was planned.
        effort: The best effort.
        certificate: Describes its certificate.
    """
    if effort is None:
        return None
    return {
        "certified": False,
        "violations": effort.violations,
        "steps": effort.steps,
        "terminal_time_s": effort.plan.terminal_time_s,
        **{
            with_unit(f"final_{state.name}", state.unit): effort.plan.states[-1, index]
            for index, state in enumerate(problem.states)
        },
        "certificate": certificate(problem, effort.certificate),
    }


def print_effort(described: dict[str, Any]) -> None:
    """Prints a described best effort below the outcome."""
    print(f"  best effort, NOT CERTIFIED: terminal time {described['terminal_time_s']:.4f} s")
    print("    it violates")
    for violation in described["violations"]:
        print(f"      {violation}")
    print("    made least, in this order")
    for step in described["steps"]:
        print(f"      {step}")
