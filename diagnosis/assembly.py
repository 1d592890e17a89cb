"""Diagnosis as a supervision tree that a user adds to the system."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

from ..actors.backoff import Backoff
from ..actors.kernel.actor import Start
from ..actors.kernel.mailbox import bounded
from ..supervision.spec import ChildSpec, child
from ..supervision.tree import supervisor
from .diagnoser import SERVER, DiagnoserActor
from .messages import DIAGNOSER
from .model import Declaration, History, System
from .model_server import ModelServer
from .observers import Observer

WAITING: Final = 10_000
"""Messages that may wait at an observer; of more, the oldest are not seen."""
RESTARTS: Final = 20
"""Within `PERIOD` seconds: diagnosis is not to end because something that it looks at is strange."""
PERIOD: Final = 60.0


def observer(name: str, start: Start[Any]) -> ChildSpec:
    """Describe an observer: nobody who publishes ever waits for it, and a crash does not make it hurry.

    Args:
        name: the last part of its address.
        start: from `start(NodeObserver, ...)`.

    Raises:
        TypeError: it is no observer. SpecError: see `child`.
    """
    if not issubclass(start.kind, Observer):
        raise TypeError(f"{start.kind.__name__} is no Observer")
    return child(name, start, mailbox=bounded(WAITING, overflow="drop_oldest"), backoff=Backoff(initial=0.1))


def tree(
    model: History | Declaration | System,
    observers: Iterable[ChildSpec] = (),
    *,
    name: str = "diagnosis",
    quiet: float = 0.02,
    limit: int = 1000,
    seconds: float = 1.0,
    explaining: float = 1.0,
    recent: float = 30.0,
    trust: Mapping[str, float] | None = None,
    repairer: ChildSpec | None = None,
    others: Iterable[ChildSpec] = (),
) -> ChildSpec:
    """Describe a supervisor over the model server, the diagnoser, the observers, and whatever is to live with them.

    Args:
        model: checked here; it, and what it becomes, outlives restarts of its server.
        observers: from `observer(...)`.
        name: of the supervisor, the last part of its address.
        quiet, limit, seconds, explaining, recent, trust: see `DiagnoserActor`.
        repairer: from `repair.repairer(...)`; it is started last.
        others: further children, such as `child("board", start(BoardActor, "tcp://..."))`; they are started first.

    Raises:
        ModelError: something is wrong with the model.
    """
    history = model if isinstance(model, History) else History(model)
    limits = {"quiet": quiet, "limit": limit, "seconds": seconds, "explaining": explaining}
    options = {**limits, "recent": recent, "trust": dict(trust or {})}
    watchers = supervisor("observers", intensity=RESTARTS, period=PERIOD, restart="permanent", children=observers)
    return supervisor(
        name,
        intensity=RESTARTS,
        period=PERIOD,
        children=[
            *others,
            child(SERVER, Start(ModelServer, (history,))),
            child(DIAGNOSER, Start(DiagnoserActor, (), options), backoff=Backoff(initial=0.1)),
            watchers,
            *([repairer] if repairer is not None else []),
        ],
    )
