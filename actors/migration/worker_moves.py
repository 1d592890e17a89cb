"""Moves as an actor process sees them: an actor that arrives here, or leaves."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from ..errors import HoldfastError, error_text
from ..exit_reasons import ExitReason, Shutdown, unpack_exit
from ..kernel import lifecycle, links, mailbox
from ..kernel.actor import Actor, Start
from ..kernel.cell import RUNNING, Cell, Host
from ..kernel.context import ActorContext
from ..kernel.envelope import Ask, Item
from ..kernel.links import LifeMonitor
from ..process.wire.frames import BadFrame
from ..process.wire.peer import Arrived, RelayedAsk
from ..process.wire.start_codec import unpack_recipe
from .luggage import let_come, pack_items, pack_rest, unpack
from .quiesce import PackLife, Settle, farewell, now, replaced, resume
from .words import Incoming, say

if TYPE_CHECKING:
    from ..kernel.cell import Admit
    from ..process.wire.frames import Migrate
    from ..process.worker_node import Guest


class Attempt(Protocol):
    """One attempt to move one actor into this process or out of it, or to hand it over to the root."""

    def obey(self, step: str, told: dict[str, Any]) -> None:
        """Do the next step. Raises BadFrame: there is no such step."""
        ...


class GuestMoves:
    """The moves of the actors of a process: its own, or those below its supervisor; one attempt at a time for each."""

    def __init__(self, guest: Guest, child_attempt: Callable[[str, int], Attempt]) -> None:
        self._guest, self._child_attempt = guest, child_attempt
        self._attempts: dict[str, tuple[int, Incoming, Attempt]] = {}  # by address: who arrives has no cell yet

    def hear(self, path: str, frame: Migrate) -> None:
        """Do the next step of a move. The words of the root come in order: a new number ends an earlier attempt.

        Raises:
            BadFrame: there is no such step.
        """
        number, incoming, attempt = self._attempts.get(path) or self._made(path, frame.attempt)
        if number != frame.attempt:
            _, incoming, attempt = self._made(path, frame.attempt)
        told = incoming.take(frame)
        if told is not None:
            attempt.obey(frame.step, told)

    def _made(self, path: str, number: int) -> tuple[int, Incoming, Attempt]:
        root = self._guest.node.root
        is_own = root is None or path == root.path  # Else it is of a child of the process's supervisor.
        attempt = GuestMove(self._guest, path, number) if is_own else self._child_attempt(path, number)
        self._attempts[path] = made = number, Incoming(imports=True), attempt
        return made

    def readdressed(self, old: str, new: str) -> None:
        """The process's own actor has another address now; an attempt to move it goes on."""
        known = self._attempts.pop(old, None)
        if known is not None and isinstance(known[2], GuestMove):
            self._attempts[new] = known
            known[2].readdressed(new)

    @staticmethod
    def prepare(recipe: bytes) -> None:
        """Import what an actor needs, and see whether it can be constructed.

        Raises:
            SpecError: its class cannot be imported. TypeError: its arguments do not fit.
        """
        unpack_recipe(recipe).check()

    def begin(self, cell: Cell, start: Start[Any]) -> asyncio.Future[None]:
        """Begin the life of an actor that is moved here; the future ends when it is up. It handles nothing yet.

        Raises:
            HoldfastError, or what `set_state` raises.
        """
        _, _, attempt = self._attempts.get(cell.path, (0, None, None))
        if not isinstance(attempt, GuestMove):
            raise BadFrame("an actor came without its state")
        return attempt.begin(cell, start)


class GuestMove:
    """One attempt to move one actor into this process or out of it."""

    def __init__(self, guest: Guest, path: str, number: int) -> None:
        self._guest, self._path, self._number = guest, path, number
        self._luggage: dict[str, Any] | None = None
        self._take: PackLife | None = None
        self._state = b""
        self._stash: list[Any] = []
        self._admit: Admit | None = None

    def _say(self, step: str, **told: Any) -> None:
        say(self._guest.connection, self._path, self._number, step, **told)

    def readdressed(self, path: str) -> None:
        self._path = path

    def obey(self, step: str, told: dict[str, Any]) -> None:
        if step == "luggage":  # It has no cell yet.
            self._luggage = told
            return
        cell = self._guest.node.cell_at(self._path)
        match step:
            case "stash":
                self._admit, cell.admit = cell.admit, self._put_aside
            case "go":
                self._go(cell, suspended=bool(told["suspended"]))
            case "take":
                self._take = PackLife(_number, self._taken, self._refused, stays=bool(told.get("stays")))
                if cell.state is RUNNING:
                    lifecycle.urge(cell, self._take)
                    self._take.hurry(cell)
            case "pack":
                self._pack(cell)
            case "back":
                self._back(cell)
            case "leave":
                _leave(cell, unpack_exit(told["reason"]))
            case _:
                raise BadFrame(f"a move has no step {step!r}")

    def _put_aside(self, cell: Cell, item: Any) -> None:
        if isinstance(item, Item):
            item.stashed()  # It has no place in the order of arrival.
        self._stash.append(item)

    # -- arriving ---------------------------------------------------------------------------------------------------

    def begin(self, cell: Cell, start: Start[Any]) -> asyncio.Future[None]:
        """Begin the life that arrives.

        Raises:
            HoldfastError, or what `set_state` raises.
        """
        luggage, self._luggage = self._luggage, None
        if luggage is None:
            raise BadFrame("an actor came without its state")
        cell.life += 1
        lifecycle.build(cell, start, ActorContext)
        cell.state = RUNNING
        actor, rest = cell.actor, luggage["rest"]
        assert actor is not None
        watches = [self._watch(cell, path, for_good) for path, for_good in rest["watches"]]
        for path in rest["links"]:
            peer = self._guest.node.cell_at(path)
            cell.extra().ties.links[peer], peer.extra().ties.links[cell] = path, cell.path
        numbers = dict(luggage["owed"])  # Those of the root, for what was packed by other ones.
        unpack(
            actor,
            luggage["state"],
            rest,
            lambda key: self._owed(numbers.get(key, key)),
            lambda path, for_good: _found(watches, path, for_good),
        )
        return await_up(cell, start)

    def _watch(self, cell: Cell, path: str, for_good: bool) -> LifeMonitor:
        return links.note_watch(
            LifeMonitor(cell, self._guest.node.cell_at(path), for_good)
        )  # The root keeps it already.

    def _owed(self, key: int) -> Ask:
        """An ask that the root waits with for its reply."""
        return RelayedAsk(None, None, (), 0.0, 0.0, None, None, True, self._guest, key)

    def _go(self, cell: Cell, *, suspended: bool) -> None:
        if self._admit is not None:
            cell.admit, self._admit = self._admit, None
        more = cell.extra()
        if cell.ctx is not None:
            cell.ctx._keep_promises()
        if self._stash:
            more.stash, self._stash = deque(self._stash), []
        if suspended:
            mailbox.suspend(cell)
        lifecycle.up(cell)
        self._say("began", at=now())

    # -- leaving ----------------------------------------------------------------------------------------------------

    def _taken(self, actor: Actor, state: bytes) -> None:
        self._state = state
        more, owes = actor.ctx._cell.extra(), actor.ctx._owes_turn
        by_user = bool(more.suspended & mailbox.BY_USER)
        self._say("taken", at=now(), trap_exits=more.trap_exits, suspended=by_user, owes_turn=owes)

    def _refused(self, why: str) -> None:
        self._say("refused", why=why)

    def _pack(self, cell: Cell) -> None:
        """Nothing comes any more: send what there is."""
        actor, page = cell.actor, self._guest.page
        assert actor is not None

        def entry(item: Item) -> list[Any] | None:
            if isinstance(item, RelayedAsk):
                return ["ask", item.id]
            if isinstance(item, Arrived) and item.page is page:
                return ["number", item.number]
            return None

        try:
            luggage = {
                "state": self._state,
                "rest": pack_rest(actor),
                "stash": pack_items(cell, cell.extra().stash or (), entry),
                "queue": pack_items(cell, cell.queue or (), entry),
            }
            self._say("packed", **luggage)
        except Exception as error:  # Whatever a message of the actor's own raises while it is encoded.
            why = str(error) if isinstance(error, HoldfastError) else error_text(error)
            self._say("refused", why=why)

    def _back(self, cell: Cell) -> None:
        """The actor stays after all, or is not to be taken any more."""
        take, self._take, self._state = self._take, None, b""
        if take is None:
            return
        take.withdraw(cell)
        if take.is_done and cell.state is RUNNING:
            resume(cell)


class Replaced:
    """The life of an actor whose place another one takes, which lives outside; its cell stands for that from now on."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._life, self._items, self._commands = replaced(cell)

    def hand_on(self, outside: Host) -> None:
        """End, and give the other one, at host `outside`, what waits; the ties that only this process has stay."""
        cell = self._cell
        ties, why = cell.extra().ties, f"moved to {cell.path}"
        ties.monitors = [one for one in ties.monitors if one.watcher.host is not outside]
        for peer in [one for one in ties.links if one.host is outside]:
            links.sever(cell, peer)
        for command in self._commands:
            command.undelivered(cell, why)
        let_come(cell, self._items)
        farewell(self._life, lifecycle.Stop(Shutdown(why)))


def hand_on_stash(cell: Cell, to: Cell) -> None:
    """Give another actor, which has taken the place of one, what that one has put aside."""
    stash, cell.extra().stash = cell.extra().stash, None
    let_come(to, stash or ())


def _leave(cell: Cell, reason: ExitReason) -> None:
    """The actor lives elsewhere: what is left here ends, and tells nobody."""
    more = cell.extra()
    for kept in (more.ties.links, more.belongings.topics, more.ties.monitors):
        kept.clear()
    if cell.queue is not None:
        cell.queue.clear()
    more.urgent = more.stash = None
    if cell.ctx is not None:
        cell.ctx._hand_on_promises()
    cell.request_stop(reason)
    lifecycle.up(cell)


def await_up(cell: Cell, start: Start[Any]) -> asyncio.Future[None]:
    """Have `on_start(True)` run as the first turn of a built life, and the life hold still behind it."""
    loop, more = cell.node.loop, cell.extra()
    settled: asyncio.Future[None] = loop.create_future()
    queue = mailbox.queue_of(cell)
    queue.appendleft(Settle(settled))
    if start.kind.on_start is not Actor.on_start:
        more.starting = loop.create_future()
        more.starting.add_done_callback(lambda done: _failed(done, settled))
        queue.appendleft(lifecycle.FirstTurn(True, more.starting))
    cell.scheduled = False
    cell.schedule()
    return settled


def _failed(started: asyncio.Future[None], settled: asyncio.Future[None]) -> None:
    error = None if started.cancelled() else started.exception()
    if error is not None and not settled.done():
        settled.set_exception(error)
        settled.exception()  # Seen: whoever waits may have given up.


def _number(ask: Ask) -> int:
    """The number under which the root knows an ask."""
    if not isinstance(ask, RelayedAsk):
        raise HoldfastError("it can answer itself only here")
    return ask.id


def _found(watches: list[LifeMonitor], path: str, for_good: bool) -> LifeMonitor:
    return next(watch for watch in watches if watch.name == path and watch.for_good is for_good)
