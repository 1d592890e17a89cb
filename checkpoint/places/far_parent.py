"""Addresses below a supervisor that lives in another process; their homes are here at the root.

The supervisor in the process wants a child started; the home gives it back what it had, and the life is lived there, or
here at the root, in a process of its own or by replicas. When the supervisor's process dies, the homes keep what they
hold until the subtree has been started again; lives at the root end with it, for nobody is left who would stop them.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from ...actors.control.orders_lane import QueuedOrder, send_call
from ...actors.errors import HoldfastError, StartFailed, StartIgnored
from ...actors.exit_reasons import ExitReason, pack_exit, unpack_exit
from ...actors.kernel import lifecycle, links
from ...actors.kernel.actor import Start
from ...actors.kernel.address_host import AddressHost, Parent, Place
from ...actors.kernel.bindings import claim, doubt
from ...actors.kernel.cell import DOWN, GONE, RUNNING, Cell, Host
from ...actors.kernel.mailbox import Bound
from ...actors.process.process_host import RemoteBound
from ...actors.process.stand_ins import know
from ...actors.process.wire import frames
from ...actors.process.wire.start_codec import pack_recipe
from ...actors.process.worker_pool import Worker, Workers
from ..home.homes import Homes
from ..home.journal_home import Entered, JournalHome
from ..home.life_ports import RemoteLife
from ..method import hybrid
from ..protocol import AtRoot, Begin, Closed, Over, Respec, Started, ToHome, Wanted
from ..turn_word import input_of, is_innocent, may_have_begun

STOPPED_STARTING = "it was stopped while it started"

Lives = Callable[["FarParent", Cell, Wanted, Host], AddressHost]
"""Gives the host of a life that is to be lived at the root, from the address's last one.

Raises HoldfastError: it cannot be had."""


class FarParent(Parent):
    """The supervisor of an address, in another process: it wants lives, and hears how they begin and end."""

    def __init__(
        self, homes: Homes, workers: Workers, path: str, lives: Lives, vacated: Callable[[FarParent], None]
    ) -> None:
        self.homes, self.workers, self.path, self._lives, self._vacated = homes, workers, path, lives, vacated
        home = JournalHome(homes, hybrid(), self)  # The method is known when a life is wanted.
        self.below = AddressHost(home, SlotPlace(self, home), self)
        self.cell: Cell | None = None
        self.worker: Worker | None = None  # the supervisor's process
        self.slot = 0  # the place on its page; 0 if there was none left
        self.wanted: Wanted | None = None  # the life that is begun or lived
        self.arriving: Callable[[ToHome], None] | None = None  # hears a life that is on its way there
        self.on_lost: Callable[[ExitReason], None] | None = None  # hears that the process of such a life has died
        self._next: Wanted | None = None  # begins when nothing is left of the last life
        self._top: Cell | None = None
        self._starting: asyncio.Future[None] | None = None
        self._last: tuple[ExitReason, Callable[[bool | None], None]] | None = None  # a life has ended: it was told
        self._is_restarting = False  # it is the supervisor that has ended
        self._beginning: tuple[AtRoot, list[str]] = AtRoot(b"", []), []  # of a life at the root, and the topics of any
        self._visitor: Visitor | None = None  # who may come to live here, with its life

    @property
    def home(self) -> JournalHome:
        """The home of lives in the supervisor's process."""
        home = self.below.home
        assert isinstance(home, JournalHome)
        return home

    @property
    def is_at_root(self) -> bool:
        """Whether the life is lived here, though the supervisor is not."""
        return self.cell is not None and self.cell.host.place is not self.below.place

    def joined(self, top: Cell, worker: Worker, slot: int) -> None:
        """The process that the next lives are wanted in."""
        if worker is not self.worker and self.cell is not None and not self.is_at_root:
            doubt(self.cell)
        self._top, self.worker, self.slot = top, worker, slot

    def port(self) -> RemoteLife:
        """The way to the supervisor, and to a life in its process."""
        assert self.worker is not None
        return RemoteLife(self.path, self.worker)

    # -- what the supervisor says -----------------------------------------------------------------------------------

    def hear(self, worker: Worker, record: ToHome) -> None:
        """Take what the supervisor says, or a life in its process."""
        if worker is not self.worker:
            return
        if isinstance(record, Wanted):
            self._begin(record)
        elif self.arriving is not None:
            self.arriving(record)
        elif isinstance(record, Closed):
            self._hear_closed(record)
        elif self.home.switch is not None and self.wanted is not None and not self.is_at_root:
            self.home.switch.from_life(record)

    def _begin(self, wanted: Wanted) -> None:
        """Bring the actor back: its state, what it has handled since, what waits."""
        if self._visitor is not None:
            self._visitor.wanted = wanted
            return
        left = self._left()
        if left:
            self._next = wanted
            asyncio.gather(*left, return_exceptions=True).add_done_callback(lambda _: self._begin_next(wanted))
            return
        worker, top = self.worker, self._top
        assert worker is not None
        assert top is not None
        self.wanted, self._last, self._is_restarting = wanted, None, False
        self._beginning = self._beginning[0], wanted.topics
        if self.cell is not None and self.cell.state is GONE:
            self.cell = None
        cell = self.cell = worker.inner.homed(top, self.path, self.cell, self.below)
        cell.spec = wanted  # Somebody restarts it: it is not dead between two lives.
        know(cell, wanted.kind)
        claim(cell, wanted.bindings)
        if wanted.bound is not None and not isinstance(cell.extra().bound, RemoteBound):
            cell.extra().bound = Bound(wanted.bound.capacity, wanted.bound.overflow)
        try:
            if wanted.register is not None:
                cell.node.name_life(cell, wanted.register)
            host = self._host_for(cell, wanted)
            cell.host = host
            context = cell.node.base_context.copy()  # Not in that of the socket, which is whoever's had the process.
            starting = context.run(host.start, cell)
        except HoldfastError as error:  # What is recorded does not fit its class, among others.
            self._tell_start(wanted, error)
            return
        assert starting is not None
        self._starting = starting
        starting.add_done_callback(lambda done: self._has_started(wanted, done))

    def _begin_next(self, wanted: Wanted) -> None:
        if self._next is wanted:
            self._next = None
            self._begin(wanted)

    def _left(self) -> list[asyncio.Future[Any]]:
        """What has to come to its end before another life may begin."""
        cell = self.cell
        if cell is None or not self.is_at_root:
            return []
        left = cell.host.place.left(cell)
        return [*left, cell.ended()] if cell.state is RUNNING and not left else left

    def _host_for(self, cell: Cell, wanted: Wanted) -> AddressHost:
        if wanted.at_root is None:
            self.home.method = wanted.method
            return self.below
        self._beginning = wanted.at_root, wanted.topics
        return self._lives(self, cell, wanted, cell.host)

    def _has_started(self, wanted: Wanted, done: asyncio.Future[None]) -> None:
        error: BaseException | None = StartFailed(self.path, STOPPED_STARTING) if done.cancelled() else done.exception()
        self._tell_start(wanted, error)

    def _tell_start(self, wanted: Wanted, error: BaseException | None) -> None:
        if self.wanted is not wanted:
            return
        problem = "" if error is None else error.reason if isinstance(error, StartFailed) else str(error)
        if error is not None and wanted.at_root is not None:
            self.wanted = None
        self.port().to_life(Started(wanted.number, problem, isinstance(error, StartIgnored)))

    def _hear_closed(self, record: Closed) -> None:
        """It has heard of the end of a life, or gives up its start."""
        if self._visitor is not None:
            self._visitor.wanted = None
        elif self._next is not None:
            self._next = None  # There was none yet.
        elif self.wanted is None or record.number != self.wanted.number or self.cell is None:
            return
        elif self.is_at_root:
            self._end_unwanted(unpack_exit(record.reason), recovers=record.recovers)
        else:
            running = self.below.place.running(self.cell)
            self._over_below(unpack_exit(record.reason), running, recovers=record.recovers)

    def lost(self, worker: Worker, reason: ExitReason, *, one_works: bool) -> bool:
        """The supervisor has died with its process, and the lives there too.

        Args:
            one_works: there was a turn in one of them that did not wait.

        Returns:
            Whether a turn of the life here has ended the process, as far as anybody knows.
        """
        if worker is not self.worker:
            return False
        self._next = None
        if self._visitor is not None:
            self._visitor.wanted = None
        if self.on_lost is not None:
            self.on_lost(reason)
        if self.wanted is None or self.cell is None:
            return False
        if self.is_at_root:
            self._end_unwanted(reason, recovers=True)
            return False
        running, switch = self.below.place.running(self.cell), self.home.switch
        is_blameless = is_innocent(worker.page[self.slot], reason, one_works=one_works)
        has_ended_it = running >= 0 and not is_blameless and switch is not None and switch.life.is_released
        self._over_below(reason, running, ordered=is_blameless, noticed=worker.end.noticed_at)
        return has_ended_it

    # -- the end of a life ------------------------------------------------------------------------------------------

    def _over_below(
        self,
        reason: ExitReason,
        running: int,
        *,
        recovers: bool = True,
        ordered: bool = True,
        noticed: float | None = None,
    ) -> None:
        """The life in its process is over: tell whom it concerns here."""
        cell, home = self.cell, self.home
        self.wanted = None
        if cell is None or cell.state is not RUNNING:
            return
        recovers = recovers and home.recovers(reason)
        home.over(
            cell, running, str(reason), ordered=ordered, noticed=noticed, reason=reason, recovers=recovers
        )  # fmt: skip
        _tell_end(cell, reason, recovers=recovers)

    def _end_unwanted(self, reason: ExitReason, *, recovers: bool) -> None:
        """Nobody wants the life at the root any more, however far it has come."""
        self.wanted = None
        assert self.cell is not None
        if self._last is not None:
            self._close(recovers=recovers)
        else:
            self.cell.host.place.end(self.cell, reason)

    def life_over(self, cell: Cell, reason: ExitReason, over: Callable[[bool | None], None]) -> None:
        self._last = reason, over
        is_starting = self._starting is not None and not self._starting.done()
        if self.wanted is None or is_starting:  # That is told by how the start went.
            self._close(recovers=True)
        else:
            self.port().to_life(Over(self.wanted.number, pack_exit(reason)))

    def _close(self, *, recovers: bool) -> None:
        """The life at the root is over, and it is known what follows: tell whom it concerns here."""
        cell, last, self._last = self.cell, self._last, None
        if last is None or cell is None or cell.state is not RUNNING:
            return
        reason, over = last
        recovers = recovers and cell.host.recovers(reason)
        over(recovers)
        cell.extra().suspended = 0
        _tell_end(cell, reason, recovers=recovers)

    @property
    def has_ended(self) -> bool:
        """Whether the life at the root has ended, and the supervisor has not answered yet."""
        return self._last is not None

    # -- what is asked of a parent ----------------------------------------------------------------------------------

    def recipe(self, cell: Cell) -> Start[Any] | bytes:
        return self._beginning[0].recipe

    def topics(self, cell: Cell) -> Iterable[str]:
        return self._beginning[1]

    def is_restarting(self, cell: Cell) -> bool:
        return self._is_restarting

    @property
    def has_lost(self) -> bool:
        return self.wanted is None and self._next is None

    def begins_without(self, cell: Cell) -> None:
        if not self.has_lost or self.cell is not cell:
            return
        left = self._left()
        if left:  # Else who has asked what was in hand would hear that it was not begun.
            asyncio.gather(*left, return_exceptions=True).add_done_callback(lambda _: self.begins_without(cell))
        else:
            self.leaves(is_restarting=True)
            lifecycle.retire(cell, "its supervisor has ended")

    def leaves(self, *, is_restarting: bool) -> None:
        self._is_restarting = is_restarting

    def respecified(self, cell: Cell, spec: dict[str, Any]) -> None:
        if self.worker is not None:
            self.port().to_life(Respec(**spec))

    def begins_with(self, cell: Cell, start: Start[Any]) -> None:
        if self.is_at_root:  # Else the process in which it lives has heard of it first.
            self.respecified(cell, {**cell.host.place.spec_data(cell), "start": pack_recipe(start, self.path)})

    def retired(self, cell: Cell) -> None:
        left = cell.host.place.left(cell) if self.is_at_root else []
        if self.is_at_root:
            self.wanted = None
        if left:
            asyncio.gather(*left, return_exceptions=True).add_done_callback(lambda _: self._vacate(cell))
        else:
            self._vacate(cell)

    def _vacate(self, cell: Cell) -> None:
        """The address is free: nothing need be known of it here, unless something is under way."""
        if self.cell is cell and self._next is None and self.arriving is None:
            self._vacated(self)

    # -- actors that come with their lives from another supervisor, or leave for one --------------------------------

    def expect(self) -> None:
        """An actor may come to live here: the life that the supervisor wants is not begun, but waits for it."""
        if self._visitor is None:
            self._visitor = Visitor()

    @property
    def is_expected(self) -> bool:
        """Whether the supervisor wants a life for the actor that may come."""
        return self._visitor is not None and self._visitor.wanted is not None

    def expect_nobody(self) -> None:
        """Nobody comes; the supervisor has given up the life that it wanted, or has ended."""
        self._visitor = None

    def take(self, cell: Cell) -> None:
        """The actor has come: its life is the one that was wanted."""
        visitor, self._visitor = self._visitor, None
        assert visitor is not None
        assert self.worker is not None
        wanted = visitor.wanted
        assert wanted is not None
        assert wanted.at_root is not None
        self.cell, self.wanted, self._last, self._is_restarting = cell, wanted, None, False
        self._beginning = wanted.at_root, wanted.topics
        self.worker.inner.adopt(self.path, cell)
        cell.host.handed_to(self)
        self.port().to_life(Started(wanted.number))

    def give_away(self, parent: Parent) -> None:
        """The actor has another supervisor, and another address, from now on."""
        cell = self.cell
        assert cell is not None
        cell.host.handed_to(parent)
        if self.worker is not None:
            self.worker.disown(cell, self.path)
        self.cell = self.wanted = None
        self._vacated(self)

    def why_busy(self, cell: Cell) -> str:
        """Why the life at the root cannot be given to another supervisor at this instant; "" if it can."""
        is_starting = self._starting is not None and not self._starting.done()
        if self.cell is not cell or self.wanted is None or self.has_ended or is_starting or cell.state is not RUNNING:
            return f"{self.path} is being restarted"
        return ""

    # -- lives that move while they are lived -----------------------------------------------------------------------

    def prepare(self, made: AtRoot, topics: list[str]) -> None:
        """A life is to come to the root, of an actor that begins so."""
        self._beginning = made, topics

    @property
    def number(self) -> int:
        """That under which the supervisor wants the present life; -1 if it wants none."""
        return -1 if self.wanted is None else self.wanted.number

    @property
    def starting(self) -> asyncio.Future[None] | None:
        """The start that is under way, or the last one; its supervisor hears of its end."""
        return self._starting

    def comes_to_root(self, cell: Cell, wanted: Wanted) -> None:
        """The life is lived at the root from now on."""
        self.cell = cell
        self.wanted = msgspec.structs.replace(wanted, at_root=self._beginning[0])

    def goes_back(self, cell: Cell) -> None:
        """The life is lived in the supervisor's process again, and its home is here."""
        assert self.wanted is not None
        self.home.clock = None
        cell.spec = self.wanted = msgspec.structs.replace(self.wanted, at_root=None)

    def goes_for_good(self) -> None:
        """It is lived in the process again, and there is no home."""
        self.cell = self.wanted = self.home.switch = None


class Visitor:
    """An actor that may come with its life."""

    def __init__(self) -> None:
        self.wanted: Wanted | None = None  # what the supervisor has asked for


class SlotPlace(Place):
    """The process of the supervisor: each life has a word on its page."""

    is_here = False
    kind = "subtree"

    def __init__(self, parent: FarParent, home: JournalHome) -> None:
        self._parent, self._home = parent, home
        self._starting: asyncio.Task[None] | None = None

    def start(self, cell: Cell) -> asyncio.Future[None]:
        wanted, home = self._parent.wanted, self._home
        assert wanted is not None
        problem = home.homes.refuses(wanted.method)
        if not self._parent.slot:
            problem = "its process holds as many recorded actors as it can"
        if problem:
            raise StartFailed(cell.path, problem)
        entered = home.enter(cell)
        if home.is_gated:
            begun = self._step_by_step(cell, wanted, entered)
        else:
            home.isolated()
            self._launch(cell, wanted, entered)
            self._replay(cell, entered)
            begun = self._follow(cell, entered)
        self._starting = lifecycle.outside_turn(cell, begun)
        return self._starting

    def _launch(self, cell: Cell, wanted: Wanted, entered: Entered) -> None:
        """S3, the new life with its state."""
        home, switch, port = self._home, entered.switch, self._parent.port()
        cell.life += 1
        cell.state = RUNNING
        if home.homes.file is not None:
            home.homes.file.meet(cell.path, wanted.kind)
        home.subscribe(cell, wanted.topics)
        for record in switch.restore_records():
            port.to_life(record)
        port.to_life(Begin(wanted.number, cell.life, switch.ledger.state_turn, switch.ledger.stash, self._parent.slot))
        assert home.clock is not None
        home.clock.mark("restart")

    def _replay(self, cell: Cell, entered: Entered) -> None:
        entered.switch.attach(self._parent.port())
        calls, cell.extra().calls = cell.extra().calls, []
        assert self._parent.worker is not None
        for call in calls:
            send_call(self._parent.worker, cell.path, call)

    async def _step_by_step(self, cell: Cell, wanted: Wanted, entered: Entered) -> None:
        """A recovery on whose way others have something to do; it may be given up, or its process end, meanwhile."""
        await self._home.let_begin()
        if self._parent.wanted is not wanted or cell.state is GONE:
            return
        self._launch(cell, wanted, entered)
        await self._home.gate("replay")
        if not entered.live.done():  # Else it has ended meanwhile.
            self._replay(cell, entered)
        await self._follow(cell, entered)

    async def _follow(self, cell: Cell, entered: Entered) -> None:
        wanted = self._parent.wanted
        await self._home.until_live(cell, entered)
        if self._parent.wanted is wanted:
            self._home.clock = None

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        self._tell(cell, "stop", {"reason": pack_exit(reason)})

    def kill(self, cell: Cell) -> None:
        self._tell(cell, "kill", {})

    def end(self, cell: Cell, reason: ExitReason) -> None:
        parent = self._parent
        if parent.wanted is not None and cell.state is RUNNING:
            parent.port().to_life(Over(parent.wanted.number, pack_exit(reason)))

    def _tell(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        worker = self._parent.worker
        if worker is not None and cell.state is RUNNING:
            worker.connection.send(frames.Command(worker.connection.names.to_wire(cell.path), verb, data))

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        worker = self._parent.worker
        if worker is not None and cell.state is RUNNING:
            send_call(worker, cell.path, call)
        else:
            cell.extra().calls.append(call)  # Sent behind what the next life begins with.

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        worker = self._parent.worker
        if verb == "bind" and worker is not None:  # Also between two lives: the address has its bindings there.
            worker.connection.send(frames.Command(worker.connection.names.to_wire(cell.path), verb, data))

    def process(self, cell: Cell) -> Worker | None:
        return self._parent.worker if cell.state is RUNNING else None

    def running(self, cell: Cell) -> int:
        parent = self._parent
        return -1 if parent.worker is None or parent.wanted is None else input_of(parent.worker.page[parent.slot])

    def may_have_begun(self, cell: Cell, key: int) -> bool:
        parent = self._parent
        return parent.worker is not None and may_have_begun(parent.worker.page[parent.slot], key)

    def retired(self, cell: Cell) -> None:
        live = None if self._home.switch is None else self._home.switch.life.live
        if self._starting is not None and cell.state is GONE and (live is None or not live.done()):
            self._starting.cancel()  # Else it ends by itself, and tells how the recovery went.


def _tell_end(cell: Cell, reason: ExitReason, *, recovers: bool) -> None:
    """Tell of the end of a life whose supervisor is in another process: that one decides what follows."""
    more = cell.extra()
    cell.state, more.reason = DOWN, reason
    if isinstance(cell.spec, Wanted):  # Whoever links with it now is linked with the next life, if there is one.
        cell.spec = msgspec.structs.replace(cell.spec, goes_on=recovers)
    lifecycle.free_names(cell)
    links.announce(cell, reason, recovering=recovers)
    lifecycle.tell_enders(more, reason)
