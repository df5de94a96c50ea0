"""Where each quantity stands in the decision vector of a subproblem."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrajectoryLayout:
    """Order ``[t_f?, x[0], u[0], ..., x[N], u[N], virtual control[0..N-1]?]``, scaled.

    The part before the virtual control is the *reference vector*: what one iteration hands to
    the next.

    Attributes:
        state_scale: (nx,), SI per scaled unit.
        control_scale: (nu,), SI per scaled unit.
        time_scale: Seconds per scaled unit of the terminal time.
        intervals: N.
        free_terminal_time: Whether t_f is a decision.
        virtual_scale: (nx,), SI per unit of virtual control; 0 for a state without it.
    """

    state_scale: Array
    control_scale: Array
    time_scale: float
    intervals: int
    free_terminal_time: bool
    virtual_scale: Array

    @property
    def nx(self) -> int:
        """Number of states."""
        return int(self.state_scale.size)

    @property
    def nu(self) -> int:
        """Number of controls."""
        return int(self.control_scale.size)

    @property
    def offset(self) -> int:
        """Position of x[0]: 1 when the terminal time comes first, else 0."""
        return int(self.free_terminal_time)

    @property
    def reference_size(self) -> int:
        """Length of a reference vector."""
        return self.offset + (self.intervals + 1) * (self.nx + self.nu)

    @cached_property
    def virtual_states(self) -> NDArray[np.intp]:
        """Indices of the states whose dynamics have a virtual control."""
        return np.flatnonzero(self.virtual_scale)

    @property
    def size(self) -> int:
        """Length of a decision vector."""
        return self.reference_size + self.intervals * self.virtual_states.size

    def state_index(self, node: int, state: int) -> int:
        """Position of one state at one node."""
        return self.offset + node * (self.nx + self.nu) + state

    def control_index(self, node: int, control: int) -> int:
        """Position of one control at one node."""
        return self.offset + node * (self.nx + self.nu) + self.nx + control

    def _nodes(self, reference: Array) -> Array:
        return reference[self.offset : self.reference_size].reshape(
            self.intervals + 1, self.nx + self.nu
        )

    def states(self, reference: Array) -> Array:
        """States of a reference or decision vector, (N+1, nx), SI."""
        return np.asarray(self._nodes(reference)[:, : self.nx] * self.state_scale)

    def controls(self, reference: Array) -> Array:
        """Controls, (N+1, nu), SI."""
        return np.asarray(self._nodes(reference)[:, self.nx :] * self.control_scale)

    def terminal_time(self, reference: Array) -> float | None:
        """Terminal time in seconds, or None when it is no decision."""
        return float(reference[0] * self.time_scale) if self.free_terminal_time else None

    def virtual_control(self, decision: Array) -> Array:
        """Virtual control, (N, nx), SI; zero for states without it."""
        virtual = np.zeros((self.intervals, self.nx))
        scaled = decision[self.reference_size :].reshape(self.intervals, -1)
        virtual[:, self.virtual_states] = scaled * self.virtual_scale[self.virtual_states]
        return virtual

    def virtual_part(self, virtual_control: Array) -> Array:
        """Inverse of `virtual_control`: the tail of a decision vector."""
        kept = virtual_control[:, self.virtual_states]
        return np.asarray(kept / self.virtual_scale[self.virtual_states]).ravel()

    def reference(self, states: Array, controls: Array, terminal_time: float) -> Array:
        """Reference vector of SI arrays (N+1, nx), (N+1, nu) and seconds."""
        nodes = np.hstack([states / self.state_scale, controls / self.control_scale]).ravel()
        if not self.free_terminal_time:
            return np.asarray(nodes)
        return np.concatenate([[terminal_time / self.time_scale], nodes])

    def relative(self, residual: Array) -> float:
        """Largest entry of (..., nx) in size, relative to the states' scales."""
        return float(np.max(np.abs(residual) / self.state_scale))
