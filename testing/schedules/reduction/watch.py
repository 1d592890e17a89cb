"""Watches a run step by step: whose step it is, what it touches, and without which steps it could not have come."""

from __future__ import annotations

import asyncio
import functools
import inspect
import random
import sys
import types
from collections import defaultdict, deque
from collections.abc import Callable, Generator, Hashable
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from ....actors.kernel.actor import Start
from ....actors.kernel.cell import NEXT_URGENT, Cell
from ....actors.kernel.context import ActorContext
from ....actors.kernel.lifecycle import build
from ....actors.kernel.loop import RunnerTask
from ....actors.kernel.node import Node
from ....actors.kernel.ref import current
from ....actors.kernel.timers import LoopTimer
from ...library_code import is_file_of_library
from ..places import LOOP, Root, inside, lane_of
from .footprints import EVERYTHING, LIBRARY, PROGRAM, Footprint
from .pauses import Pause, pause_of
from .sharing import shares_memory
from .telling import TellingFuture, TellingTask

if TYPE_CHECKING:
    from ..due import Option
    from .stepped import Stepped

ASYNCIO = asyncio.__file__.rpartition("/")[0]
ORDERS = 0
"""In place of the id of a message: commands come in order."""
ACTOR: Any = vars(Cell.__base__)["actor"]
GATHERED = "gather.<locals>._done_callback"
WAKE_UPS = ("_set_result_unless_cancelled", "_release_waiter")
"""Timers of asyncio that end a wait, and do nothing else."""


class StepWatch:
    """Tells a search of each step of a run.

    Args:
        stepped: is told.
        node: of the root: what its actors do is known. A step in another place is taken to touch everything.
    """

    def __init__(self, stepped: Stepped, node: Node) -> None:
        self._stepped, self._node = stepped, node
        self._reads: set[Hashable] = set()
        self._writes: set[Hashable] = set()
        self._is_silent = False
        self._cells: dict[Cell, tuple[Any, ...]] = {}
        self._random: object = None
        self._made: dict[int, int] = {}  # by the id of a callback: in which step it was scheduled
        self._sent: dict[Cell, dict[int, deque[int]]] = defaultdict(lambda: defaultdict(deque))
        self._set: dict[Hashable, int] = {}  # by future: in which step it has got its outcome
        self._is_program = True  # whether code of the test runs in this step
        self._sharing: set[Cell] = set()  # actors whose memory is that of the test, too
        self._held: set[Hashable] = set()  # the actors that the test has got hold of, and may look into
        self._pause: Pause | None = None  # where the task of this step has waited before it
        self._task: asyncio.Task[Any] | None = None
        self._names: dict[int, tuple[object, Hashable]] = {}
        self._lanes: dict[Hashable, deque[int]] = defaultdict(deque)  # the numbers of the callbacks that wait there
        self._placed = 0
        self._number = -1
        node.cell_kinds.put_in(self, self._methods())
        self._add, node.deadlines.add = node.deadlines.add, self._add_deadline  # type: ignore[method-assign]
        self._cells = self._state()

    # -- what is touched ----------------------------------------------------------------------------------------------

    def read(self, token: Hashable) -> None:
        """Something was looked at in the present step."""
        if not self._is_silent:
            self._reads.add(token)

    def write(self, token: Hashable) -> None:
        """Note that the present step has changed something."""
        if not self._is_silent:
            self._writes.add(token)
            self._set[token] = self._number

    @contextmanager
    def _silence(self) -> Generator[None]:
        """What is looked at here changes nothing that anybody could see."""
        was, self._is_silent = self._is_silent, True
        try:
            yield
        finally:
            self._is_silent = was

    def _add_deadline(self, ask: Any) -> None:
        with self._silence():
            self._add(ask)

    def _methods(self) -> dict[str, Callable[..., Any]]:
        """What the cells of the node do first."""

        def take_in(cell: Cell, _: Cell, item: Any) -> None:
            self._send(cell, item)
            cell.admit(cell, item)

        def push(cell: Cell, item: Any) -> None:
            self._send(cell, item)
            Cell.push(cell, item)

        def urge(cell: Cell, item: Any) -> None:
            self._order(cell)
            self._sent[cell][ORDERS].append(self._number)
            Cell.urge(cell, item)

        def kill(cell: Cell, **options: Any) -> None:
            self._order(cell)
            Cell.kill(cell, **options)

        def request_stop(cell: Cell, *args: Any) -> None:
            self._order(cell)
            Cell.request_stop(cell, *args)

        def actor(cell: Cell) -> Any:
            if self._is_program and not is_file_of_library(sys._getframe(1).f_code.co_filename):
                self._held.add(("actor", cell.path))
            return ACTOR.__get__(cell)

        looked_at: Any = property(actor, ACTOR.__set__)
        return {
            "actor": looked_at,
            "take_in": take_in,
            "push": push,
            "urge": urge,
            "kill": kill,
            "request_stop": request_stop,
        }

    def build(self, cell: Cell, start: Start[Any], context: Callable[[Cell], ActorContext]) -> None:
        """In place of the function that makes an actor."""
        if shares_memory(start):
            self._sharing.add(cell)
        build(cell, start, context)

    def _send(self, cell: Cell, item: Any) -> None:
        self.write(("mailbox", cell.path))
        self._sent[cell][id(item)].append(self._number)

    def _order(self, cell: Cell) -> None:
        self.write(("mailbox", cell.path))
        self.write(("actor", cell.path))

    # -- steps --------------------------------------------------------------------------------------------------------

    def footprint(self) -> Footprint:
        """What the present step has touched so far."""
        reads, writes = set(self._reads), set(self._writes)
        if self._is_program and not self._is_pause():
            writes |= {PROGRAM, *self._held}
        state = self._state()
        for cell in state.keys() | self._cells.keys():
            if state.get(cell) != self._cells.get(cell):
                writes |= {("actor", cell.path), ("mailbox", cell.path)}
        if self._random is not None and random.getstate() != self._random:
            writes.add("random")
        if reads or writes:
            reads.add(EVERYTHING)
        return Footprint(frozenset(reads), frozenset(writes))

    def turn(self, cell: Cell) -> None:
        """An actor has the next step."""
        self._begin(self.name(cell), self._sender(cell))
        self._writes.add(("actor", cell.path))
        if cell in self._sharing:
            self._writes.add(PROGRAM)
        more = cell.more
        if cell.node is not self._node or (more is not None and more.outlet is not None):
            self._writes.add(LIBRARY)
        if more is not None and more.bound is not None:
            self._writes.add(("mailbox", cell.path))

    def callback(self, option: Option) -> None:
        """Begin the step of a callback that is called now."""
        key, handle, has_place = option
        context: Any = handle._context  # type: ignore[attr-defined]  # no stub has it
        made = self._made.pop(id(handle), -1)
        owner: Any = key
        self._begin(self.name(key), {made} if made >= 0 else set())
        if has_place:
            lane = lane_of(handle)
            self._lanes[lane].popleft()
            self._stepped.keep_place(lane, made)
        place = context.get(inside)
        if place is not None and type(place) is not Root:
            self._writes.add(EVERYTHING)
        elif isinstance(owner, asyncio.Task):
            self._step_of(owner, context)
        elif type(owner) is not Node:
            self._call(handle)

    def _step_of(self, task: asyncio.Task[Any], context: Any) -> None:
        if isinstance(task, RunnerTask):
            runner = task._runner
            turn = runner._turn
            if turn is None:
                return
            self._writes.add(("actor", turn.cell.path))
            if runner._context is None:  # It takes over the wait of the turn, whatever has become of that.
                waiting = turn.waiting
                if isinstance(waiting, TellingFuture) and waiting.token in self._set:
                    self._stepped.need(self._set[waiting.token])
                self._is_silent = True
            elif turn.cell in self._sharing:
                self._writes.add(PROGRAM)
            return
        if isinstance(task, TellingTask):
            self._writes.add(task.token)
        self._task, self._pause = task, pause_of(task)
        self._code_of(context, _files(task.get_coro()))

    def _call(self, handle: Any) -> None:
        callback = handle._callback
        if isinstance(callback, types.MethodType) and isinstance(callback.__self__, LoopTimer):
            self._writes.add(("actor", callback.__self__._cell.path))
            return
        function = _function_of(callback)
        if _is_gathered(function) and _has_succeeded(*handle._args):
            return  # In which order they come is the same to whoever has gathered them.
        if type(handle) is asyncio.TimerHandle and function is not None and function.__name__ in WAKE_UPS:
            return
        self._code_of(handle._context, [] if function is None else [function.__code__.co_filename])

    def _code_of(self, context: Any, files: list[str]) -> None:
        """The memory that the code of a step has."""
        actor = context.get(current)
        own = [file for file in files if not file.startswith((ASYNCIO, "<"))]
        if actor is not None:
            self._writes.add(("actor", actor._cell.path))
            if actor._cell in self._sharing:
                self._writes.add(PROGRAM)
        elif own and all(map(is_file_of_library, own)):
            self._writes.add(LIBRARY)
        else:
            self._is_program = True

    def _begin(self, owner: Hashable, enabled_by: set[int]) -> None:
        self._stepped.begin(owner, self.footprint, enabled_by)
        self._number = self._stepped.number
        self._reads, self._writes, self._is_silent = set(), set(), False
        self._cells, self._task, self._pause, self._is_program = self._state(), None, None, False
        self._random = random.getstate()

    def _is_pause(self) -> bool:
        """Whether the step has been one more round of a loop that waits, and sees nothing but its own variables."""
        return self._pause is not None and self._task is not None and self._pause == pause_of(self._task)

    def _sender(self, cell: Cell) -> set[int]:
        """In which step was sent what the actor handles now."""
        item = cell.queue[0] if cell.queue else None
        sent = self._sent.get(cell)
        if sent is None or item is None:
            return set()
        if item is NEXT_URGENT:  # Without the order the actor could have had a turn all the same, if it was ready.
            orders = sent[ORDERS]
            step = orders.popleft() if orders else -1
            return set() if step < 0 or self._stepped.was_ready(step, self.name(cell)) else {step}
        steps = sent.get(id(item))
        return {step for step in (steps.popleft(),) if step >= 0} if steps else set()

    # -- the loop -----------------------------------------------------------------------------------------------------

    def made(self, key: Hashable, handle: asyncio.Handle, has_place: bool) -> None:
        """Note by which step a callback was scheduled."""
        if type(handle) is not asyncio.TimerHandle:
            self._made[id(handle)] = self._number
        lane = self._lanes[lane_of(handle)]
        if has_place:
            self._placed += 1
            lane.append(self._placed)
            self.write(("place", self._placed))
        elif isinstance(key, asyncio.Task):
            for place in lane:  # It comes behind those.
                self.read(("place", place))

    def set_timer(self, handle: asyncio.TimerHandle) -> None:
        """Note by which step a timer was set."""
        self._made[id(handle)] = self._number

    def time_passes(self) -> None:
        """Nothing else could happen at this moment."""
        self._stepped.end_moment()

    def name(self, key: Hashable) -> Hashable:
        """The same for the same actor, task or timer in each run: paths, or the order in which they came."""
        owner: Any = key
        if isinstance(owner, Cell):
            return owner.path
        if isinstance(owner, RunnerTask) and owner._runner._turn is not None:
            return ("turn", owner._runner._turn.cell.path)
        if isinstance(owner, (asyncio.Task, asyncio.TimerHandle)):
            return self._names.setdefault(id(owner), (owner, ("came", len(self._names))))[1]
        if owner is LOOP or isinstance(owner, str):
            return str(owner)
        if isinstance(owner, Node):
            return ("node", owner.name)
        if isinstance(owner, tuple):
            return ("fence", *map(self.name, owner))
        return self._names.setdefault(id(owner), (owner, ("came", len(self._names))))[1]

    def _state(self) -> dict[Cell, tuple[Any, ...]]:
        found: dict[Cell, tuple[Any, ...]] = {}
        cells = [self._node.root] if self._node.root is not None else []
        for cell in cells:  # It grows meanwhile.
            found[cell] = (cell.state, cell.life)
            cells += (cell.children or {}).values()
        return found


def _function_of(callback: Any) -> types.FunctionType | None:
    """The function in Python that a callback is made of; None: it is another thing."""
    while isinstance(callback, functools.partial):
        callback = callback.func
    if isinstance(callback, types.MethodType):
        callback = callback.__func__
    return callback if isinstance(callback, types.FunctionType) else None


def _is_gathered(function: types.FunctionType | None) -> bool:
    return function is not None and function.__qualname__ == GATHERED


def _has_succeeded(future: Any) -> bool:
    return not asyncio.Future.cancelled(future) and asyncio.Future.exception(future) is None


def _files(coro: Any) -> list[str]:
    """The files of what a coroutine runs in, from the outermost on."""
    found: list[str] = []
    while coro is not None:
        if inspect.iscoroutine(coro):
            found.append(coro.cr_code.co_filename)
            coro = coro.cr_await
        elif inspect.isgenerator(coro):
            found.append(coro.gi_code.co_filename)
            coro = coro.gi_yieldfrom
        elif inspect.isasyncgen(coro):
            found.append(coro.ag_code.co_filename)
            coro = coro.ag_await
        else:
            break
    return found
