"""The failover manager: who leads, and in which epoch (T36 to T39).

Each step leaves the group such that the next life of this actor can go on from there. The order is what keeps two
replicas from leading at once: the epoch goes up; the old primary is killed and reaped; the new one is told to lead;
only then the proxy sends to it.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, ClassVar

from ...actors.errors import ActorStopped, AskFailed, AskTimeout, HoldfastError
from ...actors.exit_reasons import KILLED
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.cell import RUNNING
from ...actors.kernel.message import Message
from ..bricks.brick_messages import Lead
from ..bricks.replica_orders import Commit, Peer, Prepare
from ..bricks.sealed_frames import Refused
from ..events import FailedOver
from .group import Look
from .hung import end_stuck

if TYPE_CHECKING:
    from collections.abc import Callable

    from .group import Group
    from .reconfiguration import Reconfiguration

ANSWERED_WITHIN = 1.0
"""Seconds after which a replica is looked at again that was told something: it may have been suspected meanwhile."""
TOLD_WITHIN = 1.0
"""Seconds until the end of a replica that has said so is known with its reason."""
BACK_WITHIN = 30.0
"""Seconds after which a replica is given up that is brought back to an earlier stack of mechanisms."""
INSPECT_EVERY = 5.0
"""Seconds between two looks at those that do not lead."""
AGAIN_AFTER = 0.05
"""Seconds until something is tried again that a replica has refused."""


class Inspect(Message):
    """It is time to look at those that do not lead."""


class FailoverManager(Actor):
    """Sees to it that one replica leads, and that it waits for no dead ones, nor for those that let nothing pass."""

    _is_part: ClassVar[bool] = True

    deterministic = False

    def __init__(self, group: Group, step: Callable[[str], None] | None = None) -> None:
        self._group = group
        self._step = step or nothing
        self._timer: asyncio.TimerHandle | None = None
        self._inspection: asyncio.Task[None] | None = None
        self._inspected = -1  # the last turn behind which the others were looked at

    def on_start(self, restored: bool) -> None:
        """The last life may have died in the middle of a step."""
        self._group.tell("failover", Look())
        self.ctx.every(INSPECT_EVERY, Inspect())

    def on_stop(self, reason: object) -> None:
        if self._timer is not None:
            self._timer.cancel()

    @on(Look)
    async def look(self, message: Look) -> None:
        """See what is to be done, until there is nothing."""
        group = self._group
        while not group.is_over and group.is_begun:
            if group.is_changing:
                return  # It is short, and whoever does it wakes us.
            if group.primary is not None and group.primary == group.renewing and group.is_well(group.primary):
                self._renew(group.primary)
            elif group.primary is not None and not group.is_well(group.primary):
                if group.is_awaited(group.primary):  # To end it would lose what only it has.
                    self._later()
                    return
                if not group.hold.take(f"{group.primary} does not lead any more"):
                    self._later()
                    return
                self._depose(group.primary)
            elif group.primary is None:
                if not await self._replaced():
                    return
            elif not await self._tidied():
                break
        group.tell("join", Look())

    @on(Inspect)
    def inspect(self, message: Inspect) -> None:
        """Look at those that do not lead, unless nothing has come to them. (On probation they are looked at anyway.)"""
        group = self._group
        is_idle = group.switch.turn == self._inspected and group.out is None and not group.waiting
        is_quiet = not (group.is_over or group.is_changing or group.untrusted or self._inspection is not None)
        if is_quiet and not is_idle and group.primary is not None and group.backups():
            self._inspection = self.ctx.create_task(self._inspect(group.switch.turn))

    async def _inspect(self, turn: int) -> None:
        try:
            await end_stuck(self._group)
            self._inspected = turn
        except HoldfastError:
            return  # The next look is soon.
        finally:
            self._inspection = None

    def _depose(self, name: str) -> None:
        """What it says from now on does not count, and it must be dead before another one leads."""
        group = self._group
        self._step("depose")
        life = group.members.get(name, 0)
        cell = group.cell_of(name)
        if group.suspects.get(name) != life:
            group.why = "its process has ended" if cell is None else f"its process has ended ({cell.extra().reason})"
        group.primary, group.condemned[name] = None, life
        group.lost(name, group.why)

    def _renew(self, name: str) -> None:
        """The only replica that is left leads anew, in another epoch, when it has other bricks."""
        group = self._group
        self._step("epoch")
        group.epoch += 1
        group.forget_answers()
        group.primary, group.leading, group.renewing = None, name, None

    async def _replaced(self) -> bool:
        """One step towards another primary; False: none is left."""
        group = self._group
        leading = group.leading
        if leading is None or not group.is_well(leading):
            if leading is not None:
                if group.silences.get(leading) == group.suspects.get(leading) and group.is_awaited(leading):
                    self._later()  # It may be building the actor from a large state, which nobody else has.
                    return False
                group.condemned[leading] = group.members.get(leading, 0)
                group.lost(leading, group.why)
                group.leading = None
            left = group.backups()
            if left and group.background.is_lost():  # From the journal it is begun again.
                group.why, left = f"{group.why}, with background work (pipe_to_self) out", []
            if not left:
                group.is_over = True
                group.on_over(group.why)
                return False
            self._step("epoch")
            group.epoch += 1
            group.forget_answers()
            group.behind.drop()
            group.leading = left[0]
            return True
        for name, life in list(group.condemned.items()):
            self._step("kill")
            await bury(group, name, life)
            group.condemned.pop(name, None)
        back = group.back_to()
        if back is not None and not await self._brought_back(leading, back):
            return True
        self._step("lead")
        try:
            known = group.switch.turn
            order = Lead(group.epoch, group.config, group.least_turn(), group.peer_of(leading), known)
            await group.protocol(leading).ask(order, ANSWERED_WITHIN)
        except AskTimeout:
            return True
        except HoldfastError as error:
            if group.is_well(leading) and not (back is not None and isinstance(error, Refused)):
                group.suspect(leading, group.members[leading], f"it refused to lead: {error}")
                group.at_fault(leading, f"it refused to lead: {error}")
            return True
        self._step("bind")
        if group.is_well(leading):
            self._bind(leading)
        return True

    async def _brought_back(self, name: str, back: Reconfiguration) -> bool:
        """Whether a replica that is to lead has the stack again that was there before one which has failed."""
        group, life = self._group, self._group.members.get(name, 0)
        self._step("back")
        try:
            await group.protocol(name).ask(Prepare(back.config, back.descriptions), BACK_WITHIN)
            await group.protocol(name).ask(Commit(back.config, insists=True), BACK_WITHIN)
        except HoldfastError as error:
            if group.is_well(name):
                group.suspect(name, life, f"it could not go back to the mechanism before: {error}")
            return False
        group.went_back(back)
        for other in [one for one in group.members if one != name]:
            group.lost(other, "it has the stack that has failed, and begins again")
        return True

    def _bind(self, name: str) -> None:
        """From here on it is the one."""
        group = self._group
        group.primary, group.leading = name, None
        group.bind_proxy()
        for other in [one for one in group.members if one != name and not group.keeps_members]:
            group.lost(other, "it has to catch up with the new primary")
        group.failovers += 1
        group.hold.give_back()
        seconds = time.monotonic() - group.noticed if group.noticed else 0.0
        group.noticed = 0.0
        group.send_again(careful=True)
        group.node.emit(FailedOver(group.path, name, group.epoch, seconds, group.why))

    async def _tidied(self) -> bool:
        """Backups that have ended, or are suspected, do not count, and nobody waits for them. Whether one was."""
        group, found = self._group, False
        for name, life in list(group.joining.items()):
            if group.life_of(name) != life:  # Its next life has to be told first that it follows.
                del group.joining[name]
                group.dropped.add(name)
        for name, life in list(group.strays.faulty.items()):
            self._step("kill")
            await bury(group, name, life)
            group.strays.faulty.pop(name, None)
            found = True
        for name in group.names:
            life = group.members.get(name, 0) or group.up.get(name, 0)
            if name == group.primary or not life:
                continue
            is_suspect = group.suspects.get(name) == life and group.life_of(name) == life
            if name in group.members and not group.is_well(name):
                group.lost(name, group.doubts[name] if is_suspect else "its process has ended")
                group.dropped.add(name)
                found = True
            if is_suspect:
                group.dropped.add(name)
                self._step("kill")
                await bury(group, name, life)
                found = True
        return await self._alone() or found

    async def _alone(self) -> bool:
        """Have the primary wait no longer for those that do not count any more."""
        group, primary = self._group, self._group.primary
        if not group.dropped or primary is None:
            return False
        self._step("peer")
        left = group.backups()
        try:
            await group.protocol(primary).ask(
                Peer(group.epoch, group.place(left[0]) if left else None), ANSWERED_WITHIN
            )
        except HoldfastError:
            if group.is_well(primary):
                self._later()
                return False
        else:
            group.dropped.clear()
            group.noticed = 0.0
        return True

    def _later(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.ctx.cell.node.loop.call_later(AGAIN_AFTER, self._group.wake)


async def bury(group: Group, name: str, life: int) -> None:
    """Kill a replica's process, if it is that life, and wait until it has been reaped."""
    while not group.is_over:
        with group.hold.of(group.place(name), "it does not count any more") as is_ours:
            if is_ours:
                await killed(group, name, life)
                return
        await asyncio.sleep(AGAIN_AFTER)


async def killed(group: Group, name: str, life: int) -> None:
    """Kill a replica's process, if it is that life, and wait until it has been reaped; by nobody's leave."""
    cell = group.cell_of(name)
    if cell is None or cell.life != life or cell.state is not RUNNING:
        return
    worker = group.worker_of(name)
    if worker is None:
        cell.kill()
        await cell.ended()
    else:
        worker.kill(KILLED)
        await worker.gone()


def nothing(step: str) -> None:
    """Nobody wants to know of the steps."""


async def why_ended(group: Group, name: str, life: int, error: HoldfastError) -> str:
    """Why a replica has not done as it was told: if it has ended, it says soon of what."""
    cell = group.cell_of(name)
    if not isinstance(error, (ActorStopped, AskFailed)) or cell is None:
        return str(error)
    if group.life_of(name) == life:
        await asyncio.wait((cell.ended(),), timeout=TOLD_WITHIN)
    return str(cell.extra().reason)
