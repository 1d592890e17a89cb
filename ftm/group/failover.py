"""The failover manager: it carries out who leads, and in which epoch (T36 to T39).

`membership.next_step` decides what comes next; each step leaves the group such that the next life of this actor can go
on from there.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from ...actors.errors import AskTimeout, HoldfastError
from ...actors.kernel.actor import on
from ...actors.kernel.message import Message
from ..bricks.brick_messages import Lead
from ..bricks.replica_orders import Commit, PrepareStack, SetPeer
from ..bricks.sealed_frames import Refused
from ..events import FailedOver
from .hung import end_stuck
from .membership import LookAgain, is_to_end, next_step
from .replicas import AGAIN_AFTER, GroupPart

if TYPE_CHECKING:
    from collections.abc import Callable

    from .group import Group
    from .reconfiguration import Reconfiguration

ANSWERED_WITHIN = 1.0
"""Seconds after which a replica is looked at again that was told something: it may have been suspected meanwhile."""
BACK_WITHIN = 30.0
"""Seconds after which a replica is given up that is brought back to an earlier stack of mechanisms."""
INSPECT_EVERY = 5.0
"""Seconds between two looks at those that do not lead."""


class Inspect(Message):
    """It is time to look at those that do not lead."""


class FailoverManager(GroupPart):
    """Sees to it that one replica leads, and that it waits for no dead ones, nor for those that let nothing pass."""

    def __init__(self, group: Group, step: Callable[[str], None] = lambda step: None) -> None:
        self._group, self._known, self._replicas = group, group.membership, group.replicas
        self._step = step
        self._inspection: asyncio.Task[None] | None = None
        self._inspected = -1  # the last turn behind which the others were looked at

    def on_start(self, restored: bool) -> None:
        """The last life may have died in the middle of a step."""
        self._replicas.tell("failover", LookAgain())
        self.ctx.every(INSPECT_EVERY, Inspect())

    @on(LookAgain)
    async def look(self, message: LookAgain) -> None:
        """Carry out what is to be done, step by step, until there is nothing."""
        known, replicas = self._known, self._replicas
        while not known.is_over and known.is_begun:
            if self._group.adaptation.is_changing:
                return  # It is short, and whoever does it wakes us.
            now, hopeless = replicas.node.loop.time(), replicas.detection.hopeless
            kind, name = next_step(known, replicas.lives(), now, hopeless)
            match kind:
                case "wait":
                    self._later()
                    return
                case "depose":
                    if not replicas.hold.take(f"{name} does not lead any more"):
                        self._later()
                        return
                    self._depose(name)
                case "condemn":
                    known.condemn(name)
                    replicas.lost(name, known.why)
                case "renew" | "elect":
                    if not self._elect(name):
                        return
                case "fall":
                    self._group.fall(known.why)
                    return
                case "bury":
                    await self._bury(name)
                case "lead":
                    await self._lead(name)
                case "forget":
                    del known.joining[name]
                    known.dropped.add(name)
                case "drop":
                    await self._drop(name)
                case "tell":
                    if not await self._tell_peer():
                        break
                case "rest":
                    break
        replicas.tell("join", LookAgain())

    @on(Inspect)
    def inspect(self, message: Inspect) -> None:
        """Look at those that do not lead, unless nothing has come to them. (On probation they are looked at anyway.)"""
        group, turn = self._group, self._group.switch.turn
        is_busy = self._known.is_over or group.adaptation.is_changing or self._inspection is not None
        is_idle = turn == self._inspected and group.delivery.is_idle
        if is_busy or is_idle or group.copies.untrusted:
            return
        if self._known.primary is not None and self._replicas.backups():
            self._inspection = self.ctx.create_task(self._inspect(turn))

    async def _inspect(self, turn: int) -> None:
        try:
            await end_stuck(self._replicas, turn)
            self._inspected = turn
        except HoldfastError:
            return  # The next look is soon.
        finally:
            self._inspection = None

    def _depose(self, name: str) -> None:
        """What it says from now on does not count."""
        known = self._known
        self._step("depose")
        cell = self._replicas.cell_of(name)
        if not known.is_suspect(name, known.members.get(name, 0)):
            known.why = "its process has ended" if cell is None else f"its process has ended ({cell.extra().reason})"
        known.condemn(name)
        self._replicas.lost(name, known.why)

    def _elect(self, name: str) -> bool:
        """Begin an epoch in which this one is to lead, with other bricks if it does so now; False: the life is over."""
        group, known = self._group, self._known
        if known.primary is None:
            if group.background.is_lost():  # From the journal it is begun again.
                group.fall(f"{known.why}, with background work (pipe_to_self) out")
                return False
            group.behind.drop()
        self._step("epoch")
        known.elect(name)
        group.forget_answers()
        return True

    async def _bury(self, name: str) -> None:
        """It must be dead before another one leads, or before its next life joins."""
        self._step("kill")
        await self._replicas.bury(name, self._known.condemned[name])
        self._known.condemned.pop(name, None)

    async def _lead(self, name: str) -> None:
        """Tell a replica to lead, with the stack of mechanisms that is wanted; then send to it."""
        group, known, replicas = self._group, self._known, self._replicas
        back = group.place.back_to(group)
        if back is not None and not await self._bring_back(name, back):
            return
        self._step("lead")
        peer, turn = known.peer_of(name, replicas.lives()), group.switch.turn
        path = None if peer is None else replicas.place(peer)
        least = -1 if group.switch.method.replays else turn  # Turns that are lost do not come again.
        order = Lead(known.epoch, group.adaptation.config, least, path, turn)
        try:
            await replicas.ask(name, order, ANSWERED_WITHIN)
        except AskTimeout:
            return
        except HoldfastError as error:
            if replicas.is_well(name) and not (back is not None and isinstance(error, Refused)):
                replicas.blame(name, known.members[name], f"it refused to lead: {error}")
            return
        self._step("bind")
        if replicas.is_well(name):
            self._bind(name)

    async def _bring_back(self, name: str, back: Reconfiguration) -> bool:
        """Whether a replica that is to lead has the stack again that was there before one which has failed."""
        known, replicas = self._known, self._replicas
        life = known.members.get(name, 0)
        self._step("back")
        try:
            await replicas.ask(name, PrepareStack(back.config, back.descriptions), BACK_WITHIN)
            await replicas.ask(name, Commit(back.config, insists=True), BACK_WITHIN)
        except HoldfastError as error:
            if replicas.is_well(name):
                replicas.suspect(name, life, f"it could not go back to the mechanism before: {error}")
            return False
        self._group.place.went_back(self._group, back)
        for other in [one for one in known.members if one != name]:
            replicas.lost(other, "it has the stack that has failed, and begins again")
        return True

    def _bind(self, name: str) -> None:
        """The proxy sends to it from here on."""
        group, known, replicas = self._group, self._known, self._replicas
        seconds = time.monotonic() - known.noticed if known.noticed else 0.0
        behind = known.bind(name)
        replicas.bind_proxy()
        for other in behind:
            replicas.lost(other, "it has to catch up with the new primary")
        group.failovers += 1
        replicas.hold.give_back()
        group.send_again(careful=True)
        replicas.node.emit(FailedOver(replicas.path, name, known.epoch, seconds, known.why))

    async def _drop(self, name: str) -> None:
        """A backup that has ended, or is suspected, does not count, and is killed if it lives."""
        known, replicas = self._known, self._replicas
        lives = replicas.lives()
        is_alive = is_to_end(known, name, lives)
        if name in known.members and not known.is_well(name, lives):
            replicas.lost(name, known.suspected[name].why if is_alive else "its process has ended")
        known.dropped.add(name)
        if is_alive:
            self._step("kill")
            await replicas.bury(name, lives[name])

    async def _tell_peer(self) -> bool:
        """Have the primary wait no longer for those that do not count any more; False: it has not answered."""
        known, replicas = self._known, self._replicas
        primary = known.primary
        assert primary is not None
        self._step("peer")
        left = replicas.backups()
        order = SetPeer(known.epoch, replicas.place(left[0]) if left else None)
        try:
            await replicas.ask(primary, order, ANSWERED_WITHIN)
        except HoldfastError:
            if replicas.is_well(primary):
                self._later()
                return False
        else:
            known.dropped.clear()
            known.noticed = 0.0
        return True

    def _later(self) -> None:
        self.call_later(AGAIN_AFTER, self._replicas.wake)
