"""An event loop whose every step is chosen: the next actor's turn, and the next task or callback.

What the loop promises is kept. Callbacks that are no steps of tasks are called in the order in which they were
scheduled, and before the steps of tasks that were scheduled after them: who awaits a future goes on after the callbacks
that were added to it before. A task's steps are in order among themselves; a timer comes when it is due. All else may
come in any order: which task goes on first, which of two timers at one moment fires first, how many turns there are
between two callbacks.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import inspect
import itertools
import threading
import types
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable
from contextvars import Context
from typing import TYPE_CHECKING, Any, Final, TypeVar, TypeVarTuple

from ...actors.kernel import lifecycle
from ...actors.kernel import loop as run_loop
from ...actors.kernel.cell import Cell
from ...actors.kernel.node import Node
from ..clock import TICKS, VirtualClockLoop
from ..latencies import Latencies, LateReplies, What
from ..swaps import Swaps
from .choices import Choices
from .disk import simulated
from .due import DueQueue, Option, TellingHandle
from .livelock import Rounds
from .numbered import NumberedFuture, NumberedTask
from .places import SimulatedPlace, inside, is_dead, never, no_more, place_of
from .reduction.stepped import Stepped
from .reduction.telling import TellingFuture, TellingTask
from .reduction.watch import StepWatch
from .world import EPOCH

if TYPE_CHECKING:
    from .choices import Keys
    from .turn_log import TurnLog

T = TypeVar("T")
Ts = TypeVarTuple("Ts")
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
            cell = control.at(self, control.choose(len(self), self._keys))
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

    def __init__(self, *, ticks: int = TICKS) -> None:
        self.control: Control | None = None
        super().__init__(epoch=EPOCH, ticks=ticks)
        self.due = DueQueue()
        self._ready: Any = self.due
        self._own_thread = threading.get_ident()
        self._numbers = itertools.count()  # of its tasks and futures
        self._sent: deque[asyncio.Handle] = deque()  # by threads
        self._work: dict[asyncio.Future[Any], int] = {}  # of anyio's threads, by when it was given
        self._resting: list[asyncio.Future[None]] = []
        self._is_ending = False
        self._dead: list[Any] = []  # tasks: kept, since what is collected is closed, which runs its code
        self.latencies = Latencies(Choices(0), {})  # none
        self.late_replies: LateReplies | None = None

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

    def forget_ticks(self) -> None:
        super().forget_ticks()
        if self.control is not None:
            self.control.begin_moment()

    def has_too_many_ticks(self, ticks: int) -> bool:
        """As every virtual loop; when steps are chosen, a tick is a round of all that waited when it began."""
        return super().has_too_many_ticks(ticks) if self.control is None else self.control.goes_on_for_ever(ticks)

    def hears_at_once(self) -> bool:
        return self.control is None

    def held_back(self) -> int:
        sent: Any = self._sent
        return sum(_given(handle._args) >= 0 for handle in sent)

    def number_work(self, future: asyncio.Future[Any]) -> None:
        """A thread of anyio is given work, the result of which this future is for."""
        self._work[future] = next(self._numbers)

    def _given(self, args: Any) -> int:
        """When the work was given whose result a callback with these arguments brings; -1: it brings none."""
        match args:
            case (asyncio.Future() as future, _, _) if future in self._work:
                return self._work.pop(future)
            case _:
                return _given(args)

    def at_rest(self) -> bool:
        sent: Any = self._sent
        self._sent = deque()
        for handle in sorted(sent, key=lambda handle: self._given(handle._args)):
            self.due.append(handle)
        if sent:
            return True
        resting, self._resting = self._resting, []
        if resting and self.control is not None and self.control.watch is not None:
            self.control.watch.time_passes()
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
        handle = TellingHandle(callback, args, self, context)
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

    def call_at(
        self, when: float, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """As every loop; the watch of the steps, if there is one, notes the timer."""
        handle = super().call_at(when, callback, *args, context=context)
        if self.due.watch is not None:
            self.due.watch.set_timer(handle)
        return handle

    def _wake_up(self) -> None:
        wake: Callable[[], None] = getattr(self, "_write_to_self")  # noqa: B009  # asyncio's own, which no stub has
        wake()

    def create_future(self) -> asyncio.Future[Any]:
        """As every loop; the hash of the future is its number."""
        watch = self.due.watch
        if watch is None:
            future: NumberedFuture[Any] = NumberedFuture(loop=self)
        else:
            future = TellingFuture(loop=self)
            future.listener = watch
        future.number = next(self._numbers)
        return future

    def create_task(self, coro: Any, **options: Any) -> asyncio.Task[Any]:
        """As every loop; the hash of the task is its number."""
        task: asyncio.Task[Any]
        if self._is_ending:  # By the `finally` of what was killed: nobody runs it.
            _close(coro)
            raise RuntimeError("Event loop is closed")
        if self.get_task_factory() is None:
            if self.is_closed():
                raise RuntimeError("Event loop is closed")
            number, watch = next(self._numbers), self.due.watch
            if watch is None:
                task = NumberedTask(number, coro, loop=self, **options)
            else:
                task = TellingTask(watch, number, coro, loop=self, **options)
        else:
            task = super().create_task(coro, **options)
        context: Context | None = options.get("context")
        place = inside.get() if context is None else context.get(inside)
        if place is not None:
            place.tasks.add(task)
            if place.is_dead:  # In the step in which it has died.
                self._bury(task)
        return task

    def run_in_executor(self, executor: Any, func: Callable[[*Ts], T], *args: *Ts) -> asyncio.Future[T]:
        """Run in a thread; but work for a simulated store is done here, when its drawn seconds are over."""
        work = simulated(func, args)
        if work is None:
            return super().run_in_executor(executor, func, *args)
        done: asyncio.Future[T] = self.create_future()
        self.call_later(self.latencies.of(work.takes)(), _do, done, work)
        return done

    def hold_up(self, what: What) -> None:
        """Something is done in the loop that takes time, in which nothing else is done here."""
        seconds = self.latencies.of(what)()
        if seconds:
            self.pass_time(seconds)

    def lateness(self) -> float:
        return self.latencies.of("timers")() if self.control is not None else 0.0

    def on_their_way(self) -> list[float]:
        """When each late reply arrives."""
        return [] if self.late_replies is None else self.late_replies.times()

    def drop(self, place: SimulatedPlace) -> None:
        """Nothing of this place runs any more."""
        place.is_dead = self.due.has_dead = True
        timers: Any = self._scheduled
        for handle in [*self.due, *timers, *self._sent]:
            if is_dead(handle):
                _close_unbegun(handle)
                handle.cancel()
        tasks: list[Any] = [*place.tasks]
        for node in place.nodes:
            tasks += (runner.task for runner in node._runners)
            node.wake = never  # type: ignore[method-assign]
            node.idle_again = no_more  # type: ignore[method-assign]
            if self.control is not None:
                self.control.drop(node)
        for task in tasks:
            self._bury(task)

    def _bury(self, task: Any) -> None:
        """Nobody waits for a task, and it cleans nothing up."""
        asyncio._unregister_task(task)
        task._log_destroy_pending = False
        self._dead.append(task)

    def close(self) -> None:
        """As every loop. What was left of killed processes is collected now: Python runs the `finally` of each then."""
        self._is_ending = True
        dead, self._dead = self._dead, []
        for task in dead:
            _close(task.get_coro())
        super().close()


def _close(coroutine: Any) -> None:
    """Close a coroutine; of one that has not begun, those too that it was given, which nobody awaits any more."""
    given: list[Any] = []
    if inspect.iscoroutine(coroutine) and inspect.getcoroutinestate(coroutine) == inspect.CORO_CREATED:
        given = [one for one in inspect.getcoroutinelocals(coroutine).values() if inspect.iscoroutine(one)]
    try:
        coroutine.close()
    except BaseException:  # Whatever it raises, nobody is there to hear of it.
        pass
    for one in given:
        _close(one)


def _close_unbegun(handle: Any) -> None:
    """Close the coroutines that a callback has which is never called, and that have not begun: nobody awaits them."""
    callback = handle._callback
    for cell in (callback.__closure__ or ()) if isinstance(callback, types.FunctionType) else ():
        try:
            held = cell.cell_contents
        except ValueError:  # It is empty.
            continue
        if inspect.iscoroutine(held) and inspect.getcoroutinestate(held) == inspect.CORO_CREATED:
            held.close()


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
    """Has the choices of one run carried out, from here to `remove`.

    The turns of every node of the loop are chosen, from when its actors have something to do for the first time.

    Args:
        choices: what decides.
        log: notes the turns.
        node: of the system that the test has; None: it has none.
        loop: whose steps are chosen.
        on_node: called with each node whose turns are chosen, and what its place is called.
    """

    def __init__(
        self,
        choices: Choices,
        log: TurnLog,
        node: Node | None,
        loop: ControlledLoop,
        *,
        on_node: Callable[[Node, str], None] = lambda node, name: None,
    ) -> None:
        self.choices = choices
        self.choose: Callable[[int, Keys], int] = choices.turn  # which of so many goes on
        self._rounds: Rounds | None = None  # counted only at a moment that goes on for long
        self._moment = 0  # how many turns there had been when it began
        self.next_cell: Cell | None = None
        self._next: Option | None = None
        self._log, self._note = log, log.note
        self._loop, self._due, self._on_node = loop, loop.due, on_node
        self._now = 0.0
        self._turns = 0  # since a callback was called
        self._last: Cell | None = None
        self._in_a_row = 0  # turns of that one
        self._nodes: dict[object, DrawnCells] = {}
        self._drained: DrawnCells | None = None  # where a turn was begun, after which nothing has been chosen yet
        self.watch: StepWatch | None = None
        if isinstance(choices, Stepped) and node is not None:
            self.watch = loop.due.watch = choices.watch = StepWatch(choices, node)
            self._due.is_told = True
        self._swaps = Swaps()
        if self.watch is not None:
            self._swaps.put(lifecycle, "build", self.watch.build)
        self._swaps.put(run_loop, "clock", self._clock)
        for name in ("MOST", "STRIDE"):
            self._swaps.put(run_loop, name, 1)
        if node is not None:
            self.meet(node)
        loop.control = loop.due.chooser = self

    def meet(self, node: Node) -> None:
        """The turns of this node are chosen, too, from now on."""
        if node in self._nodes:
            return
        place = place_of(node)
        name = "" if place is None else place.name
        if place is not None and node not in place.nodes:
            place.nodes.append(node)
        self._log.call(node, name)
        cells = self._nodes[node] = DrawnCells(node.ready, self)
        self._swaps.put(node, "ready", cells)
        for limit in ("most", "stride"):
            self._swaps.put(
                node, limit, 1
            )  # One turn, and a look at the clock, which is where the next step is chosen.
        self._on_node(node, name)

    def drop(self, node: Node) -> None:
        """Nothing of this node has a turn any more."""
        cells = self._nodes.get(node)
        if cells is not None:
            cells.clear()
        if self.next_cell is not None and self.next_cell.node is node:
            self.next_cell = None

    def remove(self) -> None:
        """Let the rest of the run be as in production."""
        self._loop.control = self._due.chooser = self._due.watch = None
        self._loop.forget_ticks()  # All that were counted till now were others.
        self._swaps.undo()
        for node, cells in self._nodes.items():
            ready: deque[Cell] = node.ready  # type: ignore[attr-defined]
            if ready is not cells:
                ready.clear()
                ready.extend(cells)
        self._nodes.clear()

    # -- who is ready -------------------------------------------------------------------------------------------------

    def _goes_on(self, ready: deque[Cell]) -> bool:
        """Whether the actor that had the last turn has another one first, as in production."""
        return ready[-1] is self._last and self._in_a_row < MOST

    def at(self, ready: deque[Cell], index: int) -> Cell:
        """The one at this place in the order of production."""
        return ready[index - self._goes_on(ready)]  # The last one is the first.

    def in_order(self, ready: deque[Cell]) -> list[Cell]:
        """Who is ready, in the order in which production would let them run."""
        return [ready[-1], *itertools.islice(ready, len(ready) - 1)] if self._goes_on(ready) else [*ready]

    def _keys(self, options: list[Option]) -> list[Hashable]:
        """Who goes on with each of these callbacks: with that of a node, each actor that is ready there."""
        keys: list[Hashable] = []
        for key, _, _ in options:
            cells = self._nodes.get(key)
            keys += self.in_order(cells) if cells else [key]
        return keys

    def _waiting(self) -> dict[Hashable, int]:
        """Who could go on, and how much is before each."""
        found = Counter[Hashable](key for key, handle, _ in self._due.options if not handle.cancelled())
        for node, cells in self._nodes.items():
            found.pop(node, None)
            found.update({cell: len(cell.queue or (None,)) for cell in cells})
        begun = self._last  # It is in no run queue, and what it handles now waits no more.
        if self._drained is not None and begun is not None and begun.queue and len(begun.queue) > 1:
            found[begun] = len(begun.queue) - 1
        return found

    # -- steps --------------------------------------------------------------------------------------------------------

    def takes_turn(self, cell: Cell, ready: DrawnCells) -> None:
        """The cell has the next turn; `ready` are those of the same node."""
        self._drained = ready
        self._turns += 1
        self._in_a_row = self._in_a_row + 1 if cell is self._last else 1
        self._last = cell
        if self._rounds is not None:
            self._rounds.step(cell)
        self._note(cell)
        if self.watch is not None:
            self.watch.turn(cell)

    def _clock(self) -> float:
        """The run loop's measure of its slices: asked before the first turn and after each."""
        ready, self._drained = self._drained, None
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
            chosen = self.choose(total, lambda: [*self.in_order(ready), *(option[0] for option in others)])
        if chosen < count:
            self.next_cell = self.at(ready, chosen)
        else:
            self._next = others[chosen - count]
            self._now += 1.0  # The slice is over.
        return self._now

    def choose_callback(self, due: DueQueue) -> Option:
        """The callback that is called next; if it is that of a node, a cell of it is chosen, too."""
        chosen, self._next = self._next, None
        if chosen is None or chosen not in due.options:
            chosen = self._chosen(due)
        if self.next_cell is None:
            self._turns = 0
        return chosen

    def _chosen(self, due: DueQueue) -> Option:
        options = due.next_options()
        if not options:  # All are cancelled.
            return due.options[0]
        count, nodes, left = len(options), self._nodes, due.nodes
        drained: list[tuple[int, DrawnCells]] = []  # where the callback of a node stands, and who is ready there
        for place, option in enumerate(options):
            if not left:
                break
            if type(key := option[0]) is Node:
                left -= 1
                if cells := nodes.get(key):
                    drained.append((place, cells))
                    count += len(cells) - 1
        index = 0 if count == 1 else self.choose(count, lambda: self._keys(options))
        for place, cells in drained:
            if index < place:
                break
            if index < place + len(cells):
                self.next_cell = self.at(cells, index - place)
                return options[place]
            index -= len(cells) - 1
        return options[index]

    def called(self, option: Option) -> None:
        """A callback is called; if it is that of a node, its turns tell more."""
        if type(option[0]) is not Node:
            if self._rounds is not None:
                self._rounds.step(option[0])
            if self.watch is not None:
                self.watch.callback(option)
        elif self.watch is not None and not self._nodes.get(option[0]):
            self.watch.callback(option)

    # -- the moment ---------------------------------------------------------------------------------------------------

    def begin_moment(self) -> None:
        """Virtual time has passed."""
        self._rounds, self._moment, self._due.is_told = None, self._log.turns, self.watch is not None
        self.choose = self.choices.turn
        if self.watch is not None:
            self.watch.time_passes()

    def goes_on_for_ever(self, ticks: int) -> bool:
        """Whether it seems that virtual time will never pass, after so many ticks of the loop at this moment."""
        if self._rounds is None and (ticks > (most := self._loop.most_ticks) or self._log.turns - self._moment > most):
            self._rounds, self._due.is_told = Rounds(most, self._waiting), True
            self.choose = self._choose_in_round
        return self._rounds is not None and self._rounds.are_too_many

    def _choose_in_round(self, count: int, keys: Keys) -> int:
        assert self._rounds is not None
        return self._rounds.first(keys()) if self._rounds.is_late else self.choices.turn(count, keys)
