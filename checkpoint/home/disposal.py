"""Ends inputs that nobody will handle, and homes that are given up or erased."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from ...actors.errors import ActorStopped, AskFailed, HoldfastError, Quarantined
from ...actors.events import MessageQuarantined
from ...actors.kernel.codec import Parcel
from ..group_commit import Unkept
from ..inputs import Batch, Input
from ..protocol import DROPPED, MESSAGE, START, TICK, Answer
from .pending_asks import SwitchAsk

if TYPE_CHECKING:
    from .switch import Switch


def end_begun(home: Switch, source: Input, error: HoldfastError, batch: Batch) -> None:
    """End the turn that was in hand when the life ended: it is not gone on with.

    It uses up its number: what that turn has sent, and asks it has out, are not another's. What was looked at beside
    another turn has none, and that turn goes on.
    """
    if home.ledger.released and source.id != home.ledger.begun:
        home.end_without_turn(source, _failure(home, error), batch)
        return
    home.end_turn(source, home.ledger.turn + 1, DROPPED, batch)
    home.give(source, _failure(home, error), batch)


def put_into_quarantine(home: Switch, source: Input) -> None:
    """Put an input aside that has ended its actor's process again and again."""
    home.node.emit(MessageQuarantined(home.path, source.name, source.deliveries))
    batch, error = Batch(), Quarantined(home.path, source.deliveries)
    home.homes.quarantine.hold(home, source, batch)
    end_begun(home, source, error, batch)
    batch.commit(home.journal)


def undo_begun(home: Switch, why: str) -> None:
    """Undo the turn in hand, whose first state is gone: if it has let something out, it ends with that."""
    source = home.ledger.undo_begun()
    if source is None:
        return
    if source.kind == MESSAGE and source.ask is None:
        lose(home, source, why)
    batch = Batch()
    end_begun(home, source, AskFailed(home.path, why), batch)
    batch.commit(home.journal)


def drop_all(
    home: Switch, why: str, *, keep_tells: bool = False, keep_asks: bool = False, keep_ticks: bool = True
) -> None:
    """End what waits where nobody lives any more: whoever waits for it is told, the rest goes to dead letters.

    What has begun, and what is to be answered later, fails otherwise than what has surely not.

    `keep_tells`: it is the actor's supervisor that has ended. Both may be started again, so what nobody waits for
    stays for the next life.
    `keep_asks`: that will be. What turns of recorded actors ask stays as well: they wait for it, or their next lives
    do. A turn in hand that waits for such an answer stays too; whoever asked for it from outside is told now.
    `keep_ticks`: what timers have brought stays as well, as the timers do that run: the address is not erased.
    """
    batch, stopped, ledger = Batch(), ActorStopped(home.path, why), home.ledger
    reason = None if home.cell is None else home.cell.extra().reason
    ended = AskFailed(home.path, why if reason is None else str(reason))
    home.life.abandon()
    home.timers.pause()
    if home.intake.bound is not None:
        home.intake.bound.release(stopped, keep_asks=keep_asks)
    lasts = ledger.waits.lasts or (keep_asks and home.calls.waits_for_answer)
    for source in list(ledger.open.values()):
        if source.kind == START or (keep_tells and source.ask is None) or (keep_ticks and source.kind == TICK):
            continue
        if home.homes.far.goes_on(source.ask):
            continue
        if keep_asks and isinstance(source.ask, SwitchAsk):
            source.ask.strand()  # Also if it is the turn in hand: the next life goes on with that.
            continue
        if source.ask is None and source.kind == MESSAGE:
            lose(home, source, why)
        if source.id == ledger.begun and ledger.released and lasts and keep_tells:
            ask, source.ask = source.ask, None  # It goes on in the next life: what it has done is not left half done.
            if ask is not None:
                ask.fail(ended)
        elif source.id == ledger.begun and ledger.released:
            end_begun(home, source, ended, batch)
        else:
            home.end_without_turn(source, _failure(home, ended if source.was_cut else stopped), batch)
    batch.commit(home.journal)
    home.calls.renounce(ended, keep_asks=keep_asks)
    home.limit.wake()
    home.due.abandon(why)


def forget_home(home: Switch, why: str) -> None:
    """Forget all that was recorded, which is gone from the store: nothing is written for it any more."""
    home.journal = Unkept(home.journal.commits)
    home.calls.abandon()
    drop_all(home, why, keep_ticks=False)
    home.timers.replace({})
    home.ties.replace([])
    home.images.close()
    if home.intake.between is not None:
        home.intake.between.over()
    home.cell = home.intake.between = None


def lose(home: Switch, message: Input | Parcel, why: str) -> None:
    """Make a dead letter of a message that will not be handled, and that nobody waits for."""
    cell = home.cell
    if cell is None:
        return
    try:
        decoded = cell.node.codec.decode(cell.table.kind_named(message.name), message.body)
    except (HoldfastError, msgspec.DecodeError):
        cell.node.dead_letter(cell, Parcel(message.name, message.body), why)
    else:
        cell.undelivered(decoded, why)


def _failure(home: Switch, error: HoldfastError) -> Answer:
    return Answer(*home.node.codec.encode_error(error))
