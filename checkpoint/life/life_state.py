"""The state of a recorded life besides the turn in hand: restored data, timers, snapshots, its end."""

from __future__ import annotations

import asyncio
import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from ...actors.effects import EffectCall
from ..durable_timers import said_by
from ..turn_word import IDLE, OVER, WAITS

if TYPE_CHECKING:
    from collections.abc import Callable

    from ...actors.exit_reasons import ExitReason
    from ...actors.kernel.envelope import Item
    from ...actors.kernel.message import Message
    from ..protocol import Clock, EndWanted, Go, Lent, Restore
    from .outcome_order import OutcomeOrder


MOST_PROMISES = 100_000


class Asked(NamedTuple):
    """Whose reply to what a turn waits for."""

    actor: str
    message: type[Message[Any]]


Awaited: TypeAlias = "Asked | EffectCall | tuple[type[Message[Any]], ...] | None"
"""What a turn waits for: the reply to a message of that class, an effect, a message of one of these types (none: a
moment), or that a `send` is accepted."""


@dataclasses.dataclass(slots=True)
class RestoredState:
    """The state that a life begins with, as its home has sent it.

    Attributes:
        pieces: what is not put back yet.
        image: where it is, if it is to be mapped.
        has_state: whether there is one; else the actor begins afresh.
        traps: whether the actor trapped exits.
        variables: those that its class had when `__init__` had run.
        is_mapped: whether that was another version of the class, whose state the actor would save otherwise now.
        stash_ids: inputs that had been put aside.
        unstashes: whether those are to come again.
        seconds: how long it took to put the state back.
        promises: inputs that it has been given, or has made, the handle of a later reply for, until it is live.
    """

    pieces: list[bytes] = dataclasses.field(default_factory=list)
    image: Lent | None = None
    has_state: bool = False
    traps: bool = False
    variables: list[str] = dataclasses.field(default_factory=list)
    is_mapped: bool = False
    stash_ids: frozenset[int] = frozenset()
    unstashes: bool = False
    seconds: float = 0.0
    promises: set[int] = dataclasses.field(default_factory=set)

    def take_promises(self) -> list[int] | None:
        """Give up what it can answer later; None if that is too much to say."""
        promises, self.promises = self.promises, set()
        return sorted(promises) if len(promises) <= MOST_PROMISES else None

    def take(self, record: Restore) -> None:
        """Take one more piece of the state."""
        self.has_state = True
        self.traps = self.traps or record.traps
        self.variables += record.variables
        self.image = record.image
        self.pieces.append(record.data)

    def joined(self) -> bytes:
        """The whole state; its pieces are given up."""
        pieces, self.pieces = self.pieces, []
        return b"".join(pieces)


@dataclasses.dataclass(slots=True)
class LifeTimers:
    """The timers of a life, as far as it has to know them.

    Attributes:
        active: those whose messages may still come, after the turns that were handled. Another dict with each change.
        running: those that run at home, as far as a hook has not said so.
        cancelled: timers whose ticks may still be on their way.
        named: how many timers of hooks say this, by its checksum.
    """

    active: dict[str, Clock] = dataclasses.field(default_factory=dict)
    running: dict[str, Clock] = dataclasses.field(default_factory=dict)
    cancelled: set[str] = dataclasses.field(default_factory=set)
    named: dict[str, int] = dataclasses.field(default_factory=dict)

    def take(self, clocks: dict[str, Clock]) -> None:
        """Take the timers that ran where the life begins."""
        self.active = self.active | clocks
        self.running.update(clocks)

    def set(self, key: str, clock: Clock) -> None:
        """A turn or a hook has set one."""
        self.active = self.active | {key: clock}

    def came(self, key: str) -> None:
        """The turn of its message has come: one that comes once is over."""
        if key in self.active and not self.active[key][2]:
            self.drop(key)

    def drop(self, key: str) -> None:
        """Its message does not come any more."""
        self.active = {other: clock for other, clock in self.active.items() if other != key}

    def key_for(self, clock: Clock, where: str) -> str:
        """The key of a timer that a hook wants. If one that runs says the same, it is that one.

        So `on_start` may set its timers at each life. Another one is named by what it says: the next life that begins
        at the same state gives it the same name, whatever else its hook does.

        >>> timers = LifeTimers(running={"3.1": ("Tick", b"", 1.0)})
        >>> [timers.key_for(("Tick", b"", 1.0), "5start") for _ in range(2)]
        ['3.1', '5starte37cb9c8.1']
        """
        known = next((key for key, other in self.running.items() if other == clock), None)
        if known is not None:
            del self.running[known]
            return known
        said = said_by(*clock)
        self.named[said] = number = self.named.get(said, 0) + 1
        return f"{where}{said}.{number}"


@dataclasses.dataclass(slots=True)
class SnapshotState:
    """What a life knows of its snapshots.

    Attributes:
        is_needed: whether the actor's state must be one that can be saved.
        turn: after which the last one was made; -1: none, -2: the last one was lost.
        is_postponed: whether one is to be taken when background work has come back.
        variables: of the actor, when `__init__` had run; none if it says itself what is saved.
        begun_with: the turn and a digest of the state that the life has begun with, if a hook may change that.
        is_due: whether a hook may have changed the state: nothing is handled before one is made.
    """

    is_needed: bool = True
    turn: int = -1
    is_postponed: bool = False
    variables: list[str] = dataclasses.field(default_factory=list)
    begun_with: tuple[int, bytes] = (-1, b"")
    is_due: bool = False


@dataclasses.dataclass(slots=True)
class LifeWaits:
    """What turns of a life wait for.

    Attributes:
        outcomes: futures of what comes of outputs, by (turn, output), each with what it has to be.
        moment: until when the handler of the turn in hand has waited, in Unix time.
        resting: moments and messages that the turn in hand waits for, and that have not come.
        threads: effects whose functions run in threads of this process, by (turn, output).
        stranded: asks whose receivers have been stopped, and answer in their next lives, by (turn, output).
        heard: how many outcomes the home has told.
        order: tells the turn in hand its outcomes, one after another.
    """

    order: OutcomeOrder
    outcomes: dict[tuple[int, int], tuple[asyncio.Future[Any], Awaited]] = dataclasses.field(default_factory=dict)
    moment: float = 0.0
    resting: tuple[asyncio.Future[Any], ...] = ()
    threads: set[tuple[int, int]] = dataclasses.field(default_factory=set)
    stranded: frozenset[tuple[int, int]] = frozenset()
    heard: int = 0

    def are_stranded(self, has_nobody: Callable[[Awaited], bool]) -> bool:
        """Whether all that the turn in hand waits for at home are answers that do not come before others live again."""
        left = [(place, awaited) for place, (future, awaited) in self.outcomes.items() if not future.done()]
        return bool(left) and all(place in self.stranded or has_nobody(awaited) for place, awaited in left)

    def how(self, turn: int) -> int:
        """How this turn stands, which waits: a thread, or what it has begun itself, may end the process unseen."""
        out = [kind for (of, _), (future, kind) in self.outcomes.items() if of == turn and not future.done()]
        if not out or any(of == turn for of, _ in self.threads):
            return WAITS
        return OVER if any(type(kind) is tuple for kind in out) else WAITS | IDLE  # What rests for days ends nothing.

    @property
    def is_open(self) -> bool:
        """Whether the turn in hand rests, or has an effect out, so that its state can be looked at beside it."""
        effects = (future for future, kind in self.outcomes.values() if isinstance(kind, EffectCall))
        return bool(self.resting) or not all(future.done() for future in effects)

    @property
    def may_be_left(self) -> bool:
        """Whether the turn in hand rests, and all that it has let out so far was accepted."""
        return bool(self.resting) and all(kind is not None or future.done() for future, kind in self.outcomes.values())

    def rested(self, one: asyncio.Future[Any]) -> None:
        """It has come, or is not waited for any more; if it was an earlier turn that did, nothing changes."""
        self.resting = tuple(other for other in self.resting if other is not one)


@dataclasses.dataclass(slots=True)
class LifeStage:
    """What waits until a life is live, and how it is to end.

    Attributes:
        has_replayed: whether it has handled anything again.
        begins_suspended: whether it is suspended when it is live.
        was_left: whether the turn that had begun was left at rest, by a life that has been carried over.
        owed: the input whose turn had begun in a life that has ended in it: what that has let out the class of then has
            to let out again. Until it is over, or rests, nothing is changed. -1: none.
        postponed: orders from outside that wait until it is live, or until no turn is owed.
        ending: that it is to end behind the turn in hand, as that has said.
        stop_wanted: why it is to end when it is live.
        stopping: why it is to end behind the turn in hand, as it was told.
        ends_itself: that it is the turn in hand which has it end, at this moment.
        stop_turn: the turn that has said so, if it was handled again; -1: it was none.
        begun: the input that has sent something in a turn without an end: it comes before what hooks have put back.
        is_cut_off: whether it ends by an EXIT that it does not trap.
        ignored_why: why the actor does not want to be started.
        is_over: whether it has ended.
        is_adrift: whether a turn of it was left in the middle, so that its state is that of no turn.
        trace: the trace in which the turn in hand sends; "" if it is in none.
    """

    has_replayed: bool = False
    begins_suspended: bool = False
    was_left: bool = False
    owed: int = -1
    postponed: list[Item] = dataclasses.field(default_factory=list)
    ending: EndWanted | None = None
    stop_wanted: ExitReason | None = None
    stopping: ExitReason | None = None
    ends_itself: bool = False
    stop_turn: int = -1
    begun: int = -1
    is_cut_off: bool = False
    ignored_why: str | None = None
    is_over: bool = False
    is_adrift: bool = False
    trace: str = ""

    def judge(self, go: Go) -> None:
        """All was handled again: whether the life is to end now is for the home to say, which knows what was done."""
        self.owed = -1 if self.was_left or self.begins_suspended else go.begun
        if go.ends is not None:
            self.stop_wanted, self.is_cut_off = go.ends.exit_reason, go.ends.is_cut_off
        elif 0 <= self.stop_turn <= go.ended:
            self.stop_wanted, self.is_cut_off = None, False
