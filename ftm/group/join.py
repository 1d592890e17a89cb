"""Joining: a new or repaired replica catches up while requests flow, and counts only then (T8c)."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from ...actors.errors import AskTimeout, HoldfastError
from ...actors.kernel.actor import Actor, on
from ..bricks.brick_messages import ConfigMismatch, Follow
from ..bricks.replica_orders import Join
from ..bricks.sealed_frames import Refused
from ..events import ReplicaJoined
from .failover import bury
from .group import Look

if TYPE_CHECKING:
    import asyncio

    from .group import Group

FOLLOWED_WITHIN = 2.0
"""Seconds in which a replica has to say that it follows."""
JOINED_WITHIN = 60.0
"""Seconds that the transfer of a state may take."""
DEAF_AFTER = 2
"""Orders to follow that a replica does not take, one after the other: then it is started again.

If it says nothing at all, the time that it got no processor, or may be going through its state, does not count.
"""
FIRST_RETRY, LONGEST_RETRY = 0.02, 2.0
"""Seconds until a replica that could not join is tried again; doubled each time."""


class Deaf(NamedTuple):
    """A replica that has not taken an order to follow: in which life, how often, and since when.

    `starved`: seconds for which it had got no processor by then.
    """

    life: int
    times: int
    since: float
    starved: float


class Joiner(Actor):
    """Has replicas that are up, and do not count, catch up with the primary."""

    _is_part: ClassVar[bool] = True

    deterministic = False

    def __init__(self, group: Group) -> None:
        self._group = group
        self._timer: asyncio.TimerHandle | None = None
        self._delay = FIRST_RETRY
        self._deaf: dict[str, Deaf] = {}  # by name

    def on_start(self, restored: bool) -> None:
        """Whoever was about to join begins anew."""
        self._group.is_joining = False
        self._group.tell("join", Look())

    def on_stop(self, reason: object) -> None:
        if self._timer is not None:
            self._timer.cancel()

    @on(Look)
    async def look(self, message: Look) -> None:
        """Take in who is up."""
        group = self._group
        for name in group.names:
            primary = group.primary
            if group.is_changing or group.is_resting or (group.change is not None and group.change.is_back):
                return  # Whoever does that wakes us; until then it would come with the bricks that have failed.
            if (
                group.is_over
                or not (group.is_live or group.joins_early)
                or primary is None
                or name == primary
                or name in group.members
            ):
                continue
            life = group.life_of(name)
            if not life or group.up.get(name) != life or group.suspects.get(name) == life or group.dropped:
                continue
            if name in group.strays.faulty:
                continue  # It ends, which wakes us.
            if (pause := group.strays.pause(name, life)) > 0:
                self._later(pause)
                continue
            group.is_joining = True
            try:
                await self._join(primary, name, life)
            except ConfigMismatch:  # It was started before the mechanism was changed; its next life knows better.
                await bury(group, name, life)
            except HoldfastError:
                self._later()  # If one of them has died, that is seen elsewhere.
            else:
                self._delay = FIRST_RETRY
            finally:
                group.joining.pop(name, None)
                group.is_joining = False
                group.stir()

    async def _join(self, primary: str, name: str, life: int) -> None:
        group, epoch, begin = self._group, self._group.epoch, time.monotonic()
        await self._tell_to_follow(name, life, epoch)
        group.on_joining(name)
        group.joining[name] = life
        group.watch(name)
        strayed = group.strays.count
        turn = await group.protocol(primary).ask(Join(epoch, group.place(name)), JOINED_WITHIN)
        if group.strays.count != strayed:
            return  # What it had joined with is lost already; whoever has heard of that wakes us.
        if group.epoch != epoch or group.primary != primary or group.life_of(name) != life or group.is_over:
            if group.epoch == epoch and group.primary == primary and group.life_of(name) != life:
                group.dropped.add(name)  # The primary may wait for the life that has ended.
                group.wake()
            return  # It has caught up with one that does not lead any more.
        group.joined(name, life)
        group.node.emit(ReplicaJoined(group.path, name, epoch, turn, time.monotonic() - begin))
        group.wake()

    async def _tell_to_follow(self, name: str, life: int, epoch: int) -> None:
        """One that was started with links that are secured otherwise does not even understand that it is a mismatch."""
        group, begin, starved = self._group, time.monotonic(), self._group.starved(name)
        try:
            await group.protocol(name).ask(Follow(epoch, group.config), FOLLOWED_WITHIN)
        except (AskTimeout, Refused) as error:
            first = self._deaf.get(name)
            if first is None or first.life != life:
                first = Deaf(life, 0, begin, starved)
            deaf = self._deaf[name] = first._replace(times=first.times + 1)
            silent = time.monotonic() - first.since - group.excused(name, first.starved)
            if isinstance(error, AskTimeout) and silent < DEAF_AFTER * FOLLOWED_WITHIN:
                raise  # It got no processor, or goes through a large state.
            if deaf.times < DEAF_AFTER:
                raise
            await bury(group, name, life)  # Its next life has the present stack of mechanisms.
            raise
        self._deaf.pop(name, None)

    def _later(self, seconds: float | None = None) -> None:
        """Look again then; None: what has failed is tried again, after longer each time."""
        loop = self.ctx.cell.node.loop
        if self._timer is not None:
            self._timer.cancel()
        self._timer = loop.call_later(seconds or self._delay, self._group.tell, "join", Look())
        if seconds is None:
            self._delay = min(self._delay * 2, LONGEST_RETRY)
