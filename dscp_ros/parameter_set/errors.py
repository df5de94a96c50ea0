"""What can be wrong with a parameter set."""

from __future__ import annotations

from dscp_core.errors import DscpError


class ParameterSetError(DscpError):
    """A parameter set that is damaged, was changed, does not fit, or cannot be written."""
