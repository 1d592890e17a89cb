"""The places in which code of a simulated run runs: programs and processes. Of a dead one nothing runs any more."""

from __future__ import annotations

import asyncio
import inspect
import weakref
from collections.abc import Hashable
from contextvars import Context, ContextVar
from typing import TYPE_CHECKING, Any, Final

from ...actors.errors import AskFailed
from ...actors.kernel.cell import GONE
from ...actors.kernel.mailbox import admit_gone
from ...actors.kernel.node import Node
from ...actors.kernel.ref import ActorRef
from ..barrier import waiter_of
from ..guard.loop_methods import LoopMethods

if TYPE_CHECKING:
    from ...system.system import ActorSystem
    from ..guarded import GuardedSystem
    from .control import ControlledLoop
    from .processes import SimulatedWorkers

LOOP: Final = "the loop"
"""The lane of the test and of the root."""


class SimulatedPlace:
    """Where code of a simulated run runs: a program, or a process of one. Of a dead one nothing runs any more.

    Args:
        name: what charts call it, before the addresses of its actors; empty: nothing.

    Attributes:
        nodes: whose actors are there.
        tasks: that were created there.
        lane: what keeps its callbacks in order.
        is_dead: whether it was killed, or has ended.
    """

    def __init__(self, name: str = "") -> None:
        self.name = name
        self.nodes: list[Node] = []
        self.tasks: weakref.WeakSet[asyncio.Task[Any]] = weakref.WeakSet()
        self.lane: Hashable = self
        self.is_dead = False


class ProgramPlace(SimulatedPlace):
    """A program of the run.

    Attributes:
        systems: that it has had, the one that runs last.
        pools: of their processes.
    """

    def __init__(self, name: str = "") -> None:
        super().__init__(name)
        self.systems: list[ActorSystem] = []
        self.pools: list[SimulatedWorkers] = []

    def halt(self, loop: ControlledLoop) -> None:
        """Let nothing of it run any more, as of a SIGKILL, nor of its actors' processes."""
        for pool in self.pools:
            pool.end()
        for node in self.nodes:
            LoopMethods.of(type(loop)).actors_killed(loop, node)  # First: what is dropped is collected at once.
        loop.drop(self)

    def bury(self) -> None:
        """Tell whoever waits for one of its systems, which may only have begun, that it is dead. It was halted."""
        for system in self.systems:
            if (node := system._running) is not None:
                _bury(system, node)


class Root(ProgramPlace):
    """The program whose system the test has. The test lives there, too, and outlives it.

    Attributes:
        is_up: whether its system has been started.
    """

    def __init__(self, system: GuardedSystem) -> None:
        super().__init__()
        self.system, self.is_up = system, False
        self.systems.append(system)
        self.lane = LOOP


inside: ContextVar[SimulatedPlace | None] = ContextVar("holdfast simulated place", default=None)
"""The place whose code runs; None: the test's."""
NOWHERE: Final = Context()
"""The context of what belongs to no place: what is on its way between programs arrives whoever has died meanwhile."""


def place_of(node: Node) -> SimulatedPlace | None:
    """The place in which a node was made; None: the test's."""
    return node.base_context.get(inside)


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
    place = place_of(owner) if isinstance(owner, Node) else None
    return place is not None and place.is_dead


def never() -> None:
    """In place of the wake-up of a dead node."""


def no_more(runner: object) -> bool:
    """A dead node needs no runner again."""
    return False


def _bury(system: ActorSystem, node: Node) -> None:
    system._body = None
    node.threads.close()
    cells = [] if node.root is None else [node.root]
    for cell in cells:  # It grows meanwhile.
        cells += (cell.children or {}).values()
        cell.state, cell.admit = GONE, admit_gone
    for ask in node.deadlines.close():
        if ask.sender is None:
            ask.fail(AskFailed(ask.to.path, "the root was killed"))
            if isinstance(ask.future, asyncio.Future):
                ask.future.exception()  # A client that waits no more need not see it.
    for task in asyncio.all_tasks():
        waiter = waiter_of(task)
        if waiter is not None and not waiter.done() and _is_called_by(task, system, node):
            waiter.set_exception(AskFailed(f"/{node.name}", "the root was killed"))
    system._running = system._root = None  # It is not running.


def _is_called_by(task: asyncio.Task[Any], system: ActorSystem, node: Node) -> bool:
    """Whether a task waits within a call of a system or of a ref to one of its actors, such as `send`."""
    coro: Any = task.get_coro()
    while inspect.iscoroutine(coro):
        called = coro.cr_frame.f_locals.get("self") if coro.cr_frame is not None else None
        if called is system or (isinstance(called, ActorRef) and called._cell.node is node):
            return True
        coro = coro.cr_await
    return False
