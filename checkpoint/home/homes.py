"""The homes of a root, and the phases of a recovery: detect, isolate, restart, restore, replay, release."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

from ...actors.errors import ControlFailed, HoldfastError, StartFailed, StartIgnored
from ...actors.events import ActorStarted, Recovered, RecoveryFailed
from ...actors.exit_reasons import ExitReason
from ...actors.kernel import lifecycle, links
from ...actors.kernel.cell import DOWN, GONE, Cell, Host
from ...actors.persistence import child_key
from ..group_commit import Commits, Unkept
from ..inputs import HomeJournal
from ..journal import Journal, Saved
from ..method import Durability, Method, hybrid
from ..protocol import START, LifePort
from ..recovery.recoveries import Recoveries, Recovery
from ..recovery_file import RecoveryFile
from ..snapshot.rollback import older_snapshot, roll_back
from ..snapshot.snapshot_groups import Groups
from ..snapshot.snapshot_schedule import nobody
from ..snapshot.unreplayed import forget_turns
from .admission import Admission
from .ask_recovery import Rejoin
from .capacity import HomeBound
from .held_messages import hold, inlet, let_go
from .quarantine import PLACE, Quarantine
from .switch import Switch

if TYPE_CHECKING:
    from ...actors.kernel.envelope import Ask, Item
    from ...actors.kernel.node import Node

ENDED = "it ended before it was live"
ERASED = "what was recorded of it has been erased"
ERASING = "erasing"
"""The fact that names the address whose tree is being erased."""


class Homes:
    """All recorded addresses of a root, and their journal. A home stays when its actor is stopped."""

    def __init__(self, node: Node, journal: Journal, *, durability: Durability | None = None) -> None:
        self.node = node
        self.journal = Commits(journal, node.loop, durability=durability or "os", emit=node.emit, where=f"/{node.name}")
        self._unkept = Unkept(self.journal)
        self.quarantine = Quarantine(node, self.journal)
        self._switches: dict[str, Switch] = {}
        self.recoveries = Recoveries(node)
        self.on_first: Callable[[], None] | None = None  # there is something to watch over from now on
        self.on_home: Callable[[Switch], None] = nobody  # a home has a life again, or for the first time
        self._blamed: set[str] = set()  # because of whom a supervisor has ended that is not back yet
        self.file: RecoveryFile | None = None
        self._returns: dict[str, list[float]] = {}  # when that came back to an address, on the loop's clock
        self.planted: dict[str, Saved] = {}  # what the next life at an address begins with, whatever is recorded
        unfinished = journal.notes(ERASING).get(ERASING)
        self._stored = set(journal.addresses()) - {PLACE}
        self.groups = Groups(self)
        self.rejoin = Rejoin(self)
        if unfinished is not None:  # This process's predecessor died in the middle of it.
            self._erase_tree(unfinished.decode())

    def of(self, cell: Cell, method: Method) -> Switch:
        """The home of an address; taken up from the store when it is first asked for.

        Raises:
            StartFailed: the class that is to live there would misread what is recorded.
        """
        switch = self._switches.get(cell.path)
        if switch is None:
            switch = Switch(self.node, cell.path, method, self._journal_of(method), self.planted.get(cell.path))
            switch.cell = cell
            self._check(switch, cell)
            self.planted.pop(cell.path, None)
            self._switches[cell.path] = switch
            switch.recoveries, switch.quarantine, switch.rejoin = self.recoveries, self.quarantine, self.rejoin
            self.rejoin.loaded(switch)
            self._count_death(switch)
            if self.on_first is not None:
                begin, self.on_first = self.on_first, None
                begin()
        self.absolve(cell.path)
        switch.use(method)
        if switch.journal.durable:
            self.journal.want(cell.path, method.durability)
        switch.cell = cell
        self.on_home(switch)
        more = cell.extra()
        if more.bound is not None:
            let_go(switch)
            switch.bound, more.bound = HomeBound(switch, more.bound), None
        self.groups.opened(switch)
        cell.admit = switch.admit
        more.outlet = switch
        return switch

    def _check(self, switch: Switch, cell: Cell) -> None:
        """Refuse what would misread the records of a home that was just read.

        Raises:
            StartFailed: with the difference in words; the home is forgotten, and the store as it was.
        """
        try:
            switch.shapes.check(cell)
        except StartFailed:
            switch.timers.pause()
            switch.images.close()
            raise

    def _count_death(self, switch: Switch) -> None:
        """The root was killed in a turn of this actor: count that against its input, durably, before it begins again.

        Raises:
            StartFailed: the store refused.
        """
        hands = self.journal.in_hand
        source = None if hands is None else switch.open.get(hands.begun(switch.path))
        if hands is None or source is None or source.kind == START:
            return
        source.deliveries += 1
        try:
            source.positions += self.journal.append([(switch.path, ("tried", source.id, source.deliveries))])
        except HoldfastError as error:
            raise StartFailed(switch.path, str(error)) from error
        hands.word(switch.path)[0] = 0
        if source.deliveries >= switch.method.max_deliveries:
            switch.ends.quarantine(source)

    def page(self, switch: Switch) -> memoryview | None:
        """Where a life in this process says which input it has in hand, so that it is known when that one is killed."""
        hands = self.journal.in_hand
        return None if hands is None or not switch.journal.durable else hands.word(switch.path)

    def _journal_of(self, method: Method) -> HomeJournal:
        """Where what happens at an address is kept, from its first life on."""
        wanted = method.durability or self.journal.durability
        return self._unkept if self.journal.durable and wanted == "memory" else self.journal

    def made(self, cell: Cell, method: Method) -> Switch:
        """A home for an actor that has none, which nothing reaches before it is adopted."""
        switch = Switch(self.node, cell.path, method, self._journal_of(method))
        switch.recoveries, switch.quarantine, switch.cell = self.recoveries, self.quarantine, cell
        return switch

    def adopt(self, cell: Cell, switch: Switch, method: Method) -> None:
        """From here on what is sent to the address goes there."""
        self._switches[cell.path] = switch
        self.of(cell, method)

    def released(self, path: str) -> None:
        """The actor at an address, which was not recorded, goes on without a home."""
        self._switches.pop(path, None)

    def vacate(self, path: str, why: str) -> None:
        """What is known here of an address where nobody lives is not true any more; the store is somebody else's."""
        self._stored.add(path)
        switch = self._switches.pop(path, None)
        if switch is not None:
            switch.ends.erased(why)

    def refuses(self, method: Method) -> str:
        """Why this method cannot work here; "" if it can."""
        if method.durability in ("os", "fsync") and not self.journal.durable:
            return f"durability={method.durability!r} needs a store: ActorSystem(store='sqlite:PATH')"
        return ""

    def at(self, path: str) -> Switch | None:
        """The home of an address that somebody was started at."""
        return self._switches.get(path)

    def find(self, path: str) -> Cell | None:
        """The cell of a recorded address that waits for its next life, even if the tree above it is down."""
        switch = self._switches.get(path)
        return None if switch is None or switch.cell is None or switch.cell.state is GONE else switch.cell

    def roll_back(self, path: str, why: str) -> None:
        """Have the next life at an address, where nobody lives now, begin with the snapshot before the newest.

        Raises:
            ControlFailed: nothing is recorded there, somebody lives there, or there is no older snapshot.
            HoldfastError: the store refused.
        """
        switch = self._switches.get(path)
        if switch is None:
            raise ControlFailed(path, "roll_back", "nothing was recorded of it in this run")
        if switch.cell is not None and switch.cell.state not in (DOWN, GONE):
            raise ControlFailed(path, "roll_back", "it runs: stop it first")
        if older_snapshot(switch) is None:
            raise ControlFailed(path, "roll_back", "there is no older snapshot")
        roll_back(switch, "older_snapshot", why)

    def __iter__(self) -> Iterator[Switch]:
        return iter(self._switches.values())

    # -- what supervisors say (`Keeper`) ----------------------------------------------------------------------------

    def knows(self, path: str) -> bool:
        """Whether anything was ever recorded at this address, and not erased since."""
        return path in self._switches or path in self._stored

    def known(self, above: str) -> list[str]:
        """The addresses below one, at which anything was recorded."""
        prefix = f"{above}/"
        return [path for path in {**dict.fromkeys(self._stored), **self._switches} if path.startswith(prefix)]

    def erase(self, path: str, *, below: bool) -> None:
        """Forget all about an address where nobody lives; with `below`, also about all addresses below it.

        Raises:
            HoldfastError: the store refused. What is left is erased when it is opened again.
        """
        if not below:
            self._erase(path)
            return
        self.journal.note(ERASING, path.encode())
        self._erase_tree(path)

    def _erase_tree(self, top: str) -> None:
        for path in (top, *self.known(top)):
            self._erase(path)
        for key in self.journal.notes(child_key(top, "")):
            self.journal.note(key, None)
        self.journal.note(ERASING, None)

    def _erase(self, path: str) -> None:
        if path in self._stored and path not in self._switches:
            self._tell_stored(path, ERASED)
        self.journal.erase(path)  # First: if the store refuses, nothing is forgotten here either.
        self.quarantine.forget(path)
        self._stored.discard(path)
        self._blamed.discard(path)
        self._returns.pop(path, None)
        self.planted.pop(path, None)
        switch = self._switches.pop(path, None)
        if switch is not None:
            switch.ends.erased(ERASED)

    def _tell_stored(self, path: str, why: str) -> None:
        """Tell whoever waits at an address where nobody has been started since the root began: it is erased."""
        cell = self.node.cell_at(path)
        try:
            switch = self.made(cell, hybrid())
        except HoldfastError as error:
            self.node.emit(RecoveryFailed(path, f"what waits there is not told that it has been erased: {error}"))
            return
        switch.rejoin = self.rejoin
        self.rejoin.loaded(switch)
        switch.ends.drop_all(why)
        switch.images.close()

    def blame(self, path: str) -> None:
        """The supervisor above this address ends because of the actor there."""
        self._blamed.add(path)

    def absolve(self, path: str) -> None:
        """A life begins there: what happens from now on has other causes."""
        self._blamed.discard(path)

    def returned(self, path: str, period: float) -> None:
        """The supervisor at `path` is started again by its own: who was to blame comes back as its method says."""
        prefix, now = f"{path}/", self.node.loop.time()
        for blamed in [one for one in self._blamed if one.startswith(prefix)]:
            switch = self._switches.get(blamed)
            if switch is None:
                continue
            times = [*(when for when in self._returns.get(blamed, ()) if now - when <= period), now]
            self._returns[blamed] = times
            why = f"its supervisor has ended because of it, {len(times)} time(s) within {period:g} s"
            try:
                roll_back(switch, switch.method.after_escalation(len(times)), why)
            except HoldfastError as error:
                self.node.emit(RecoveryFailed(blamed, f"it comes back as it was: {error}"))

    def note(self, key: str, value: bytes | None) -> None:
        """Keep a small fact; None forgets it."""
        self.journal.note(key, value)

    def notes(self, prefix: str) -> dict[str, bytes]:
        """The facts whose keys begin so, oldest first."""
        return self.journal.notes(prefix)

    async def synced(self) -> None:
        """Wait until all that has happened is as safe as the store's durability says."""
        if self.journal.durability == "fsync":
            await self.node.loop.run_in_executor(None, self.journal.engine.sync)

    async def settled(self) -> None:
        """Wait until everything that was submitted has taken effect."""
        await self.journal.settled()

    def close(self) -> None:
        """Close the store, and let go of the states."""
        self.recoveries.close()
        for switch in self._switches.values():
            switch.images.close()
        self.journal.close()


class Clock:
    """The phases of one recovery. (Clocks of loops are too coarse for this.)"""

    __slots__ = ("_marks",)

    def __init__(self) -> None:
        self._marks: dict[str, float] = {}

    def mark(self, phase: str, when: float | None = None) -> None:
        """This phase is over now."""
        self._marks[phase] = time.monotonic() if when is None else when

    def when(self, phase: str) -> float:
        """The end of a phase."""
        return self._marks[phase]

    def phases(self, restore_seconds: float) -> dict[str, float]:
        """Seconds by phase."""
        spans: dict[str, float] = {}
        before = self._marks.get("noticed")
        for phase in ("detect", "isolate", "restart", "replay", "release"):
            after = self._marks.get(phase)
            if after is None:
                continue
            spans[phase] = max(0.0, after - before) if before is not None else 0.0
            before = after
        spans["restart"] = max(0.0, spans.get("restart", 0.0) - restore_seconds)
        spans["restore"] = restore_seconds
        return spans


class HomeHost(Host):
    """What all hosts of recorded actors have in common: the home, and the clock of the recovery at hand."""

    takes_parcels = True
    page: memoryview | None = None  # of a life in this process

    def __init__(self, homes: Homes, method: Method) -> None:
        self.homes, self.method = homes, method
        self.switch: Switch | None = None
        self.clock: Clock | None = None
        self.recovery: Recovery | None = None  # that of the life which is begun now
        self._starting: asyncio.Task[None] | None = None

    def enter(self, cell: Cell) -> tuple[Switch, asyncio.Future[float], bool]:
        """As `open`, and it is a recovery if anything comes back, or if one is not over."""
        switch, live, recovering = self.open(cell)
        recoveries = self.homes.recoveries
        self.recovery = None
        if recovering or recoveries.of(cell.path) is not None:
            self.recovery = recoveries.starts(cell.path, self.method)
            hold(switch)
            switch.waits_for_release = recoveries.needs(self.recovery, "release")
        return switch, live, recovering

    def may_have_begun(self, cell: Cell, ask: Ask) -> bool:
        return True

    @property
    def is_gated(self) -> bool:
        """Whether the recovery of the life at hand waits for somebody on its way."""
        return self.recovery is not None and self.homes.recoveries.is_gated(self.recovery)

    async def gate(self, stage: str) -> None:
        """Wait until the recovery may go on to this stage; not for long."""
        recovery = self.recovery
        if recovery is not None:
            wait = self.homes.recoveries.gate(recovery, stage)
            if wait is not None:
                await asyncio.shield(wait)
            if stage == "restart":
                self.isolated()

    def isolated(self) -> None:
        """S2 is over: nothing reaches the actor, and nothing of its old life gets out."""
        if self.recovery is not None:
            self.homes.recoveries.phase(self.recovery, "isolate", time.monotonic())

    def open(self, cell: Cell) -> tuple[Switch, asyncio.Future[float], bool]:
        """A life is to begin: its home holds what comes. Returns the home, when it is live, and if it recovers."""
        switch = self.switch = self.homes.of(cell, self.method)
        if not self.method.replays:
            forget_turns(switch)
        self.clock = self.clock or Clock()
        self.clock.mark("isolate")
        return switch, switch.prepare(), not switch.is_new

    def topics(self, cell: Cell) -> Iterable[str]:
        """Those that the class subscribes to."""
        start = cell.extra().start
        return start.kind._topics if start is not None else ()

    def is_restarting(self, cell: Cell) -> bool:
        """Whether a retired address may have its supervisor, and so itself, started again."""
        return lifecycle.parent_ended(cell)

    def subscribe(self, cell: Cell) -> None:
        """Have the home admit what is published, also between two lives."""
        assert self.switch is not None
        for topic in (*self.topics(cell), *self.switch.topics):
            cell.node.topics.subscribe(topic, inlet(self.switch, topic))

    def over(
        self,
        cell: Cell,
        running: int,
        why: str,
        *,
        ordered: bool,
        noticed: float | None = None,
        reason: ExitReason | None = None,
        recovers: bool | None = None,
    ) -> None:
        """A life has ended; the home keeps everything.

        Args:
            cell: its address.
            running: the input in hand, -1 if none.
            why: in words.
            ordered: we have killed it, or another life in its process has.
            noticed: when its end was noticed, if before now.
            reason: why it has ended; that of the cell if left out.
            recovers: whether it is brought back; judged by its spec if left out.
        """
        switch = self.switch
        if switch is None:
            return
        if self.page is not None:
            self.page[0] = 0
        self.clock = Clock()
        self.clock.mark("noticed", noticed)
        self.clock.mark("detect")
        switch.died(running, ordered=ordered)
        if recovers is None:
            end = cell.extra().reason if reason is None else reason
            recovers = self.recovers(end) and cell.spec is not None and cell.spec.restarts(end)
        if recovers:
            hold(switch, running)
            self.homes.recoveries.crashed(cell.path, self.method, noticed)
        cell.extra().topics.clear()  # These would be unsubscribed with the life.
        if switch.live is not None and not switch.live.done():
            switch.live.set_exception(StartFailed(cell.path, why))
            switch.live.exception()  # Nobody may be left to look.

    def ended_below(self, cell: Cell, reason: ExitReason, *, recovers: bool) -> None:
        """Tell of the end of a life whose supervisor is in another process: that one decides what follows."""
        more = cell.extra()
        cell.state, more.reason = DOWN, reason
        links.announce(cell, reason, recovering=recovers)
        lifecycle.tell_enders(more, reason)

    def offer(self, cell: Cell, item: Any) -> Awaitable[None] | None:
        """Admit a message for a sender that waits until it counts."""
        commits = self.homes.journal
        before = commits.submitted
        cell.admit(cell, item)
        last = commits.last if commits.submitted != before else None
        return last.accepted() if isinstance(last, Admission) else None

    def progress(self, cell: Cell) -> object:
        """How far the replay has come."""
        return None if self.switch is None else self.switch.progress

    def recovers(self, reason: ExitReason) -> bool:
        """Whether an end for this reason is followed by a recovery."""
        return not reason.is_clean

    def is_up(self, cell: Cell) -> bool:
        """Whether the life takes messages now."""
        return self.switch is not None and self.switch.is_released

    def backlog(self, cell: Cell) -> int:
        """Messages that wait."""
        return 0 if self.switch is None else self.switch.backlog(self.running(cell))

    def load(self, cell: Cell) -> int:
        """Messages that wait and those in hand; what the actor has put aside is among them."""
        return 0 if self.switch is None else len(self.switch.open)

    def running(self, cell: Cell) -> int:
        """The input in hand, -1 if none is known."""
        return -1

    def push(self, cell: Cell, item: Item) -> None:
        """Have the home put an item of the runtime's own behind the messages."""
        if self.switch is not None:
            self.switch.push(item)

    def retired(self, cell: Cell) -> None:
        """The address is gone for good: a start that is under way is not wanted any more."""
        if self._starting is not None and not self._starting.done():
            self._starting.cancel()
        self.give_up(cell)

    def give_up(self, cell: Cell) -> None:
        """The address is free: it hears nothing more."""
        if self.switch is None:
            return
        restarting = self.is_restarting(cell)
        for topic in (*self.topics(cell), *self.switch.topics):
            cell.node.topics.unsubscribe(topic, inlet(self.switch, topic))
        self.switch.ends.drop_all("it has stopped", keep_tells=restarting)
        let_go(self.switch)
        why = "its supervisor has ended" if restarting else "it is not started again"
        self.homes.recoveries.given_up(cell.path, why)

    async def replay(self, cell: Cell, port: LifePort, live: asyncio.Future[float], recovering: bool) -> None:
        """The rest of S3, what a life that has begun has handled since; then S4.

        Raises:
            StartFailed: it did not come so far.
        """
        assert self.clock is not None
        assert self.switch is not None
        self.clock.mark("restart")
        await self.gate("replay")
        if not live.done():  # Else it has ended meanwhile.
            self.switch.attach(port)
        await self.until_live(cell, live, recovering)

    async def until_live(self, cell: Cell, live: asyncio.Future[float], recovering: bool) -> None:
        """Wait until a life has caught up, and tell of it.

        Raises:
            StartFailed: it did not.
        """
        node, clock, switch = cell.node, self.clock, self.switch
        assert clock is not None
        assert switch is not None
        try:
            restore_seconds = await live
            if switch.port is None:  # It was over before anybody came to look.
                if switch.waits_for_release:
                    raise StartFailed(cell.path, ENDED)
                return  # It was up, and has ended in a turn: that is told by its end, and no start has failed.
            clock.mark("replay", switch.live_at)
            await self._let_at(switch, clock, restore_seconds)
        except HoldfastError as error:
            if not isinstance(error, StartIgnored):
                node.emit(RecoveryFailed(cell.path, str(error)))
            raise error if isinstance(error, StartFailed) else StartFailed(cell.path, str(error)) from error
        except asyncio.CancelledError:
            raise StartFailed(cell.path, "it was stopped while it started") from None
        if node.watched:
            node.emit(ActorStarted(cell.path, cell.life))
        if recovering:
            clock.mark("release")
            if node.watched:
                node.emit(Recovered(cell.path, cell.life, switch.replayed, clock.phases(restore_seconds)))
        self.homes.recoveries.over(cell.path)

    async def _let_at(self, switch: Switch, clock: Clock, restore_seconds: float) -> None:
        """S4, if anybody has a say in it; else the home has done it.

        Raises:
            StartFailed: the life has ended meanwhile.
        """
        recovery, port = self.recovery, switch.port
        if recovery is None:
            return
        self.homes.recoveries.came_up(recovery, clock.when("restart"), switch.live_at, restore_seconds)
        if switch.waits_for_release:
            await self.gate("release")
            if port is None or switch.port is not port:
                raise StartFailed(switch.path, ENDED)
            switch.waits_for_release = False
            switch.let_at()
