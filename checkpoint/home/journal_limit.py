"""The journal's size limit: when it is reached, nothing is admitted until a snapshot has cut the journal."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from ...actors.errors import MailboxFull
from ...actors.events import JournalFull
from ...actors.kernel.envelope import Ask
from ...actors.kernel.mailbox import Senders
from ..protocol import SnapshotNow
from .replay_filter import turns_to_skip

if TYPE_CHECKING:
    from .switch import Switch


class Limit:
    """Who waits, or is refused, while the journal of one home is full."""

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
