"""Recorded actors below a supervisor that has a process of its own: their homes are here at the root.

The supervisor in the process wants a child started; the home gives it back what it had, and the life is lived there.
When the process dies, the homes keep what they hold until the subtree has been started again.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from typing import Any, Protocol

from ...actors.control.orders_lane import Call, send_call
from ...actors.errors import HoldfastError, StartFailed
from ...actors.exit_reasons import KILLED, ExitReason, OutOfMemory, pack_exit, unpack_exit
from ...actors.kernel import lifecycle
from ...actors.kernel.bindings import claim, doubt
from ...actors.kernel.cell import GONE, RUNNING, Cell, Host
from ...actors.kernel.mailbox import Bound
from ...actors.persistence import child_key
from ...actors.process.process_host import Elsewhere, ProcessHost
from ...actors.process.resource_limits import Limits
from ...actors.process.stand_ins import know
from ...actors.process.wire import frames
from ...actors.process.worker_pool import Worker, Workers
from ..method import hybrid
from ..protocol import Begin, Closed, Started, ToHome, Wanted
from ..turn_word import blamed, input_of, is_at_work
from .homes import HomeHost, Homes
from .recorded_hosts import RemoteLife, records_of


class Lived(Host, Protocol):
    """The host of a child whose lives are lived at the root, though its supervisor is in another process."""

    def begin(self, cell: Cell, wanted: Wanted, port: RemoteLife) -> None:
        """Begin the life that its supervisor wants, who hears of it by `port`."""
        ...

    def closed(self, record: Closed) -> None:
        """Its supervisor has heard of the end of a life, or gives up its start."""
        ...

    def lost(self, cell: Cell, reason: ExitReason) -> None:
        """Its supervisor has died with its process."""
        ...

    def left(self) -> list[asyncio.Task[None]]:
        """What has to come to its end before another life may begin."""
        ...


Protect = Callable[["SubtreeHome", Cell, Wanted, "Lived | None"], Lived]
"""Gives the host of such a child; the last one, if there was one. Raises HoldfastError: it cannot be had."""


class SubtreeHost(ProcessHost):
    """The host of a supervisor with a process of its own, and the keeper of the homes below it."""

    def __init__(self, workers: Workers, limits: Limits | None, homes: Homes, protect: Protect) -> None:
        super().__init__(workers, limits)
        self._homes, self._protect = homes, protect
        self._below: dict[str, SubtreeHome] = {}
        self._slots: Slots | None = None

    async def take(self, cell: Cell) -> tuple[Worker, bytes]:
        worker, recipe = await super().take(cell)
        kept = self._homes.notes(child_key(cell.path, ""))
        file = self._homes.file
        more = {} if file is None else {"recovery_file": file.data()}
        self._options = {"kept": kept, "known": self._homes.known(cell.path), **more}
        slots = self._slots = Slots(len(worker.page))

        def joined(path: str) -> SubtreeHome:
            home = self.at(path)
            home.joined(cell, worker, slots.of(path))
            return home

        def taker(path: str) -> frames.TakeRecord:
            joined(path)

            def taken(record: ToHome) -> None:
                home = self._below.get(path) or joined(path)  # It was vacated, and somebody is wanted there again.
                home.from_life(worker, record)

            return records_of(worker, taken)

        worker.record_taker = taker
        return worker, recipe

    def at(self, path: str) -> SubtreeHome:
        """The home of an address below."""
        home = self._below.get(path)
        if home is None:
            home = self._below[path] = SubtreeHome(self._homes, path, self._protect)
        return home

    def vacated(self, home: SubtreeHome) -> None:
        """Nobody lives at an address below any more: what is known of it here goes, and its place on the page."""
        if self._below.get(home.path) is not home:
            return
        del self._below[home.path]
        if self._slots is not None:
            self._slots.give_back(home.path)

    def died(self, cell: Cell, reason: ExitReason) -> None:
        worker = self._workers.of(cell)
        if worker is not None:
            is_of_one = not isinstance(reason, OutOfMemory)  # Its memory belongs to all of them.
            one_works = is_of_one and self._slots is not None and self._slots.is_any_at_work(worker.page)
            for home in self._below.values():
                home.lost(worker, reason, one_works=one_works)
        super().died(cell, reason)

    def retired(self, cell: Cell) -> None:
        super().retired(cell)
        for home in reversed(list(self._below.values())):
            if home.cell is not None:
                home.cell.host.told(home.cell, "gone", {"with_parent": True})
                lifecycle.retire(home.cell, "its supervisor has stopped")
        self._below.clear()


class Slots:
    """Places on the page: which input each recorded life in a process is handling. The first two are taken."""

    def __init__(self, count: int) -> None:
        self._unused = iter(range(2, count))
        self._free: list[int] = []  # given back
        self._by_path: dict[str, int] = {}

    def of(self, path: str) -> int:
        """The place of an address; 0 when there is none left."""
        slot = self._by_path.get(path)
        if slot is None:
            slot = self._free.pop() if self._free else next(self._unused, 0)
            if slot:
                self._by_path[path] = slot
        return slot

    def is_any_at_work(self, page: memoryview) -> bool:
        """Whether one of the lives has a turn in hand that does not wait."""
        return any(is_at_work(page[slot]) for slot in self._by_path.values())

    def give_back(self, path: str) -> None:
        """Nobody lives at an address any more."""
        slot = self._by_path.pop(path, 0)
        if slot:
            self._free.append(slot)


class SubtreeHome(HomeHost, Elsewhere):
    """The host of one recorded address below a supervisor in another process.

    Of a child that a mechanism protects the lives are lived at the root: its host is another one, and this only hands
    it what the supervisor says.
    """

    def __init__(self, homes: Homes, path: str, protect: Protect) -> None:
        super().__init__(homes, hybrid())  # The method is known when a life is wanted.
        self.path, self._protect = path, protect
        self._group: Lived | None = None  # has the lives of a protected child
        self._next: Wanted | None = None  # begins when nothing is left of a group
        self.arriving: Callable[[ToHome], None] | None = None  # hears a life that is being handed over
        self.on_lost: Callable[[ExitReason], None] | None = None  # hears that the process of such a life has died
        self.cell: Cell | None = None
        self.restarting = False  # it is its supervisor that has ended
        self._top: Cell | None = None
        self._worker: Worker | None = None
        self._slot = 0
        self._wanted: Wanted | None = None

    def joined(self, top: Cell, worker: Worker, slot: int) -> None:
        """The process that the next lives are lived in."""
        if worker is not self._worker and self.cell is not None and self._group is None:
            doubt(self.cell)
        self._top, self._worker, self._slot = top, worker, slot

    def from_life(self, worker: Worker, record: ToHome) -> None:
        """Take what the life, or the supervisor that wants one, says."""
        if worker is not self._worker:
            return
        if isinstance(record, Wanted):
            self._begin(record)
        elif isinstance(record, Closed) and self.arriving is None:
            if self._next is not None:
                self._next = None  # There was none yet.
            elif self._group is not None:
                self._group.closed(record)
            elif self._wanted is not None and record.number == self._wanted.number:
                self._closed(unpack_exit(record.reason), self.running(self.cell), recovers=record.recovers)
        elif self.arriving is not None:
            self.arriving(record)
        elif self.switch is not None and self._wanted is not None:
            self.switch.from_life(record)

    def _begin(self, wanted: Wanted) -> None:
        """Bring the actor back: its state, what it has handled since, what waits."""
        worker, top = self._worker, self._top
        assert worker is not None
        assert top is not None
        left = [] if self._group is None else self._group.left()
        if left:
            self._next = wanted
            asyncio.gather(*left, return_exceptions=True).add_done_callback(lambda _: self._begin_next(wanted))
            return
        self._wanted = wanted
        self.method, self.restarting = wanted.method, False
        if self.cell is not None and self.cell.state is GONE:
            self.cell = None
        cell = self.cell = worker.inner.homed(top, self.path, self.cell, self)
        cell.spec = wanted  # Somebody restarts it: it is not dead between two lives.
        know(cell, wanted.kind)
        claim(cell, wanted.bindings)
        if wanted.bound is not None:
            cell.extra().bound = Bound(wanted.bound.capacity, wanted.bound.overflow)
        port = RemoteLife(self.path, worker)
        if wanted.protected is not None:
            self._begin_protected(cell, wanted, port)
            return
        self._group, cell.host = None, self
        if not self._slot:
            port.to_life(Started(wanted.number, "its process holds as many recorded actors as it can"))
            return
        problem = self.homes.refuses(wanted.method)
        if problem:
            port.to_life(Started(wanted.number, problem))
            return
        try:
            switch, live, recovering = self.enter(cell)
        except StartFailed as error:  # What is recorded does not fit its class.
            port.to_life(Started(wanted.number, error.reason))
            return
        if self.is_gated:
            self._starting = lifecycle.outside_turn(cell, self._step_by_step(cell, wanted, live, recovering))
        else:
            self.isolated()
            self._launch(cell, wanted)
            switch.attach(port)
            self._send_calls(cell, worker)
            self._starting = lifecycle.outside_turn(cell, self._follow(cell, wanted, live, recovering))

    def _begin_next(self, wanted: Wanted) -> None:
        if self._next is wanted:
            self._next = None
            self._begin(wanted)

    # -- lives that are handed over while they are lived ------------------------------------------------------------

    @property
    def worker(self) -> Worker | None:
        """The process of the supervisor."""
        return self._worker

    @property
    def slot(self) -> int:
        """The place on the page; 0 if there was none left."""
        return self._slot

    def hand_over(self, group: Lived) -> Wanted:
        """The life that its supervisor wants is lived at the root from now on."""
        wanted, self._wanted, self._group = self._wanted, None, group
        assert wanted is not None
        return wanted

    def take_back(self, cell: Cell, wanted: Wanted) -> None:
        """It is lived in the process again."""
        self._wanted, self._group, self.clock = wanted, None, None
        cell.spec = wanted

    def found(self, cell: Cell, group: Lived) -> None:
        """A life that was not recorded is lived at the root from now on."""
        self.cell, self._group = cell, group

    def forget(self) -> None:
        """It is lived in the process again, and there is no home."""
        self.cell = self._group = self.switch = None

    # -- lives at the root ------------------------------------------------------------------------------------------

    def _begin_protected(self, cell: Cell, wanted: Wanted, port: RemoteLife) -> None:
        """A life that is lived at the root."""
        self._wanted = None
        try:
            self._group = self._protect(self, cell, wanted, self._group)
        except HoldfastError as error:
            port.to_life(Started(wanted.number, str(error)))
            return
        cell.host = self._group
        self._group.begin(cell, wanted, port)

    def _launch(self, cell: Cell, wanted: Wanted) -> None:
        """S3, the new life with its state."""
        worker, switch = self._worker, self.switch
        assert worker is not None
        assert switch is not None
        cell.life += 1
        cell.state = RUNNING
        if self.homes.file is not None:
            self.homes.file.meet(self.path, wanted.kind)
        self.subscribe(cell)
        port = RemoteLife(self.path, worker)
        for record in switch.restore_records():
            port.to_life(record)
        port.to_life(Begin(wanted.number, cell.life, switch.state_turn, switch.stash, self._slot))
        assert self.clock is not None
        self.clock.mark("restart")

    def _send_calls(self, cell: Cell, worker: Worker) -> None:
        calls, cell.extra().calls = cell.extra().calls, []
        for call in calls:
            send_call(worker, cell.path, call)

    async def _step_by_step(self, cell: Cell, wanted: Wanted, live: asyncio.Future[float], recovering: bool) -> None:
        """A recovery on whose way others have something to do; it may be given up, or its process end, meanwhile."""
        worker, switch = self._worker, self.switch
        assert worker is not None
        assert switch is not None
        await self.gate("restart")
        if self._wanted is not wanted or cell.state is GONE:
            return
        self._launch(cell, wanted)
        await self.gate("replay")
        if not live.done():  # Else it has ended meanwhile.
            switch.attach(RemoteLife(self.path, worker))
            self._send_calls(cell, worker)
        await self._follow(cell, wanted, live, recovering)

    async def _follow(self, cell: Cell, wanted: Wanted, live: asyncio.Future[float], recovering: bool) -> None:
        worker = self._worker
        assert worker is not None
        problem = ""
        try:
            await self.until_live(cell, live, recovering)
        except StartFailed as error:
            problem = error.reason
        if self._wanted is wanted:
            if not problem:
                self.clock = None
            RemoteLife(self.path, worker).to_life(Started(wanted.number, problem))

    def _closed(
        self,
        reason: ExitReason,
        running: int = -1,
        *,
        recovers: bool = True,
        ordered: bool = True,
        noticed: float | None = None,
    ) -> None:
        """The life is over: tell whom it concerns here; its supervisor decides what follows."""
        cell = self.cell
        self._wanted = None
        if cell is None or cell.state is not RUNNING:
            return
        recovers = recovers and self.recovers(reason)
        self.over(cell, running, str(reason), ordered=ordered, noticed=noticed, recovers=recovers)
        self.ended_below(cell, reason, recovers=recovers)

    def lost(self, worker: Worker, reason: ExitReason, *, one_works: bool) -> None:
        """The process is gone, and the life with it. `one_works`: there was a turn in it that did not wait."""
        if worker is self._worker:
            self._next = None
            if self.on_lost is not None:
                self.on_lost(reason)
        if worker is self._worker and self._group is not None and self.cell is not None:
            self._group.lost(self.cell, reason)
        elif worker is self._worker and self._wanted is not None:
            is_blameless = reason == KILLED or blamed(worker.page[self._slot], one_works=one_works) < 0
            self._closed(reason, self.running(self.cell), ordered=is_blameless, noticed=worker.noticed_at)

    # -- what a host does -------------------------------------------------------------------------------------------

    def worker_of(self, cell: Cell) -> Worker | None:
        return self._worker if cell.state is RUNNING else None

    def running(self, cell: Cell | None) -> int:
        return -1 if self._worker is None or self._wanted is None else input_of(self._worker.page[self._slot])

    def start(self, cell: Cell) -> None:
        raise HoldfastError(f"{cell.path} is started by its supervisor, which is in another process")

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        self._tell(cell, "stop", {"reason": pack_exit(reason)})

    def kill(self, cell: Cell) -> None:
        self._tell(cell, "kill", {})

    def _tell(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        worker = self._worker
        if worker is not None and cell.state is RUNNING:
            worker.connection.send(frames.Command(worker.connection.name_out(cell.path), verb, data))

    def control(self, cell: Cell, call: Call) -> None:
        if self._worker is not None and cell.state is RUNNING:
            send_call(self._worker, cell.path, call)
        else:
            cell.extra().calls.append(call)  # Sent behind what the next life begins with.

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        worker = self._worker
        if verb == "bind" and worker is not None:  # Also between two lives: the address has its bindings there.
            worker.connection.send(frames.Command(worker.connection.name_out(cell.path), verb, data))
        elif verb == "gone":
            self.restarting = bool(data["with_parent"])

    def topics(self, cell: Cell) -> Iterable[str]:
        return self._wanted.topics if self._wanted is not None else ()

    def is_restarting(self, cell: Cell) -> bool:
        return self.restarting

    def retired(self, cell: Cell) -> None:
        live = None if self.switch is None else self.switch.live
        if self._starting is not None and cell.state is GONE and (live is None or not live.done()):
            self._starting.cancel()  # Else it ends by itself, and tells how the recovery went.
        self.give_up(cell)
        self.vacate(cell)

    def vacate(self, cell: Cell) -> None:
        """The address is free: nothing need be known of it here, unless something is under way."""
        top = self._top
        is_idle = self.cell is cell and self._next is None and self.arriving is None
        if is_idle and top is not None and isinstance(top.host, SubtreeHost):
            top.host.vacated(self)
