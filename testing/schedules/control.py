"""A loop whose every step is chosen: which actor has the next turn, and which task or callback of the loop runs next.

What the loop promises is kept. Callbacks that are no steps of tasks are called in the order in which they were
scheduled, and before the steps of tasks that were scheduled after them: who awaits a future goes on after the callbacks
that were added to it before. A task's steps are in order among themselves; a timer comes when it is due. All else may
come in any order: which task goes on first, which of two timers at one moment fires first, how many turns there are
between two callbacks.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import itertools
import threading
from collections import deque
from collections.abc import Callable, Hashable, Iterable
from contextvars import Context
from typing import TYPE_CHECKING, Any, Final, TypeVar, TypeVarTuple

from ...actors.kernel import loop as run_loop
from ...actors.kernel.cell import NEXT_URGENT, Cell
from ...actors.kernel.envelope import Ask
from ...actors.kernel.message import Message, message_of
from ...actors.kernel.node import Node
from ...checkpoint.life.recorded_inbox import Fed
from ..clock import VirtualClockLoop
from ..swaps import Swaps
from .disk import simulated
from .due import Due, Option
from .numbered import NumberedFuture, NumberedTask
from .places import Place, inside, is_dead, never, no_more
from .strategies import ALL, Explored, Footprint

if TYPE_CHECKING:
    from .choices import Choices

T = TypeVar("T")
Ts = TypeVarTuple("Ts")
TICKS: Final = 30_000
"""Ticks of the loop at one moment of virtual time: as many as it makes in some seconds."""
MOST_TURNS: Final = 64
"""Turns after which the loop has a look at files and threads, if no callback of its own wants to run."""
MOST: Final = run_loop.MOST
LONGEST: Final = 1024
"""Turns after which a callback has to be called, whatever the schedule says."""


class DrawnCells(deque[Cell]):
    """The run queue. The next actor to have a turn is chosen."""

    def __init__(self, cells: Iterable[Cell], control: Control) -> None:
        super().__init__(cells)
        self._control = control

    def popleft(self) -> Cell:
        control = self._control
        cell = control.next_cell
        if cell is not None:
            control.next_cell = None
            self.remove(cell)
        elif len(self) == 1:
            cell = super().popleft()
        else:
            cell = control.at(self, control.choices.turn(len(self), self._keys))
            self.remove(cell)
        control.takes_turn(cell, self)
        return cell

    def _keys(self) -> list[Hashable]:
        return list(self._control.in_order(self))


class ControlledLoop(VirtualClockLoop):
    """A loop with a virtual clock whose steps are chosen as soon as a `Control` is installed.

    What a thread sends (`call_soon_threadsafe`) comes when nothing else can happen at that moment of virtual time, and
    results of `run_in_executor` then come in the order in which the work was given: not when the machine lets the
    thread run.
    """

    def __init__(self) -> None:
        super().__init__(ticks=TICKS)
        self.due = Due()
        self._ready: Any = self.due
        self.control: Control | None = None
        self._own_thread = threading.get_ident()
        self._numbers = itertools.count()  # of its tasks and futures
        self._sent: deque[asyncio.Handle] = deque()  # by threads
        self._resting: list[asyncio.Future[None]] = []
        self._dead: list[Any] = []  # tasks: kept, since what is collected is closed, which runs its code
        self.sync_seconds: Callable[[], float] = float  # that a sync of a simulated store takes: none

    async def rest(self) -> None:
        """Wait until nothing else can happen at this moment: one tick more is not enough where others come first."""
        if self.control is None:
            await super().rest()
            return
        rest: asyncio.Future[None] = self.create_future()
        self.rests(rest)
        await rest

    def rests(self, rest: asyncio.Future[None]) -> None:
        """Have a future done when nothing else can happen at this moment, if it is not done before."""
        self._resting.append(rest)

    def hears_at_once(self) -> bool:
        return self.control is None

    def held_back(self) -> int:
        sent: Any = self._sent
        return sum(_given(handle._args) >= 0 for handle in sent)

    def at_rest(self) -> bool:
        sent: Any = self._sent
        self._sent = deque()
        for handle in sorted(sent, key=lambda handle: _given(handle._args)):
            self.due.append(handle)
        if sent:
            return True
        resting, self._resting = self._resting, []
        for rest in resting:
            if not rest.done():
                rest.set_result(None)
        return bool(resting)

    def call_soon(
        self, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.Handle:
        """As every loop, in half of the time."""
        if self._debug or self._closed:
            return super().call_soon(callback, *args, context=context)
        handle = asyncio.Handle(callback, args, self, context)
        self.due.append(handle)
        return handle

    def call_soon_threadsafe(
        self, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.Handle:
        """As every loop from its own thread; another thread's callback waits until nothing else can happen.

        So does the result of work that a thread has done before the loop could ask to be told of it.
        """
        is_own = threading.get_ident() == self._own_thread and _given(args) < 0
        if is_own or self.control is None:
            return super().call_soon_threadsafe(callback, *args, context=context)
        handle = asyncio.Handle(callback, args, self, context)
        self._sent.append(handle)
        self._wake_up()
        return handle

    def _wake_up(self) -> None:
        wake: Callable[[], None] = getattr(self, "_write_to_self")  # noqa: B009  # asyncio's own, which no stub has
        wake()

    def create_future(self) -> asyncio.Future[Any]:
        """As every loop; the hash of the future is its number."""
        future: NumberedFuture[Any] = NumberedFuture(loop=self)
        future.number = next(self._numbers)
        return future

    def create_task(self, coro: Any, **options: Any) -> asyncio.Task[Any]:
        """As every loop; the hash of the task is its number."""
        task: asyncio.Task[Any]
        if self.get_task_factory() is None:
            if self.is_closed():
                raise RuntimeError("Event loop is closed")
            task = NumberedTask(next(self._numbers), coro, loop=self, **options)
        else:
            task = super().create_task(coro, **options)
        context: Context | None = options.get("context")
        place = inside.get() if context is None else context.get(inside)
        if place is not None:
            place.tasks.add(task)
        return task

    def run_in_executor(self, executor: Any, func: Callable[[*Ts], T], *args: *Ts) -> asyncio.Future[T]:
        """Run in a thread; but work for a simulated store is done here, when its drawn seconds are over."""
        work = simulated(func, args)
        if work is None:
            return super().run_in_executor(executor, func, *args)
        done: asyncio.Future[T] = self.create_future()
        self.call_later(self.sync_seconds(), _do, done, work)
        return done

    def add(self, place: Place) -> None:
        """A place begins to run in this loop."""
        if self.control is not None:
            self.control.add(place.node)

    def drop(self, place: Place) -> None:
        """Nothing of this place runs any more."""
        place.is_dead = self.due.has_dead = True
        timers: Any = self._scheduled
        for handle in [*self.due, *timers, *self._sent]:
            if is_dead(handle):
                handle.cancel()
        node = place.node
        tasks: list[Any] = [*place.tasks, *(runner.task for runner in node._runners)]
        for task in tasks:
            asyncio._unregister_task(task)  # Nobody waits for it, and it cleans nothing up.
            task._log_destroy_pending = False
        self._dead += tasks
        node.wake = never  # type: ignore[method-assign]
        node.idle_again = no_more  # type: ignore[method-assign]
        if self.control is not None:
            self.control.drop(node)

    def close(self) -> None:
        """As every loop. What was left of killed processes is collected now: Python runs the `finally` of each then."""
        dead, self._dead = self._dead, []
        for task in dead:
            try:
                task.get_coro().close()
            except BaseException:  # Whatever it raises, nobody is there to hear of it.
                pass
        super().close()

    def scheduled_timers(self) -> int:
        """How many timers there are."""
        return len(self._scheduled)


def _given(args: Any) -> int:
    """When the work was given whose result a callback with these arguments brings from a thread; -1: it brings none."""
    match args:
        case (NumberedFuture(number=number), concurrent.futures.Future()):
            return number
        case _:
            return -1


def _do(done: asyncio.Future[T], work: Callable[[], T]) -> None:
    if done.cancelled():
        return
    try:
        done.set_result(work())
    except Exception as error:
        done.set_exception(error)


class Control:
    """Has the choices of one run carried out, and notes the turns.

    Attributes:
        trace: (address, what was handled) of each turn, in the order in which they began.
    """

    def __init__(self, choices: Choices, trace: list[tuple[str, str]]) -> None:
        self.choices, self.trace = choices, trace
        self.next_cell: Cell | None = None
        self._next: Option | None = None
        self._now = 0.0
        self._has_stepped = False
        self._turns = 0  # since a callback was called
        self._last: Cell | None = None
        self._in_a_row = 0  # turns of that one
        self._names: dict[type, str] = {}
        self._swaps = Swaps()
        self._node: Node | None = None
        self._nodes: dict[object, DrawnCells] = {}
        self._draining: deque[Cell] = deque()
        self.on_node: Callable[[Node], None] = lambda node: None
        self._due = Due()
        self._moments: list[tuple[int, asyncio.Future[None]]] = []  # after so many turns of the run
        self._before: dict[Cell, tuple[Any, ...]] = {}
        self._touched: set[Hashable] = set()

    def install(self, node: Node, loop: ControlledLoop) -> None:
        """From here on every step is chosen."""
        self._node, self._due, self._loop = node, loop.due, loop
        if isinstance(self.choices, Explored):
            self.choices.control = self
        self._swaps.put(run_loop, "clock", self._clock)
        for name in ("MOST", "STRIDE"):
            self._swaps.put(run_loop, name, 1)
        self.add(node)
        loop.control = loop.due.chooser = self

    def add(self, node: Node) -> None:
        """The turns of this node are chosen, too: the root's, or that of a process."""
        cells = self._nodes[node] = DrawnCells(node.ready, self)
        self._swaps.put(node, "ready", cells)
        for name in ("most", "stride"):
            self._swaps.put(node, name, 1)  # One turn, and a look at the clock, which is where the next step is chosen.
        self.on_node(node)

    def drop(self, node: Node) -> None:
        """Nothing of this node has a turn any more."""
        cells = self._nodes.get(node)
        if cells is not None:
            cells.clear()
        if self.next_cell is not None and self.next_cell.node is node:
            self.next_cell = None

    def moment(self, turns: int) -> asyncio.Future[None]:
        """A future that is done after so many turns, or when nothing else can happen."""
        moment: asyncio.Future[None] = self._loop.create_future()
        self._moments.append((len(self.trace) + turns, moment))
        self._loop.rests(moment)
        return moment

    def remove(self) -> None:
        """Let the rest of the run be as in production."""
        if self._node is not None:
            self._loop.control = self._due.chooser = None
        self._swaps.undo()
        for node, cells in self._nodes.items():
            ready: deque[Cell] = node.ready  # type: ignore[attr-defined]
            if ready is not cells:
                ready.clear()
                ready.extend(cells)

    def goes_on(self, ready: deque[Cell]) -> bool:
        """Whether the actor that had the last turn has another one first, as in production."""
        return ready[-1] is self._last and self._in_a_row < MOST

    def at(self, ready: deque[Cell], index: int) -> Cell:
        """The one at this place in the order of production."""
        return ready[index - self.goes_on(ready)]  # The last one is the first.

    def in_order(self, ready: deque[Cell]) -> list[Cell]:
        """Who is ready, in the order in which production would let them run."""
        return [ready[-1], *itertools.islice(ready, len(ready) - 1)] if self.goes_on(ready) else [*ready]

    # -- steps --------------------------------------------------------------------------------------------------------

    def takes_turn(self, cell: Cell, ready: DrawnCells) -> None:
        """The cell has the next turn; `ready` are those of the same node."""
        self._has_stepped, self._draining = True, ready
        if self._moments:
            self._tell_moments()
        self._turns += 1
        self._in_a_row = self._in_a_row + 1 if cell is self._last else 1
        self._last = cell
        queue = cell.queue
        if queue:
            item = queue[0]
            message: Any = item.message if type(item) is Ask else item
            name = self._names.get(type(message))
            if name is None:
                name = told(cell, item)
                if isinstance(message, Message):
                    self._names[type(message)] = name
            self.trace.append((cell.path, name))
        if self._before:
            self._touched.add(cell.path)

    def _tell_moments(self) -> None:
        for number, moment in self._moments:
            if number <= len(self.trace) and not moment.done():
                moment.set_result(None)
        self._moments = [one for one in self._moments if not one[1].done()]

    def _clock(self) -> float:
        """The run loop's measure of its slices: asked before the first turn and after each."""
        if not self._has_stepped:
            return self._now
        self._has_stepped = False
        ready = self._draining
        if not ready:
            return self._now
        if not self._due.options:
            if self._turns % MOST_TURNS == 0:
                self._now += 1.0
            return self._now
        others = self._due.next_options()
        count = len(ready)
        total = count + len(others)
        if self._turns >= LONGEST:
            chosen = count
        elif total == 1:
            chosen = 0
        else:
            chosen = self.choices.turn(total, lambda: [*self.in_order(ready), *(option[0] for option in others)])
        if chosen < count:
            self.next_cell = self.at(ready, chosen)
        else:
            self._next = others[chosen - count]
            self._now += 1.0  # The slice is over.
        return self._now

    def choose_callback(self, due: Due) -> Option:
        """The callback that is called next; if it is that of a node, a cell of it is chosen, too."""
        chosen, self._next = self._next, None
        if chosen is None or chosen not in due.options:
            chosen = self._chosen(due)
        if self.next_cell is None:
            self._turns = 0
            if self._before:
                self._touched |= ALL
        return chosen

    def _chosen(self, due: Due) -> Option:
        options = due.next_options()
        if not options:  # All are cancelled.
            return due.options[0]
        count, nodes = len(options), self._nodes
        drained: list[tuple[int, DrawnCells]] = []  # where the callback of a node stands, and who is ready there
        for place, option in enumerate(options):
            if type(key := option[0]) is Node and (cells := nodes.get(key)):
                drained.append((place, cells))
                count += len(cells) - 1
        index = 0 if count == 1 else self.choices.turn(count, lambda: self._keys(options))
        for place, cells in drained:
            if index < place:
                break
            if index < place + len(cells):
                self.next_cell = self.at(cells, index - place)
                return options[place]
            index -= len(cells) - 1
        return options[index]

    def _keys(self, options: list[Option]) -> list[Hashable]:
        keys: list[Hashable] = []
        for key, _, _ in options:
            cells = self._nodes.get(key)
            keys += self.in_order(cells) if cells else [key]
        return keys

    # -- what a step touches ------------------------------------------------------------------------------------------

    def begin_footprint(self) -> None:
        """A step begins: note how everything is."""
        self._before = self._state()
        self._touched = set()
        self._begun = self._outside()

    def footprint(self) -> Footprint:
        """The actors that the steps since then have touched; ALL if anything else may have changed."""
        if self._outside() != self._begun or "all" in self._touched:
            return ALL
        after = self._state()
        if after.keys() != self._before.keys():
            return ALL
        changed = {cell.path for cell, state in after.items() if state != self._before[cell]}
        return frozenset(self._touched | changed)

    def _outside(self) -> tuple[int, int]:
        return len(self._due), self._loop.scheduled_timers()

    def _state(self) -> dict[Cell, tuple[Any, ...]]:
        assert self._node is not None
        found: dict[Cell, tuple[Any, ...]] = {}
        cells = [self._node.root] if self._node.root is not None else []
        for cell in cells:  # It grows meanwhile.
            more = cell.more
            urgent = len(more.urgent or ()) if more is not None else 0
            queue = cell.queue
            found[cell] = (len(queue) if queue is not None else -1, cell.state, cell.life, urgent)
            cells += (cell.children or {}).values()
        return found


def told(cell: Cell, item: Any) -> str:
    """What a turn handles, in a word or two."""
    if item is NEXT_URGENT:
        commands = cell.more.urgent if cell.more is not None else None
        item = commands[0] if commands else item
    elif isinstance(item, Fed):
        feed = item.feed
        return feed.name.rpartition(":")[2] or feed.kind
    message = message_of(item)
    return type(item if message is None else message).__name__
