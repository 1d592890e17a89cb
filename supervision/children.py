"""A child as its supervisor sees it, and the items through which a supervisor talks to itself."""

from __future__ import annotations

import asyncio
import dataclasses
from collections import deque
from collections.abc import Callable
from typing import Any

from ..actors.cell import Cell
from ..actors.errors import HoldfastError, NoSuchActor, StartFailed
from ..actors.exits import ExitReason
from ..actors.mail import Item, ReplyHandle
from .admin import ChildInfo
from .spec import ChildSpec

# What a child may be in, as `WhichChildren` tells it.
STOPPED = "stopped"
UP = "running"
RESTARTING = "restarting"
RECOVERING = "recovering"


@dataclasses.dataclass(slots=True, eq=False)
class Child:
    """A child as its supervisor sees it."""

    spec: ChildSpec
    cell: Cell | None = None
    state: str = STOPPED
    ignored_life: int = 0  # the end of this life is known already: its start failed, or we stopped it
    attempts: int = 0  # restarts in a row without a healthy life
    up_since: float = 0.0
    retry: int = 0  # the number of the retry that counts; stale ones are dropped
    up: asyncio.Future[None] | None = None  # a start that is waited for outside our turn; None once it is known or void
    row: Row | None = None  # those that are started one after another, and it is one of them

    @property
    def is_running(self) -> bool:
        """Whether a life is lived there now, or is being brought back."""
        return self.state in (UP, RECOVERING)

    def info(self, above: str) -> ChildInfo:
        """As `WhichChildren` tells it."""
        return ChildInfo(self.spec.id, self.state, f"{above}/{self.spec.id}", self.spec.is_supervisor)


def complete(own: Cell, spec: ChildSpec) -> ChildSpec:
    """A child's spec with what is said of it elsewhere. Raises SpecError: the two do not go together."""
    completed: ChildSpec = own.node.complete(spec, f"{own.path}/{spec.id}")
    return completed


def new_cell(own: Cell, one: Child) -> Cell:
    """An address below a supervisor's, for the lives of a child.

    Raises:
        StartFailed: a binding points nowhere. NameTaken: somebody else lives there.
    """
    node, spec = own.node, complete(own, one.spec)
    one.spec = spec
    targets = {port: node.find(path) for port, path in spec.bindings.items()}
    for port, target in targets.items():  # Before there is a cell: a child that cannot start leaves no name taken.
        if target is None:
            missing = NoSuchActor(spec.bindings[port])
            raise StartFailed(f"{own.path}/{spec.id}", f"binding {port!r}: {missing}") from missing
    cell = node.cell_below(own, spec.id, node.host_for(spec))
    cell.spec = spec
    cell.extra().start = spec.start
    if spec.mailbox is not None:
        node.bound(cell, spec.mailbox)
    for port, target in targets.items():
        assert target is not None
        node.bind(cell, port, target)
    return cell


@dataclasses.dataclass(slots=True, eq=False)
class Row:
    """Children that are started one after another; what waits for a slow one is served meanwhile."""

    waiting: deque[Child]
    reason: ExitReason  # of the end for which they are started again
    asked: Asked | None = None  # it is a first start, of one child


@dataclasses.dataclass(slots=True, eq=False)
class Asked:
    """Who waits for a start that takes longer than the turn in which it was asked for."""

    handle: ReplyHandle[Any]
    undo: Callable[[], None]  # what follows if it fails

    def failed(self, error: HoldfastError) -> None:
        """It has not come up: the answer is an error, and it is not tried again."""
        self.undo()
        self.handle.fail(error)


class Retry(Item):
    """A restart that is due: after a failed attempt, or a back-off. Other requests are served before it."""

    __slots__ = ("child", "number", "reason")

    def __init__(self, child: Child, number: int, reason: ExitReason) -> None:
        self.child, self.number, self.reason = child, number, reason

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        return actor._retry(item.child, item.number, item.reason)


class StartOver(Item):
    """A child's start, waited for outside the supervisor's turn, has come to its end."""

    __slots__ = ("child", "up")

    def __init__(self, child: Child, up: asyncio.Future[None]) -> None:
        self.child, self.up = child, up

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        return actor._start_over(item.child, item.up)
