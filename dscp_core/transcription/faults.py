"""Names of what is wrong with the values of a subproblem: which function, at which node, when."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.convexity import NotConvexError, least_eigenvalue
from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import DERIVED_COSTS, TERMINAL_TIME, OptimalControlProblem
from dscp_core.transcription.layout import TrajectoryLayout
from dscp_core.transcription.stage import Block, Kind, Stage
from dscp_core.transcription.stages import StageFunctions

Array = NDArray[np.float64]

_COSTS = (Kind.COST_MATRIX, Kind.COST_VECTOR)
_CONES = (Kind.CONE_MATRIX, Kind.CONE_VECTOR)


def not_finite(stages: StageFunctions, reference: Array, parameters: Array) -> InvalidInputError:
    """What the first value that is not finite belongs to, and where.

    Args:
        stages: Of the problem.
        reference: Scaled reference vector.
        parameters: Packed parameters, SI.
    """
    for block, values, place in _blocks(stages, reference, parameters):
        wrong = values[~np.isfinite(values)]
        bound, derivative = "finite", "a derivative of " if block.columns.size else ""
        if block.kind is Kind.CONE_VECTOR and not np.isnan(wrong).any():
            # Plus infinity is the absence of a bound, and minus infinity one that nothing meets.
            wrong, bound = wrong[wrong < 0.0], "a margin above minus infinity"
        if wrong.size:
            what, value = f"{derivative}{_label(block)}", f"{wrong[0]:g} {place}".rstrip()
            return InvalidInputError(what, value, bound)
    return InvalidInputError("subproblem", "a value that is not finite", "finite")


def not_convex(stages: StageFunctions, reference: Array, parameters: Array) -> NotConvexError:
    """Which cost has the least eigenvalue of all, and where; arguments as for `not_finite`."""
    least, what, where = np.inf, "cost", ""
    for block, values, place in _blocks(stages, reference, parameters):
        if block.kind is not Kind.COST_MATRIX or not block.columns.size or not values.size:
            continue
        size = int(max(block.rows.max(), block.columns.max())) + 1
        matrix = np.zeros((size, size))
        matrix[block.rows, block.columns] = values
        eigenvalue = least_eigenvalue(np.triu(matrix) + np.triu(matrix, 1).T)
        if eigenvalue < least:
            least, what, where = eigenvalue, _label(block), place
    return NotConvexError(
        what, f"least eigenvalue {least:.3g} of its Hessian {where}", "convex, none below 0"
    )


def describe_entry(problem: OptimalControlProblem, layout: TrajectoryLayout, index: int) -> str:
    """Which quantity an entry of a reference vector is, and at which node."""
    if index < layout.offset:
        return TERMINAL_TIME
    node, local = divmod(index - layout.offset, layout.nx + layout.nu)
    variable = (*problem.states, *problem.controls)[local]
    return f"{variable.name} at node {node}"


def _blocks(
    stages: StageFunctions, reference: Array, parameters: Array
) -> Iterator[tuple[Block, Array, str]]:
    """Every block at every place: its values, and the place in words."""
    layout = stages.layout
    width = layout.nx + layout.nu
    nodes = reference[layout.offset :].reshape(-1, width)
    time = reference[: layout.offset]
    total = layout.terminal_time(reference)
    if total is None:
        total = float(parameters[stages.problem.table.slice(TERMINAL_TIME)][0])
    step = total / layout.intervals

    def at(stage: Stage, vector: Array, place: str) -> Iterator[tuple[Block, Array, str]]:
        column = np.asarray(ca.DM(stage.function(vector, parameters)).full()).ravel()
        for block, entries in stage.located():
            yield block, column[entries], place

    yield from at(stages.boundary, np.concatenate([time, nodes[-1]]), "")
    for n in range(layout.intervals + 1):
        vector = np.concatenate([time, nodes[n]])
        yield from at(stages.node, vector, f"at node {n} ({n * step:.4g} s)")
        if n < layout.intervals:
            both = np.concatenate([time, nodes[n], nodes[n + 1]])
            yield from at(stages.interval, both, f"in interval {n} (from {n * step:.4g} s)")
    yield from at(stages.terminal, np.concatenate([time, nodes[-1]]), f"at the end ({total:.4g} s)")


def _label(block: Block) -> str:
    """The function that a block comes from, as messages call it."""
    if block.kind in _COSTS and block.group not in DERIVED_COSTS:
        return f"cost term {block.group}"
    if block.kind in _CONES:
        of_time = block.group == TERMINAL_TIME
        return "terminal_time_bounds" if of_time else f"constraint {block.group}"
    return block.group
