"""Detach: the life of a group of replicas becomes that of a task again.

What is inside comes out, and nothing new goes in; the new life takes up the state, and handles nothing until it is the
one. If it does not come so far, the group goes on as if nothing had been.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Any, cast

from ...actors.errors import AskTimeout, CannotMove, HoldfastError, StartFailed
from ...actors.exit_reasons import ExitReason, unpack_exit
from ...actors.kernel import lifecycle, mailbox
from ...actors.kernel.cell import Cell, Host
from ...actors.kernel.context import ActorContext
from ...actors.kernel.envelope import Envelope
from ...actors.kernel.lifecycle import LOCAL
from ...actors.kernel.links import Down, Exit, Monitor
from ...actors.kernel.mailbox import Bound, Overflow
from ...actors.kernel.timers import Timer
from ...actors.migration.process_move import Move
from ...actors.migration.quiesce import decoded, now, obey_commands, settle, sorted_out, twin
from ...actors.migration.to_task import dispose
from ...actors.migration.worker_moves import await_up
from ...checkpoint.home.capacity import HomeBound
from ...checkpoint.home.recorded_hosts import LocalLife, TaskHost
from ...checkpoint.home.recorded_moves import ArrivingHome, Detached, refuse_unsaved
from ...checkpoint.home.switch import Switch
from ...checkpoint.life.recorded_life import Life
from ...checkpoint.protocol import DOWN, EXIT, MESSAGE, PIPE, START, TICK
from ...checkpoint.snapshot.key_variables import restore_state
from ..group.group_host import GroupHost
from ..group.steering import AGAIN_AFTER
from ..group.transient_homes import is_unkept
from ..replica.replica_orders import Export
from .subtree_groups import SubtreeGroup

EXPORTED_WITHIN = 5.0
"""Seconds until whoever leads is asked again for the state: it may have died with the question."""
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
        self._twin: Cell | None = None
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
        if self._twin is not None:
            dispose(self._twin)
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
        cell, host, start = self.cell, self.host, self.cell.extra().start
        assert start is not None
        refuse_unsaved(cell, self._switch)
        other = self._twin = twin(cell)
        other.life -= 1  # Counted up by the life that begins; it is no other one.
        other.extra().bindings = cell.extra().bindings
        switch, live, _ = host.open(cell)
        settled: asyncio.Future[None] = self.node.loop.create_future()
        home = ArrivingHome(host, cell, other, settled)
        host.page = host.homes.page(switch)
        life = Life(other, home, host.method, host.page)
        life.begins_suspended = self._group.is_suspended
        for record in switch.restore_records():
            life.from_home(record)
        other.ended().add_done_callback(lambda done: home.fail(StartFailed(cell.path, str(done.result()))))
        life.begin(start, switch.state_turn, switch.stash)
        switch.attach(LocalLife(life))
        live.add_done_callback(lambda done: None if done.cancelled() else home.fail(done.exception()))
        await self.within(settled, self.timeout, lambda: "its new life was not up")
        self._switch_over(other, life, home)

    def _switch_over(self, other: Cell, life: Life, home: ArrivingHome) -> None:
        """From here on the new life is the one."""
        cell, host, more = self.cell, self.host, self.cell.extra()
        assert self.transit is not None
        self.is_done = True
        tap = more.tap
        if tap is not None:
            tap.detach()
        queue, its = other.queue, other.extra()
        urgent, suspended = its.urgent, its.suspended
        settle(other, cell)
        life.cell = cell
        cell.queue, more.urgent, more.suspended = deque(queue or ()), urgent, suspended
        host.life, host.clock = life, None
        if tap is not None:
            tap.attach()
        self.transit.over(cell, host)
        self.dismantled()
        lifecycle.up(cell)
        home.open()  # Now it is live: its home feeds it what waits.
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
        switch = self._switch
        await super().take()
        if switch.later:
            raise CannotMove(
                self.cell.path, f"{len(switch.later)} asks wait for replies that only its handles can give"
            )
        self.rested()

    async def collect(self, epoch: int, end: float) -> None:
        group = self._group
        primary = group.primary
        if primary is not None:
            ask = group.protocol(primary).ask(Export(epoch), EXPORTED_WITHIN)
            exported = await self.within(ask, end - now(), lambda: "its state did not come")
            self._data, self._stash, self._traps = exported.data, list(exported.stash), exported.traps

    async def carry(self) -> None:
        cell, start = self.cell, self.cell.extra().start
        assert start is not None
        other = self._twin = twin(cell)
        other.table = start.kind._table
        other.extra().bindings = cell.extra().bindings
        lifecycle.build(other, start, ActorContext)
        other.extra().trap_exits = self._traps
        actor = other.actor
        assert actor is not None
        try:
            restore_state(actor, self._data)
        except Exception as error:
            raise StartFailed(cell.path, f"its state could not be restored: {error}") from error
        gone, settled = other.ended(), await_up(other, start)
        gone.add_done_callback(lambda done: self._ended_early(settled, done.result()))
        await self.within(settled, self.timeout, lambda: "its new life was not up")
        self._switch_over(other)

    def _switch_over(self, other: Cell) -> None:
        """From here on the new life is the one."""
        cell, more, switch = self.cell, self.cell.extra(), self._switch
        assert self.transit is not None
        self.is_done = True
        tap = more.tap
        if tap is not None:
            tap.detach()
        own, commands = sorted_out(other, ticks=True)
        settle(other, cell)
        stash, items = self._moved_out(switch)
        more.outlet = None
        cell.admit = mailbox.admit_first
        homed, switch.bound = switch.bound, None
        self._old.homes.released(cell.path)
        if homed is not None and homed.capacity:
            more.bound = Bound(homed.capacity, cast("Overflow", homed.overflow))
            cell.admit = mailbox.admit_bounded
        cell.queue = None  # All is at the home; the queue of a bounded mailbox is another one.
        queue = mailbox.queue_of(cell)
        taken = (decoded(cell, item) for item in (*own, *items))
        queue.extend(item for item in taken if item is not None)
        if more.bound is not None:
            more.bound.count = sum(map(mailbox.counts, queue))
        kept = [one for item in stash if (one := decoded(cell, item)) is not None]
        more.stash = deque(kept) if kept else None
        for name, body, left, interval in switch.timers.saved().values():
            message = cell.node.codec.decode(cell.table.kind_named(name), body)
            Timer.unpacked(cell, message, max(0.0, left), interval or None, False)
        switch.timers.replace({})
        for ask, name, body, sender in getattr(homed, "waiting", ()):
            del name, body, sender
            cell.admit(cell, ask)
        if isinstance(homed, HomeBound):
            homed.senders.release()
        if self._group.is_suspended:
            more.suspended = True
            mailbox.hold(cell)
        else:
            more.suspended = False
        if tap is not None:
            tap.attach()
        self.transit.over(cell, LOCAL)
        self.dismantled()
        obey_commands(cell, commands)
        lifecycle.up(cell)
        self.gone_on_at = now()
        self.moved()

    def _ended_early(self, settled: asyncio.Future[None], reason: ExitReason) -> None:
        if not settled.done():
            settled.set_exception(StartFailed(self.cell.path, str(reason)))
            settled.exception()

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
