"""Errors of the tuner."""

from __future__ import annotations

from dscp_core.errors import DscpError


class TuningError(DscpError):
    """A tuning that cannot start or go on."""
