"""The repairer as a child of a supervision tree."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from ...actors.backoff import Backoff
from ...actors.kernel.actor import Start
from ...supervision.spec import ChildSpec, child
from ..model import Declaration, Model, System
from ..planning import Planner
from .actions import RepairAction, Repertoire
from .approvals import Approver
from .ledger import Memory
from .policy import NORMAL, Policy, Stance, check_stance
from .repairer import Repairer


def repairer(
    model: Model | Declaration | System,
    actions: Repertoire | Iterable[RepairAction],
    policy: Policy | None = None,
    *,
    name: str = "repairer",
    addresses: Mapping[str, str] | None = None,
    base: Iterable[str] = (),
    planner: Planner | None = None,
    diagnoser: str | None = None,
    mode: str = NORMAL,
    stance: Stance = "on",
    approve: Approver | None = None,
    file: str | Path | None = None,
) -> ChildSpec:
    """The spec of a repairer, for `tree(..., repairer=...)`.

    What was tried, given up and forbidden, and the mode, outlive its restarts.

    Args:
        model, actions, policy, addresses, base, planner, diagnoser: see `Repairer`.
        name: the last part of its address.
        mode: at first; `SetMode` changes it.
        stance: how far repair goes at first: "off", "advise", "ask" or "on"; `SetStance` changes it.
        approve: is asked for approval, besides people; whoever answers first decides.
        file: where the scores of advice and what people have denied are kept, for the next program.

    Raises:
        ValueError: there is no such stance, or the file is another one. OSError: it cannot be read.
        ModelError: something is wrong with the model. PlanningError: with the actions.
    """
    made = model if isinstance(model, Model) else Model(model)
    repertoire = actions if isinstance(actions, Repertoire) else Repertoire(actions)
    memory = Memory(mode=mode, stance=check_stance(stance))
    if file is not None:
        memory.load(Path(file))
    options = {
        "addresses": {} if addresses is None else addresses,
        "base": tuple(base),
        "planner": planner,
        "diagnoser": diagnoser,
        "memory": memory,
        "approve": approve,
    }
    return child(name, Start(Repairer, (made, repertoire, policy), options), backoff=Backoff(initial=0.1))
