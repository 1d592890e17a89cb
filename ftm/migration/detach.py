"""Detach: the life of a group of replicas becomes that of a task again.

What is inside comes out, and nothing new goes in; the new life takes up the state, and handles nothing until it is the
one. If it does not come so far, the group goes on as if nothing had been.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, cast

from ...actors.errors import AskTimeout, CannotMove, HoldfastError
from ...actors.exit_reasons import unpack_exit
from ...actors.kernel import lifecycle
from ...actors.kernel.cell import Cell, Host
from ...actors.kernel.envelope import Envelope
from ...actors.kernel.lifecycle import LOCAL
from ...actors.kernel.links import Down, Exit, Monitor
from ...actors.kernel.mailbox import Bound
from ...actors.kernel.timers import Timer
from ...actors.migration.here import Arrival
from ...actors.migration.process_move import Move
from ...actors.migration.quiesce import now, obey_commands
from ...actors.overflow import Overflow
from ...checkpoint.home.capacity import HomeBound
from ...checkpoint.home.recorded_hosts import TaskHost
from ...checkpoint.home.recorded_moves import Detached, RecordedArrival, refuse_unsaved
from ...checkpoint.home.switch import Switch
from ...checkpoint.protocol import DOWN, EXIT, MESSAGE, PIPE, START, TICK
from ...checkpoint.snapshot.key_variables import restore_state
from ..bricks.replica_orders import EXPORTED_WITHIN, Export
from ..group.group_host import GroupHost
from ..group.steering import AGAIN_AFTER
from ..group.transient_homes import is_unkept
from .subtree_groups import SubtreeGroup

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor

FAILED_OVER_WITHIN = 1.0


class FromGroup(Move):
    """From a group to a task; what recorded and other actors have in common."""

    to = "task"

    def __init__(self, cell: Cell, host: Host, timeout: float) -> None:
        super().__init__(cell, host, timeout)
        old = cell.host
        if not isinstance(old, GroupHost) or old.group is None or old.switch is None:
            raise CannotMove(cell.path, "it is being recovered; try again")
        self._old, self._group, self._switch = old, old.group, old.switch
        self._home: Detached | None = None
        self._arrival: Arrival | None = None
        self._over = self._group.on_over
        self._has_fallen = False
        self.ending: asyncio.Future[None] | None = None  # that of the replicas

    async def take(self) -> None:
        group = self._group
        group.is_stopping = True
        self.rest_at = now()
        end = self.rest_at + self.timeout
        while True:
            await self.within(group.quiet(), end - now(), lambda: "a turn of it has not ended")
            if self.given_up.done():
                raise CannotMove(self.cell.path, self.given_up.result())
            epoch = group.epoch
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
            if group.epoch == epoch and group.primary is not None and group.out is None and not group.inside:
                return

    async def _has_died(self, epoch: int) -> bool:
        """Whether it was for a failover that no state came: it shows within a second."""
        group = self._group
        for _ in range(round(FAILED_OVER_WITHIN / AGAIN_AFTER)):
            if group.epoch != epoch or group.is_over:
                break
            await asyncio.sleep(AGAIN_AFTER)
        return group.epoch != epoch and not group.is_over

    async def collect(self, epoch: int, end: float) -> None:
        """Get the state as it is now from whoever leads; after a failover it is done again."""
        raise NotImplementedError

    def rested(self) -> None:
        """Nothing is inside any more; if no replica is left meanwhile, the life ends when it is known where it is."""
        self.at_rest()
        self._group.on_over = self._fell

    def _fell(self, why: str) -> None:
        self._has_fallen = True
        self.give_up(why)

    def dismantled(self) -> None:
        """The replicas are not needed any more."""
        host, cell = self._old, self.cell
        group = host.group
        if group is not None:
            group.is_over = True
        if host.probation is not None:
            host.probation.left()
        self.ending = asyncio.ensure_future(host.dismantle(cell))

    def undo(self) -> None:
        cell = self.cell
        if self._arrival is not None:
            self._arrival.discard()
        self._group.is_stopping = False
        transit = self.transit
        if transit is not None:
            if self._home is not None:
                self._home.attach_again(transit)
            transit.over(cell, self._old)
            self._group.on_over = self._over
            if self._has_fallen:
                self._over(self._group.why)
        self._group.poke()


class ToRecordedTask(FromGroup):
    """A recorded actor lives as a task again."""

    host: TaskHost

    async def take(self) -> None:
        await super().take()
        self.rested()
        self._home = Detached(self._switch)

    async def collect(self, epoch: int, end: float) -> None:
        if self._switch.method.snapshots:
            await self.within(self._switch.due.wish(), end - now(), lambda: "its state was not saved")

    async def carry(self) -> None:
        refuse_unsaved(self.cell, self._switch)
        arrival = RecordedArrival(self.cell, self.host)
        self._arrival = arrival
        await arrival.is_up(self, arrival.begin_recorded(suspended=self._group.is_suspended))
        assert self.transit is not None
        with self.commit():
            arrival.take_place()
        self.transit.over(self.cell, self.host)
        self.dismantled()
        arrival.go_on()
        self.gone_on_at = now()
        self.moved()


class ToPlainTask(FromGroup):
    """An actor without recovery lives as a task again, and has no home any more."""

    def __init__(self, cell: Cell, host: Host, timeout: float) -> None:
        super().__init__(cell, host, timeout)
        self._data = b""
        self._stash: list[int] = []
        self._traps = False  # `ctx.trap_exits`

    async def take(self) -> None:
        await super().take()
        self.rested()

    async def collect(self, epoch: int, end: float) -> None:
        group, promised = self._group, self._switch.later
        if promised:  # Nothing is handled any more: they will not become fewer.
            raise CannotMove(self.cell.path, f"{len(promised)} asks wait for replies that only its handles can give")
        primary = group.primary
        if primary is not None:
            ask = group.protocol(primary).ask(Export(epoch, EXPORTED_WITHIN), EXPORTED_WITHIN)
            exported = await self.within(ask, end - now(), lambda: "its state did not come")
            self._data, self._stash, self._traps = exported.data, list(exported.stash), exported.traps

    async def carry(self) -> None:
        start = self.cell.extra().start
        assert start is not None

        def restore(actor: Actor) -> None:
            restore_state(actor, self._data)

        arrival = self._arrival = Arrival(self.cell)
        await arrival.is_up(self, arrival.begin(start, restore, trap_exits=self._traps))
        self._commit(arrival)

    def _commit(self, arrival: Arrival) -> None:
        """From here on the new life is the one."""
        cell, switch = self.cell, self._switch
        assert self.transit is not None
        with self.commit():
            stash, items = self._moved_out(switch)
            homed, switch.bound = switch.bound, None
            self._old.homes.released(cell.path)
            bound = (
                Bound(homed.capacity, cast("Overflow", homed.overflow))
                if homed is not None and homed.capacity
                else None
            )
            commands = arrival.take_over(items, stash, bound, suspended=self._group.is_suspended)
            for name, body, left, interval in switch.timers.saved().values():
                message = cell.node.codec.decode(cell.table.kind_named(name), body)
                Timer.unpacked(cell, message, max(0.0, left), interval or None, False)
            switch.timers.replace({})
            for ask, _, _, _ in getattr(homed, "waiting", ()):
                cell.admit(cell, ask)
            if isinstance(homed, HomeBound):
                homed.senders.release()
        self.transit.over(cell, LOCAL)
        self.dismantled()
        obey_commands(cell, commands)
        lifecycle.up(cell)
        self.gone_on_at = now()
        self.moved()

    def _moved_out(self, switch: Switch) -> tuple[list[Any], list[Any]]:
        """What waits at the home: what the actor has put aside, and its messages, as a mailbox has them."""
        cell, node = self.cell, self.node
        stash: list[Any] = []
        items: list[Any] = []
        for source in switch.open.values():
            if source.kind in (MESSAGE, TICK, PIPE):
                item: Any = source.ask
                if item is None:
                    message = node.codec.message_in(cell, source.name, source.body)
                    sender = node.cell_at(source.sender) if source.sender and source.kind == MESSAGE else None
                    item = message if sender is None else Envelope(message, sender)
                else:
                    item.started = False
                (stash if source.id in self._stash else items).append(item)
            elif source.kind in (EXIT, DOWN):
                items.extend(arrived(cell, source.kind, source.body))
            else:
                assert source.kind == START
        switch.open.clear()
        return stash, items


def arrived(cell: Cell, kind: str, body: bytes) -> list[Any]:
    """An EXIT or DOWN at a mailbox again."""
    data = cell.node.codec.decode(dict[str, Any], body)
    source = cell.node.cell_at(data["source"])
    if kind == EXIT:
        return [Exit(source, unpack_exit(data["reason"]))]
    return [Down(Monitor(cell, source, for_good=False), unpack_exit(data["reason"]), bool(data["recovering"]))]


def from_group(cell: Cell, host: Host, timeout: float) -> FromGroup:
    """The move of a group's life into a task, where `host` lives it.

    Raises:
        CannotMove: it is being recovered.
    """
    old = cell.host
    if isinstance(old, SubtreeGroup):
        if is_unkept(old.method):
            from .unrecorded_handover import IntoProcess

            return IntoProcess(cell, timeout)
        from .recorded_handover import IntoSubtree

        return IntoSubtree(cell, timeout)
    if isinstance(old, GroupHost) and is_unkept(old.method):
        return ToPlainTask(cell, host, timeout)
    return ToRecordedTask(cell, host, timeout)
