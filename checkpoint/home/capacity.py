"""What bounds the admissions of a recorded actor: the capacity of its mailbox, and the size limit of its journal.

Inputs that are admitted and not begun count. Everything admitted is journaled, so the home cannot take back what it has
fed. A policy that drops queued messages therefore feeds one input at a time.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING

from ...actors.errors import HoldfastError, MailboxFull
from ...actors.events import JournalFull
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import Ask
from ...actors.kernel.mailbox import Bound, Senders
from ...actors.overflow import DROPS, Overflow, decide, drop_reason
from ..inputs import Batch, Input
from ..protocol import MESSAGE, Answer, SnapshotNow
from .disposal import lose
from .pending_asks import turned_away
from .replay_filter import turns_to_skip

if TYPE_CHECKING:
    from .switch import Switch


class HomeBound:
    """Capacity, overflow policy, and who waits for room."""

    def __init__(self, home: Switch, chosen: Bound) -> None:
        self._home = home
        self.capacity = chosen.capacity
        self.overflow: Overflow = chosen.overflow
        self.one_at_a_time = chosen.overflow in DROPS
        stashed = home.ledger.stashed()
        self._counted = {  # by id, in admission order
            key: source for key, source in home.ledger.open.items() if source.kind == MESSAGE and key not in stashed
        }
        self.waiting: deque[tuple[Ask, str, bytes, str | None]] = deque()  # asks that wait for room
        self.senders = Senders()
        self._fed = -1  # one at a time: the input in hand
        self._behind: dict[int, Input] = {}  # and those that wait for it

    @property
    def count(self) -> int:
        """Messages that wait for their turn."""
        if self.one_at_a_time:
            in_hand = self._fed in self._counted
        else:
            in_hand = self._home.life.is_released and bool(self._counted)
        return len(self._counted) - in_hand

    @property
    def is_full(self) -> bool:
        """Whether one more would be too many."""
        return self.count >= self.capacity or bool(self.waiting)

    # -- admission --------------------------------------------------------------------------------------------------

    def makes_room(self, ask: Ask | None, name: str, body: bytes, sender: str | None) -> bool:
        """Whether a message can be admitted now; the policy has seen to it otherwise.

        Raises:
            MailboxFull: it is a tell, and the policy refuses it.
        """
        if not self.is_full:
            return True
        verdict, keep = decide(self.overflow, self.capacity, is_ask=ask is not None)
        if verdict == "take":
            self._drop(keep)
            return True
        if verdict == "wait" and ask is not None:
            self.waiting.append((ask, name, body, sender))
            return False
        error = MailboxFull(self._home.path, self.capacity)
        self._home.node.count_no_room(self._home.path)
        if verdict == "lose":
            lose(self._home, Parcel(name, body), drop_reason(self.capacity, self.overflow))
        elif ask is None:
            raise error
        if ask is not None:
            ask.fail(error)
        return False

    def _drop(self, keep: int) -> None:
        """End queued messages, oldest first, until `keep` are left."""
        home = self._home
        batch = Batch()
        error = Answer(*home.node.codec.encode_error(MailboxFull(home.path, self.capacity, self.overflow)))
        for source in list(self._counted.values()):
            if self.count <= keep:
                break
            if source.id not in (self._fed, home.ledger.begun):
                self._behind.pop(source.id, None)
                home.node.count_no_room(home.path)
                lose(home, source, drop_reason(self.capacity, self.overflow))
                home.end_without_turn(source, error, batch)
        batch.commit(home.journal)

    @property
    def has_room(self) -> bool:
        """Whether a message would be taken now (or lost: only the policy "block" has a sender wait)."""
        return self.overflow != "block" or not self.is_full

    def room(self) -> asyncio.Future[None] | None:
        """For `send`: None if there is room."""
        return None if self.has_room else self.senders.wait(self._home.node.loop)

    # -- what the home tells of its inputs --------------------------------------------------------------------------

    def added(self, source: Input) -> None:
        """Count an input that was admitted, if it is a message."""
        if source.kind == MESSAGE:
            self._counted[source.id] = source

    def ended(self, source: Input) -> None:
        """An input has left the queue: handled, dropped, or stashed."""
        counted = self._counted.pop(source.id, None)
        if source.id == self._fed:
            self._fed = -1
            self._feed_next()
        if counted is not None:
            self.refill()

    def refill(self) -> None:
        """Let in who waits, as far as there is room."""
        home = self._home
        while self.waiting and self.count < self.capacity:
            ask, name, body, sender = self.waiting.popleft()
            if not ask.is_done:  # Expired or given up while it waited: never admitted.
                home.take(ask, name, body, sender)
        self.senders.wake(lambda: not self.is_full)

    def release(self, error: HoldfastError, *, keep_asks: bool = False) -> None:
        """The address is given up: whoever waits shall see it. `keep_asks`: turns of recorded actors wait on."""
        waiting, self.waiting = self.waiting, deque()
        for one in waiting:
            if not turned_away(one[0], error, keep_asks=keep_asks):
                self.waiting.append(one)
        self.senders.release()

    def in_hand(self) -> tuple[int, dict[int, Input]]:
        """What the life has been fed, and what waits for that."""
        return self._fed, dict(self._behind)

    def take_up(self, in_hand: tuple[int, dict[int, Input]]) -> None:
        """The life that was fed this goes on."""
        self._fed, self._behind = in_hand

    # -- one at a time ----------------------------------------------------------------------------------------------

    def restart(self) -> None:
        """The life is over: nothing is in hand."""
        self._fed = -1
        self._behind.clear()

    def may_feed(self, source: Input) -> bool:
        """Whether an input goes to the life now, or waits until the one in hand has ended."""
        if not self.one_at_a_time:
            return True
        if self._fed >= 0:
            self._behind[source.id] = source
            return False
        self._fed = source.id
        return True

    def _feed_next(self) -> None:
        while self._behind and self._fed < 0:
            source = self._behind.pop(next(iter(self._behind)))
            if source.id in self._home.ledger.open:
                self._home.forward(source)


class Limit:
    """Who waits, or is refused, while the journal of one home is full: until a snapshot has cut it."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._senders = Senders()
        self._is_told = False
        self._looked_at = -1  # the number of turns kept when it was last tried to keep fewer
        self.at = home.method.trigger
        """Bytes from which on an admission has to ask here."""

    @property
    def is_reached(self) -> bool:
        """Whether the journal has no room."""
        return self._home.ledger.journal_bytes >= self._home.method.journal_limit

    def makes_room(self) -> bool:
        """Whether there is room when what no replay needs is given up."""
        ledger, count = self._home.ledger, len(self._home.ledger.turns)
        # During a replay they may still be wanted; and each look costs as much as there are turns.
        if self._home.life.is_released and abs(count - self._looked_at) >= max(16, count // 8):
            chosen = turns_to_skip(self._home)
            for number in (chosen.readonly | chosen.superseded) - {ledger.turn}:  # Numbers go on from the last one.
                ledger.give_up(number)
            self._looked_at = len(ledger.turns)
        return not self.is_reached

    def has_room(self, ask: Ask | None) -> bool:
        """Enough is journaled that a snapshot is due, or too much: then the message is refused.

        Raises:
            MailboxFull: to a tell; an ask fails with it.
        """
        home = self._home
        if not self.is_reached or self.makes_room():
            self.at = home.method.journal_limit
            home.due.want()
            return True
        self.refuse(ask)
        return False

    def refuse(self, ask: Ask | None) -> None:
        """Have a snapshot taken, and refuse a message until the journal is cut.

        Raises:
            MailboxFull: to a tell; an ask fails with it.
        """
        home = self._home
        if not self._is_told:
            self._is_told = True
            home.node.emit(JournalFull(home.path, home.ledger.state_turn, home.ledger.journal_bytes, self._way_out()))
        self._want_snapshot()
        error = MailboxFull(home.path, len(home.ledger.open))
        home.node.count_no_room(home.path, "journal")
        if ask is None:
            raise error
        ask.fail(error)

    def wait(self) -> asyncio.Future[None]:
        """A future that ends when it is worth trying again."""
        self._want_snapshot()
        return self._senders.wait(self._home.node.loop)

    def _way_out(self) -> str:
        if self._home.method.snapshots:
            return "it goes on behind the next snapshot"
        return (
            f"{self._home.method.name} takes no snapshots, so nothing more is admitted: "
            "raise journal_limit, use hybrid, or start the actor afresh"
        )

    def _want_snapshot(self) -> None:
        if self._home.life.port is not None:
            self._home.life.port.to_life(SnapshotNow())

    def cut(self) -> None:
        """Let everybody in again: the journal was cut."""
        self.at = self._home.method.trigger
        self._is_told = False
        self.wake()

    def wake(self) -> None:
        """Whoever waits shall look again."""
        self._senders.release()
