"""What can be differentiated of a plan, by name, with symbol and unit."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.losses import ConvergenceLoss, CostLoss, FinalStateLoss, Loss
from dscp_core.problem.declaration import OptimalControlProblem

COST = "cost"
CONVERGENCE = "convergence"
FINAL = "final_"


@dataclass(frozen=True)
class Quantity:
    """A loss, and what to call it.

    Attributes:
        name: As it is asked for.
        loss: The loss.
        symbol: Its symbol.
        unit: Its unit; empty where it is not known.
    """

    name: str
    loss: Loss
    symbol: str
    unit: str


def quantity(problem: OptimalControlProblem, of: str | Loss) -> Quantity:
    """What is meant by a name or a loss.

    Args:
        problem: The declaration.
        of: ``"cost"``; ``"convergence"``, the sum of ``|J_k - J_K|`` over the iterations; a state's
            name, or ``"final_"`` and that, for its final value; or any loss.

    Raises:
        InvalidInputError: Nothing is known by that name.
    """
    if isinstance(of, CostLoss) or of == COST:
        return Quantity(COST, CostLoss(), "J", problem.cost_unit)
    if isinstance(of, ConvergenceLoss) or of == CONVERGENCE:
        return Quantity(CONVERGENCE, ConvergenceLoss(), "sum |J_k - J_K|", problem.cost_unit)
    if isinstance(of, FinalStateLoss):
        found = quantity(problem, FINAL + of.state)
        factor = "" if of.factor == 1.0 else f"{of.factor:g} * "
        return replace(found, name=factor + found.name, symbol=factor + found.symbol, loss=of)
    if not isinstance(of, str):
        if isinstance(of, type) or not callable(getattr(of, "gradient", None)):
            raise InvalidInputError("quantity", of, "a name or a loss")
        return Quantity(type(of).__name__, of, "L", "")
    for state in problem.states:
        if of in (FINAL + state.name, state.name):
            loss = FinalStateLoss(state.name)
            return Quantity(FINAL + state.name, loss, f"{state.name}(t_f)", state.unit)
    known = [COST, CONVERGENCE, *(FINAL + state.name for state in problem.states)]
    near = difflib.get_close_matches(of, [*known, *(s.name for s in problem.states)])
    hint = f"; did you mean {', '.join(near)}?" if near else ""
    raise InvalidInputError("quantity", of, f"one of {', '.join(known)}{hint}")
