"""Homes of actors without recovery: they stand only as long as a mechanism protects them, and keep nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...actors.errors import AskFailed
from ...checkpoint.home.journal_home import Entered, JournalHome
from ...checkpoint.method import Method
from ...checkpoint.snapshot.snapshot_record import meta_now, put

if TYPE_CHECKING:
    from ...actors.exit_reasons import ExitReason
    from ...actors.kernel.address_host import Parent
    from ...actors.kernel.cell import Cell
    from ...checkpoint.home.homes import Homes
    from ...checkpoint.home.switch import Switch
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
        if not (self.copy is not None and begin_again(entered.switch, self.copy)):
            begin_afresh(entered.switch)
        self.copy = None
        return entered

    def life_ended(self, switch: Switch, reason: ExitReason) -> None:
        forget_later(switch, str(reason))


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
    switch.ledger.begin_with(
        type(newest)(newest.format, switch.turn, newest.next_id, [], {}, [], newest.epoch, b"", switch.turn)
    )
    switch.timers.replace({})
    switch.topics.clear()


def begin_again(switch: Switch, copy: Meta) -> bool:
    """Between two lives of an actor whose mechanism was not trusted: whether it begins with the copy of its state."""
    return switch.ledger.newest is copy and copy.turn == switch.turn


def forget_later(switch: Switch, why: str) -> None:
    """Replies that the ended life owed will not come."""
    switch.calls.renounce(AskFailed(switch.path, why))
