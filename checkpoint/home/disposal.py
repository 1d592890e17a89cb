"""Ends without a turn: what becomes of inputs that nobody will handle, and of a home that is given up or erased."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from ...actors.errors import ActorStopped, AskFailed, HoldfastError, Quarantined
from ...actors.events import MessageQuarantined
from ...actors.kernel.codec import Parcel
from ..group_commit import Unkept
from ..inputs import OVERHEAD, Batch, Input
from ..protocol import DROPPED, MESSAGE, START, TICK, Answer

if TYPE_CHECKING:
    from .switch import Switch


class Ends:
    """How the inputs of one home end that its actor does not handle."""

    def __init__(self, home: Switch) -> None:
        self._home = home

    def without_turn(self, source: Input, answer: Answer, batch: Batch) -> None:
        """An input that will not be handled: it gets an end record all the same."""
        home = self._home
        del home.open[source.id]
        home.bytes -= len(source.body) + OVERHEAD
        if home.bound is not None:
            home.bound.ended(source)
        if home.journal.durable:
            position: list[int] = []
            home.dropped += (source.positions, position)  # Perhaps they stand nowhere yet.
            batch.add(home.path, ("drop", source.id), position)
        home.give(source, answer, batch)

    def begun(self, source: Input, error: HoldfastError, batch: Batch) -> None:
        """The input of the turn that was in hand when the life ended is not gone on with.

        It uses up the number of its turn: what that has sent, and asks it has out, are not another's.
        """
        home = self._home
        home.end_turn(source, home.turn + 1, DROPPED, batch)
        home.give(source, self._failure(error), batch)

    def quarantine(self, source: Input) -> None:
        """An input that has ended its actor's process again and again."""
        home = self._home
        home.node.emit(MessageQuarantined(home.path, source.name, source.deliveries))
        batch = Batch()
        if home.quarantine is not None:
            home.quarantine.hold(home, source, batch)
        self.begun(source, Quarantined(home.path, source.deliveries), batch)
        batch.commit(home.journal)

    def undo_begun(self, why: str) -> None:
        """The state that the turn in hand began with is gone: if it has let something out, it ends with that."""
        home = self._home
        source = home.open.get(home.partial_id)
        if source is None or not home.partial:
            home.partial, home.partial_id = [], -1
            return
        if source.kind == MESSAGE and source.ask is None:
            self.lost(source.name, source.body, why)
        batch = Batch()
        self.begun(source, AskFailed(home.path, why), batch)
        batch.commit(home.journal)

    def drop_all(self, why: str, *, keep_tells: bool = False, keep_ticks: bool = True) -> None:
        """Nobody lives here any more: whoever waits is told, the rest goes to dead letters.

        What has begun, and what is to be answered later, fails otherwise than what has surely not.

        `keep_tells`: it is the actor's supervisor that has ended. Both may be started again, so what nobody waits for
        stays for the next life.
        `keep_ticks`: what timers have brought stays as well, as the timers do that run: the address is not erased.
        """
        home = self._home
        batch, stopped = Batch(), ActorStopped(home.path, why)
        reason = None if home.cell is None else home.cell.extra().reason
        ended = AskFailed(home.path, why if reason is None else str(reason))
        if home.live is not None and not home.live.done():
            home.live.cancel()
        home.timers.pause()
        if home.bound is not None:
            home.bound.release(stopped)
        for source in list(home.open.values()):
            if source.kind == START or (keep_tells and source.ask is None):
                continue
            if source.kind == TICK and keep_ticks:
                continue
            if source.ask is None and source.kind == MESSAGE:
                self.lost(source.name, source.body, why)
            if source.id == home.partial_id and home.partial:
                self.begun(source, ended, batch)
            else:
                self.without_turn(source, self._failure(ended if source.was_cut else stopped), batch)
        batch.commit(home.journal)
        for ask in home.later.values():
            ask.fail(ended)
        home.later.clear()
        home.limit.wake()
        home.due.abandon(why)

    def erased(self, why: str) -> None:
        """All that was recorded is gone from the store; here it goes too, and nothing is written for it any more."""
        home = self._home
        home.journal = Unkept(home.journal.commits)
        home.calls.abandon()
        self.drop_all(why, keep_ticks=False)
        home.timers.replace({})
        home.ties.replace([])
        home.images.close()
        home.cell = None

    def lost(self, name: str, body: bytes, why: str) -> None:
        """A message that will not be handled, and nobody waits for."""
        cell = self._home.cell
        if cell is None:
            return
        try:
            message = cell.node.codec.decode(cell.table.kind_named(name), body)
        except (HoldfastError, msgspec.DecodeError):
            cell.node.dead_letter(cell, Parcel(name, body), why)
        else:
            cell.undelivered(message, why)

    def _failure(self, error: HoldfastError) -> Answer:
        return Answer(*self._home.node.codec.encode_error(error))
