"""All homes of a root: what each recorded address has accepted, from the store or since; and who is to blame."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TYPE_CHECKING

from ...actors.errors import ControlFailed, HoldfastError, StartFailed
from ...actors.events import RecordsMapped, RecoveryFailed
from ...actors.kernel.cell import DOWN, GONE, Cell
from ...actors.persistence import CHILDREN, ENTRIES, child_key
from ..absentees import Absentees
from ..addresses import Addresses, AddressTree, is_of_actor, renamed
from ..group_commit import Commits, Unkept
from ..inputs import HomeJournal
from ..journal import Saved, StoreEngine
from ..method import Durability, Method, hybrid
from ..recovery.recoveries import Recoveries
from ..recovery_file import RecoveryFile
from ..recovery_settings import RecoveryHooks
from ..snapshot.rollback import older_snapshot, roll_back
from ..snapshot.snapshot_groups import Groups
from ..snapshot.snapshot_record import take_over
from ..snapshot.snapshot_schedule import nobody
from .ask_recovery import FarMail, Rejoin
from .capacity import HomeBound
from .disposal import Erased, Erasures, drop_all, forget_home, put_into_quarantine
from .held_messages import Holding, end_wait, let_go
from .next_lives import RuntimeAsks
from .quarantine import Quarantine
from .switch import Switch

if TYPE_CHECKING:
    from ...actors.kernel.mailbox import Bound
    from ...actors.kernel.node import Node

ENDED = "it ended before it was live"
ERASED = "what was recorded of it has been erased"
BEING_ERASED = "what was recorded of it is being erased: start it again when that is over"
OPENED = "opened"
"""The fact that says when the root was begun whose fencing tokens were the largest: a whole number, of seconds."""
TOKEN_BITS = 31
"""Of the part of a fencing token that counts within a second; in front of it are whole seconds."""


class Homes:
    """All recorded addresses of a root, and their journal. A home stays when its actor is stopped."""

    def __init__(
        self,
        node: Node,
        journal: StoreEngine,
        *,
        durability: Durability | None = None,
        file: RecoveryFile | None = None,
        hooks: RecoveryHooks | None = None,
        runtime: RuntimeAsks | None = None,
    ) -> None:
        self.node = node
        self.journal = Commits(journal, node.loop, durability=durability or "os", emit=node.emit, where=f"/{node.name}")
        self._unkept = Unkept(self.journal)
        self.addresses = Addresses(node, journal, self.find, Absentees(node, self.noted, self.has_recorded))
        self.quarantine = Quarantine(node, self.journal)
        self._switches: dict[str, Switch] = {}
        self.recoveries = Recoveries(node, self.journal, hooks)
        self.on_first: Callable[[], None] | None = None  # there is something to watch over from now on
        self.on_home: Callable[[Switch], None] = nobody  # a home has a life again, or for the first time
        self.on_dismissed: list[Callable[[str], None]] = []  # who is told of children that are gone for good
        self._blamed: set[str] = set()  # because of whom a supervisor has ended that is not back yet
        self.file = file
        self.planted: dict[str, Saved] = {}  # what the next life at an address begins with, whatever is recorded
        node.numbers.begin_tokens(_first_token(journal, node.clock.wall()))
        self._stored = set(filter(is_of_actor, journal.addresses()))
        self._known = AddressTree(self._stored)  # with those at which somebody was started since
        self._noted = AddressTree(key.removeprefix(CHILDREN) for key in journal.notes(CHILDREN))  # children
        self.groups = Groups(self)
        self.rejoin = Rejoin(self, runtime or RuntimeAsks())
        self.far = FarMail(self)
        self.erasures = Erasures(self)
        node.on_rebound = self._rebound

    def of(self, cell: Cell, method: Method) -> Switch:
        """The home of an address; taken up from the store when it is first asked for.

        Raises:
            StartFailed: the class that is to live there would misread what is recorded.
        """
        switch = self.expecting(cell, method)
        self.absolve(cell.path)
        self._led_to(switch, {port: target.path for port, target in cell.extra().bindings.items()})
        self.on_home(switch)
        self.groups.opened(switch)
        return switch

    def _led_to(self, switch: Switch, targets: Mapping[str, str]) -> None:
        if targets and switch.method.replays:
            is_saved = switch.ledger.turn <= switch.ledger.state_turn
            self.addresses.led.bound(self.addresses.key(switch.path), targets, is_saved=is_saved)

    def _rebound(self, cell: Cell, port: str, target: str) -> None:
        """A binding of an actor leads elsewhere now."""
        switch = self._switches.get(cell.path)
        if switch is not None:
            try:
                self._led_to(switch, {port: target})
            except HoldfastError:
                pass  # This root knows it; the next one has no more than the store, which takes nothing now.

    def expecting(self, cell: Cell, method: Method) -> Switch:
        """The home of an address where the next life is still to begin, as `of` takes it up; it holds what comes.

        Raises:
            StartFailed: as `of`.
        """
        path = cell.path
        switch = self._switches.get(path)
        if self.erasures.covers(path):
            raise StartFailed(path, BEING_ERASED)
        if switch is None:
            self._settle_key(path)
            switch = Switch(self, cell, method, self._journal_of(method), self.planted.get(path))
            self._check(switch, cell)
            self.planted.pop(path, None)
            self._switches[path] = switch
            self._known.add(path)
            self.rejoin.loaded(switch)
            switch.ties.rename(self.addresses.now)
            self._count_death(switch)
            if self.on_first is not None:
                begin, self.on_first = self.on_first, None
                begin()
        switch.begin_at(cell, method)
        if switch.journal.durable:
            self.journal.want(path, method.durability)
        more = cell.extra()
        if more.bound is not None:
            _bind(switch, more.bound)
            more.bound = None
        cell.admit = switch.admit
        more.outlet = switch
        return switch

    def _settle_key(self, path: str) -> None:
        try:
            self.addresses.settle(path)
        except HoldfastError as error:
            raise StartFailed(path, str(error)) from error

    def _check(self, switch: Switch, cell: Cell) -> None:
        """Map the records of a home that was just read to the code that there is now.

        Raises:
            StartFailed: with the difference in words; the home is forgotten, and the store as it was.
        """
        try:
            switch.shapes.check(cell)
            mapped = take_over(switch)
        except StartFailed:
            switch.timers.pause()
            switch.images.close()
            raise
        if mapped:
            self.node.emit(RecordsMapped(switch.path, mapped))

    def _count_death(self, switch: Switch) -> None:
        """The root was killed in a turn of this actor: count that against its input, durably, before it begins again.

        Raises:
            StartFailed: the store refused.
        """
        hands = self.journal.in_hand
        source = None if hands is None else switch.ledger.blamed(hands.begun(self.addresses.key(switch.path)))
        if hands is None or source is None:
            return
        source.deliveries += 1
        try:
            tried = self.journal.append([(switch.path, ("tried", source.id, source.deliveries))])
        except HoldfastError as error:
            raise StartFailed(switch.path, str(error)) from error
        source.positions = [*(source.positions or ()), *tried]
        hands.word(self.addresses.key(switch.path))[0] = 0
        if source.deliveries >= switch.method.max_deliveries:
            put_into_quarantine(switch, source)

    def page(self, switch: Switch) -> memoryview | None:
        """Where a life in this process says which input it has in hand, so that it is known when that one is killed."""
        hands = self.journal.in_hand
        return None if hands is None or not switch.journal.durable else hands.word(self.addresses.key(switch.path))

    def _journal_of(self, method: Method) -> HomeJournal:
        """Where what happens at an address is kept, from its first life on."""
        wanted = method.durability or self.journal.durability
        return self._unkept if self.journal.durable and wanted == "memory" else self.journal

    def made(self, cell: Cell, method: Method, planted: Saved | None = None) -> Switch:
        """A home for an actor that has none, which nothing reaches before it is adopted.

        It begins with what is `planted`, if that is given, and then keeps nothing beyond this process.
        """
        journal = self._journal_of(method) if planted is None else self._unkept
        return Switch(self, cell, method, journal, planted)

    def adopt(self, cell: Cell, switch: Switch, method: Method) -> None:
        """From here on what is sent to the address goes there."""
        self._switches[cell.path] = switch
        self._known.add(cell.path)
        self.of(cell, method)

    def released(self, path: str) -> None:
        """The actor at an address, which was not recorded, goes on without a home."""
        self._switches.pop(path, None)
        if path not in self._stored:
            self._known.discard(path)

    def move(self, names: Mapping[str, str]) -> None:
        """Actors have moved, with all below them: what is known of their addresses is true of the new ones.

        Args:
            names: the new addresses by the old ones, all at once.

        Raises:
            HoldfastError: the store refused.
        """
        paths = {path: renamed(names, path) for path in {*self._stored, *self._switches}}
        paths = {was: now for was, now in paths.items() if was != now}
        try:
            self._move_stored(names, paths)
        finally:  # Whatever the store says, they have moved.
            self.journal.rename(paths)
            self._switches = {paths.get(path, path): switch for path, switch in self._switches.items()}
            self._stored = {paths.get(path, path) for path in self._stored}
            self._known = AddressTree((*self._stored, *self._switches))
            self._blamed = {paths.get(path, path) for path in self._blamed}
            self.planted = {paths.get(path, path): saved for path, saved in self.planted.items()}
            for path, switch in self._switches.items():
                if switch.path != path:
                    switch.readdress(path)
                switch.ties.rename(lambda one: renamed(names, one))
            self.rejoin.rename(paths)
            self.addresses.absentees.rename(lambda one: renamed(names, one))

    def _move_stored(self, names: Mapping[str, str], paths: Mapping[str, str]) -> None:
        for path in {now for now in paths.values() if now not in paths and self.knows(now)}:
            self._erase(path)  # Whoever had it is not there any more, and what comes there has a journal of its own.
        self.addresses.rename(paths)
        self.addresses.moved(names)
        for key, value in list(self.journal.notes(CHILDREN).items()):
            above, _, name = key.removeprefix(CHILDREN).rpartition("/")
            if (now := renamed(names, above)) != above:
                self.note(key, None)
                self.note(child_key(now, name), value)
        self.addresses.registered.rename(names)
        self.quarantine.rename(paths)

    def vacate(self, path: str, why: str) -> None:
        """What is known here of an address where nobody lives is not true any more; the store is somebody else's."""
        self._stored.add(path)
        self._known.add(path)
        switch = self._switches.pop(path, None)
        if switch is not None:
            forget_home(switch, why)

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
        return path in self._known

    def has_recorded(self, path: str) -> bool:
        """Whether anything is recorded at this address or below it, or noted of a child of a supervisor there."""
        return self._known.has(path) or any(True for _ in self._noted.below(path))

    def is_unopened(self, path: str) -> bool:
        """Whether something is recorded at this address, and nobody has been started there since the root began."""
        return path in self._stored and path not in self._switches

    def known(self, above: str) -> list[str]:
        """The addresses below one, at which anything was recorded."""
        return list(self._known.below(above))

    def tree_of(self, top: str) -> Iterator[str]:
        """The address, if anything was recorded there, and those below it."""
        if top in self._known:
            yield top
        yield from self._known.below(top)

    def child_notes(self, above: str) -> Iterator[str]:
        """The addresses of the children below an address that are noted as those of a supervisor."""
        return self._noted.below(above)

    def erase(self, path: str, *, below: bool) -> asyncio.Future[None] | None:
        """Forget all about an address where nobody lives; with `below`, also about all addresses below it.

        Returns:
            None: it is done. A future: it goes on, a few addresses at a time.

        Raises:
            HoldfastError: the store refused. What is left is erased when it is opened again.
        """
        if not below:
            self._erase(path)
            self.quarantine.forget(path)
            return None
        erased = self.erasures.erase(path)
        if not erased.done():
            return self.node.loop.create_task(_over(erased), context=self.node.base_context.copy())
        erased.result()
        return None

    def erasing(self, path: str) -> asyncio.Future[None] | None:
        """The erasure that has to be over before a life may begin at this address, if there is one."""
        erased = self.erasures.at(path)
        return None if erased is None else self.node.loop.create_task(_over(erased))

    def forget(self, path: str) -> bool:
        """Forget what was recorded at one address; whether anything was."""
        was_known = self.knows(path)
        self._erase(path)
        return was_known

    def _erase(self, path: str) -> None:
        if path in self._stored and path not in self._switches:
            self._tell_stored(path, ERASED)
        if not self.addresses.is_lent(path):  # Else the store has there what was recorded of one that has moved away.
            self.journal.erase(path)  # First: if the store refuses, nothing is forgotten here either.
        self.addresses.erased(path)
        self.addresses.registered.erase(path)
        self._stored.discard(path)
        self._known.discard(path)
        self._blamed.discard(path)
        self.planted.pop(path, None)
        switch = self._switches.pop(path, None)
        if switch is not None:
            forget_home(switch, ERASED)

    def _tell_stored(self, path: str, why: str) -> None:
        """Tell whoever waits at an address where nobody has been started since the root began: it is erased."""
        cell = self.node.cell_at(path)
        try:
            switch = self.made(cell, hybrid())
        except HoldfastError as error:
            self.node.emit(RecoveryFailed(path, f"what waits there is not told that it has been erased: {error}"))
            return
        self.rejoin.loaded(switch)
        drop_all(switch, why)
        switch.images.close()

    def blame(self, path: str) -> None:
        """The supervisor above this address ends because of the actor there."""
        self._blamed.add(path)

    def absolve(self, path: str) -> None:
        """A life begins there: what happens from now on has other causes."""
        self._blamed.discard(path)

    def returned(self, path: str) -> None:
        """The supervisor at `path` is started again by its own: who was to blame comes back as its method says."""
        for blamed in [one for one in self._blamed if one.startswith(f"{path}/")]:
            switch = self._switches.get(blamed)
            if switch is None:
                continue
            try:
                roll_back(switch, switch.method.on_escalate, "its supervisor has ended because of it")
            except HoldfastError as error:
                self.node.emit(RecoveryFailed(blamed, f"it comes back as it was: {error}"))

    def dismissed(self, path: str, *, below: bool, for_good: bool) -> None:
        """The child at `path` is forgotten by its supervisor, and nobody brings back those below it.

        What has come while they ended waits for whoever is started there anew; what comes now is lost, and told so.
        """
        for tell in self.on_dismissed if for_good else ():
            tell(path)
        if not below:
            return
        self.addresses.absentees.dismissed(path)
        self.rejoin.next_lives.dismissed(path)
        for waiting in self.known(path):
            if (switch := self._switches.get(waiting)) is not None:
                end_wait(switch)

    def began(self, path: str, listed: Collection[str]) -> None:
        """The supervisor at `path` begins with these children: nobody else is brought back below it."""
        names = frozenset(listed)
        for below in self.known(path):
            switch = self._switches.get(below)
            if switch is None or switch.cell is None or switch.intake.between is not None:
                continue
            if below[len(path) + 1 :].partition("/")[0] not in names:
                switch.cell.host.parent.begins_without(switch.cell)
        self.addresses.absentees.began(path, listed)
        self.rejoin.next_lives.began(path, listed)

    def note(self, key: str, value: bytes | None) -> None:
        """Keep a small fact; None forgets it."""
        self.journal.note(key, value)
        if key.startswith(CHILDREN):
            path = key.removeprefix(CHILDREN)
            if value is None:
                self._noted.discard(path)
            else:
                self._noted.add(path)
        elif key.startswith(ENTRIES):
            self.addresses.registered.noted(key, value)

    def noted(self, key: str) -> bytes | None:
        """The fact of that name, or None."""
        return self.journal.noted(key)

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
        self.erasures.close()
        self.recoveries.close()
        for switch in self._switches.values():
            if end_wait(switch) and not switch.journal.durable:  # Else the next program has it.
                drop_all(switch, "the system has ended")
            switch.images.close()
        self.journal.close()


async def _over(erased: asyncio.Future[Erased]) -> None:
    """Wait for an erasure, which goes on if whoever waits does not."""
    await asyncio.shield(erased)


def _bind(switch: Switch, chosen: Bound) -> None:
    """Give a home its mailbox's bound; whoever waits for room there waits on, also in the next life."""
    intake = switch.intake
    before = intake.holding.inner if intake.holding is not None else intake.bound
    assert not isinstance(before, Holding)
    if before is not None and (before.capacity, before.overflow) == (chosen.capacity, chosen.overflow):
        return
    let_go(switch)
    bound = intake.bound = HomeBound(switch, chosen)
    if before is not None:
        bound.waiting, bound.senders = before.waiting, before.senders


def _first_token(journal: StoreEngine, now: float) -> int:
    """The token behind which those of a new root begin: they are larger than those of all roots before it.

    They begin with the wall clock, so that they also rise without a store, and where one is begun anew. What a store
    knows sees to it that they do if the clock was set back: no root gives out as many as there are for a second.
    """
    known = journal.noted(OPENED)
    seconds = max(int(now), int(known) + 2 if known is not None else 0)
    journal.note(OPENED, str(seconds).encode())
    return max(int(now * 2**TOKEN_BITS), seconds << TOKEN_BITS)
