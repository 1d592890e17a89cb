"""Joining: a new or repaired replica catches up while requests flow, and counts only then (T8c)."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, NamedTuple

from ...actors.errors import AskTimeout, HoldfastError
from ...actors.kernel.actor import on
from ..bricks.brick_messages import ConfigMismatch, Follow
from ..bricks.replica_orders import Join
from ..bricks.sealed_frames import Refused
from ..events import ReplicaJoined
from .membership import LookAgain
from .replicas import GroupPart
from .steering import bind_again, past_resting_turns

if TYPE_CHECKING:
    from .group import Group

FOLLOWED_WITHIN = 2.0
"""Seconds in which a replica has to say that it follows."""
JOINED_WITHIN = 60.0
"""Seconds that the transfer of a state may take."""
DEAF_AFTER = 2
"""Orders to follow that a replica does not take, one after the other: then it is started again.

If it says nothing at all, the time that it got no processor, or may be going through its state, does not count.
"""
FIRST_RETRY, LONGEST_RETRY = 0.02, 1.0
"""Seconds until a replica that could not join is tried again; doubled each time."""


class Deaf(NamedTuple):
    """A replica that has not taken an order to follow: in which life, how often, and since when.

    `starved`: seconds for which it had got no processor by then.
    """

    life: int
    times: int
    since: float
    starved: float


class Joiner(GroupPart):
    """Has replicas that are up, and do not count, catch up with the primary."""

    def __init__(self, group: Group) -> None:
        self._group, self._known, self._replicas = group, group.membership, group.replicas
        self._delay = FIRST_RETRY
        self._deaf: dict[str, Deaf] = {}  # by name

    def on_start(self, restored: bool) -> None:
        """Whoever was about to join begins anew."""
        self._known.is_joining = False
        self._replicas.tell("join", LookAgain())

    @on(LookAgain)
    async def look(self, message: LookAgain) -> None:
        """Take in who is up."""
        group, known, replicas = self._group, self._known, self._replicas
        for name in known.names:
            if group.is_being_changed():
                return  # Whoever does that wakes us; until then it would come with the bricks that have failed.
            primary, lives = known.primary, replicas.lives()
            if known.is_over or primary is None or not (group.delivery.is_live or group.joins_early):
                return  # The failover manager wakes us when one leads.
            if not known.may_join(name, lives):
                continue
            life = lives[name]
            if (pause := group.strays.pause(name, life, group.switch.turn, replicas.node.loop.time())) > 0:
                self._later(pause)
                continue
            known.is_joining = True
            try:
                await self._join(primary, name, life)
            except ConfigMismatch:  # It was started before the mechanism was changed; its next life knows better.
                await replicas.bury(name, life)
            except HoldfastError:
                self._later()  # If one of them has died, that is seen elsewhere.
            else:
                self._delay = FIRST_RETRY
            finally:
                known.joining.pop(name, None)
                known.is_joining = False
                replicas.stir()

    async def _join(self, primary: str, name: str, life: int) -> None:
        group, known, replicas = self._group, self._known, self._replicas
        epoch, begin = known.epoch, time.monotonic()
        await self._tell_to_follow(name, life, epoch)
        bind_again(replicas, name)
        known.joining[name] = life
        replicas.watch(name)
        strayed = group.strays.count
        joined = replicas.ask(primary, Join(epoch, replicas.place(name)), JOINED_WITHIN)
        await past_resting_turns(group, joined)
        turn = await joined
        if group.strays.count != strayed:
            return  # What it had joined with is lost already; whoever has heard of that wakes us.
        if known.epoch != epoch or known.primary != primary or known.is_over:
            return  # It has caught up with one that does not lead any more.
        if replicas.life_of(name) != life:
            known.dropped.add(name)  # The primary may wait for the life that has ended.
        else:
            group.joined(name, life)
            replicas.node.emit(ReplicaJoined(replicas.path, name, epoch, turn, time.monotonic() - begin))
        replicas.wake()

    async def _tell_to_follow(self, name: str, life: int, epoch: int) -> None:
        """One that was started with links that are secured otherwise does not even understand that it is a mismatch."""
        replicas, begin, starved = self._replicas, time.monotonic(), self._replicas.starved(name)
        try:
            await replicas.ask(name, Follow(epoch, self._group.adaptation.config), FOLLOWED_WITHIN)
        except (AskTimeout, Refused) as error:
            first = self._deaf.get(name)
            if first is None or first.life != life:
                first = Deaf(life, 0, begin, starved)
            deaf = self._deaf[name] = first._replace(times=first.times + 1)
            silent = time.monotonic() - first.since - replicas.excused(name, first.starved)
            if isinstance(error, AskTimeout) and silent < DEAF_AFTER * FOLLOWED_WITHIN:
                raise  # It got no processor, or goes through a large state.
            if deaf.times >= DEAF_AFTER:
                await replicas.bury(name, life)  # Its next life has the present stack of mechanisms.
            raise
        self._deaf.pop(name, None)

    def _later(self, seconds: float | None = None) -> None:
        """Look again then; None: what has failed is tried again, after longer each time."""
        self.call_later(seconds or self._delay, lambda: self._replicas.tell("join", LookAgain()))
        if seconds is None:
            self._delay = min(self._delay * 2, LONGEST_RETRY)
