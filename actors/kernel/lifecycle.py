"""Lives: how an actor in this process begins, crashes, is stopped or killed, and what follows from its end.

The order of an end: children (newest first), `on_stop`, replies that were promised, timers and tasks, names, links and
monitors, then the supervisor is told, or the address is given up.
"""

from __future__ import annotations

import asyncio
import contextvars
import signal
import weakref
from asyncio.tasks import _unregister_task  # the documented hook for tasks that nobody waits for
from collections import deque
from collections.abc import Callable, Coroutine, Iterable
from typing import TYPE_CHECKING, Any

from .. import exit_reasons
from ..errors import ActorStopped, AskFailed, Ignore, StartFailed, StartIgnored, TurnTimeout, remote_crash, type_name
from ..events import ActorCrashed, ActorStarted, HookFailed, LifeAbandoned
from ..exit_reasons import KILLED, NORMAL, SHUTDOWN, Crash, ExitReason
from . import links, mailbox
from .actor import Actor
from .address_host import AddressHost, Home, Parent, Place
from .cell import DOWN, ENDING, GONE, RUNNING, Cell
from .context import ActorContext
from .envelope import LEAVE, Ask, Item, message_in
from .message import Refusal
from .ref import current

if TYPE_CHECKING:
    from .actor import Start
    from .address_host import QueuedOrder
    from .loop import Suspended

GRACE = 1.0
"""Seconds a killed turn may take to end after its cancellation, before its life is abandoned."""
PATIENCE = 5.0
"""Seconds an actor that nobody supervises may take to stop in good order before it is killed."""
KILLED_WITHIN = 5.0
"""Seconds until a killed child is given up that has not ended; a process that was sent SIGKILL takes less."""


class MailboxHome(Home):
    """A deque in this process: what is sent is handled where it waits."""

    takes_parcels = False

    def push(self, cell: Cell, item: Item) -> None:
        mailbox.queue_of(cell).append(item)
        cell.schedule()

    def backlog(self, cell: Cell, running: int) -> int:
        return sum(map(mailbox.counts, cell.queue or ()))

    def load(self, cell: Cell) -> int:
        return len(cell.queue or ()) + (cell.more is not None and cell.more.turn is not None)


class HerePlace(Place):
    """The place of all actors whose turns run in this event loop."""

    is_here = True

    def start(self, cell: Cell) -> asyncio.Future[None] | None:
        start = cell.extra().start
        assert start is not None
        return begin(cell, start)

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        if cell.state is not RUNNING:
            return
        actor: Any = cell.actor
        if cell.scheduled or cell.children or type(actor).on_stop is not Actor.on_stop:
            urge(cell, Stop(reason))
        else:
            ended(cell, reason)  # Idle, and nothing of the user's has to run: it is over at once.

    def kill(self, cell: Cell) -> None:
        turn = cell.more.turn if cell.more is not None else None
        if turn is not None:
            turn.kill()
            cell.node.loop.call_later(GRACE, abandon, turn)
        elif cell.state is RUNNING:
            cell.urge(Kill())
            cell.node.loop.call_soon(_strike, cell, cell.life)

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        if call.runs_beside(cell):
            return
        if call.is_urgent:
            urge(cell, call)
        else:
            mailbox.queue_of(cell).append(call)
            cell.schedule()

    def is_up(self, cell: Cell) -> bool:
        return is_up(cell)


class NearParent(Parent):
    """A supervisor in this process, or nobody: it hears of the end of a life by the mailbox."""

    def life_over(self, cell: Cell, reason: ExitReason, over: Callable[[bool | None], None]) -> None:
        over(None)
        ended(cell, reason)

    def recipe(self, cell: Cell) -> Start[Any] | bytes:
        start = cell.extra().start
        assert start is not None
        return start

    def topics(self, cell: Cell) -> Iterable[str]:
        start = cell.extra().start
        return start.kind._topics if start is not None else ()

    def is_restarting(self, cell: Cell) -> bool:
        return may_live_again(cell)


def _strike(cell: Cell, life: int) -> None:
    """A kill has come in the first step of a turn: if that waits now, perhaps for ever, it does not wait any longer."""
    if cell.life == life and cell.state is RUNNING and cell.more is not None and cell.more.turn is not None:
        cell.host.kill(cell)


def outside_turn(
    cell: Cell, work: Coroutine[Any, Any, None], what: str = "start", context: contextvars.Context | None = None
) -> asyncio.Task[None]:
    """Run a start or an end of a life that takes long; whoever has asked for it need not wait for its outcome."""
    task = cell.node.loop.create_task(work, name=f"{what} of {cell.path}", context=context)
    # If the system stops meanwhile, perhaps nobody looks, and asyncio need not complain of that.
    task.add_done_callback(lambda done: None if done.cancelled() else done.exception())
    return task


def is_up(cell: Cell) -> bool:
    """Whether a life has begun in this process, `on_start` included."""
    if cell.state is not RUNNING:
        return False
    starting = cell.more.starting if cell.more is not None else None
    return starting is None or starting.done()


def urge(cell: Cell, command: Item) -> None:
    """Put a command ahead of all messages, but behind `on_start`: `on_stop` would find nothing done."""
    queue = cell.queue
    if queue and type(queue[0]) is FirstTurn:
        first = deque.popleft(queue)
        cell.urge(command)
        queue.appendleft(first)
    else:
        cell.urge(command)


MAILBOX, HERE, NEAR = MailboxHome(), HerePlace(), NearParent()
LOCAL = AddressHost(MAILBOX, HERE, NEAR)


def begin(
    cell: Cell, start: Start[Any], *, restored: bool = False, context_type: type[ActorContext] = ActorContext
) -> asyncio.Future[None] | None:
    """Begin a life: construct the actor, then `on_start` as its first turn if the class has one.

    Returns:
        None if the life is up now; else a future that ends with `on_start` (StartFailed if that raises).

    Raises:
        StartFailed: `__init__` raised. StartIgnored: it raised `Ignore`.
    """
    cell.life += 1
    build(cell, start, context_type)
    cell.state = RUNNING
    node = cell.node
    if node.events.hears_starts if cell.life == 1 else node.events.has_listeners:
        node.emit(ActorStarted(cell.path, cell.life))
    for topic in start.kind._topics:
        node.topics.subscribe(topic, cell)
    if node.on_life is not None:
        node.on_life(cell)
    if start.kind.on_start is Actor.on_start:
        up(cell)
        return None
    started: asyncio.Future[None] = node.loop.create_future()
    if cell.more is not None or start.kind._supervises:
        cell.extra().starting = started  # Somebody waits, also if the life ends before its first turn has.
    mailbox.queue_of(cell).appendleft(FirstTurn(restored, started))
    up(cell)
    return started


def build(cell: Cell, start: Start[Any], context_type: Callable[[Cell], ActorContext]) -> None:
    """Construct the actor with its `ctx`."""
    kind: Any = start.kind
    ctx = context_type(cell)
    actor = kind.__new__(kind)
    actor.ctx = ctx
    cell.actor, cell.ctx, cell.table, cell.context, cell.item = actor, ctx, kind._table, None, None
    try:
        actor.__init__(*start.args, **start.kwargs)
    except BaseException as error:
        pass_on(cell, error)
        ctx._close()
        _kill_orphans(cell)
        if cell.more is not None:
            _undo(cell)
        cell.actor = cell.ctx = None
        reason = NORMAL if isinstance(error, Ignore) else exit_reasons.crash(error)
        if cell.more is not None:
            cell.more.reason = reason
            if not cell.goes_on(reason):
                links.tell_linked(cell, reason)  # Else the next life would have the links of one that never began.
        if isinstance(error, Ignore):
            raise StartIgnored(cell.path, error.why) from error
        raise StartFailed(cell.path, str(reason)) from error
    if cell.more is not None and cell.more.tap is not None:
        cell.more.tap.attach()
    limit_turns(cell)


def up(cell: Cell) -> None:
    """Let the run loop at the queue."""
    cell.scheduled = False
    if cell.queue:
        cell.schedule()


def open_context(cell: Cell) -> contextvars.Context:
    """The life's own context, in which `current` names it for good: sends find their sender there."""
    context = cell.node.base_context.copy()
    context.run(current.set, cell.ctx)  # type: ignore[arg-type]  # a life that runs has its context
    cell.context = context
    return context


class FirstTurn(Item):
    """The first item of each life, turn 0: it calls `on_start`."""

    __slots__ = ("restored", "started")

    def __init__(self, restored: bool, started: asyncio.Future[None]) -> None:
        self.restored, self.started = restored, started

    def is_start(self) -> bool:
        return True

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        try:
            result = actor.on_start(item.restored)
        except Refusal as no:  # Nobody asked: an actor that refuses to start has failed to.
            raise StartFailed(actor.ctx.path, str(no)) from no
        if asyncio.iscoroutine(result):
            return _first(actor, result, item.started)
        _first_over(actor, item.started)
        return None

    def hook(self) -> str:
        return "on_start"

    def ignored(self, cell: Cell, why: str) -> bool:
        start_fails(cell, self, StartIgnored(cell.path, why))
        return True

    def undelivered(self, cell: Cell, reason: str) -> None:
        self.fail_start(StartFailed(cell.path, reason))

    def fail_start(self, error: StartFailed) -> None:
        """Whoever waits for the start hears of it."""
        if not self.started.done():
            self.started.set_exception(error)
            self.started.exception()  # Seen: if nobody waits for it, asyncio need not complain.


async def _first(actor: Actor, hook: Any, started: asyncio.Future[None]) -> None:
    try:
        await hook
    except Refusal as no:
        raise StartFailed(actor.ctx.path, str(no)) from no
    _first_over(actor, started)


def _first_over(actor: Actor, started: asyncio.Future[None]) -> None:
    """`on_start` has returned; the start may go on without it, and then ends with `came_up`, or with the life."""
    if not actor._is_starting() and not started.done():
        started.set_result(None)


def came_up(cell: Cell) -> None:
    """A start that went on after `on_start` is over: whoever waits for it hears of it."""
    starting = cell.more.starting if cell.more is not None else None
    if starting is not None and not starting.done():
        starting.set_result(None)


class Stop(Item):
    """A command: end in good order."""

    __slots__ = ("reason",)

    def __init__(self, reason: ExitReason) -> None:
        self.reason = reason

    @property
    def stops(self) -> ExitReason:  # type: ignore[override]  # others have it as None
        return self.reason

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        stop(actor.ctx._cell, item.reason, item)
        return LEAVE


class CutOff(Stop):
    """A command: end behind a turn that was left in the middle, without `on_stop`."""

    __slots__ = ()
    ends_turn = True

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        finish(actor.ctx._cell, item.reason, is_orderly=False)
        return LEAVE


class Kill(Item):
    """A command: end now, without hooks."""

    __slots__ = ()

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        killed(actor.ctx._cell)
        return LEAVE


def pass_on(cell: Cell, error: BaseException) -> None:
    """Let Ctrl+C end the program, too, where Python's own handler raises it wherever it strikes.

    `run`, `asyncio.run` and processes of actors have handlers of their own: there, what is raised here was raised by
    the actor, or is the second Ctrl+C of a program that stops already, and ends nothing but this life.
    """
    if isinstance(error, KeyboardInterrupt) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        cell.node.loop.call_soon(_raise, error)  # Behind this slice: the run loop must be fit to stop all in order.


def _raise(error: BaseException) -> None:
    raise error


def crash(cell: Cell, item: Any, error: BaseException) -> None:
    """User code raised in the turn of `item`: its asker hears of it, and the life ends."""
    pass_on(cell, error)
    is_item = isinstance(item, Item)  # Else it is the user's message, whose fields may have any names.
    if isinstance(error, Ignore) and is_item and item.ignored(cell, error.why):
        finish(cell, NORMAL, is_orderly=False)  # No crash: it does not want to live.
        return
    is_start = is_item and item.is_start()
    reason = exit_reasons.crash(error)
    if is_item:
        item.fail(remote_crash(error))
    if isinstance(item, FirstTurn):
        start_fails(cell, item, exit_reasons.start_failed(cell.path, reason))
        if isinstance(error, StartFailed) and cell.actor is not None and cell.actor._supervises:
            finish(cell, SHUTDOWN)  # A child did not start, which is no crash of ours (OTP).
            return
    tell_crash(cell, reason, item)
    finish(cell, reason, is_orderly=not is_start)


def tell_crash(cell: Cell, reason: ExitReason, item: object) -> None:
    """The life ends by a crash, be it that its code raised or that it says so."""
    node = cell.node
    if node.events.has_listeners:
        node.emit(ActorCrashed(cell.path, cell.life, reason, item))


def start_fails(cell: Cell, item: FirstTurn, error: StartFailed) -> None:
    """`on_start` has failed: who waits hears of it when the life is over, for only then can the next one begin."""
    if cell.more is None:
        item.fail_start(error)
    else:
        cell.more.start_error = error


def killed(cell: Cell) -> None:
    """The life ends without hooks; its children are killed with it."""
    if cell.children:
        _wind_down(cell, End(KILLED), _kill_children(cell))
    else:
        ended(cell, KILLED)


def cut_off(cell: Cell, item: Any) -> None:
    """The turn of `item` was killed: its asker hears of it now, not at the deadline."""
    if isinstance(item, Ask):  # An input of a recorded actor will be handled again instead.
        item.fail(AskFailed(cell.path, str(KILLED)))


def limit_turns(cell: Cell) -> None:
    """The actor at a cell is of this class from now on: have its turns end that take longer than that allows."""
    seconds = None if cell.actor is None else cell.actor.turn_timeout
    if seconds is not None and cell.host.place.limits_turns:
        TurnLimit(cell, seconds)


class TurnLimit:
    """Ends the life at a cell whose turn waits for too long; no turn is slower for it, for nothing is done in one.

    Starts and ends have limits of their own, and a turn that rests as it has said (`ctx.sleep`) is at no work: it is
    given the whole time anew.

    Args:
        cell: whose life has just been built, or has another class.
        seconds: that a turn may take.
    """

    __slots__ = ("_cell", "_kind", "_life", "_seconds")

    def __init__(self, cell: Cell, seconds: float) -> None:
        self._cell, self._life, self._seconds = weakref.ref(cell), cell.life, seconds
        self._kind = type(cell.actor)
        cell.node.loop.call_later(seconds, self._look)

    def _look(self) -> None:
        cell = self._cell()
        if cell is None or cell.life != self._life or type(cell.actor) is not self._kind:
            return
        turn = cell.more.turn if cell.more is not None else None
        loop = cell.node.loop
        wait = self._seconds
        if turn is not None and not self._is_excused(cell, turn):
            wait = turn.since + self._seconds - loop.time()
            if wait <= 0:
                turn.overrun(TurnTimeout(cell.path, type_name(type(message_in(turn.item))), self._seconds))
                loop.call_later(GRACE, abandon, turn)
                return
        loop.call_later(wait, self._look)

    @staticmethod
    def _is_excused(cell: Cell, turn: Suspended) -> bool:
        is_turn = turn.then is None and not turn.killed and not turn.is_left and not isinstance(turn.item, FirstTurn)
        return not is_turn or cell.ctx is None or cell.ctx._rests()


def stop(cell: Cell, reason: ExitReason, item: Item) -> None:
    """A life was told to stop, by itself or by others. Called in the actor's own context."""
    if isinstance(reason, Crash):
        tell_crash(cell, reason, item)
    finish(cell, reason)


def finish(cell: Cell, reason: ExitReason, *, is_orderly: bool = True) -> None:
    """End a life: children, `on_stop`, then `ended`. Called in the actor's own context.

    `on_stop` is left out where nothing was built up that it could take down (a start that failed), and where the life
    is cut off (an EXIT that is not trapped): `is_orderly` is False then.
    """
    actor: Any = cell.actor
    says = is_orderly and type(actor).on_stop is not Actor.on_stop
    if cell.children or says:
        end = End(reason)
        _wind_down(cell, end, _farewell(cell, end, says))
    else:
        ended(cell, reason)


class End:
    """Why a life ends; `on_stop` may say otherwise."""

    __slots__ = ("reason",)

    def __init__(self, reason: ExitReason) -> None:
        self.reason = reason


def _wind_down(cell: Cell, end: End, farewell: Any) -> None:
    cell.state = ENDING
    cell.extra().reason = end.reason  # Those below it, which end with it, say why.
    cell.scheduled = True
    if cell.node.step(cell, None, farewell):
        ended(cell, end.reason)
        return
    turn = cell.extra().turn
    assert turn is not None
    turn.then = lambda: ended(cell, KILLED if turn.killed else end.reason)


async def _farewell(cell: Cell, end: End, says: bool) -> None:
    """Stop the children, then say good-bye."""
    actor = cell.actor
    assert actor is not None
    await actor._stop_children()
    if not says:
        return
    try:
        result = actor.on_stop(end.reason)
        if asyncio.iscoroutine(result):
            result = await result
        if isinstance(result, ExitReason):
            exit_reasons.check_farewell(end.reason, result)
    except BaseException as error:  # A failing hook must not keep the end from being told.
        result = exit_reasons.crash(error)
        cell.node.emit(HookFailed(cell.path, "on_stop", result))
        if isinstance(end.reason, Crash):
            return  # The first cause is told.
    else:
        if isinstance(result, Crash):
            tell_crash(cell, result, None)
    if isinstance(result, ExitReason):
        end.reason = result


async def _kill_children(cell: Cell) -> None:
    for child in reversed(list((cell.children or {}).values())):
        gone = child.ended()
        child.kill()
        await asyncio.wait((gone,), timeout=KILLED_WITHIN)  # Whatever holds it, it does not hold us.
        retire(child, "its parent was killed")


def abandon(turn: Suspended) -> None:
    """A turn that swallows its cancellation: its life is over all the same, and its sends are refused."""
    cell = turn.cell
    more = cell.more
    if more is None or more.turn is not turn:
        return
    more.turn = None
    more.bindings.update(turn.rebinds or {})
    cell.node.turns_held -= 1
    let_go(turn.runner.task)
    cell.node.emit(LifeAbandoned(cell.path, cell.life))
    reason: ExitReason = KILLED
    if turn.overran is None:
        cut_off(cell, turn.item)
    else:
        reason = exit_reasons.crash(turn.overran)
        if isinstance(turn.item, Item):
            turn.item.fail(remote_crash(turn.overran))
        tell_crash(cell, reason, turn.item)
    _kill_orphans(cell)
    ended(cell, reason)


def let_go(task: asyncio.Task[Any]) -> None:
    """Have nobody wait for a task that swallows its cancellation, as `asyncio.run` does for all that it knows of."""
    _unregister_task(task)
    task._log_destroy_pending = False  # type: ignore[attr-defined]


def _kill_orphans(cell: Cell) -> None:
    """Kill the children of a life that cannot wait for their end; their names are free at once."""
    children, cell.children = cell.children, None
    for child in reversed(list((children or {}).values())):
        child.kill()


def ended(cell: Cell, reason: ExitReason) -> None:
    """The life is over: undo what it had, tell who wants to know, and pass the address on."""
    reason = cell.host.home.cause(reason)
    cell.state = DOWN
    cell.scheduled = True
    more, ctx = cell.more, cell.ctx
    if more is not None:
        more.reason = reason
    if ctx is not None:
        if cell.actor is None or not cell.actor._keeps_promises:
            for ask in ctx._promised():  # Nobody else can answer these.
                ask.fail(AskFailed(cell.path, str(reason)))
        ctx._close()
    actor = cell.actor
    if actor is not None and type(actor).on_undelivered is not Actor.on_undelivered:
        cell.extra().last = actor  # It may yet be handed what was queued.
    cell.actor = cell.ctx = cell.context = cell.item = None
    if more is not None:
        starting, more.starting = more.starting, None
        error, more.start_error = more.start_error, None
        if starting is not None and not starting.done():
            starting.set_exception(error or exit_reasons.start_failed(cell.path, reason))
            starting.exception()  # Seen: a supervisor may have given up this start meanwhile.
        _undo(cell)
    if cell.spec is not None and cell.parent is not None:
        if more is not None:
            links.announce(cell, reason, recovering=cell.goes_on(reason))
            tell_enders(more, reason)
        cell.parent.push(ChildExit(cell, cell.life, reason))
    else:
        retire(cell, reason)
        if more is not None:
            links.announce(cell, reason, recovering=False)
            tell_enders(more, reason)


def tell_enders(more: Any, reason: ExitReason) -> None:
    """Whoever waits for the end hears of it."""
    enders, more.enders = more.enders, None
    for future in enders or ():
        if not future.done():
            future.set_result(reason)


def _undo(cell: Cell) -> None:
    """Whatever belongs to the life ends with it: timers, tasks, subscriptions, names, trapping, the suspension.

    The stash goes back to the queue.
    """
    more = cell.extra()
    if more.has_more:
        own = more.belongings
        for timer in list(own.timers):
            timer.cancel()
        for task in own.tasks:
            task.cancel()
        own.tasks.clear()
        for topic in list(own.topics):
            cell.node.topics.unsubscribe(topic, cell)
        free_names(cell)
        more.ties.watching.clear()
    cell.host.parent.undone(cell)
    more.suspended, more.trap_exits = 0, False
    queue = cell.queue
    if queue:
        kept = deque.copy(queue) if type(queue) is deque else deque(queue)
        deque.clear(queue)
        queue.extend(item for item in kept if not isinstance(item, Item) or not item.of_life)
    urgent, more.urgent = more.urgent, None
    for command in urgent or ():  # Control of the address waits for the next life; stop and kill were for this one.
        if not command.of_life:
            cell.urge(command)
    if more.stash:
        mailbox.queue_of(cell).extendleft(reversed(more.stash))
        if more.bound is not None:
            more.bound.count += len(more.stash)
        more.stash.clear()


def free_names(cell: Cell) -> None:
    """Nobody has the names any more that the life at the cell had, or one that was about to begin."""
    if cell.more is None or not cell.more.has_more:
        return
    names = cell.more.belongings.names
    for name in names:
        if cell.node.names.get(name) is cell:  # Else the life has moved, and its names with it.
            del cell.node.names[name]
    names.clear()


def retire(cell: Cell, why: object) -> None:
    """The address is given up: its name is free, and what is queued will not be handled."""
    if cell.state is GONE:
        return
    cell.state = GONE
    cell.admit = mailbox.admit_gone  # Closed before it is drained, so that no ask waits on the dead.
    cell.host.retired(cell)
    kept = cell.node.kept.pop(cell, None)
    if kept is not None:
        kept.given_up(ActorStopped(cell.path, str(why)))
    parent = cell.parent
    if parent is not None and parent.children is not None and parent.children.get(cell.name) is cell:
        del parent.children[cell.name]
    queue, cell.queue = cell.queue, None
    more = cell.more
    if more is not None:
        free_names(cell)  # Of a life that was about to begin: another one's end has freed them already.
        if more.bound is not None:
            waiting, more.bound.waiting = more.bound.waiting, deque()
            for ask in waiting:
                ask.undelivered(cell, str(why))
            more.bound.release()
        links.announce(cell, more.reason, recovering=False)  # Links of a recorded actor wait for this.
        links.gone(cell, more.reason)
        commands: list[Item] = [*(more.calls if more.has_more else ()), *(more.urgent or ())]
        if more.has_more:
            more.calls = []
        more.urgent = None
        for command in commands:
            command.undelivered(cell, str(why))
        if more.tap is not None:
            more.tap.close()
    while queue:
        item = deque.popleft(queue)
        if isinstance(item, Item):
            item.undelivered(cell, str(why))
        else:
            cell.undelivered(item, str(why))


def retire_with_parent(cell: Cell) -> None:
    """The address is given up, for the parent ends; who waits there is told why that is, if it is no mere stop."""
    lives = [cell] if cell.state is DOWN else []
    reasons = (one.more.reason for one in (cell.parent, *lives) if one is not None and one.more is not None)
    reason = next((one for one in reasons if one not in (NORMAL, SHUTDOWN)), None)
    said = "" if reason is None else f": {reason}"
    retire(cell, f"its parent has stopped{said}")


def disown(cell: Cell) -> None:
    """The actor at a cell has another supervisor from now on, and its life goes on; here nobody hears of an end."""
    parent = cell.parent
    assert parent is not None
    if parent.actor is not None:
        parent.actor._child_lost(cell)
    cell.host.place.disowned(cell)
    if parent.children is not None and parent.children.get(cell.name) is cell:
        del parent.children[cell.name]
    cell.parent = cell.spec = None
    tell_enders(cell.extra(), SHUTDOWN)  # Whoever has stopped it does not wait for its end any more.


def parent_ended(cell: Cell) -> bool:
    """Whether it is the supervisor of a retired cell that has ended, and both may be started again."""
    if cell.parent is None or cell.parent.state is RUNNING:
        return False
    above: Cell | None = cell
    while above is not None and above.state is not RUNNING:
        if above.spec is not None and not above.spec.comes_back:
            return False
        above = above.parent
    return True


def may_live_again(cell: Cell) -> bool:
    """Whether an actor is away because its supervisor is, and the system goes on."""
    return parent_ended(cell) and not mailbox.is_over(cell.node)


def nobody_at(cell: Cell) -> ActorStopped:
    """What whoever wants something of an actor that is not there gets."""
    if may_live_again(cell):
        why = "its supervisor has ended, and may start it again"
    else:
        why = mailbox.SYSTEM_ENDED if mailbox.is_over(cell.node) else "nobody lives there"
    return ActorStopped(cell.path, why)


class ChildExit(Item):
    """A child's life has ended: its supervisor decides what follows."""

    __slots__ = ("child", "life", "reason")

    def __init__(self, child: Cell, life: int, reason: ExitReason) -> None:
        self.child, self.life, self.reason = child, life, reason

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        try:
            return actor.child_exited(item.child, item.life, item.reason)
        except Exception as error:
            error.add_note(f"raised while {actor.ctx.path} handled the end of {item.child.path}")
            raise

    def undelivered(self, cell: Cell, reason: str) -> None:
        retire(self.child, "its supervisor has stopped")


# -- ends that are asked for from outside ----------------------------------------------------------------------------


async def stop_in_time(cell: Cell, reason: ExitReason = SHUTDOWN) -> ExitReason:
    """Stop an actor that has no spec to say how: ask, wait, kill."""
    timer = cell.node.loop.call_later(PATIENCE, cell.kill)
    try:
        return await stop_and_wait(cell, reason)
    finally:
        timer.cancel()


def stop_and_wait(cell: Cell, reason: ExitReason = SHUTDOWN) -> asyncio.Future[ExitReason]:
    """Ask for an end in good order; the future has the reason it really ended with."""
    gone = cell.ended()
    cell.request_stop(reason)
    return gone
