"""A child as its supervisor sees it, and the items through which a supervisor talks to itself."""

from __future__ import annotations

import asyncio
import dataclasses
from collections import deque
from typing import Any

from ..actors.cell import Cell
from ..actors.exits import ExitReason
from ..actors.mail import Item
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


@dataclasses.dataclass(slots=True, eq=False)
class Row:
    """Children that are started one after another; what waits for a slow one is served meanwhile."""

    waiting: deque[Child]
    reason: ExitReason  # of the end for which they are started again


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
