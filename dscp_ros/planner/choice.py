"""The problem that a node, or a tuning, was told to plan."""

from __future__ import annotations

from dataclasses import dataclass

from dscp_core import problems
from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problems.loading import FILE_MARK, ProblemFamily
from dscp_ros.planner.interface import check_plannable


def is_file(text: str) -> bool:
    """Whether a text names a problem in a Python file, which is code."""
    return FILE_MARK in text


@dataclass(frozen=True)
class ProblemChoice:
    """A problem by the text that named it. A file is run once, when it is read.

    Attributes:
        text: A known name, or ``FILE.py:NAME``.
        family: The problem with its formulations.
    """

    text: str
    family: ProblemFamily

    @staticmethod
    def read(text: str) -> ProblemChoice:
        """Look up a text; a file is run.

        Raises:
            InvalidInputError: Nothing is known by it, or what was found is no problem.
        """
        return ProblemChoice(text, problems.family(text))

    @property
    def is_file(self) -> bool:
        """Whether it is one of a Python file."""
        return is_file(self.text)

    @property
    def name(self) -> str:
        """Name of the problem.

        Raises:
            InvalidInputError: See `make`.
        """
        return self.make(next(iter(self.family.formulations), "")).name

    def make(self, formulation: str) -> OptimalControlProblem:
        """The declaration.

        Args:
            formulation: One of the family's; empty where there is one form only.

        Raises:
            InvalidInputError: It cannot be made, or not be planned from a state.
        """
        try:
            problem = self.family.make(formulation)
        except DscpError:
            raise
        except Exception as error:
            bound = f"one that can be made: {type(error).__name__}: {error}"
            raise InvalidInputError("problem", self.text, bound) from error
        check_plannable(problem)
        return problem
