"""The members of a group of replicas, their primary and their suspects, and failover's next step: data and decisions.

Nothing here waits, tells, or reads a clock. `replicas.py` has what else belongs to a change of the membership, and
`failover.py` carries the steps out. They are told which life each replica lives now: a name to a number, 0 for none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from ...actors.kernel.message import Message

if TYPE_CHECKING:
    from ...actors.kernel.ref import ActorRef

Lives = Mapping[str, int]
Kind = Literal["wait", "renew", "depose", "condemn", "elect", "fall", "bury", "lead", "forget", "drop", "tell", "rest"]


MOST_STRAYED = 3
"""Times in a row that a follower may stray."""
STEADY = 1000
"""Turns after which it has not strayed again: the next time is the first one."""
FIRST_PAUSE, LONGEST_PAUSE = 0.02, 2.0
"""Seconds until it joins again; doubled each time in a row."""


class LookAgain(Message):
    """Something has happened to the group: see what is to be done."""


class Suspicion(NamedTuple):
    """Why a replica may have to be replaced."""

    life: int
    why: str
    since: float  # on the loop's clock
    is_silence: bool = False  # nothing else is wrong with it: a sign of life clears it
    is_barred: bool = False  # nothing can be heard from it any more: there is nothing to wait for


class FailoverStep(NamedTuple):
    """What failover does next, with which replica."""

    kind: Kind
    name: str = ""


@dataclasses.dataclass(slots=True)
class Membership:
    """The replicas of one group, and who of them leads.

    Attributes:
        names: the replicas that there are to be.
        epoch: it rises with each change of who leads.
        primary: the one that leads.
        leading: the one that is to lead in this epoch: `Lead` may or may not have reached it.
        renewing: the primary, if it is to lead anew, with other bricks.
        why: the last one does not lead any more.
        noticed: since when that is known, on the monotonic clock; 0.0 if nothing is the matter.
        keeps_members: the next leader brings the others to its state before anything leaves, so that they stay members.
        is_begun: somebody has led.
        is_over: no replica leads, or will.
        is_joining: a replica is catching up.
        members: name to life, of those that hold all state: the primary and its backups.
        condemned: name to life, of those that must be dead before the next one leads, or before their next life joins.
        dropped: backups that the primary still has to forget.
        up: name to life, of those heard of.
        joining: name to life, of those that the primary is bringing to its state.
        suspected: by name; it may be about an earlier life.
    """

    names: tuple[str, ...]
    epoch: int
    primary: str | None = None
    leading: str | None = None
    renewing: str | None = None
    why: str = ""
    noticed: float = 0.0
    keeps_members: bool = False
    is_begun: bool = False
    is_over: bool = False
    is_joining: bool = False
    members: dict[str, int] = dataclasses.field(default_factory=dict)
    condemned: dict[str, int] = dataclasses.field(default_factory=dict)
    dropped: set[str] = dataclasses.field(default_factory=set)
    up: dict[str, int] = dataclasses.field(default_factory=dict)
    joining: dict[str, int] = dataclasses.field(default_factory=dict)
    suspected: dict[str, Suspicion] = dataclasses.field(default_factory=dict)

    # -- what there is ----------------------------------------------------------------------------------------------

    def is_suspect(self, name: str, life: int) -> bool:
        """Whether this life of a replica is suspected."""
        suspicion = self.suspected.get(name)
        return suspicion is not None and suspicion.life == life

    def is_well(self, name: str, lives: Lives) -> bool:
        """Whether a member is the one that was taken in, and nobody suspects it."""
        life = self.members.get(name, 0)
        return life > 0 and lives.get(name, 0) == life and not self.is_suspect(name, life)

    def well(self, lives: Lives) -> dict[str, int]:
        """The members that are well: name to life."""
        return {name: life for name, life in self.members.items() if self.is_well(name, lives)}

    def backups(self, lives: Lives) -> list[str]:
        """Those that could lead instead of the primary, in order."""
        return [name for name in self.names if name not in (self.primary, self.leading) and self.is_well(name, lives)]

    def is_awaited(self, name: str, lives: Lives, now: float, hopeless: float) -> bool:
        """Whether a member that is suspected, and may yet be heard of again, is all there is."""
        life = self.members.get(name, 0)
        is_alive = life > 0 and lives.get(name, 0) == life
        if not is_alive or self.backups(lives) or not self.is_suspect(name, life):
            return False
        return not self.suspected[name].is_barred and now - self.suspected[name].since < hopeless

    def is_whole(self, lives: Lives) -> bool:
        """Whether one replica leads, and all others could."""
        return self.primary is not None and all(self.is_well(name, lives) for name in self.names)

    def is_led(self, lives: Lives) -> bool:
        """Whether one replica leads, and nobody has to be told so, or of a death, or catches up."""
        is_well = self.primary is not None and self.leading is None and self.is_well(self.primary, lives)
        return is_well and not self.condemned and not self.dropped and not self.is_joining

    def peer_of(self, leading: str, lives: Lives) -> str | None:
        """A member that goes on under the next leader, if its mechanism keeps its members."""
        left = (name for name in self.names if name != leading and self.is_well(name, lives))
        return next(left, None) if self.keeps_members else None

    def watched(self, lives: Lives) -> Iterator[tuple[str, int]]:
        """Who is expected to be heard of, and is not suspected already: name and life."""
        for name, life in self.up.items():
            if lives.get(name, 0) == life and not self.is_suspect(name, life):
                yield name, life

    def may_join(self, name: str, lives: Lives) -> bool:
        """Whether a replica that does not count could catch up with the primary now."""
        life, is_wanted = lives.get(name, 0), name != self.primary and name not in self.members
        is_heard = life > 0 and self.up.get(name) == life and not self.is_suspect(name, life)
        return is_wanted and is_heard and not self.dropped and name not in self.condemned

    def state_of(self, name: str, life: int) -> str:
        """How a replica does, which lives this life, in a word."""
        if not life:
            return "down"
        if self.is_suspect(name, life):
            return "silent"
        if self.members.get(name) != life:
            return "joining"
        return "leads" if name == self.primary else "follows"

    # -- what is heard of them --------------------------------------------------------------------------------------

    def hear(self, name: str, life: int) -> Literal["new", "again", "cleared", "known"]:
        """Take down a sign of life: of a new life, or of one that was suspected for its silence, or for something else.

        Only a suspicion for silence is cleared; of a "known" suspect nothing else is taken down.
        """
        is_suspect = self.is_suspect(name, life)
        if is_suspect and not self.suspected[name].is_silence:
            return "known"
        if is_suspect:
            del self.suspected[name]
        is_new, self.up[name] = self.up.get(name) != life, life
        return "new" if is_new else "cleared" if is_suspect else "again"

    def expect(self, name: str) -> None:
        """A replica is about to be started, and none of its name is there: what is known is of an earlier one.

        The lives of each are counted from one.
        """
        for known in (self.up, self.suspected, self.joining):
            known.pop(name, None)

    def suspect(self, name: str, suspicion: Suspicion, clock: float) -> None:
        """A replica must be replaced, unless it is suspected for its silence and a sign of life comes in time.

        Args:
            name: of the replica.
            suspicion: why it is suspected, and since when.
            clock: the same moment on the monotonic clock.
        """
        self.suspected[name] = suspicion
        if name in (self.primary, self.leading):
            self.why, self.noticed = suspicion.why, clock

    # -- steps of a failover ----------------------------------------------------------------------------------------

    def condemn(self, name: str) -> None:
        """It leads no longer, or will not, and must be dead before another one does."""
        self.condemned[name] = self.members.get(name, 0)
        self.primary, self.leading = None, None

    def elect(self, name: str) -> None:
        """Begin an epoch in which this one is to lead."""
        self.epoch += 1
        self.primary, self.leading, self.renewing = None, name, None

    def bind(self, name: str) -> list[str]:
        """It leads from here on; returns the members that have to catch up with it first."""
        self.primary, self.leading, self.noticed = name, None, 0.0
        return [] if self.keeps_members else [one for one in self.members if one != name]


def next_step(known: Membership, lives: Lives, now: float, hopeless: float) -> FailoverStep:
    """Decide what failover does next; one that is all there is, and silent, is given up after `hopeless` seconds.

    The order keeps two replicas from leading at once: the epoch rises when one is elected; those before it are buried;
    only then it is told to lead.
    """
    primary, leading = known.primary, known.leading
    if primary is not None:
        if known.is_well(primary, lives):
            return FailoverStep("renew", primary) if known.renewing == primary else next_tidying(known, lives)
        is_awaited = known.is_awaited(primary, lives, now, hopeless)
        return FailoverStep("wait" if is_awaited else "depose", primary)  # To end it would lose what only it has.
    if leading is None:
        left = known.backups(lives)
        return FailoverStep("elect", left[0]) if left else FailoverStep("fall")
    if not known.is_well(leading, lives):
        # It may be building the actor from a large state, which nobody else has.
        is_awaited = known.is_awaited(leading, lives, now, hopeless) and known.suspected[leading].is_silence
        return FailoverStep("wait" if is_awaited else "condemn", leading)
    return FailoverStep("bury", next(iter(known.condemned))) if known.condemned else FailoverStep("lead", leading)


def next_tidying(known: Membership, lives: Lives) -> FailoverStep:
    """Decide what follows while one leads: those that have ended, or are suspected, do not count, and nobody waits."""
    for name, life in known.joining.items():
        if lives.get(name, 0) != life:  # Its next life has to be told first that it follows.
            return FailoverStep("forget", name)
    if known.condemned:
        return FailoverStep("bury", next(iter(known.condemned)))
    for name in known.names:
        if name == known.primary:
            continue
        if is_to_end(known, name, lives) or (name in known.members and not known.is_well(name, lives)):
            return FailoverStep("drop", name)
    return FailoverStep("tell" if known.dropped else "rest")


def is_to_end(known: Membership, name: str, lives: Lives) -> bool:
    """Whether a replica that does not lead is to be killed: the life that is known of it lives, and is suspected."""
    life = known.members.get(name, 0) or known.up.get(name, 0)
    return life > 0 and lives.get(name, 0) == life and known.is_suspect(name, life)


def is_within(place: str, sender: ActorRef[Any] | None) -> bool:
    """Whether a replica, or what is below it, has said this."""
    return sender is not None and f"{sender.path}/".startswith(f"{place}/")


@dataclasses.dataclass(slots=True)
class StrayRecord:
    """What is known of one life of a follower."""

    life: int
    turn: int  # at which it joined last
    times: int = 0  # in a row
    until: float = 0.0  # it does not join before that, on the loop's clock


@dataclasses.dataclass(slots=True)
class Strays:
    """Followers that have lost the leader's state: they join again, and are ended if that does not help.

    A transient fault is over when the state was taken once more. Who diverges again and again is faulty: its process
    ends, and what is started in its place joins, each time later than the time before. `turn` is the last one that
    home knows of, each time.
    """

    records: dict[str, StrayRecord] = dataclasses.field(default_factory=dict)
    count: int = 0

    def joined(self, name: str, life: int, turn: int) -> None:
        """It has the leader's state."""
        self._of(name, life, turn).turn = turn

    def count_again(self, name: str, life: int, turn: int, now: float) -> tuple[int, bool]:
        """It has lost the state: how often in a row, and whether it is faulty."""
        self.count += 1
        record = self._of(name, life, turn)
        record.times = 1 if turn - record.turn > STEADY else record.times + 1
        record.until = now + min(FIRST_PAUSE * 2 ** (record.times - 1), LONGEST_PAUSE)
        return record.times, record.times >= MOST_STRAYED

    def pause(self, name: str, life: int, turn: int, now: float) -> float:
        """Seconds until it may join again."""
        return self._of(name, life, turn).until - now

    def _of(self, name: str, life: int, turn: int) -> StrayRecord:
        record = self.records.get(name)
        if record is None or record.life != life:
            record = self.records[name] = StrayRecord(life, turn)
        return record
