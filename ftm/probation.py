"""Probation: a stack of mechanisms that has just been changed to is not trusted until it has worked for a while.

If a replica ends meanwhile by what its own code has done, or the bricks let nothing pass, the stack before comes back.
Who leads then is brought to that stack before it leads, so that no request ever meets the bad bricks again.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from ..actors.errors import HoldfastError
from .events import MechanismSettled
from .orders import Computes, Doing

if TYPE_CHECKING:
    from collections.abc import Callable

    from .adaptation import Reconfiguration
    from .group import Group
    from .mechanism import Mechanism

SECONDS: Final = 5.0
"""It lasts at least so long,"""
TURNS: Final = 100
"""and until so many turns have ended,"""
MOST_SECONDS: Final = 60.0
"""but no longer than this, as soon as nothing is in the bricks of which that is not known."""
STUCK_AFTER: Final = 5.0
"""Seconds for which a batch may be in the bricks while the protected actor does nothing."""
LOOK_EVERY: Final = 1.0
"""Seconds between two looks at how it does."""
LONGEST_PAUSE: Final = 60.0
"""Seconds until going back is tried again, if it could not be; doubled each time, from one second on."""
ASKED_WITHIN: Final = 2.0
"""Seconds that whoever leads has to say whether it is at work."""


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
        self.on_back: Callable[[], None] = lambda: None  # keeps in the store that the stack before is there again
        self._group, self._begin_going_back, self._over = group, begin, over
        self._since, self._turn = group.node.loop.time(), group.switch.turn
        self._last_turn, self._moved_at = self._turn, self._since
        self._timer = group.node.loop.call_later(LOOK_EVERY, self._look)
        self._asking: asyncio.Task[None] | None = None
        self._again_at, self._pause = 0.0, LOOK_EVERY  # when going back is tried again

    @property
    def is_over(self) -> bool:
        """Whether it is known what comes of it."""
        return self.settled.done()

    def moved(self, group: Group) -> None:
        """Another group goes on with the same stack."""
        self._group = group

    def failed(self, why: str) -> bool:
        """Something has gone wrong which may be the fault of this stack. Whether the one before has to come back."""
        if self.is_over or self.why:
            return not self.is_over
        self.why = why
        self._begin_going_back()
        return True

    def refuses_all(self) -> bool:
        """A brick has let a request fall, and no other one has passed: whether another replica is asked instead."""
        group, name = self._group, self._group.primary
        if self.is_over or group.switch.turn != self._turn or not group.backups():
            return False
        if not self.why and name is not None:
            why = "its bricks let all requests fall"
            group.at_fault(name, why)
            group.suspect(name, group.members.get(name, 0), why)
        return True

    def end(self, *, is_kept: bool) -> None:
        """It is known what comes of it."""
        if self.is_over:
            return
        self._timer.cancel()
        node = self._group.node
        was, now = (tuple(one.name for one in layers) for layers in (self.before, self.layers))
        event = MechanismSettled(
            self._group.path, was, now, is_kept, self.why, node.loop.time() - self._since
        )  # fmt: skip
        self.settled.set_result(event)
        if node.watched:
            node.emit(event)
        if not is_kept:
            self.on_back()
        self._over(self)

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
        if group.switch.turn != self._last_turn or (group.out is None and not group.waiting):
            self._last_turn, self._moved_at = group.switch.turn, now
        seconds, turns = now - self._since, group.switch.turn - self._turn
        if now - self._moved_at >= STUCK_AFTER:  # Whoever has led meanwhile: nothing has passed.
            if self._asking is None and group.primary is not None:
                self._asking = loop.create_task(self._ask(group, group.primary))
        elif self._moved_at == now and (seconds >= MOST_SECONDS or (seconds >= SECONDS and turns >= TURNS)):
            self.end(is_kept=True)  # Not while something is inside that may never come out.

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
            self._moved_at = group.node.loop.time()
            if self._moved_at - self._since >= MOST_SECONDS:
                self.end(is_kept=True)
            return
        if group.switch.turn != self._last_turn or group.primary != name or not group.is_well(name):
            return  # It goes on, or another one is asked.
        why = f"its bricks have let nothing pass for {STUCK_AFTER:g} s"
        group.at_fault(name, why)
        if group.backups() or not doing.keeps:
            group.suspect(name, life, why)
        else:  # It is all there is.
            group.why, group.renewing = why, name
            group.wake()
