"""Probation: a stack of mechanisms that has just been changed to is not trusted until it has worked for a while.

If a replica ends meanwhile by what its own code has done, or the bricks let nothing pass, the stack before comes back.
Who leads then is brought to that stack before it leads, so that no request ever meets the bad bricks again.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from ...actors.errors import HoldfastError
from ...actors.kernel.message import message_name
from ..bricks.brick_messages import RequestDropped
from ..bricks.replica_orders import Computes, Doing
from ..events import MechanismSettled
from ..model.mechanism import NOTHING
from .hung import ASKED_WITHIN, STUCK_AFTER, end_stuck

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from ...checkpoint.protocol import TurnEnd
    from ..model.mechanism import Mechanism
    from .group import Group
    from .reconfiguration import Reconfiguration

SECONDS: Final = 5.0
"""It lasts at least so long with the same replicas: one that dies, of whatever, may hide what the bricks would do,"""
TURNS: Final = 100
"""and until so many turns of theirs have ended,"""
MOST_SECONDS: Final = 60.0
"""but no longer than this, as soon as nothing is in the bricks of which that is not known."""
LOOK_EVERY: Final = 1.0
"""Seconds between two looks at how it does."""
LONGEST_PAUSE: Final = 60.0
"""Seconds until going back is tried again, if it could not be; doubled each time, from one second on."""
DROPPED: Final = message_name(RequestDropped)


class Probation:
    """One stack of mechanisms that is not trusted yet.

    Args:
        group: the one that has it.
        before: the stack that comes back.
        change: how it came to this one.
        earlier: the probation that was not over when this one began: the stack before is not trusted either.
        begin: starts going back, while the group is led as before.
        over: called once, with whether it stays.
    """

    def __init__(
        self,
        group: Group,
        before: tuple[Mechanism, ...],
        change: Reconfiguration,
        earlier: Probation | None,
        begin: Callable[[], None],
        over: Callable[[Probation], None],
    ) -> None:
        self.before, self.layers, self.config = before, change.layers, change.config
        self.earlier = earlier
        self.why = ""  # it has failed
        self.back: Reconfiguration | None = None  # how it goes back
        self.settled: asyncio.Future[MechanismSettled] = group.node.loop.create_future()
        self._on_over: Callable[[bool], None] = lambda is_kept: None
        self.detach: Callable[[], Awaitable[None]] | None = None  # there was no mechanism before
        self._detaching: asyncio.Task[None] | None = None
        self._begin_going_back, self._over = begin, over
        self.moved(group)
        self._begun = group.node.loop.time()
        self._begin_anew()
        self._last_turn, self._looked_at = self._turn, self._since
        self._has_moved(self._since)
        self._timer = group.node.loop.call_later(LOOK_EVERY, self._look)
        self._asking: asyncio.Task[None] | None = None
        self._again_at, self._pause = 0.0, LOOK_EVERY  # when going back is tried again

    def _begin_anew(self) -> None:
        """From here on it is seen whether it works."""
        group = self._group
        self._since, self._turn, self._members = group.node.loop.time(), group.switch.turn, dict(group.members)

    @property
    def is_over(self) -> bool:
        """Whether it is known what comes of it."""
        return self.settled.done()

    def when_over(self, told: Callable[[bool], None]) -> None:
        """Have somebody told whether it stays, as soon as that is known."""
        self._on_over = told
        if self.is_over:
            told(self.settled.result().is_kept)

    def moved(self, group: Group) -> None:
        """Another group goes on with the same stack."""
        self._group = group
        group.keep_copy(self)

    def failed(self, why: str) -> bool:
        """Something has gone wrong which may be the fault of this stack. Whether the one before has to come back."""
        if self.is_over or self.why:
            return not self.is_over
        self.why = why
        self._begin_going_back()
        return True

    def drops(self, end: TurnEnd) -> bool:
        """A brick has ended a request itself: whether that is asked of the stack before, since it was let fall.

        One that may have run is asked of another replica alone: what came of it is known there, or was never.
        """
        group, name = self._group, self._group.primary
        if self.is_over or end.answer.name != DROPPED:
            return False
        error = group.node.codec.decode_error(end.answer.kind, end.answer.name, end.answer.body)
        why = "its bricks have let a request fall"
        life = 0 if name is None else group.members.get(name, 0)
        if name is not None and not self.why:
            group.at_fault(name, why)
            self._take_from(name, life, why)
        if not isinstance(error, RequestDropped):
            return False
        if error.may_have_run and name is not None and group.is_well(name) and group.backups():
            group.suspect(name, life, why)
        return not error.may_have_run or (bool(group.backups()) and (name is None or not group.is_well(name)))

    def end(self, *, is_kept: bool) -> None:
        """It is known what comes of it."""
        if self.is_over:
            return
        self._timer.cancel()
        node = self._group.node
        stacks = self.before if self.before is not NOTHING else (), self.layers
        was, now = (tuple(one.name for one in layers) for layers in stacks)
        event = MechanismSettled(
            self._group.path, was, now, is_kept, self.why, node.loop.time() - self._begun
        )  # fmt: skip
        self.settled.set_result(event)
        if node.events.has_listeners:
            node.emit(event)
        self._group.untrusted.discard(self)
        self._on_over(is_kept)
        self._over(self)

    def left(self) -> None:
        """There is no mechanism any more: because of this, or because somebody wants that."""
        if self._detaching is None:
            self.end(is_kept=True)

    def went_back(self) -> None:
        """The stack before is there again; if that was none, all replicas but one have to go, and then that one."""
        if self.detach is None:
            self.end(is_kept=False)
        elif self._detaching is None and not self.is_over:
            self._detaching = self._group.node.loop.create_task(self._detach(self.detach))

    async def _detach(self, detach: Callable[[], Awaitable[None]]) -> None:
        cell, pause = self._group.cell, LOOK_EVERY
        while not (cell.is_dead or self.is_over):
            try:
                await detach()
                break
            except HoldfastError:  # The text says why, to whoever detaches it by hand.
                await asyncio.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE)
        self.end(is_kept=False)

    def _look(self) -> None:
        group, loop = self._group, self._group.node.loop
        if self.is_over:
            return
        if group.cell.is_dead:
            self.end(is_kept=True)  # Nobody lives there any more.
            return
        now = loop.time()
        self._timer = loop.call_later(LOOK_EVERY, self._look)
        if self.why:
            if now >= self._again_at and (self.back is None or self.back.outcome.done()):
                self._again_at = now + self._pause
                self._pause = min(2 * self._pause, LONGEST_PAUSE)
                self._begin_going_back()  # It could not the last time.
            return
        if group.is_over:
            return  # Its life is being begun again.
        self._looked_at = now
        if group.members != self._members:
            self._begin_anew()
        if group.switch.turn != self._last_turn or (group.out is None and not group.waiting):
            self._last_turn = group.switch.turn
            self._has_moved(now)
        if now - self._moved_at >= STUCK_AFTER:  # Whoever has led meanwhile: nothing has passed.
            name = group.primary
            if self._asking is None and name is not None and now - self._moved_at - self._excused() >= STUCK_AFTER:
                self._asking = loop.create_task(self._ask(group, name))
        elif self._is_long_enough() and self._asking is None:
            self._asking = loop.create_task(self._look_at_others(group))

    def _has_moved(self, now: float) -> None:
        """A turn has ended, or nothing waits for one."""
        group = self._group
        self._moved_at, self._starved = now, {name: group.starved(name) for name in group.names}

    def _excused(self) -> float:
        """Seconds since then for which it is no fault of the bricks that nothing has passed.

        Those of whoever leads wait for the others: that one of them goes through its state is excuse enough.
        """
        return max(self._group.excused(name, self._starved.get(name, 0.0)) for name in self._group.names)

    async def _ask(self, group: Group, name: str) -> None:
        """Something has waited for long, and no turn has ended: is the actor at work, or do the bricks keep it?"""
        life = group.members.get(name, 0)
        try:
            doing: Doing = await group.protocol(name).ask(Computes(group.switch.turn), ASKED_WITHIN)
        except HoldfastError:  # If it has died, that is seen elsewhere; else it is asked once more.
            return
        finally:
            self._asking = None
        if doing.computes or group.is_suspended or group.is_stopping:
            self._looked_at = group.node.loop.time()
            self._has_moved(self._looked_at)
            return
        if group.switch.turn != self._last_turn or group.primary != name or not group.is_well(name):
            return  # It goes on, or another one is asked.
        why = f"its bricks have let nothing pass for {STUCK_AFTER:g} s"
        group.at_fault(name, why)
        self._take_from(name, life, why, keeps=doing.keeps)

    def _take_from(self, name: str, life: int, why: str, *, keeps: bool = True) -> None:
        """Whoever leads has bricks that do not do it: another one leads, or the same one with the bricks before."""
        group = self._group
        if group.backups() or not keeps:
            group.suspect(name, life, why)
        else:  # It is all there is.
            group.why, group.renewing = why, name
            group.wake()

    async def _look_at_others(self, group: Group) -> None:
        """Nobody waits for the bricks of those that do not lead: it stays if they too have let pass what has come."""
        try:
            if await end_stuck(group) is not None:
                return
        except HoldfastError:  # If it has died, that is seen elsewhere; else it is asked once more.
            return
        finally:
            self._asking = None
        if not self.why and self._is_long_enough():
            self.end(is_kept=True)

    def _is_long_enough(self) -> bool:
        """Whether it has worked for so long, and nothing is inside that may never come out."""
        group, now = self._group, self._group.node.loop.time()
        seconds, turns = now - self._since, group.switch.turn - self._turn
        is_idle = group.out is None and not group.waiting
        is_moving = is_idle or group.switch.turn != self._last_turn or self._moved_at == self._looked_at
        return is_moving and (seconds >= MOST_SECONDS or (seconds >= SECONDS and turns >= TURNS))
