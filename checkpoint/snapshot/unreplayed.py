"""Forgetting what is not replayed: an actor with snapshots alone comes back as its last one has it.

The next life is given the number of the last turn to go on from, so numbers of turns and outputs stay unique. In the
journal what is forgotten stays until the next snapshot; a root that reads it again forgets it again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from ...actors.errors import AskFailed
from ...actors.events import TurnsLost
from ..inputs import OVERHEAD
from ..protocol import OK, START, STASHED
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
    home.ends.undo_begun(LOST)
    if home.turn == home.state_turn:
        return
    count = sum(turn.status == OK and turn.input.kind != START for turn in home.turns.values())
    for number, turn in home.turns.items():
        source = turn.input
        known = home.positions.pop(number, [])  # Perhaps they stand nowhere yet.
        if home.journal.durable:
            home.dropped.append(known)
            if source.id not in home.open:  # Else it was put aside, and waits again.
                home.dropped.append(source.positions)
        if turn.status != STASHED:
            home.bytes -= len(source.body) + OVERHEAD
        ask = home.later.pop(source.id, None)
        if ask is not None:  # The handle with which it would have been answered is gone with the state.
            ask.fail(AskFailed(home.path, LOST))
    home.turns.clear()
    home.pipes_done.clear()
    home.calls.outcomes.clear()
    meta = home.newest or Meta(FORMAT, home.turn, 0, [], {}, [], 0, b"")
    home.newest = msgspec.structs.replace(meta, turn=home.turn)
    go_back(home, meta)
    if count and home.node.events.has_listeners:
        home.node.emit(TurnsLost(home.path, count, meta.base))
