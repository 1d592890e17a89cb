"""Attach: the life at an address moves from a task into a group of replicas.

The old life comes to rest between two turns; the new one takes up its state, and handles nothing until it is the one. A
group is that only when a second replica has caught up. If it does not come so far, the old life goes on as if nothing
had been.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from typing import TYPE_CHECKING, Any

from ...actors.errors import CannotMove, HoldfastError, StartFailed
from ...actors.exit_reasons import ExitReason, Shutdown
from ...actors.kernel.cell import Cell
from ...actors.kernel.envelope import Item
from ...actors.kernel.lifecycle import LOCAL, Stop
from ...actors.kernel.mailbox import Bound
from ...actors.kernel.message import message_name
from ...actors.migration.here import Departure
from ...actors.migration.luggage import Stays, check_sendable, pack_rest
from ...actors.migration.process_move import Move
from ...actors.migration.quiesce import farewell, now, obey_commands, part, resume, sorted_out
from ...actors.process.wire.peer import OutsideHost
from ...checkpoint.home.recorded_hosts import TaskHost
from ...checkpoint.home.recorded_moves import Detached, leave_task, refuse_unsaved
from ...checkpoint.home.subtree_homes import SubtreeHome
from ...checkpoint.home.switch import Switch
from ...checkpoint.protocol import MESSAGE, TICK, Live
from ...checkpoint.snapshot.key_variables import save_state
from ...checkpoint.snapshot.snapshot_record import meta_now
from ..group.group import Group, Look
from ..group.group_host import GroupHost
from ..group.trial import rehearsed

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor
    from ...checkpoint.home.homes import Homes

MADE_WITHIN = 60.0
"""Seconds that the processes of the replicas may take to come up; the old life works on meanwhile."""


class ToGroup(Move):
    """From a task to a group."""

    to = "group"

    def __init__(self, cell: Cell, host: GroupHost, timeout: float) -> None:
        super().__init__(cell, host, timeout)
        self.host: GroupHost = host
        self._old = cell.host
        self._departure: Departure | None = None
        self._live: asyncio.Future[Live] = self.node.loop.create_future()
        self._joined: asyncio.Future[None] = self.node.loop.create_future()
        self._group: Group | None = None
        self._home: Detached | None = None
        self._switch = self._old.switch if isinstance(self._old, TaskHost) else None
        self._rest: dict[str, Any] = {}
        self.ending: asyncio.Future[None] | None = None  # that of the replicas, if they are not needed

    @property
    def is_recorded(self) -> bool:
        """Whether the actor has a home already."""
        return isinstance(self._old, TaskHost)

    async def prepare(self) -> None:
        cell, host = self.cell, self.host
        if cell.children:
            raise CannotMove(
                cell.path,
                f"it has children of its own ({', '.join(cell.children)}): have a supervisor start them beside it",
            )
        if self._switch is None:
            self._switch = host.homes.made(cell, host.method)
        switch = host.switch = self._switch
        group = self._group = await self.within(
            host.build(cell, switch), MADE_WITHIN, lambda: "its replicas were not up"
        )
        group.on_live, group.on_joined = self._is_live, self._has_joined
        group.on_over = self.give_up
        # Its replicas have no part yet: one of them tries what all of them are to do.
        await self.within(
            rehearsed(group, group.names[-1]), MADE_WITHIN, lambda: "its replicas could not try their parts"
        )

    def _is_live(self, live: Live) -> None:
        if not self._live.done():
            self._live.set_result(live)

    def _has_joined(self) -> None:
        if not self._joined.done():
            self._joined.set_result(None)

    async def take(self) -> None:
        self._departure = Departure(self, self._owe, self._pack, ignored=("ftm",))
        await self._departure.quiesce()

    def _owe(self, ask: Any) -> int:
        raise Stays("an ask waits for its reply, which it could not give from another place")

    def _pack(self, actor: Actor, state: bytes) -> None:
        switch = self._switch
        assert switch is not None
        if self.is_recorded:
            self._home = Detached(switch)
        else:
            check_sendable(self.cell)
            data, self._rest = save_state(actor), pack_rest(actor)
            self._plant(switch, data)

    def _plant(self, switch: Switch, data: bytes) -> None:
        """The home of an actor that had none begins with its state, and with what it has put aside."""
        cell = self.cell
        for item in cell.extra().stash or ():
            message, sender = (item.message, item.sender) if hasattr(item, "message") else (item, None)
            body = cell.node.codec.encode(message, cell.path)
            origin = None if sender is None else sender.path
            source = switch.record(MESSAGE, message_name(type(message)), body, origin)
            if hasattr(item, "future"):
                source.ask, source.chain = item, item.chain
        switch.turn = 0
        switch.newest = meta_now(switch, 0, list(switch.open), data)
        switch.stash = list(switch.open)

    async def carry(self) -> None:
        cell, host, group, switch = self.cell, self.host, self._group, self._switch
        assert group is not None
        assert switch is not None
        refuse_unsaved(cell, switch if self.is_recorded else None)
        live = switch.prepare()
        live.add_done_callback(self._failed)
        await self.within(host.lead(group, switch), self.timeout, lambda: "its first replica did not lead")
        switch.attach(group)
        ended = await self.within(self._live, self.timeout, lambda: "its new life was not up")
        group.wake()
        if len(group.names) > 1:
            group.tell("join", Look())
            await self.within(self._joined, self.timeout, lambda: "no second replica caught up")
        self._switch_over(ended)

    def _failed(self, live: asyncio.Future[float]) -> None:
        error = None if live.cancelled() else live.exception()
        if error is not None and not self._live.done():
            self._live.set_exception(StartFailed(self.cell.path, str(error)))
            self._live.exception()

    def _switch_over(self, live: Live) -> None:
        """From here on the group is the one."""
        cell, host, group, switch, more = self.cell, self.host, self._group, self._switch, self.cell.extra()
        assert self.transit is not None
        assert group is not None
        assert switch is not None
        self.is_done = True
        tap = more.tap
        if tap is not None:
            tap.detach()
        suspended = more.suspended
        stop: Item
        old_host = self._old
        if isinstance(old_host, TaskHost):
            old, stop, commands = leave_task(cell, old_host, self.reason())
        else:
            topics, bound = list(more.topics), more.bound
            old = part(cell)
            items, commands = sorted_out(cell)
            self._move_in(switch, items, topics, bound)
            stop = Stop(self.reason())
        host.take_over(cell, group)
        self.transit.over(cell, host)
        if suspended:
            group.is_suspended = more.suspended = True
        host.attached(cell, group)
        switch.from_life(live)  # What waits is fed.
        group.go_on()
        self.gone_on_at = now()
        obey_commands(cell, commands)
        farewell(old, stop)
        self.moved()

    def _move_in(self, switch: Switch, items: list[Any], topics: list[str], bound: Bound | None) -> None:
        """What waits for an actor that had no home waits there."""
        cell, more = self.cell, self.cell.extra()
        waiting = []
        if bound is not None:
            waiting, bound.waiting = list(bound.waiting), deque()
        for index, (name, body, left, interval, queued) in enumerate(self._rest["timers"]):
            key = f"attached.{index}"
            if queued:
                switch.record(TICK, name, body, None, origin=key)
            if not queued or interval:
                switch.timers.start(key, name, body, left or 0.0, interval or 0.0)
        for item in items:
            if isinstance(item, Item) and not hasattr(item, "message"):
                with contextlib.suppress(HoldfastError):  # What is left is of the life that ends.
                    switch.push(item)
            else:
                switch.admit(cell, item)
        self.host.homes.adopt(cell, switch, self.host.method)
        for topic in topics:
            switch.topics[topic] = None
            cell.node.topics.subscribe(topic, cell)
        for item in waiting:
            cell.admit(cell, item)
        if bound is not None:
            bound.release()
        more.stash = None

    def reason(self) -> ExitReason:
        return Shutdown("moved into a group of replicas")

    def undo(self) -> None:
        cell = self.cell
        if self._departure is not None:
            self._departure.call_off()
        self.ending = asyncio.ensure_future(self.host.dismantle(cell))
        if self._live.done() and not self._live.cancelled():
            self._live.exception()
        transit = self.transit
        if not self.is_recorded and self._switch is not None:
            self._switch.timers.replace({})
            if self._switch.live is not None and not self._switch.live.done():
                self._switch.live.cancel()
        if transit is None:
            return
        if self._home is not None:
            self._home.attach_again(transit)
        transit.over(cell, transit.old)
        resume(cell)


def to_group(cell: Cell, homes: Homes, mechanism: Any, timeout: float) -> ToGroup:
    """The move of a task into a group.

    Raises:
        CannotMove: it lives somewhere else.
    """
    old = cell.host
    if isinstance(old, TaskHost):
        return ToGroup(cell, GroupHost(homes, old.method, mechanism), timeout)
    if isinstance(old, SubtreeHome):
        from .recorded_handover import OutOfSubtree

        return OutOfSubtree(cell, old, mechanism, timeout)
    if isinstance(old, OutsideHost):
        from .unrecorded_handover import OutOfProcess

        return OutOfProcess(cell, old, mechanism, timeout)
    if old is not LOCAL:
        raise CannotMove(cell.path, "only an actor that lives as a task can be given a mechanism")
    return ToGroup(cell, GroupHost(homes, None, mechanism), timeout)
