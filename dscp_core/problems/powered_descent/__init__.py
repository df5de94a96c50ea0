"""Powered descent guidance (section 4.1 and appendix A of the paper)."""

from dscp_core.problems.powered_descent.definition import FAMILY, NAME, Formulation, powered_descent

__all__ = ["FAMILY", "NAME", "Formulation", "powered_descent"]
