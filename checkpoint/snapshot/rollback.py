"""Rollback: an actor whose supervisor has ended because of it comes back with an older state, or with none.

The older snapshot is put in the place of all that came after it, under the number of the last turn: so numbers of turns
and outputs go on, nothing that has left is sent again, and the journal is cut just as behind any other snapshot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from ...actors.events import RolledBack
from ..method import OnEscalate
from .snapshot_record import FORMAT, Meta, decode_meta, go_back, put

if TYPE_CHECKING:
    from ..home.switch import Switch

UNDONE = "its turn was undone: the actor went back to an older state"


def roll_back(home: Switch, to: OnEscalate, why: str) -> None:
    """Between two lives: drop what the turns after the older snapshot (or all turns) did to the state.

    What was not handled stays queued; but an input whose turn has let something out already ends with that turn.

    Raises:
        HoldfastError: the store refused, and the actor comes back as it was.
    """
    if to == "restore" or home.ledger.is_new:
        return
    older = older_snapshot(home) if to == "older_snapshot" else None
    if to == "older_snapshot" and older is None:
        why = f"{why}; there is no older snapshot"
    if older is not None:
        home.images.fetch(older)
    home.undo_begun(UNDONE)
    first = home.ledger.turn
    if older is None:
        older = Meta(FORMAT, first, 0, [], {}, [], 0, b"")
    meta = msgspec.structs.replace(older, turn=first, next_id=home.ledger.next_id, epoch=home.journal.epoch)
    put(home, meta, 1)  # Nothing else stays: what was undone must not be what the next step back leads to.
    home.ledger.older = None
    home.images.tidy()
    home.forget_end()
    go_back(home, meta)
    home.node.emit(RolledBack(home.path, first, meta.base, why))


def older_snapshot(home: Switch) -> Meta | None:
    """The snapshot before the newest, if one is kept and it is really an older state.

    Raises:
        NotMapped: an earlier version of the program has written its timers, and their classes cannot read them.
    """
    if not home.journal.durable:
        return home.ledger.older
    saved = home.journal.load(home.path, older=True)
    newest = home.ledger.newest
    if saved.snapshot is None or newest is None:
        return None
    meta = decode_meta(saved.snapshot)
    timers = home.shapes.timers_now(meta.timers, meta.made.shapes)
    return msgspec.structs.replace(meta, timers=timers) if 0 <= meta.base < newest.base else None
