"""Hypersonic entry (sections 4.2 and 4.3, entry appendix of the paper)."""

from dscp_core.problems.entry.definition import FAMILY, NAME, Formulation, entry

__all__ = ["FAMILY", "NAME", "Formulation", "entry"]
