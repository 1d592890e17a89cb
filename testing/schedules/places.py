"""The places in which code of a simulated run runs: the root, and each process. Of a dead one nothing runs any more."""

from __future__ import annotations

import asyncio
import weakref
from collections.abc import Hashable
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, Final

from ...actors.kernel.node import Node

if TYPE_CHECKING:
    from ..guarded import GuardedSystem

LOOP: Final = "the loop"
"""The lane of the test and of the root."""


class SimulatedPlace:
    """Where code of a simulated run runs: the root, or a process. Of a dead one nothing runs any more.

    Attributes:
        node: whose actors are there, once it has begun.
        tasks: that were created there.
        lane: what keeps its callbacks in order.
        is_dead: whether it was killed, or has ended.
    """

    node: Node

    def __init__(self) -> None:
        self.tasks: weakref.WeakSet[asyncio.Task[Any]] = weakref.WeakSet()
        self.lane: Hashable = self
        self.is_dead = False


class Root(SimulatedPlace):
    """The process in which a system of the run lives. The test lives there, too, and outlives it.

    Attributes:
        is_up: whether its system has been started.
    """

    def __init__(self, system: GuardedSystem) -> None:
        super().__init__()
        self.system, self.is_up = system, False
        self.lane = LOOP


inside: ContextVar[SimulatedPlace | None] = ContextVar("holdfast simulated place", default=None)
"""The place whose code runs; None: the test's."""


def lane_of(handle: Any) -> Hashable:
    """What keeps a callback in order: the loop of the process in which it runs."""
    place = handle._context.get(inside)
    return LOOP if place is None else place.lane


def is_dead(handle: Any) -> bool:
    """Whether a callback belongs to a place that is dead."""
    if handle._cancelled:
        return False
    place = handle._context.get(inside)
    if place is not None:
        return bool(place.is_dead)
    owner = getattr(handle._callback, "__self__", None)  # Who is called for, by the test, may be dead as well.
    return isinstance(owner, Node) and owner.wake is never


def never() -> None:
    """In place of the wake-up of a dead node."""


def no_more(runner: object) -> bool:
    """A dead node needs no runner again."""
    return False
