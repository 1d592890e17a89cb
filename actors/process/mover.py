"""One move of a live actor: made ready, brought to rest, carried over, and let go in one place; or undone.

At each instant one of the two lives may handle messages, and this process decides which. The new life is up, and has
handled nothing, when it becomes the one; until then the old one is only at rest.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, TypeVar

from .. import lives, mailbox
from ..cell import RUNNING, Cell, Host
from ..context import ActorContext
from ..control.calls import Call, OrderAsk
from ..control.luggage import check_sendable, pack_rest, unpack, unpack_items
from ..control.moving import (
    Take,
    Transit,
    decoded,
    farewell,
    now,
    obey_commands,
    part,
    resume,
    settle,
    sorted_out,
    twin,
)
from ..errors import AskFailed, BadMessage, CannotMove, StartFailed, error_text
from ..exits import KILLED, ExitReason, Shutdown
from ..links import Monitor
from ..lives import PATIENCE, Stop
from ..mail import Ask
from . import frames
from .moves import Luggage, await_up, send_luggage
from .recipe import pack_recipe
from .remote import Outlet, ProcessHost, RemoteBound, admit_remote, admit_remote_bounded, undelivered

if TYPE_CHECKING:
    from ..actor import Actor
    from .workers import Worker, Workers

T = TypeVar("T")
LATE = 1.0
"""Seconds to wait for a moved actor's process to say when it went on."""


class Move:
    """One move; `run` carries it out."""

    to: str

    def __init__(self, cell: Cell, host: Host, timeout: float) -> None:
        self.cell, self.host, self.timeout = cell, host, timeout
        self.node = cell.node
        self.given_up: asyncio.Future[str] = self.node.loop.create_future()
        self.transit: Transit | None = None
        self.rest_at = self.gone_on_at = 0.0
        self.is_done = False
        self.is_late = False  # its life has ended before it was at rest
        self.moved: Callable[[], None] = lambda: None  # called at once when the new life is the one
        self._start = cell.extra().start

    async def run(self) -> None:
        """Move the actor.

        Raises:
            CannotMove, StartFailed, ProcessUnavailable: why it stays; it goes on as if nothing had been.
        """
        ended = self.cell.ended()
        ended.add_done_callback(self._life_ended)
        try:
            await self.prepare()
            await self.take()
            await self.carry()
        except BaseException as error:
            if not self.is_done:
                self.undo()
            if isinstance(error, StartFailed):
                raise CannotMove(self.cell.path, f"its new life could not begin ({error.reason})") from error
            raise
        finally:
            enders = self.cell.extra().enders
            if ended in enders:
                enders.remove(ended)

    def _life_ended(self, ended: asyncio.Future[ExitReason]) -> None:
        self.is_late = True
        self.give_up("its life has ended")

    async def prepare(self) -> None:
        """Make the new place ready."""

    async def take(self) -> None:
        """Bring the old life to rest."""
        raise NotImplementedError

    async def carry(self) -> None:
        """Bring the new life up, and make it the one."""
        raise NotImplementedError

    def undo(self) -> None:
        """The old life goes on."""
        raise NotImplementedError

    def give_up(self, why: str) -> None:
        """Whatever the move waits for: it is not to be."""
        if not self.given_up.done():
            self.given_up.set_result(why)

    async def within(self, work: Awaitable[T], seconds: float, why: Any) -> T:
        """What comes of `work`.

        Raises:
            CannotMove: nothing within the time, or the move was given up.
        """
        future = asyncio.ensure_future(work)
        try:
            await asyncio.wait((future, self.given_up), timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:
            future.cancel()
            raise
        if future.done() and (not self.given_up.done() or future.exception() is not None):
            return future.result()
        future.cancel()
        if self.given_up.done():
            raise CannotMove(self.cell.path, self.given_up.result())
        raise CannotMove(self.cell.path, f"{why()} within {seconds:g} s")

    def at_rest(self) -> None:
        """The old life handles nothing any more."""
        self.transit = Transit(self.cell.host, self.give_up)
        self.cell.host = self.transit

    def reason(self) -> ExitReason:
        """What the old life's `on_stop` is told."""
        return Shutdown(f"moved to {'a process' if self.to == 'process' else 'a task'}")


class ToProcess(Move):
    """From a task to a process of its own."""

    to = "process"

    def __init__(self, cell: Cell, host: ProcessHost, timeout: float, workers: Workers, limits: Any) -> None:
        super().__init__(cell, host, timeout)
        self.workers, self.limits = workers, limits
        self.worker: Worker | None = None
        self.recipe = b""
        self._take: Take | None = None
        self._luggage: dict[str, Any] = {}
        self._taken: asyncio.Future[None] = self.node.loop.create_future()
        self._began: asyncio.Future[float] = self.node.loop.create_future()
        self._topics: set[str] = set()
        self._links: set[Cell] = set()
        self._watches: set[Monitor] = set()

    async def prepare(self) -> None:
        start = self.cell.extra().start
        assert start is not None
        self.workers.want(start.kind.__module__)
        self.recipe = pack_recipe(start, self.cell.path)
        worker = self.worker = await self.workers.take()
        worker.reserve(
            self.cell, self.limits, lambda cell, reason: self.give_up(f"the new process has died ({reason})")
        )
        worker.on_move = self._said
        await self.within(worker.prepare(self.cell, self.recipe), 60.0, lambda: "the new process was not ready")

    def _said(self, data: dict[str, Any]) -> None:
        if data.get("step") == "began" and not self._began.done():
            self._began.set_result(float(data["at"]))

    async def take(self) -> None:
        worker = self.worker
        assert worker is not None
        take = self._take = Take(worker.expect, self._at_rest, self.give_up)
        lives.urge(self.cell, take)
        await self.within(self._taken, self.timeout, lambda: f"{take.why}, and that did not change")

    def _at_rest(self, actor: Actor, state: bytes) -> None:
        """Called in its place between two turns; if this raises, the actor goes on."""
        if self.given_up.done():
            raise CannotMove(self.cell.path, self.given_up.result())
        if self.cell.extra().start is not self._start:
            raise CannotMove(self.cell.path, "its code was replaced meanwhile; try again")
        self.rest_at = now()
        self.pack(actor, state)
        self.at_rest()
        self._taken.set_result(None)

    def pack(self, actor: Actor, state: bytes) -> None:
        """Pack what the actor takes along."""
        check_sendable(self.cell)
        self._luggage = {"state": state, "rest": pack_rest(actor)}

    async def carry(self) -> None:
        cell, worker, more = self.cell, self.worker, self.cell.extra()
        assert worker is not None
        self.remember()
        send_luggage(worker.connection, cell.path, "luggage", self._luggage)
        launched = worker.launch(cell, self.recipe, {"bounded": more.bound is not None, "moved": True})
        await self.within(launched, self.timeout, lambda: "its new life was not up")
        if not worker.is_alive():
            raise CannotMove(cell.path, "the new process has died")
        self._commit(worker)
        await self.went_on()

    def remember(self) -> None:
        """What belongs to the address: a new life that fails may have added to it."""
        more = self.cell.extra()
        self._topics, self._links, self._watches = set(more.topics), set(more.links), set(more.watching)

    async def went_on(self) -> None:
        """Wait for the process to say when the actor went on."""
        self.gone_on_at = now()
        done, _ = await asyncio.wait((self._began,), timeout=LATE)
        if done:
            self.gone_on_at = self._began.result()

    def _commit(self, worker: Worker) -> None:
        """From here on the new life is the one."""
        cell, host, more = self.cell, self.host, self.cell.extra()
        assert isinstance(host, ProcessHost)
        assert self.transit is not None
        self.is_done = True
        suspended, stash = more.suspended, list(more.stash or ())
        old = part(cell)
        items, commands = sorted_out(cell)
        tap = more.tap
        if tap is not None:
            tap.detach()
        outlet = more.outlet = Outlet(cell.path)
        cell.admit = admit_remote
        if more.bound is not None:
            more.bound = RemoteBound(more.bound).inherit(more.bound)
            cell.admit = admit_remote_bounded
        worker.adopt(cell, None, host.died)
        _unpack_there(cell, worker, stash, suspended=suspended)
        outlet.worker = worker
        calls = [item for item in items if isinstance(item, Call)]
        cell.queue = deque(item for item in items if not isinstance(item, Call))
        send_queue(cell)
        worker.connection.flush()
        if tap is not None:
            tap.attach()
        self.transit.over(cell, host)
        obey_commands(cell, [*commands, *calls])
        farewell(old, Stop(self.reason()))
        self.moved()

    def undo(self) -> None:
        cell, worker = self.cell, self.worker
        if self._take is not None:
            self._take.is_void = True
        if worker is not None:
            worker.give_back()
        transit = self.transit
        if transit is None:
            return
        more = cell.extra()
        for topic in set(more.topics) - self._topics:
            cell.node.topics.unsubscribe(topic, cell)
        for peer in set(more.links) - self._links:
            peer.extra().links.pop(cell, None)
            del more.links[peer]
        for watch in set(more.watching) - self._watches:
            watch.cancel()
        self.stay(transit)

    def stay(self, transit: Transit) -> None:
        """The old life goes on."""
        transit.over(self.cell, transit.old)
        resume(self.cell)


def _unpack_there(cell: Cell, worker: Worker, stash: list[Any], *, suspended: bool) -> None:
    """Have the life in the process take up its stash, and go on."""
    connection = worker.connection

    def step(**data: Any) -> None:
        connection.send(frames.Command(connection.name_out(cell.path), "move", data))

    if stash:
        step(step="stash")
        for item in stash:
            worker.send_item(cell, cell.path, item, 0)
    step(step="go", suspended=suspended)


def send_queue(cell: Cell) -> None:
    """Send what is queued to the process of the actor."""
    more, queue = cell.extra(), cell.queue
    outlet: Outlet = more.outlet
    if isinstance(more.bound, RemoteBound):
        more.bound.recount(cell)
        more.bound.send(cell)
        _let_in(cell, more.bound)
        return
    while queue:
        item = queue.popleft()
        try:
            outlet.hand_over(cell, item)
        except BadMessage as error:
            undelivered(cell, item, error)


def _let_in(cell: Cell, bound: mailbox.Bound) -> None:
    """Some of those who waited for room may have it now."""
    bound.count += 1
    bound.taken(cell)


class FromProcess(Move):
    """From a process of its own to a task; what recorded and other actors have in common."""

    to = "task"

    def __init__(self, cell: Cell, host: Host, timeout: float, worker: Worker) -> None:
        super().__init__(cell, host, timeout)
        self.worker = worker
        self.taken: asyncio.Future[None] = self.node.loop.create_future()
        self.dead: ExitReason | None = None  # the old process has died meanwhile
        self.trap_exits = self.suspended = False

    async def take(self) -> None:
        self.worker.on_move = self._said
        self.say("take")
        await self.within(
            self.taken, self.timeout, lambda: "it did not come to rest: a turn or background work goes on"
        )

    def say(self, step: str) -> None:
        """Tell the old process."""
        connection = self.worker.connection
        connection.send(frames.Command(connection.name_out(self.cell.path), "move", {"step": step}))
        connection.flush()

    def _said(self, data: dict[str, Any]) -> None:
        match data.get("step"):
            case "refused":
                self.give_up(str(data["why"]))
            case "taken" if not self.given_up.done():
                self.rest_at = float(data["at"])
                self.trap_exits, self.suspended = bool(data["trap_exits"]), bool(data["suspended"])
                self.at_rest()
                self.worker.on_death(self.old_died)
                self.left()
            case "packed":
                self.packed(data)
            case _:
                pass

    def left(self) -> None:
        """The old life is at rest, and the root knows it."""
        raise NotImplementedError

    def packed(self, data: dict[str, Any]) -> None:
        """A piece of what it takes along has come."""

    def old_died(self, cell: Cell, reason: ExitReason) -> None:
        """The old process ends while its actor is being carried over: that matters only if it was to stay."""
        self.dead = reason
        if reason == KILLED:
            self.give_up("it is killed")
        if not self.taken.done():
            self.give_up(f"its process has died ({reason})")

    def leave(self) -> None:
        """What is left in the old process ends; orders that it has not carried out come here."""
        worker, cell = self.worker, self.cell
        calls = [ask.call for ask in worker.pending.values() if isinstance(ask, OrderAsk) and ask.call is not None]
        worker.pending = {
            key: ask for key, ask in worker.pending.items() if not (isinstance(ask, OrderAsk) and ask.call is not None)
        }
        worker.leave(cell, self.reason(), PATIENCE)
        for call in calls:
            if not call.ask.is_done:
                call.ask.started = False
                cell.host.control(cell, call)
        old = self.transit.old if self.transit is not None else None
        if isinstance(old, ProcessHost) and old.stop_sent is not None:  # It came when the actor was at rest already.
            cell.host.stop(cell, old.stop_sent)


class ToTask(FromProcess):
    """From a process of its own to a task."""

    def __init__(self, cell: Cell, host: Host, timeout: float, worker: Worker) -> None:
        super().__init__(cell, host, timeout, worker)
        self._incoming = Luggage()
        self._luggage: dict[str, Any] = {}
        self._queued: list[Any] = []
        self._stash: list[Any] = []
        self._asks: dict[int, Ask] = {}
        self._twin: Cell | None = None
        self._left_behind: tuple[list[Any], list[Any]] = [], []

    def left(self) -> None:
        outlet: Outlet = self.cell.extra().outlet
        outlet.worker = None  # Messages wait here from now on.
        self.say("pack")  # Behind everything that was sent: all that is there is packed.

    def packed(self, data: dict[str, Any]) -> None:
        try:
            luggage = self._incoming.take(data)
            if luggage is None:
                return
            cell, outlet = self.cell, self.cell.extra().outlet
            numbers, self._asks = dict(outlet.flight), dict(self.worker.pending)

            def known(entry: list[Any]) -> Any:
                return self._asks.get(entry[1]) if entry[0] == "ask" else numbers.get(entry[1])

            self._luggage = luggage
            self._stash = unpack_items(cell, luggage["stash"], known)
            self._queued = unpack_items(cell, luggage["queue"], known)
        except Exception as error:  # What a class of the state raises when it is read.
            self.give_up(error_text(error))
            return
        if not self.taken.done():
            self.taken.set_result(None)

    def old_died(self, cell: Cell, reason: ExitReason) -> None:
        outlet: Outlet = cell.extra().outlet
        outlet.worker = self.worker  # Its page is still there.
        self._left_behind = outlet.close()
        if self.taken.done():
            self.worker.take_pending()  # They are among what we carry; if not, they are failed by `undo`.
        super().old_died(cell, reason)

    async def carry(self) -> None:
        cell, start = self.cell, self.cell.extra().start
        assert start is not None
        other = self._twin = twin(cell)
        other.table = start.kind._table
        its = other.extra()
        its.bindings = cell.extra().bindings
        lives.build(other, start, ActorContext)
        actor, rest = other.actor, self._luggage["rest"]
        assert actor is not None
        try:
            unpack(actor, self._luggage["state"], rest, self._asks.__getitem__, self._watched)
        except Exception as error:
            raise StartFailed(cell.path, f"its state could not be restored: {error_text(error)}") from error
        gone = other.ended()
        settled = await_up(other, start)
        gone.add_done_callback(lambda done: _fail(settled, cell, done.result()))
        await self.within(settled, self.timeout, lambda: "its new life was not up")
        self._commit(other)

    def _watched(self, path: str, for_good: bool) -> Monitor:
        watching = self.cell.extra().watching
        return next(watch for watch in watching if watch.target.path == path and watch.for_good is for_good)

    def _commit(self, other: Cell) -> None:
        """From here on the new life is the one."""
        cell, more = self.cell, self.cell.extra()
        assert self.transit is not None
        self.is_done = True
        tap = more.tap
        if tap is not None:
            tap.detach()
        held, commands = sorted_out(cell)
        own, own_commands = sorted_out(other, ticks=True)
        settle(other, cell)
        more.outlet = None
        cell.admit = mailbox.admit_first
        if more.bound is not None:
            bound, more.bound = more.bound, mailbox.Bound(more.bound.capacity, more.bound.overflow).inherit(more.bound)
            assert bound is not more.bound
            cell.admit = mailbox.admit_bounded
        queue = mailbox.queue_of(cell)
        items = (decoded(cell, item) for item in (*own, *self._queued, *held))
        queue.extend(item for item in items if item is not None)
        if more.bound is not None:
            more.bound.count = sum(map(mailbox.counts, queue))
            _let_in(cell, more.bound)
        stash = [kept for item in self._stash if (kept := decoded(cell, item)) is not None]
        more.stash = deque(stash) if stash else None
        if self.suspended:
            more.suspended = True
            mailbox.hold(cell)
        if tap is not None:
            tap.attach()
        self.worker.take_pending() if self.dead is not None else self._keep_orders()
        self.transit.over(cell, self.host)
        self.leave()
        obey_commands(cell, [*own_commands, *commands])
        lives.up(cell)
        self.gone_on_at = now()
        self.moved()

    def _keep_orders(self) -> None:
        """What is asked of the actor is answered here from now on; the old process answers nothing."""
        pending = self.worker.pending
        for key, ask in list(pending.items()):
            if not isinstance(ask, OrderAsk):
                del pending[key]

    def undo(self) -> None:
        cell, worker, transit = self.cell, self.worker, self.transit
        if self._twin is not None:
            dispose(self._twin)
        if transit is None:
            worker.on_move = lambda data: None
            self.say("back")
            return
        host, outlet = transit.old, cell.extra().outlet
        assert isinstance(host, ProcessHost)
        if self.dead is None:
            worker.on_move = lambda data: None
            self.say("back")
            worker.on_death(host.died)
            outlet.worker = worker
            send_queue(cell)
            transit.over(cell, host)
            return
        begun, queued = self._left_behind
        mailbox.queue_of(cell).extendleft(reversed(queued))
        again = {id(item) for item in queued}
        for ask in (*(item for item in begun if isinstance(item, Ask)), *self._asks.values()):
            if id(ask) not in again:
                ask.fail(AskFailed(cell.path, str(self.dead)))
        cell.host = host
        host.died(cell, self.dead)
        transit.over(cell, host)


def _fail(settled: asyncio.Future[None], cell: Cell, reason: ExitReason) -> None:
    """The new life has ended before it was the one."""
    if not settled.done():
        settled.set_exception(StartFailed(cell.path, str(reason)))
        settled.exception()


def dispose(other: Cell) -> None:
    """End a new life that is not to be."""
    if other.state is not RUNNING or other.actor is None:
        return
    if other.more is not None and other.more.turn is not None:
        other.kill()
    else:
        lives.killed(other)
