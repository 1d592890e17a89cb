"""Messages that come while an actor is recovered: how many are held, and what becomes of more (T15).

Stands in the place of the home's bound during isolation, so that nothing is tested for a message at any other time.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections import deque
from collections.abc import Awaitable
from typing import TYPE_CHECKING, Any, cast

from ...actors.errors import HoldfastError, MailboxFull
from ...actors.events import HeldMessages
from ...actors.kernel.cell import GONE, Cell
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import Ask, Item
from ...actors.kernel.mailbox import Senders, admit_gone
from ...actors.overflow import decide, held_drop_reason
from ..inputs import Batch, Input
from ..protocol import MESSAGE, Answer
from ..recovery_settings import Held
from .disposal import lose
from .pending_asks import SwitchAsk, turned_away

if TYPE_CHECKING:
    from ...actors.kernel.cell import Host
    from .capacity import HomeBound
    from .recorded_home import RecordedHome
    from .switch import Switch

MAY_LIVE_AGAIN = "its supervisor has ended, and may start it again"


class Holding:
    """What is held for one home, by topic ("": all that comes by no topic with a rule of its own)."""

    def __init__(self, home: Switch, inner: HomeBound | None) -> None:
        self._home, self.inner = home, inner
        self._rules: dict[str, Held | None] = {
            "": home.method.meanwhile.held,
            **dict(home.method.meanwhile.held_topics),
        }
        self._counted: dict[int, tuple[Input, str]] = {}  # by id, in admission order
        self._waiting: deque[tuple[Ask, str, bytes, str | None, str]] = deque()  # asks that wait
        self._senders = Senders()
        self.topic = ""  # by which the message comes that is admitted next
        self._added = ""
        self.dropped = self.refused = 0

    @property
    def capacity(self) -> int:
        """The capacity of the mailbox itself."""
        return self.inner.capacity if self.inner is not None else 0

    @property
    def is_full(self) -> bool:
        """Whether one more, that comes by no topic with a rule of its own, would be too many."""
        rule = self._rules[""]
        is_over = rule is not None and self._count("") >= rule.capacity
        return is_over or (self.inner is not None and self.inner.is_full)

    @property
    def overflow(self) -> str:
        """Whether a send from a recorded turn is let in and waits then."""
        rule = self._rules.get("")
        return rule.overflow if rule is not None else self.inner.overflow if self.inner is not None else ""

    def again(self, running: int) -> None:
        """The actor has ended again: what it had not begun is still held."""
        home = self._home
        begun = (running, home.ledger.begun)
        self._counted = {k: one for k, one in self._counted.items() if k in home.ledger.open and k not in begun}

    # -- admission --------------------------------------------------------------------------------------------------

    def makes_room(self, ask: Ask | None, name: str, body: bytes, sender: str | None) -> bool:
        """Whether a message can be admitted now; the policy has seen to it otherwise.

        Raises:
            MailboxFull: it is a tell, and the policy refuses it.
        """
        topic = self._added = self._take_topic()
        rule = self._rules[topic]
        if rule is not None and self._count(topic) >= rule.capacity:
            verdict, keep = decide(rule.overflow, rule.capacity, is_ask=ask is not None)
            if verdict == "wait" and ask is not None:
                self._waiting.append((ask, name, body, sender, topic))
                return False
            if verdict != "take":
                self._turn_away(rule, ask, name, body, is_lost=verdict == "lose")
                return False
            self._drop(topic, rule, keep)
        return self.inner is None or self.inner.makes_room(ask, name, body, sender)

    def _turn_away(self, rule: Held, ask: Ask | None, name: str, body: bytes, *, is_lost: bool) -> None:
        """Raises MailboxFull: it is a tell, and its sender is to know."""
        error = MailboxFull(self._home.path, rule.capacity)
        self._home.node.count_no_room(self._home.path)
        if is_lost:
            self.dropped += 1
            lose(self._home, Parcel(name, body), _why(rule))
        else:
            self.refused += 1
            if ask is None:
                raise error
        if ask is not None:
            ask.fail(error)

    def _take_topic(self) -> str:
        """By which topic that has a rule of its own the message in hand comes."""
        topic, self.topic = self.topic, ""
        return topic if topic in self._rules else ""

    def _count(self, topic: str) -> int:
        return sum(by == topic for _, by in self._counted.values())

    def _drop(self, topic: str, rule: Held, keep: int) -> None:
        """End held messages, oldest first, until `keep` are left: in the journal too."""
        home, batch = self._home, Batch()
        answer = Answer(*home.node.codec.encode_error(MailboxFull(home.path, rule.capacity, rule.overflow)))
        mine = [source for source, by in self._counted.values() if by == topic]
        for source in mine[: len(mine) - keep]:
            self.dropped += 1
            home.node.count_no_room(home.path)
            lose(home, source, _why(rule))
            home.end_without_turn(source, answer, batch)
        batch.commit(home.journal)

    def blocks(self, topic: str) -> bool:
        """Whether the rule of a topic has a sender wait now."""
        rule = self._rules.get(topic if topic in self._rules else "")
        return rule is not None and rule.overflow == "block" and self._count(topic) >= rule.capacity

    @property
    def has_room(self) -> bool:
        """Whether a message would be taken now, or lost."""
        return not self.blocks("") and (self.inner is None or self.inner.has_room)

    def room(self, topic: str = "") -> asyncio.Future[None] | None:
        """For `send`: None if a message would be taken now, or the policy never waits."""
        if self.blocks(topic):
            return self._senders.wait(self._home.node.loop)
        return None if self.inner is None else self.inner.room()

    # -- the end of the isolation -----------------------------------------------------------------------------------

    def report(self) -> None:
        """Put what was held where the message switch finds it."""
        if self._counted or self.dropped or self.refused:
            recoveries = self._home.homes.recoveries
            recoveries.held.append(HeldMessages(self._home.path, len(self._counted), self.dropped, self.refused))
            if recoveries.on_held is not None:
                recoveries.on_held()

    def let_in(self) -> None:
        """What was held has been fed: now come those who have waited, in order."""
        home = self._home
        while self._waiting:
            ask, name, body, sender, _ = self._waiting.popleft()
            bound = home.intake.bound
            if not ask.is_done and (bound is None or bound.makes_room(ask, name, body, sender)):
                home.take(ask, name, body, sender)
        self._senders.release()

    # -- as the bound whose place this takes ------------------------------------------------------------------------

    def added(self, source: Input) -> None:
        """Count an input that was admitted, if it is a message."""
        if source.kind == MESSAGE:
            self._counted[source.id] = (source, self._added or self._take_topic())
            self._added = ""
        if self.inner is not None:
            self.inner.added(source)

    def ended(self, source: Input) -> None:
        """An input has left the queue."""
        self._counted.pop(source.id, None)
        if self.inner is not None:
            self.inner.ended(source)

    def refill(self) -> None:
        """Nothing is let in while it is held."""

    def release(self, error: HoldfastError, *, keep_asks: bool = False) -> None:
        """The address is given up: whoever waits shall see it. `keep_asks`: turns of recorded actors wait on."""
        waiting, self._waiting = self._waiting, deque()
        for ask, name, body, sender, _ in waiting:
            if not turned_away(ask, error, keep_asks=keep_asks):
                self._home.take(ask, name, body, sender)  # What is held is over: it waits with all that was told.
        self._senders.release()
        if self.inner is not None:
            self.inner.release(error, keep_asks=keep_asks)

    def restart(self) -> None:
        """The life is over: nothing is in hand."""
        if self.inner is not None:
            self.inner.restart()

    def may_feed(self, source: Input) -> bool:
        """Whether an input goes to the life now."""
        return self.inner is None or self.inner.may_feed(source)

    def in_hand(self) -> tuple[int, dict[int, Input]] | None:
        """What the life has been fed, and what waits for that."""
        return None if self.inner is None else self.inner.in_hand()

    def take_up(self, in_hand: tuple[int, dict[int, Input]]) -> None:
        """The life that was fed this goes on."""
        if self.inner is not None:
            self.inner.take_up(in_hand)


def _why(rule: Held) -> str:
    return held_drop_reason(rule.capacity, rule.overflow)


class Inlet(Cell):
    """Where a topic with a rule of its own comes in: the subscriber in the place of the actor's cell."""

    __slots__ = ("home", "topic")

    def __init__(self, home: Switch, topic: str) -> None:
        assert home.cell is not None
        self.home, self.topic = home, topic
        super().__init__(home.node, None, home.path, home.cell.host)
        self.admit = admit_inlet
        self.extra().outlet = self
        self.renew()

    def renew(self) -> None:
        """The actor's next life begins: perhaps as another class, elsewhere."""
        cell = self.home.cell
        assert cell is not None
        self.table, self.host, self.state = cell.table, InletHost(cell), cell.state

    @property
    def has_room(self) -> bool:
        """Whether a message would be taken now, or lost."""
        home = self.home
        return home.cell is None or (home.has_room and not self._is_blocked)

    @property
    def _is_blocked(self) -> bool:
        holding = self.home.intake.holding
        return holding is not None and holding.blocks(self.topic)

    def room(self) -> asyncio.Future[None] | None:
        """For `send`: None while there is room."""
        home, holding = self.home, self.home.intake.holding
        if holding is not None and (wait := holding.room(self.topic)) is not None:
            return wait
        return home.room() if home.cell is not None else None

    def mark(self) -> None:
        """What is admitted next comes by this topic."""
        if self.home.intake.holding is not None:
            self.home.intake.holding.topic = self.topic


class InletHost:
    """The actor's host, as its inlets see it."""

    def progress(self, cell: Cell) -> object:
        return None

    def __init__(self, cell: Cell) -> None:
        self._cell = cell

    def offer(self, cell: Cell, item: Any) -> Awaitable[None] | None:
        return self._cell.host.offer(cell, item)

    def __getattr__(self, name: str) -> Any:
        host: Host = self._cell.host
        return getattr(host, name)


def admit_inlet(cell: Cell, item: Any) -> None:
    """Admit what was published, as the topic's."""
    assert isinstance(cell, Inlet)
    home = cell.home
    if home.cell is None:
        return
    cell.mark()
    try:
        home.cell.admit(home.cell, item)
    finally:
        if home.intake.holding is not None:
            home.intake.holding.topic = ""


class Between(Cell):
    """A recorded address between two lives, whose supervisor has ended with it: what comes waits here for the next one.

    Whoever knew it there hears of its end, and nobody finds an actor there; only what must not be lost is taken.
    """

    __slots__ = ("home",)

    def __init__(self, home: Switch, last: Cell) -> None:
        self.home = home
        super().__init__(home.node, last.parent, last.name, last.host)
        before, more = last.extra(), self.extra()
        more.start, more.reason, more.last, more.outlet = before.start, before.reason, before.last, home
        self.table, self.admit = last.table, admit_between

    def room(self) -> asyncio.Future[None] | None:
        """For `send`: None while there is room; nobody here makes any.

        Raises:
            ActorStopped: there is none.
        """
        if self.state is GONE:
            return super().room()
        if not self.has_room:
            raise self.stopped_error(MAY_LIVE_AGAIN)
        return None

    def renamed(self, path: str) -> None:
        """The address is another one from now on."""
        self.parent, self.name = None, path

    def over(self) -> None:
        """The next life is about to begin, or none will: who has a ref to this reaches whoever lives there then."""
        self.state, self.admit = GONE, admit_gone
        for topic in list(self.extra().belongings.topics):
            self.node.topics.unsubscribe(topic, self)


def admit_between(cell: Cell, item: Any) -> None:
    """Admit a message that waits for the next life. An ask from outside fails at once: it can be asked again."""
    assert isinstance(cell, Between)
    if isinstance(item, Item) and item.is_ask and not isinstance(item, SwitchAsk):
        item.fail(cell.stopped_error(MAY_LIVE_AGAIN))
    else:
        cell.home.admit(cell, item)


def admit_unread(cell: Cell, item: Any) -> None:
    """The first message to an address whose home has not been read from the store in this program: it is, now.

    Raises:
        HoldfastError: it cannot be, and the item is no ask, which fails for that reason.
    """
    cell.node.check_caller(cell.path)
    home = cast("RecordedHome", cell.host.home)
    try:
        home.take_in(cell)
    except HoldfastError as error:
        if not isinstance(item, Ask):
            raise
        item.fail(error)
    else:
        cell.admit(cell, item)


def is_unread(cell: Cell) -> bool:
    """Whether an address was made ahead of its first life, and its home has not been read from the store."""
    return cell.admit is admit_unread


@dataclasses.dataclass(slots=True)
class Intake:
    """What stands between the senders and one home.

    Attributes:
        bound: what a message has to pass; None: nothing.
        holding: stands as the bound while the actor is recovered.
        inlets: the topics that have a rule of their own then.
        class_topics: those that the actor's class subscribes to; its own are beside the state.
        last: the last input that was to be safe before it is fed.
        between: stands as the actor's cell while nobody lives there, and its supervisor may bring it back.
    """

    bound: HomeBound | Holding | None = None
    holding: Holding | None = None
    inlets: dict[str, Inlet] = dataclasses.field(default_factory=dict)
    class_topics: tuple[str, ...] = ()
    last: Input | None = None
    between: Between | None = None

    @property
    def mailbox(self) -> HomeBound | None:
        """The bound of the mailbox itself, also while messages are held."""
        return self.bound.inner if isinstance(self.bound, Holding) else self.bound


def hold(home: Switch, running: int = -1) -> None:
    """The actor is recovered: what comes now is held by its method's rules."""
    intake = home.intake
    if intake.holding is not None:
        intake.holding.again(running)
    elif home.method.meanwhile.held is not None or home.method.meanwhile.held_topics:
        assert not isinstance(intake.bound, Holding)
        intake.bound = intake.holding = Holding(home, intake.bound)


def let_go(home: Switch) -> Holding | None:
    """Nothing is held any more."""
    intake = home.intake
    holding, intake.holding = intake.holding, None
    if holding is not None:
        intake.bound = holding.inner
    return holding


def wait_for_next_life(home: Switch) -> None:
    """Nobody lives at the address any more, and somebody may again: what must not be lost is taken in meanwhile."""
    last = home.cell
    assert last is not None
    home.cell = home.intake.between = Between(home, last)


def end_wait(home: Switch) -> bool:
    """Take nothing in for the next life any more, for it begins, or there will be none; False if nothing was."""
    between, home.intake.between = home.intake.between, None
    if between is not None:
        between.over()
    return between is not None


def inlet(home: Switch, topic: str) -> Cell:
    """Where the messages of a topic come in: the actor's cell, unless they are held by a rule of their own."""
    cell = home.cell
    assert cell is not None
    inlets = home.intake.inlets
    if topic not in inlets:
        if all(topic != one for one, _ in home.method.meanwhile.held_topics):
            return cell
        inlets[topic] = Inlet(home, topic)
    inlets[topic].renew()
    return inlets[topic]
