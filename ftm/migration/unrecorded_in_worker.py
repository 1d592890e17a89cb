"""Hands over a life without recovery, as the process of its supervisor sees it: leaving, or coming back.

It leaves: the life comes to rest with its state packed, and goes on if the group does not come so far. It comes back:
a new life is begun beside the address, and is disposed of if it is not to be.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ...actors.errors import StartFailed
from ...actors.exit_reasons import unpack_exit
from ...actors.kernel import lifecycle, links
from ...actors.kernel.cell import RUNNING, Cell
from ...actors.kernel.envelope import Ask, Item
from ...actors.kernel.lifecycle import Stop
from ...actors.kernel.links import LifeMonitor
from ...actors.kernel.mailbox import Bound, Bounded
from ...actors.kernel.timers import LoopTimer
from ...actors.kernel.topics import Topics
from ...actors.migration.here import Arrival
from ...actors.migration.luggage import check_sendable, let_come, pack_rest
from ...actors.migration.luggage import unpack as unpack_life
from ...actors.migration.quiesce import PackLife, farewell, now, obey_commands, part, resume, sorted_out
from ...actors.migration.words import say
from ...actors.process.wire.frames import BadFrame
from ...checkpoint.protocol import Respec
from .protected_stand_ins import ChildAtRoot, child_at_root, respec
from .unrecorded_luggage import EarlyAsk, pack, pack_owed, restore_owing, save_owing, unpack

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor
    from ...actors.process.worker_node import Guest


class PlainChild:
    """One attempt to hand the life at an address over, or to take it back."""

    def __init__(self, guest: Guest, path: str, attempt: int) -> None:
        self._guest, self._path, self._attempt = guest, path, attempt
        self._take: PackLife | None = None
        self._cell: Cell | None = None  # where a life is at rest, or comes back to
        self._arrival: Arrival | None = None  # beside it: the life that comes back
        self._held: list[Any] | None = None  # what has been sent to it here meanwhile
        self._owed: dict[int, Any] = {}  # the asks that it has promised to answer
        self._expected: list[int] = []  # the numbers that the root was given for them, while it may stay
        self._watches: list[LifeMonitor] = []  # those that its state holds

    def obey(self, step: str, told: dict[str, Any]) -> None:
        match step:
            case "take":
                self._come_to_rest(for_home=bool(told["for_home"]))
            case "back":
                self._go_on()
            case "leave":
                self._leave(told)
            case "come":
                self._come(told)
            case "stay":
                self._stay()
            case "settle":
                self._settle_in(told)
            case _:
                raise BadFrame(f"the handing over of a child has no step {step!r}")

    def _say(self, step: str, **told: Any) -> None:
        say(self._guest.connection, self._path, self._attempt, step, **told)

    # -- leaving ----------------------------------------------------------------------------------------------------

    def _come_to_rest(self, *, for_home: bool) -> None:
        """`for_home`: its state is packed as a home has it; else as a process takes it, with its handles."""
        cell = self._guest.node.find(self._path)
        if cell is None or cell.state is not RUNNING or cell.host is not self._guest.node.ports.here:
            self._say("refused", why="it is being restarted", has_ended=True)
            return
        at_rest = self._at_rest_for_home if for_home else self._at_rest
        take = PackLife(self._owe, at_rest, lambda why: self._say("refused", why=why))
        self._take, self._cell = take, cell

        def ended(done: asyncio.Future[Any]) -> None:
            if self._take is take and not take.is_done:
                self._say("refused", why="its life has ended", has_ended=True)

        cell.ended().add_done_callback(ended)
        lifecycle.urge(cell, take)

    def _owe(self, ask: Ask) -> int:
        """The number by which the packed state knows an ask that it has promised to answer."""
        number = next((number for number, one in self._owed.items() if one is ask), len(self._owed) + 1)
        self._owed[number] = ask
        return number

    def _at_rest_for_home(self, actor: Actor, state: bytes) -> None:
        """Called in its place between two turns; if this raises, the actor goes on."""
        state, self._owed = save_owing(actor)
        self._at_rest(actor, state, [])

    def _at_rest(self, actor: Actor, state: bytes, owed: list[list[Any]] | None = None) -> None:
        """The same; `owed` is told when it leaves."""
        guest, cell = self._guest, actor.ctx._cell
        check_sendable(cell)
        bound = cell.extra().bound
        rest, stash = pack_rest(actor), pack(guest, cell, cell.extra().stash or ())
        if owed is None:
            owed = pack_owed(guest, self._owed)
            self._expected = [key for _, key, _ in owed]
        room = None if bound is None else [bound.capacity, bound.overflow]
        self._say("taken", at=now(), state=state, rest=rest, stash=stash, owed=owed, bound=room)

    def _go_on(self) -> None:
        take, self._take, cell = self._take, None, self._cell
        if take is None or cell is None:
            return
        take.withdraw(cell)
        for key in self._expected:
            self._guest.pending.pop(key, None)
        self._owed, self._expected = {}, []
        if take.is_done and cell.state is RUNNING:
            resume(cell)

    def _leave(self, told: dict[str, Any]) -> None:
        """It is lived at the root from now on; nobody hears of that but the actor itself."""
        guest, cell, self._take = self._guest, self._cell, None
        assert cell is not None
        more, bound = cell.extra(), cell.extra().bound
        waiting: list[Any] = []
        if bound is not None:
            waiting, bound.waiting = list(bound.waiting), deque()
        old = part(cell)
        items, commands = sorted_out(cell)
        queue, waiting = pack(guest, cell, items), pack(guest, cell, waiting)
        watches = self._hand_ties_over(cell)
        owed = [] if self._expected else pack_owed(guest, self._owed)
        self._say("left", queue=queue, waiting=waiting, owed=owed, watches=watches)
        respec(cell, Respec(**told["spec"]))
        guest.recovery.begins(cell.path)
        place = child_at_root(guest, cell.spec)
        place.home.bound = None if bound is None else Bounded(bound.capacity, bound.overflow)
        more.bound = None
        place.take_up(cell, told["number"])
        if bound is not None:
            bound.release()
        obey_commands(cell, commands)
        farewell(old, Stop(unpack_exit(told["reason"])))

    def _hand_ties_over(self, cell: Cell) -> list[list[Any]]:
        """Links, and monitors that reach out of this process, are the root's from now on; so are subscriptions.

        Returns what it watches in this process: the root hears of that from here.
        """
        more, guest = cell.extra(), self._guest
        assert guest.node.root is not None
        here, watches = f"{guest.node.root.path}/", list[list[Any]]()
        for peer in more.ties.links:
            guest.command(cell, "link", {"peer": peer.path})
        for watch in [one for one in more.ties.watching if one.life == cell.life]:
            if watch.target.path.startswith(here):
                watches.append([watch.target.path, watch.for_good])
            else:
                links.drop_watch(watch)
        more.ties.monitors = [one for one in more.ties.monitors if one.watcher.host is guest.node.ports.here]
        for topic in list(more.belongings.topics):
            Topics.unsubscribe(guest.node.topics, topic, cell)
        return watches

    # -- coming back ------------------------------------------------------------------------------------------------

    def _come(self, told: dict[str, Any]) -> None:
        """Begin the life beside its address; it handles nothing yet."""
        cell = self._guest.node.find(self._path)
        if cell is None or cell.state is not RUNNING or not isinstance(cell.host.place, ChildAtRoot):
            self._say("failed", why="its life has ended")
            return
        start = cell.extra().start
        assert start is not None
        arrival = Arrival(cell)
        self._cell, self._arrival = cell, arrival

        try:
            up = arrival.begin(start, self._restoring(cell, told), trap_exits=told["traps"])
        except StartFailed as error:
            self._fail(arrival, error.reason)
            return
        up.add_done_callback(lambda done: self._is_up(arrival, done))
        arrival.other.ended().add_done_callback(lambda done: self._fail(arrival, str(done.result())))

    def _restoring(self, cell: Cell, told: dict[str, Any]) -> Callable[[Actor], None]:
        """What gives the life that comes its state: that of a home, or that of a process, with its handles."""
        guest, rest = self._guest, told["rest"]
        self._owed = {number: EarlyAsk.early(guest) for number in told["owed"]}
        if rest is None:
            return lambda actor: restore_owing(actor, told["state"], self._owed)

        def watched(path: str, for_good: bool) -> LifeMonitor:
            self._watches.append(LifeMonitor(cell, guest.node.cell_at(path), for_good))
            return self._watches[-1]

        return lambda actor: unpack_life(actor, told["state"], rest, self._owed.__getitem__, watched)

    def _fail(self, arrival: Arrival, why: str) -> None:
        if self._arrival is arrival and self._held is None:  # Else it is the one already, as far as the root knows.
            self._arrival = None
            arrival.discard()
            self._say("failed", why=why)

    def _is_up(self, arrival: Arrival, done: asyncio.Future[None]) -> None:
        error = None if done.cancelled() else done.exception()
        if error is not None:
            self._fail(arrival, error.reason if isinstance(error, StartFailed) else str(error))
        elif self._arrival is arrival and self._cell is not None:
            self._held, self._cell.admit = [], self._hold  # All that was sent before is ahead of what is said now.
            self._say("up")

    def _hold(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit` until it is known where the life goes on."""
        if not isinstance(item, Item) and type(item) not in cell.table:
            cell.require(item)
        assert self._held is not None
        self._held.append(item)

    def _stay(self) -> None:
        """It goes on at the root."""
        cell, arrival, held = self._cell, self._arrival, self._held or []
        self._arrival = self._held = None
        if arrival is not None:
            arrival.discard()
        if cell is None or not isinstance(cell.host.place, ChildAtRoot):
            return
        if cell.admit == self._hold:
            cell.admit = cell.host.place.home.way_home
        for item in held:
            cell.admit(cell, item)

    def _settle_in(self, told: dict[str, Any]) -> None:
        """From here on the new life is the one."""
        guest, cell, arrival, held = self._guest, self._cell, self._arrival, self._held or []
        self._arrival = self._held = None
        assert cell is not None
        assert arrival is not None
        place = cell.host.place
        assert isinstance(place, ChildAtRoot)
        chosen = place.home.bound
        has_ended = arrival.other.state is not RUNNING  # by its background work
        guest.recovery.port_of(self._path).place = None
        cell.host = guest.node.ports.here
        bound = None if chosen is None else Bound(chosen.capacity, chosen.overflow)
        queue, stash, waiting = (unpack(guest, cell, told[name]) for name in ("queue", "stash", "waiting"))
        commands = arrival.take_over(queue, stash, bound, suspended=bool(told["is_suspended"]))
        for number, key, _ in told["owed"]:
            self._owed[number].is_ours(key)
        for name, body, left, interval in told["timers"] if not has_ended else ():
            message = cell.node.codec.decode(cell.table.kind_named(name), body)
            LoopTimer.unpacked(cell, message, max(0.0, left), interval or None, False)
        self._take_ties_over(cell, told)
        respec(cell, Respec([]))
        let_come(cell, (*waiting, *held))
        obey_commands(cell, commands)
        if has_ended:
            lifecycle.ended(cell, arrival.other.extra().reason)
        else:
            lifecycle.up(cell)

    def _take_ties_over(self, cell: Cell, told: dict[str, Any]) -> None:
        node = self._guest.node
        for path in told["links"]:
            links.link(node.cell_at(path), cell)
        for path, for_good in told["monitors"]:
            links.monitor(node.cell_at(path), cell, for_good=for_good)
        kept = list(cell.extra().ties.watching)  # in this process
        for path, for_good in told["watches"]:  # The root keeps those that reach out of it, and tells of their ends.
            own, held = _taken_from(kept, path, for_good), _taken_from(self._watches, path, for_good)
            if own is None or held is not None:
                links.note_watch(held or LifeMonitor(cell, node.cell_at(path), for_good))
                if own is not None:
                    links.drop_watch(own)
        for topic in told["topics"]:
            node.topics.subscribe(topic, cell)


def _taken_from(watches: list[LifeMonitor], path: str, for_good: bool) -> LifeMonitor | None:
    """Such a watch, out of the list; None if there is none."""
    found = next((one for one in watches if one.name == path and one.for_good is for_good), None)
    if found is not None:
        watches.remove(found)
    return found
