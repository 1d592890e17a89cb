"""Homes of actors without recovery: they exist while a mechanism protects the actor, and store nothing.

Only as long as that mechanism is not trusted there is a copy of the state.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from ...actors.errors import AskFailed
from ...checkpoint.home.journal_home import Entered, JournalHome
from ...checkpoint.method import Method
from ...checkpoint.snapshot.snapshot_record import marks_of, meta_now, put
from .replicas import finish

if TYPE_CHECKING:
    import asyncio

    from ...actors.exit_reasons import ExitReason
    from ...actors.kernel.address_host import Parent
    from ...actors.kernel.cell import Cell
    from ...checkpoint.home.homes import Homes
    from ...checkpoint.home.switch import Switch
    from ...checkpoint.protocol import Snapshot
    from ...checkpoint.snapshot.snapshot_record import Meta

UNKEPT = Method("protected", durability="memory")
"""Of a child without recovery, as long as it is protected."""


def is_unkept(method: Method) -> bool:
    """Whether the actor has a home for as long as it is protected, and begins afresh."""
    return method.name == UNKEPT.name


class TransientHome(JournalHome):
    """A home that keeps nothing of what was handled: without recovery, the next life begins afresh."""

    def __init__(self, homes: Homes, parent: Parent) -> None:
        super().__init__(homes, UNKEPT, parent)
        self.copy: Meta | None = None  # the next life begins with it, though nothing is kept otherwise

    def open(self, cell: Cell) -> Entered:
        entered = super().open(cell)
        switch, copy = entered.switch, self.copy
        if copy is None or switch.ledger.newest is not copy or copy.turn != switch.turn:
            begin_afresh(switch)
        self.copy = None
        return entered

    @property
    def keeps_turns(self) -> bool:
        return False

    def life_ended(self, switch: Switch, reason: ExitReason) -> None:
        switch.calls.renounce(AskFailed(switch.path, str(reason)))  # Replies that it owed will not come.


def forget_ended(switch: Switch) -> None:
    """Forget all ended turns of an actor that would begin afresh."""
    put(switch, meta_now(switch, switch.turn, sorted(switch.ledger.stashed() & switch.open.keys())), 1)


def begin_afresh(switch: Switch) -> None:
    """Between two lives of an actor that is not recorded: timers, subscriptions and the stash end with a life."""
    if switch.ledger.newest is None and not switch.turns:
        return
    forget_ended(switch)
    newest = switch.ledger.newest
    assert newest is not None
    meta = type(newest)(newest.format, switch.turn, newest.next_id, [], {}, [], newest.epoch, b"", switch.turn)
    switch.ledger.begin_with(meta, switch.ledger.contained_in(meta.turn))
    switch.timers.replace({})
    switch.topics.clear()


class StateCopies:
    """Copies of the state of such an actor: the newest, for whose sake it is kept, and who waits for the next one."""

    def __init__(self, switch: Switch) -> None:
        self._switch = switch
        self.newest: Meta | None = None
        self.untrusted: set[object] = set()
        self._waiting: list[asyncio.Future[None]] = []
        self._pieces: list[bytes] = []

    def keep(self, sake: object) -> asyncio.Future[None]:
        """Keep a copy for the sake of something that is not trusted, of a state that home would not keep otherwise.

        Returns:
            What ends when the next copy has come; at once if it is kept anyway.
        """
        future: asyncio.Future[None] = self._switch.node.loop.create_future()
        if is_unkept(self._switch.method):
            self.untrusted.add(sake)
            self._waiting.append(future)
        else:
            future.set_result(None)
        return future

    def begin(self) -> None:
        """The state that home has is the first copy."""
        self.newest = self._switch.ledger.newest

    def take(self, record: Snapshot) -> None:
        """Take a piece of a copy, with what has led to it."""
        self._pieces.append(record.data)
        if record.is_last:
            state, self._pieces = b"".join(self._pieces), []
            meta = meta_now(self._switch, record.turn, record.stash, state)
            self.newest = msgspec.structs.replace(meta, marks=marks_of(record))
            put(self._switch, self.newest, 1)

    def restart(self) -> None:
        """The rest of a copy does not come any more."""
        self._pieces.clear()

    def have_come(self) -> None:
        """All that a batch has brought is here."""
        waiting, self._waiting = self._waiting, []
        finish(waiting)
