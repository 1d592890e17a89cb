"""The side of a migration that is a group of replicas: attach is a move into one, detach a move out of it.

A group is the new life only when a second replica has caught up. A life that leaves a group comes out of whoever leads
when nothing is inside any more, and nothing new goes in.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from typing import TYPE_CHECKING, Any, cast

from ...actors.errors import AskTimeout, CannotMove, HoldfastError, StartFailed
from ...actors.exit_reasons import unpack_exit
from ...actors.kernel import mailbox
from ...actors.kernel.cell import Cell
from ...actors.kernel.envelope import Ask, Envelope, Item
from ...actors.kernel.links import Down, Exit, LifeMonitor
from ...actors.kernel.mailbox import Bound
from ...actors.kernel.message import message_name
from ...actors.migration.luggage import let_come
from ...actors.migration.move import Entering, Leaving
from ...actors.migration.quiesce import Transit, now
from ...actors.overflow import Overflow
from ...checkpoint.home.capacity import HomeBound
from ...checkpoint.home.journal_home import JournalHome
from ...checkpoint.places.recorded_moves import Detached, refuse_unsaved
from ...checkpoint.protocol import DOWN, EXIT, MESSAGE, PIPE, START, TICK, Live
from ...checkpoint.snapshot.snapshot_record import meta_now
from ..bricks.replica_orders import EXPORTED_WITHIN, Export, Quiesce
from ..group.group import Group
from ..group.group_place import GroupPlace
from ..group.membership import LookAgain
from ..group.steering import AGAIN_AFTER, past_resting_turns
from ..group.trial import rehearsed
from .unrecorded_luggage import restore_owing, save_owing

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor
    from ...actors.kernel.address_host import AddressHost
    from ...checkpoint.home.switch import Switch

MADE_WITHIN = 60.0
"""Seconds that the processes of the replicas may take to come up; the old life works on meanwhile."""
FAILED_OVER_WITHIN = 1.0
SETTLED_WITHIN = 5.0
"""Seconds after which a replica is asked again whether it has come to rest: it may have died with the question."""


class ToGroup(Entering):
    """A life begins in a group; `switch` is its home, if it has one already."""

    to = "into a group of replicas"

    def __init__(self, host: AddressHost, switch: Switch | None) -> None:
        place, home = host.place, host.home
        assert isinstance(place, GroupPlace)
        assert isinstance(home, JournalHome)
        self.host, self._place, self._home = host, place, home
        self._recorded = switch
        self._group: Group | None = None

    async def prepare(self) -> None:
        cell, place, home, move = self.cell, self._place, self._home, self.move
        if cell.children:
            names = ", ".join(cell.children)
            raise CannotMove(cell.path, f"it has children of its own ({names}): have a supervisor start them beside it")
        self._live: asyncio.Future[Live] = move.node.loop.create_future()
        switch = home.switch = self._switch = self._recorded or home.homes.made(cell, home.method)
        group = self._group = await move.within(
            place.build(cell, switch), MADE_WITHIN, lambda: "its replicas were not up"
        )
        group.hand_to(self)
        # Its replicas have no part yet: one of them tries what all of them are to do.
        rehearsal = rehearsed(group.replicas, group.membership.names[-1])
        await move.within(rehearsal, MADE_WITHIN, lambda: "its replicas could not try their parts")

    def life_is_up(self, group: Group, live: Live) -> None:
        """The life has caught up."""
        if not self._live.done():
            self._live.set_result(live)

    def has_fallen(self, group: Group, why: str) -> None:
        """No replica is left: the old life goes on."""
        self.move.give_up(why)

    def owe(self, ask: Ask) -> int:
        return 0 if self._recorded is None else super().owe(ask)  # It is numbered when it is packed.

    def packed(self, actor: Actor) -> None:
        if self._recorded is None:
            self.move.luggage.data, self.move.luggage.owed = save_owing(actor)

    async def begin(self) -> None:
        move, group, switch = self.move, self._group, self._switch
        assert group is not None
        if self._recorded is None:
            self._plant()
        live = switch.prepare()
        live.add_done_callback(self._failed)
        leads = self._place.lead(group, switch, traps=move.luggage.traps)
        await move.within(leads, move.timeout, lambda: "its first replica did not lead")
        switch.attach(group)
        await move.within(self._live, move.timeout, lambda: "its new life was not up")
        group.replicas.wake()
        if len(group.membership.names) > 1:
            group.replicas.tell("join", LookAgain())
            await move.within(group.replicas.have_backup(), move.timeout, lambda: "no second replica caught up")

    def _plant(self) -> None:
        """The home of an actor that had none begins with its state, and with what it has put aside."""
        cell, luggage, switch = self.cell, self.move.luggage, self._switch
        for item in luggage.stash:
            message, sender = (item.message, item.sender) if isinstance(item, (Ask, Envelope)) else (item, None)
            body = cell.node.codec.encode(message, cell.path)
            origin = None if sender is None else sender.path
            source = switch.record(MESSAGE, message_name(type(message)), body, origin)
            if isinstance(item, Ask):
                source.ask, source.chain = item, item.chain
        switch.ledger.begin_after(meta_now(switch, 0, list(switch.open), luggage.data))

    def _failed(self, live: asyncio.Future[float]) -> None:
        error = None if live.cancelled() else live.exception()
        if error is not None and not self._live.done():
            self._live.set_exception(StartFailed(self.cell.path, str(error)))
            self._live.exception()

    def take_over(self) -> list[Item]:
        group = self._group
        assert group is not None
        if self._recorded is None:
            self._move_in()
        group.hand_to(self._place)
        return []

    def _move_in(self) -> None:
        """What waits for an actor that had no home waits there."""
        cell, more, luggage, switch = self.cell, self.cell.extra(), self.move.luggage, self._switch
        bound, topics, waiting = luggage.bound, list(more.belongings.topics), luggage.waiting
        switch.calls.later.update(luggage.owed)
        if bound is not None:
            waiting, bound.waiting = list(bound.waiting), deque()
        for index, (name, body, left, interval, queued) in enumerate(luggage.rest["timers"]):
            key = f"attached.{index}"
            if queued:
                switch.record(TICK, name, body, None, origin=key)
            if not queued or interval:
                switch.timers.start(key, name, body, left or 0.0, interval or 0.0)
        for item in luggage.queue:
            if isinstance(item, Item) and not isinstance(item, (Ask, Envelope)):
                with contextlib.suppress(HoldfastError):  # What is left is of the life that ends.
                    switch.push(item)
            else:
                switch.admit(cell, item)
        self._home.homes.adopt(cell, switch, self._home.method)
        for topic in topics:
            switch.topics[topic] = None
            cell.node.topics.subscribe(topic, cell)
        let_come(cell, waiting)
        if bound is not None:
            bound.release()
        more.stash = None

    def go_on(self) -> None:
        cell, group, luggage = self.cell, self._group, self.move.luggage
        assert group is not None
        if luggage.suspended:
            group.delivery.is_suspended, cell.extra().suspended = True, mailbox.BY_USER
        self._place.attached(group)
        self._switch.from_life(self._live.result())  # What waits is fed.
        group.go_on()
        self.move.gone_on_at = now()

    def settled(self) -> None:
        group = self._group
        assert group is not None
        if group.membership.is_over:  # No replica is left meanwhile.
            group.owner.has_fallen(group, group.membership.why)

    def discard(self) -> None:
        self.move.ending = asyncio.ensure_future(self._place.dismantle(self.cell))
        if self._group is None:
            return
        if self._live.done() and not self._live.cancelled():
            self._live.exception()
        if self._recorded is None:
            switch = self._switch
            switch.timers.replace({})
            switch.life.abandon()


class FromRecordedGroup(Leaving):
    """A recorded life comes out of a group; `is_below`: its supervisor is in another process."""

    def __init__(self, cell: Cell, *, is_below: bool) -> None:
        old, home = cell.host.place, cell.host.home
        assert isinstance(home, JournalHome)
        if not isinstance(old, GroupPlace) or old.group is None or home.switch is None:
            raise CannotMove(cell.path, "it is being recovered; try again")
        self._host, self._place, self._home, self._group, self._switch = cell.host, old, home, old.group, home.switch
        self._is_below = is_below
        self._detached: Detached | None = None
        self._owner = self._group.owner
        self._has_fallen = False

    async def quiesce(self) -> None:
        group, move = self._group, self.move
        known, delivery = group.membership, group.delivery
        delivery.is_stopping = True
        move.rest_at = now()
        end = move.rest_at + move.timeout
        while True:
            quiet = asyncio.ensure_future(self.quiet())
            try:
                await move.within(quiet, end - now(), lambda: "a turn of it has not ended")
            finally:
                quiet.cancel()
            if move.given_up.done():
                raise CannotMove(self.cell.path, move.given_up.result())
            epoch = known.epoch
            try:
                await self.collect(epoch, end)
            except CannotMove:
                raise
            except AskTimeout:
                continue  # It is asked again: until its time is over, or the move is given up.
            except HoldfastError:
                if await self._has_died(epoch):
                    continue
                raise
            if known.epoch == epoch and known.primary is not None and delivery.is_quiet:
                break
        move.luggage.suspended = delivery.is_suspended
        move.at_rest()
        group.hand_to(self)
        self.detach()

    async def quiet(self) -> None:
        """Wait until nothing is inside; a turn that rests, perhaps for days, is left, and run again elsewhere."""
        await past_resting_turns(self._group, self._group.quiet())

    async def _has_died(self, epoch: int) -> bool:
        """Whether it was for a failover that no state came: it shows within a second."""
        known = self._group.membership
        for _ in range(round(FAILED_OVER_WITHIN / AGAIN_AFTER)):
            if known.epoch != epoch or known.is_over:
                break
            await asyncio.sleep(AGAIN_AFTER)
        return known.epoch != epoch and not known.is_over

    async def collect(self, epoch: int, end: float) -> None:
        """Get the state as it is now from whoever leads; after a failover it is done again."""
        if self._switch.method.snapshots:
            await self.move.within(self._switch.due.wish(), end - now(), lambda: "its state was not saved")

    def life_is_up(self, group: Group, live: Live) -> None:
        """The life has caught up; it had before."""

    def has_fallen(self, group: Group, why: str) -> None:
        """No replica is left meanwhile: the life ends when it is known where it is."""
        self._has_fallen = True
        self.move.give_up(why)

    def detach(self) -> None:
        """Nothing is inside any more: take the life from its home.

        Raises:
            CannotMove: its state could not be kept.
        """
        self._detached = Detached(self._switch)
        refuse_unsaved(self.cell, self._switch)

    def part(self) -> list[Item]:
        self.move.luggage.suspended = self._group.delivery.is_suspended
        self.cell.extra().suspended = 0  # It is suspended where it goes, and not known as that already.
        return []

    def retire(self) -> None:
        """The replicas are not needed any more."""
        place, group = self._place, self._place.group
        if group is not None:
            group.membership.is_over = True
        if place.probation is not None:
            place.probation.left()
        self.move.ending = asyncio.ensure_future(place.dismantle(self.cell))

    def resume(self) -> None:
        if self._is_below and self.move.is_late:
            settle_in(self)
            return
        group, transit = self._group, self.move.transit
        group.delivery.is_stopping = False
        if transit is not None:
            self.take_back(transit)
            transit.over(self.cell, self._host)
            group.hand_to(self._owner)
            if self._has_fallen:
                self._owner.has_fallen(group, group.membership.why)
        group.poke()

    def take_back(self, transit: Transit) -> None:
        """What had been given away."""
        if self._detached is not None:
            self._detached.attach_again(transit)


class AtRest(FromRecordedGroup):
    """A group comes to rest where it is: all replicas stand behind the same turn, and its home has all of it.

    Failover goes on meanwhile.
    """

    def __init__(self, cell: Cell) -> None:
        super().__init__(cell, is_below=False)

    async def quiet(self) -> None:
        """Wait until nothing is inside: a turn that rests comes to its end here, for it belongs to this address."""
        await self._group.quiet()

    async def collect(self, epoch: int, end: float) -> None:
        group = self._group
        replicas, order = group.replicas, Quiesce(epoch, group.adaptation.config, True)
        for name in sorted(replicas.well(), key=lambda one: one != group.membership.primary):
            try:
                asked = replicas.ask(name, order, SETTLED_WITHIN)
                await self.move.within(asked, end - now(), lambda: "its replicas have not come to rest")
            except HoldfastError:
                if self.move.given_up.done() or now() > end:
                    raise
                await asyncio.wait((replicas.stirred(),), timeout=AGAIN_AFTER)
                raise AskTimeout(replicas.place(name), SETTLED_WITHIN) from None  # It may have died: ask all again.
        if self._switch.method.replays:
            await super().collect(epoch, end)

    def detach(self) -> None:
        """It stays with its home, from which nothing new goes in."""


class FromGroup(FromRecordedGroup):
    """A life without recovery comes out of a group; it has no home any more."""

    def __init__(self, cell: Cell, *, is_below: bool) -> None:
        super().__init__(cell, is_below=is_below)
        self._stash: list[int] = []

    async def collect(self, epoch: int, end: float) -> None:
        luggage, owed = self.move.luggage, self._switch.calls.later
        primary = self._group.membership.primary
        if primary is not None:
            ask = self._group.replicas.ask(primary, Export(epoch, EXPORTED_WITHIN), EXPORTED_WITHIN)
            exported = await self.move.within(ask, end - now(), lambda: "its state did not come")
            data = luggage.data = exported.data
            luggage.restore = lambda actor: restore_owing(actor, data, owed)
            self._stash, luggage.traps = list(exported.stash), exported.traps

    def detach(self) -> None:
        """Its home goes when it does."""

    def part(self) -> list[Item]:
        """What waits at the home: what the actor has put aside, and its messages, as a mailbox has them."""
        cell, node, luggage, switch = self.cell, self.move.node, self.move.luggage, self._switch
        for source in switch.open.values():
            if source.kind in (MESSAGE, TICK, PIPE):
                item: Any = source.ask
                if item is None:
                    message = node.codec.message_in(cell, source.name, source.body)
                    sender = node.cell_at(source.sender) if source.sender and source.kind == MESSAGE else None
                    item = message if sender is None else Envelope(message, sender)
                else:
                    item.started = False
                (luggage.stash if source.id in self._stash else luggage.queue).append(item)
            elif source.kind in (EXIT, DOWN):
                luggage.queue.append(arrived(cell, source.kind, source.body))
            else:
                assert source.kind == START
        homed, switch.intake.bound = switch.intake.bound, None
        if homed is not None and homed.capacity:
            luggage.bound = Bound(homed.capacity, cast("Overflow", homed.overflow))
        luggage.waiting = [ask for ask, _, _, _ in homed.waiting] if isinstance(homed, HomeBound) else []
        luggage.timers = [list(timer) for timer in switch.timers.saved().values()]
        luggage.owed = dict(switch.calls.later)
        switch.open.clear()
        switch.calls.later.clear()
        switch.timers.replace({})
        self._homed = homed
        self._home.homes.released(cell.path)
        return super().part()

    def retire(self) -> None:
        if isinstance(self._homed, HomeBound):
            self._homed.senders.release()
        super().retire()


def arrived(cell: Cell, kind: str, body: bytes) -> Exit | Down:
    """An EXIT or DOWN at a mailbox again."""
    data = cell.node.codec.decode(dict[str, Any], body)
    source, reason = cell.node.cell_at(data["source"]), unpack_exit(data["reason"])
    if kind == EXIT:
        return Exit(source, reason)
    return Down(LifeMonitor(cell, source, for_good=data["verb"] == "watch"), reason, bool(data["recovering"]))


def settle_in(side: Leaving) -> None:
    """The life that was on its way has ended: the next one, if it has begun already, has its own place."""
    cell, transit = side.cell, side.move.transit
    if transit is not None:
        transit.over(cell, transit.old if cell.host is transit else cell.host)
