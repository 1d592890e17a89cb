"""Probation: a stack of mechanisms that is new is not trusted until it has worked for a while.

If a replica ends meanwhile by what its own code has done, or the bricks let nothing pass, the stack before comes back.
Who leads then is brought to that stack before it leads, so that no request ever meets the bad bricks again.
"""

from __future__ import annotations

import asyncio
import dataclasses
from typing import TYPE_CHECKING, Final, Literal

from ...actors.errors import HoldfastError, NotGranted, type_name
from ...actors.events import ActorCrashed, Event
from ...actors.exit_reasons import Crash
from ...actors.kernel.message import message_name
from ...supervision.spec import ChildSpec
from ..bricks.brick_messages import NoReply, RequestDropped
from ..bricks.replica_orders import Computes, Doing
from ..events import MechanismSettled
from ..model.mechanism import NOTHING
from .hung import ASKED_WITHIN, STUCK_AFTER, end_stuck

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator, Mapping

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
NOT_GRANTED: Final = type_name(NotGranted)
"""The error of an actor that gives an order to somebody whom it has neither started nor is bound to."""
MISUSES: Final = {
    message_name(RequestDropped): "its bricks have let a request fall",
    message_name(NoReply): "its bricks have ended a request with what is no reply to it",
}
"""Errors that say of bricks how they have ended a request wrongly."""


@dataclasses.dataclass(slots=True)
class Conduct:
    """What was seen of a stack, from which it is decided whether it works.

    Attributes:
        since: when it began with the replicas that there are, on the loop's clock.
        turn: the last turn then.
        members: those replicas: name to life.
        last_turn: the last turn when it was looked at.
        moved_at: when a turn had ended, or nothing waited for one, as far as is known.
        starved: for how long each replica had got no processor by then.
        has_moved: that was when it was looked at last.
    """

    since: float
    turn: int
    members: dict[str, int]
    last_turn: int
    moved_at: float
    starved: Mapping[str, float]
    has_moved: bool = True

    def move(self, now: float, starved: Mapping[str, float]) -> None:
        """A turn has ended, or nothing waits for one, or the actor is at work."""
        self.moved_at, self.starved, self.has_moved = now, starved, True

    def look(
        self, now: float, turn: int, members: Mapping[str, int], starved: Mapping[str, float], *, is_idle: bool
    ) -> Literal["ask", "judge", "wait"]:
        """Decide what follows from how it does now.

        Args:
            now: on the loop's clock.
            turn: the last one that has ended.
            members: the replicas that count: name to life.
            starved: for how long each replica has got no processor so far.
            is_idle: nothing waits for a turn.

        Returns:
            "ask" the one that leads what it does, "judge" by the others whether it stays, or "wait".
        """
        self.has_moved = False
        if members != self.members:
            self.since, self.turn, self.members = now, turn, dict(members)
        if turn != self.last_turn or is_idle:
            self.last_turn = turn
            self.move(now, starved)
        if now - self.moved_at >= STUCK_AFTER:  # Whoever has led meanwhile: nothing has passed.
            return "ask"
        return "judge" if self.is_enough(now, turn, is_idle=is_idle) else "wait"

    def is_enough(self, now: float, turn: int, *, is_idle: bool) -> bool:
        """Whether it has worked for so long, and nothing is inside that may never come out."""
        seconds, turns = now - self.since, turn - self.turn
        is_moving = is_idle or turn != self.last_turn or self.has_moved
        return is_moving and (seconds >= MOST_SECONDS or (seconds >= SECONDS and turns >= TURNS))


def pauses() -> Iterator[float]:
    """Seconds until something is tried again that could not be: twice as long each time."""
    pause = LOOK_EVERY
    while True:
        yield pause
        pause = min(2 * pause, LONGEST_PAUSE)


UNJUDGED: Final = "it was ended before its time was over: the actor was stopped, or the mechanism was taken away"
"""Why a stack is said to be kept that has not passed."""


class Probation:
    """One stack of mechanisms that is not trusted yet.

    Args:
        group: the one that has it, at its place.
        before: the stack that comes back.
        earlier: the probation that was not over when this one began: the stack before is not trusted either.
    """

    def __init__(self, group: Group, before: tuple[Mechanism, ...], earlier: Probation | None) -> None:
        self.before, self.layers, self.earlier = before, group.place.layers, earlier
        self.why = ""  # it has failed
        self.back: Reconfiguration | None = None  # how it goes back
        self.settled: asyncio.Future[MechanismSettled] = group.replicas.node.loop.create_future()
        self._on_over: Callable[[bool], None] = lambda is_kept: None
        self.detach: Callable[[], Awaitable[None]] | None = None  # there was no mechanism before
        self._detaching: asyncio.Task[None] | None = None
        self.moved(group)
        now, turn, members = self._now(), group.switch.turn, dict(group.membership.members)
        self._begun, self._again_at, self._pauses = now, 0.0, pauses()
        self._conduct = Conduct(now, turn, members, turn, now, self._starved())
        self._timer = group.replicas.node.loop.call_later(LOOK_EVERY, self._look)
        self._asking: asyncio.Task[None] | None = None
        spec = group.replicas.cell.spec
        self._was_free = before is NOTHING and isinstance(spec, ChildSpec) and spec.isolation == "task"
        group.replicas.node.events.add_sink(self._hear)

    def _now(self) -> float:
        return self._group.replicas.node.loop.time()

    def _starved(self) -> dict[str, float]:
        return {name: self._group.replicas.starved(name) for name in self._group.membership.names}

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

    def failed(self, why: str) -> None:
        """Something has gone wrong which may be the fault of this stack: the one before has to come back."""
        if not (self.is_over or self.why):
            self.why = why
            self._group.place.begin_going_back()

    def _hear(self, event: Event) -> None:
        """An actor that has lived in this process fails by an order that it could give here, and may not give there."""
        path = self._group.replicas.path
        match event:
            case ActorCrashed(reason=Crash(type_name=name) as reason) if name == NOT_GRANTED and self._was_free:
                if event.address.startswith(f"{path}/ftm/"):
                    self.failed(f"it gives orders that a process may not give: {reason.text}")
            case _:
                pass

    def drops(self, end: TurnEnd) -> bool:
        """A brick has ended a request itself: whether that is asked of the stack before, since it was ended wrongly.

        One that may have run is asked of another replica alone: what came of it is known there, or was never.
        """
        replicas, name = self._group.replicas, self._group.membership.primary
        why = MISUSES.get(end.answer.name)
        if self.is_over or why is None:
            return False
        error = replicas.node.codec.decode_error(end.answer.kind, end.answer.name, end.answer.body)
        life = 0 if name is None else self._group.membership.members.get(name, 0)
        if name is not None and not self.why:
            replicas.at_fault(name, why)
            self._take_from(name, life, why)
        if isinstance(error, NoReply):
            return True
        if not isinstance(error, RequestDropped):
            return False
        if error.may_have_run and name is not None and replicas.is_well(name) and replicas.backups():
            replicas.suspect(name, life, why)
        return not error.may_have_run or (bool(replicas.backups()) and (name is None or not replicas.is_well(name)))

    def end(self, *, is_kept: bool, why: str = "") -> None:
        """It is known what comes of it; `why`: it does not stay because it has passed."""
        if self.is_over:
            return
        self._timer.cancel()
        node, path = self._group.replicas.node, self._group.replicas.path
        node.events.remove_sink(self._hear)
        stacks = self.before if self.before is not NOTHING else (), self.layers
        was, now = (tuple(one.name for one in layers) for layers in stacks)
        event = MechanismSettled(path, was, now, is_kept, self.why or why, self._now() - self._begun)
        self.settled.set_result(event)
        if node.events.has_listeners:
            node.emit(event)
        self._group.copies.untrusted.discard(self)
        self._on_over(is_kept)
        self._group.place.probation_over(self)

    def left(self) -> None:
        """There is no mechanism any more: because of this, or because somebody wants that."""
        if self._detaching is None:
            self.end(is_kept=True, why=UNJUDGED)

    def went_back(self) -> None:
        """The stack before is there again; if that was none, all replicas but one have to go, and then that one."""
        if self.detach is None:
            self.end(is_kept=False)
        elif self._detaching is None and not self.is_over:
            self._detaching = self._group.replicas.node.loop.create_task(self._detach(self.detach))

    async def _detach(self, detach: Callable[[], Awaitable[None]]) -> None:
        for pause in pauses():
            if self._group.replicas.cell.is_dead or self.is_over:
                break
            try:
                await detach()
                break
            except HoldfastError:  # The text says why, to whoever detaches it by hand.
                await asyncio.sleep(pause)
        self.end(is_kept=False)

    def _look(self) -> None:
        group, loop = self._group, self._group.replicas.node.loop
        if self.is_over:
            return
        if group.replicas.cell.is_dead:
            self.end(is_kept=True, why=UNJUDGED)  # Nobody lives there any more.
            return
        now = loop.time()
        self._timer = loop.call_later(LOOK_EVERY, self._look)
        if self.why:
            if now >= self._again_at and (self.back is None or self.back.outcome.done()):
                self._again_at = now + next(self._pauses)
                self._group.place.begin_going_back()  # It could not the last time.
            return
        known, is_idle = group.membership, group.delivery.is_idle
        if known.is_over:
            return  # Its life is being begun again.
        match self._conduct.look(now, group.switch.turn, known.members, self._starved(), is_idle=is_idle):
            case "ask":
                name, silent = known.primary, now - self._conduct.moved_at
                if self._asking is None and name is not None and silent - self._excused() >= STUCK_AFTER:
                    self._asking = loop.create_task(self._ask(group, name))
            case "judge":
                if self._asking is None:
                    self._asking = loop.create_task(self._look_at_others(group))
            case "wait":
                pass

    def _excused(self) -> float:
        """Seconds since then for which it is no fault of the bricks that nothing has passed.

        Those of whoever leads wait for the others: that one of them goes through its state is excuse enough.
        """
        starved = self._conduct.starved
        return max(self._group.replicas.excused(name, starved.get(name, 0.0)) for name in self._group.membership.names)

    async def _ask(self, group: Group, name: str) -> None:
        """Something has waited for long, and no turn has ended: is the actor at work, or do the bricks keep it?"""
        known, replicas = group.membership, group.replicas
        life = known.members.get(name, 0)
        try:
            doing: Doing = await replicas.ask(name, Computes(group.switch.turn), ASKED_WITHIN)
        except HoldfastError:  # If it has died, that is seen elsewhere; else it is asked once more.
            return
        finally:
            self._asking = None
        if doing.computes or group.delivery.is_suspended or group.delivery.is_stopping:
            self._conduct.move(self._now(), self._starved())
            return
        if group.switch.turn != self._conduct.last_turn or known.primary != name or not replicas.is_well(name):
            return  # It goes on, or another one is asked.
        why = f"its bricks have let nothing pass for {STUCK_AFTER:g} s"
        replicas.at_fault(name, why)
        self._take_from(name, life, why, keeps=doing.keeps)

    def _take_from(self, name: str, life: int, why: str, *, keeps: bool = True) -> None:
        """Whoever leads has bricks that do not do it: another one leads, or the same one with the bricks before."""
        known, replicas = self._group.membership, self._group.replicas
        if replicas.backups() or not keeps:
            replicas.suspect(name, life, why)
        else:  # It is all there is.
            known.why, known.renewing = why, name
            replicas.wake()

    async def _look_at_others(self, group: Group) -> None:
        """Nobody waits for the bricks of those that do not lead: it stays if they too have let pass what has come."""
        try:
            if await end_stuck(group.replicas, group.switch.turn) is not None:
                return
        except HoldfastError:  # If it has died, that is seen elsewhere; else it is asked once more.
            return
        finally:
            self._asking = None
        group = self._group
        if not self.why and self._conduct.is_enough(self._now(), group.switch.turn, is_idle=group.delivery.is_idle):
            self.end(is_kept=True)
