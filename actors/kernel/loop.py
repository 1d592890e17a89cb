"""The run loop: one queue of ready actors per node, drained in slices, one turn after another.

A turn of a plain `def` handler is a function call. A turn of an `async def` handler is stepped by hand (`send(None)`)
in the name of a runner, an idle task; if it suspends, the runner stays with it to its end, so that
`asyncio.current_task()`, `asyncio.timeout()` and anyio scopes work, and the next turn gets another runner.
"""

from __future__ import annotations

import asyncio
import contextvars
import threading
import time
import types
from asyncio.tasks import _enter_task, _leave_task  # the documented hooks for stepping coroutines in a task's name
from collections import deque
from collections.abc import Callable, Coroutine, Generator
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from ..errors import WrongLoop, WrongThread
from ..ordered import Ordered
from . import lifecycle, mailbox
from .envelope import LEAVE, Item
from .message import Refusal

if TYPE_CHECKING:
    from contextvars import Context

    from .cell import Cell

SLICE = 0.0005
"""Seconds after which the loop lets the host program's own callbacks run."""
MOST = 64
"""Messages one actor may handle before the next actor's turn."""
STRIDE = 16
"""Actors run between two looks at the clock, while they are quick."""
RUNNERS = 8
"""Idle runner tasks kept for the next turns."""

T = TypeVar("T")
Coroutine_ = types.CoroutineType
running_loop = asyncio._get_running_loop


class RunLoop:
    """The run queue of one node. `make_ready` is the only way in."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self.base_context = contextvars.copy_context()
        self.thread = threading.get_ident()
        self.ready: deque[Cell] = deque()
        self.awake = False
        self.now = loop.time()
        self.most = MOST
        self.stride = STRIDE
        self.turns_held = 0
        self.entered: Runner | None = None
        self._struck: Runner | None = None  # entered too, but cancelled in the step that runs now: only that turn's
        self._idle: list[Runner] = []
        self._runners = Ordered[Runner]()
        self._idlers: list[asyncio.Future[None]] = []

    def make_ready(self, cell: Cell) -> None:
        """Put a cell on the run queue; the caller has set `scheduled`."""
        self.ready.append(cell)
        if not self.awake:
            self.wake()

    def wake(self) -> None:
        """One callback drains every ready actor.

        Raises:
            WrongThread: by a `tell` from another thread, which nobody would notice before the loop wakes by itself. It
                is found here, where it costs nothing while actors are busy; what it has queued is taken back.
            WrongLoop: by whoever runs in another loop of this thread; found in the same place.
        """
        if not self.is_own_thread() or self.is_other_loop():
            self.check_caller(self._take_back())
        self.awake = True
        self.loop.call_soon(self._drain)

    def _drain(self) -> None:
        """Run ready actors until none is left or the slice is over."""
        ready = self.ready
        self.now = self.loop.time()
        begin = clock()
        end = begin + SLICE
        stride = left = self.stride
        while ready:
            cell = ready.popleft()
            context = cell.context
            if context is None:
                context = lifecycle.open_context(cell)
            ran = context.run(run_turns, cell, self.most)
            if ran:
                if cell.queue:
                    ready.append(cell)
                else:
                    cell.scheduled = False
            left -= 1
            if left:
                continue
            left = stride
            now = clock()
            if now > end:
                if now - begin > SLICE:
                    self._shorten(ran)
                else:
                    self._lengthen()
                break
            begin = now
        else:
            self._lengthen()
        if self.entered is not None:
            self._leave()
        elif self._struck is not None:
            self._leave_struck()
        if ready:
            self.loop.call_soon(self._drain)
        else:
            self.awake = False
            if self._idlers and not self.turns_held:
                self._tell_idlers()

    def _take_back(self) -> str:
        """Take back what was queued just now; returns whose mailbox it was in."""
        if not self.ready:
            return "the system"
        cell = self.ready.pop()
        cell.scheduled = False
        if cell.queue:
            mailbox.take_back(cell, cell.queue)
        return cell.path

    def is_own_thread(self) -> bool:
        """Whether this is the thread that the actors of the node run in."""
        return get_ident() == self.thread

    def is_other_loop(self) -> bool:
        """Whether another loop runs in this thread now than the one that the actors of the node run in."""
        return running_loop() is not self.loop and running_loop() is not None and not self.loop.is_running()

    def check_caller(self, path: str) -> None:
        """Refuse a call from another thread, or from another loop of this one.

        Raises:
            WrongThread, WrongLoop: naming the actor that was called.
        """
        if get_ident() != self.thread:
            raise WrongThread(path, threading.current_thread().name)
        if self.is_other_loop():
            raise WrongLoop(path)

    def run_now(self) -> None:
        """Run what is ready at once instead of in the next tick: for callbacks of the loop that bring messages."""
        if self.awake:
            self._drain()

    def _shorten(self, ran: int) -> None:
        """Handlers are slow: look at the clock more often, so that the host's own callbacks wait for few of them.

        `ran` is how many turns the last actor had. One long turn alone is no reason to give everybody fewer at a time:
        it would not be shorter, and what others gather for one write would be written in as many.
        """
        if self.stride > 1:
            self.stride = 1
        elif ran > 1:
            self.most = max(1, self.most // 2)

    def _lengthen(self) -> None:
        """Handlers are quick, or were all along, and something else took the time: bit by bit as it was before."""
        if self.stride < STRIDE:
            self.stride += 1
        if self.most < MOST:
            self.most += 1

    def settled(self) -> asyncio.Future[None]:
        """A future that ends when no actor of this node has anything to do (suspended turns included)."""
        future: asyncio.Future[None] = self.loop.create_future()
        self._idlers.append(future)
        if not self.awake:
            self.wake()
        return future

    def _tell_idlers(self) -> None:
        waiting, self._idlers = self._idlers, []
        for future in waiting:
            if not future.done():
                future.set_result(None)

    # -- runners ----------------------------------------------------------------------------------------------------

    def enter(self) -> None:
        """Step coroutines in a runner's name from here to the end of the slice."""
        if self._struck is not None:
            self._leave_struck()
        runner = self._idle.pop() if self._idle else Runner(self)
        while runner.task.cancelling():  # Cancelled while it was idle: that cancel is for none of our turns.
            runner = self._idle.pop() if self._idle else Runner(self)
        _enter_task(self.loop, runner.task)
        self.entered = runner

    def _leave(self) -> None:
        """Give the runner back to the idle ones."""
        runner = self.entered
        assert runner is not None
        self.entered = None
        _leave_task(self.loop, runner.task)
        self._idle.append(runner)

    def strike(self, runner: Runner) -> None:
        """A runner's task is cancelled: if it is entered, the turn in this step is meant, and none after it."""
        if self.entered is runner:
            self.entered, self._struck = None, runner

    def _leave_struck(self) -> None:
        """The turn that was cancelled in its only step has ended without a wait: nobody else gets its cancel."""
        runner = self._struck
        assert runner is not None
        self._struck = None
        _leave_task(self.loop, runner.task)

    def is_stepping(self) -> bool:
        """Whether the code that asks runs in a step of the run loop, not in a task of its own."""
        task = asyncio.current_task(self.loop)
        runner = self.entered or self._struck
        return task is None or (runner is not None and task is runner.task)

    def step(self, cell: Cell, item: Any, turn: Any) -> bool:
        """Run a coroutine's first step inside the cell's context. False: it is suspended, its runner has it now.

        Raises what the coroutine raises.
        """
        if self.entered is None:
            self.enter()
        try:
            waiting = turn.send(None)
        except StopIteration:
            return True
        self.hold(cell, item, turn, waiting)
        return False

    def step_beside(self, context: Context, work: Callable[[], T]) -> T:
        """Call something in a runner's name, while no slice runs: it may need a current task, as turns have one."""
        self.enter()
        try:
            return context.run(work)
        finally:
            if self.entered is not None:
                self._leave()
            else:
                self._leave_struck()

    def hold(self, cell: Cell, item: Any, turn: Any, waiting: Any) -> None:
        """A coroutine has suspended in its first step: its runner stays with it."""
        runner = self.entered or self._struck
        assert runner is not None
        self.entered = self._struck = None
        _leave_task(self.loop, runner.task)
        self.turns_held += 1
        suspended = Suspended(cell, item, turn, waiting, runner)
        if suspended.marked is not None:
            suspended.marked._turn_waits()
        cell.extra().turn = suspended
        runner.take(suspended)

    def turn_over(self, turn: Suspended, error: BaseException | None) -> None:
        """A suspended turn has ended; its actor goes on."""
        cell = turn.cell
        more = cell.extra()
        if more.turn is not turn:
            return  # The life was abandoned meanwhile, and this turn is not counted any more.
        self.turns_held -= 1
        more.turn = None
        if turn.rebinds is not None:
            more.bindings.update(turn.rebinds)
        if turn.overran is not None:
            turn.overran.__cause__ = error  # Its traceback says where the turn has waited.
            error = turn.overran
        if turn.then is not None and not (turn.killed and cell.children):
            turn.then()
        elif turn.killed or (error is not None and not turn.is_left):
            # What follows is again user code, maybe: it runs on the run queue, not in this runner's name.
            turn.item = turn.item if cell.ctx is None else cell.item  # It may have been forwarded or stashed.
            mailbox.queue_of(cell).appendleft(TurnRemains(turn, error))
            self.make_ready(cell)
        elif cell.queue:
            self.make_ready(cell)
        else:
            cell.scheduled = False
        if self._idlers and not self.awake:
            self.wake()

    def errand_waits(self) -> None:
        """What an actor does outside its turns has to wait: until it goes on, the node has something to do."""
        self.turns_held += 1

    def errand_goes_on(self) -> None:
        """It waits no longer, or is given up."""
        self.turns_held -= 1
        if self._idlers and not self.awake:
            self.wake()

    def idle_again(self, runner: Runner) -> bool:
        """Whether the runner shall wait for another turn."""
        if len(self._idle) >= RUNNERS or runner.task.cancelling():
            return False
        self._idle.append(runner)
        return True

    async def close(self) -> None:
        """End every runner; turns that still hang are cancelled."""
        self._idle.clear()
        tasks = [runner.task for runner in self._runners]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks, timeout=1.0)

    def joined(self, runner: Runner) -> None:
        """Keep a reference to a runner's task."""
        self._runners.add(runner)

    def left(self, runner: Runner) -> None:
        """A runner's task has ended."""
        self._runners.discard(runner)
        if runner in self._idle:
            self._idle.remove(runner)


clock: Callable[[], float] = time.monotonic
get_ident: Callable[[], int] = threading.get_ident


def run_turns(cell: Cell, most: int) -> int:
    """Run up to `most` turns of one actor, in its own context. Returns how many, at least 1; 0: it left the queue."""
    queue, actor, table = cell.queue, cell.actor, cell.table
    if queue is None or actor is None:
        return 1
    count = len(queue)
    if count > most:
        count = most
    item: Any = None
    try:
        for _ in range(count):
            cell.item = item = queue.popleft()
            result = table[type(item)](actor, item)
            if result is None:
                continue
            if type(result) is Coroutine_:
                node = cell.node
                if node.entered is None:
                    node.enter()
                try:
                    waiting = result.send(None)
                except StopIteration:
                    continue
                node.hold(cell, item, result, waiting)
                return 0
            if result is LEAVE:
                return 0
    except Refusal as no:  # Refused a tell: nobody waits for the answer.
        cell.node.refused(cell, item, no)
        return 1
    except BaseException as error:  # Whatever user code raises ends this life, and only this life.
        lifecycle.crash(cell, cell.item, error)  # Not `item`: that may have been forwarded or stashed.
        return 0
    return count or 1


class TurnRemains(Item):
    """What is left to do after a suspended turn that did not simply succeed."""

    __slots__ = ("error", "turn")
    is_command = ends_turn = True

    def __init__(self, turn: Suspended, error: BaseException | None) -> None:
        self.turn, self.error = turn, error

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        turn: Suspended = item.turn
        cell = turn.cell
        if turn.killed:
            lifecycle.cut_off(cell, turn.item)
            lifecycle.killed(cell)
        elif isinstance(item.error, Refusal):
            cell.node.refused(cell, turn.item, item.error)
            return None
        else:
            lifecycle.crash(cell, turn.item, item.error)
        return LEAVE


class Suspended:
    """A turn that waits for something, and the runner that waits with it."""

    __slots__ = (
        "cell",
        "coroutine",
        "is_left",
        "item",
        "killed",
        "marked",
        "overran",
        "rebinds",
        "runner",
        "since",
        "then",
        "waiting",
    )

    def __init__(self, cell: Cell, item: Any, coroutine: Any, waiting: Any, runner: Runner) -> None:
        self.cell, self.item, self.coroutine, self.runner = cell, item, coroutine, runner
        self.waiting = waiting  # the future that it waits for
        self.killed = self.is_left = False  # (left: cancelled, and it does not matter how it ends)
        ctx = cell.ctx  # Of this life: the cell may have another one before its coroutine ends.
        self.marked = ctx if ctx is not None and ctx._marks_waits else None  # who is told when it waits, and goes on
        self.overran: BaseException | None = None  # what it has raised, however its coroutine ends
        self.since: float = cell.node.now  # on the loop's clock, of the slice it began in
        self.rebinds: dict[str, Cell] | None = None  # bindings that change when this turn is over
        self.then: Callable[[], None] | None = None  # set when the coroutine is no turn but a winding down

    def kill(self) -> None:
        """Cancel the turn; `after_turn` then ends the life as killed."""
        self.killed = True
        self.runner.task.cancel()

    def overrun(self, error: BaseException) -> None:
        """Cancel the turn, which counts as having raised `error`."""
        self.overran = error
        self.runner.task.cancel()


class RunnerTask(asyncio.Task[None]):
    """A runner's task. It tells the run loop of a cancel, which may come from the very step that runs in its name."""

    __slots__ = ("_runner",)

    def __init__(self, runner: Runner, loop: RunLoop) -> None:
        self._runner = runner
        super().__init__(runner, loop=loop.loop, name="holdfast runner", context=loop.base_context)

    def cancel(self, msg: Any = None) -> bool:
        self._runner.strike()
        return super().cancel(msg)


class Runner(Coroutine[Any, Any, None]):
    """A task in whose name turns are stepped; when a turn suspends, it becomes that turn's task.

    The runner is what its task runs: a coroutine without a frame, for a turn may wait for days, and many may.
    """

    __slots__ = ("_call", "_context", "_loop", "_turn", "task")

    def __init__(self, loop: RunLoop) -> None:
        self._loop = loop
        self._turn: Suspended | None = None
        self._call: asyncio.Future[None] | None = None  # while it waits for a turn
        self._context: Context | None = None  # of the turn, when it has taken that over: its actor may lose it before
        self.task = RunnerTask(self, loop)
        loop.joined(self)

    def take(self, turn: Suspended) -> None:
        """Wait with this turn from the next tick on."""
        self._turn = turn
        if self._call is not None and not self._call.done():
            self._call.set_result(None)

    def retire(self) -> None:
        """End the task of this runner."""
        self.task.cancel()

    def strike(self) -> None:
        """The task is cancelled, perhaps by the turn in this step."""
        self._loop.strike(self)

    # -- what its task calls ----------------------------------------------------------------------------------------

    def send(self, value: Any) -> Any:
        """Go on: with the turn, or to the next one. Returns what the task is to wait for."""
        turn = self._turn
        if self._context is not None and turn is not None:
            return self._step(turn, self._context, turn.coroutine.send, value)
        if turn is not None:
            return self._take_over(turn)
        if self._call is not None:  # Nothing has been given to it: the system is closing.
            return self._leave()
        return self._wait()

    def throw(self, error: Any, *_: Any) -> Any:
        """The same, with what is raised where it waits: a cancel, mostly."""
        turn = self._turn
        if self._context is not None and turn is not None:
            return self._step(turn, self._context, turn.coroutine.throw, error)
        if turn is None or not isinstance(error, asyncio.CancelledError):
            self._loop.left(self)
            raise error
        # A cancel can come between the turn's first wait and our taking it over: it belongs to the turn.
        waiting = self._take_over(turn)
        if waiting is not None:
            if waiting.cancel(*error.args):  # As `Task.cancel` does: what is waited for is cancelled first.
                return waiting
            waiting._asyncio_future_blocking = False  # It is done, and we do not wait for it after all.
        assert self._context is not None
        return self._step(turn, self._context, turn.coroutine.throw, error)

    def close(self) -> None:
        """Give up the turn that it waits with."""
        if self._turn is not None:
            self._turn.coroutine.close()

    def __await__(self) -> Generator[Any, Any, None]:
        raise TypeError("only the task of a runner runs it")

    def _take_over(self, turn: Suspended) -> Any:
        self._call, self._context = None, turn.cell.context
        return turn.waiting

    def _step(self, turn: Suspended, context: Context, step: Callable[[Any], Any], value: Any) -> Any:
        """Step a started coroutine inside its actor's context; what it waits for is handed to the running task."""
        error: BaseException | None = None
        waiting, is_over, marked = None, True, turn.marked
        if marked is not None:
            marked._turn_goes_on()
        try:
            waiting = context.run(step, value)
            is_over = False
        except StopIteration:
            pass
        except BaseException as raised:  # The turn's own outcome, whatever it is: its actor gets it.
            error = raised
        if marked is not None:
            marked._turn_waits()  # If it was killed, nobody closes it.
        if not is_over:
            turn.waiting = waiting
            return waiting
        self._turn = self._context = None
        self._loop.turn_over(turn, error)
        return self._wait() if self._loop.idle_again(self) else self._leave()

    def _wait(self) -> Any:
        """Have the task wait for the next turn."""
        call = self._call = self._loop.loop.create_future()
        call._asyncio_future_blocking = True  # As a future says itself where it is awaited.
        return call

    def _leave(self) -> NoReturn:
        self._loop.left(self)
        raise StopIteration
