"""Forgets turns that will not be replayed: with snapshots alone, an actor returns as its last one has it.

The next life is given the number of the last turn to go on from, so numbers of turns and outputs stay unique. In the
journal what is forgotten stays until the next snapshot; a root that reads it again forgets it again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from ...actors.errors import AskFailed
from ...actors.events import TurnsLost
from ..protocol import OK, START
from .snapshot_record import FORMAT, Meta, go_back

if TYPE_CHECKING:
    from ..home.switch import Switch

LOST = "its turn was lost: the actor came back with the state of its last snapshot, and replays nothing"


def forget_turns(home: Switch) -> None:
    """Between two lives: what the turns since the last snapshot did to the state is lost; what is queued stays.

    A turn that was interrupted begins anew; if it has let something out already, it ends with that instead.

    Raises:
        HoldfastError: the store refused.
    """
    home.undo_begun(LOST)
    ledger = home.ledger
    if ledger.turn == ledger.state_turn:
        return
    count = sum(turn.status == OK and turn.input.kind != START for turn in ledger.turns.values())
    for number in list(ledger.turns):
        ask = home.calls.later.pop(ledger.give_up(number).input.id, None)
        if ask is not None:  # The handle with which it would have been answered is gone with the state.
            ask.fail(AskFailed(home.path, LOST))
    ledger.pipes_done.clear()
    ledger.outcomes.clear()
    meta = ledger.newest or Meta(FORMAT, ledger.turn, 0, [], {}, [], 0, b"")
    ledger.newest = msgspec.structs.replace(meta, turn=ledger.turn)
    go_back(home, meta)
    if count and home.node.events.has_listeners:
        home.node.emit(TurnsLost(home.path, count, meta.base))
