"""What goes home beside the ends of turns: what background work has brought, and snapshots."""

from __future__ import annotations

import time
from typing import Final

from ...checkpoint.protocol import Snapshot, Unsaved, pieces
from ...checkpoint.snapshot.key_variables import save_state
from ..bricks.brick_messages import Beside
from .rewind_points import Points

MOST_COPIED: Final = 16_000_000
"""Bytes of a state that home gets a copy of."""


class Reports(Points):
    """Collects it until a part is handed over, or until somebody comes for it (`on_more`)."""

    _is_large = False  # for copies: it is not gone through again for that

    def tell_more(self, record: Beside) -> None:
        """Something goes home behind the ends of the part at hand, or by itself."""
        self.more.append(record)
        self.on_more()

    def take_more(self) -> list[Beside]:
        """What goes home behind the ends that are handed over now."""
        if self._snapshot_wanted:
            self._snapshot()
        more, self.more = self.more, []
        return more

    def want_snapshot(self) -> None:
        """A snapshot goes home with the next part, or at once."""
        self._snapshot_wanted = True
        self.on_more()

    def _snapshot(self) -> None:
        life = self.life
        if life is None or life.pipes or life.feed is not None or not life.is_live or not self.method.snapshots:
            return
        self._snapshot_wanted = False
        try:
            self._send_snapshot()
        except Exception as error:  # What the user's own `get_state` raises is no reason to lose what it has.
            self.more.append(Unsaved(str(error)))

    def _send_snapshot(self) -> None:
        life = self.life
        assert life is not None
        begin = time.perf_counter()
        point = self.point
        assert life.cell.actor is not None
        is_known = point is not None and point.turn == life.turn and not point.deltas and not self.tail
        data = point.data.whole() if point is not None and is_known else save_state(life.cell.actor)
        stash = [fed.feed.id for fed in life.stash]
        parts, pause = pieces(data), time.perf_counter() - begin
        for index, one in enumerate(parts, 1):
            self.more.append(Snapshot(life.turn, one, index == len(parts), stash, pause, traps=life.traps))

    def copied(self) -> list[Snapshot]:
        """The state as it is between two turns, for a home that keeps nothing otherwise; [] if it cannot be had."""
        life, more = self.life, self.more
        if life is None or life.feed is not None or not life.is_live or not self.has_access or self._is_large:
            return []
        self.more = []
        try:
            self._send_snapshot()
            found = [one for one in self.more if isinstance(one, Snapshot)]
        except Exception:  # What the user's own `get_state` raises: there is no copy then.
            found = []
        self.more = more
        self._is_large = sum(len(one.data) for one in found) > MOST_COPIED
        return [] if self._is_large else found

    def last_snapshot(self) -> None:
        """The life ends in good order."""
        self._snapshot_wanted = True
        self._snapshot()
        self.on_more()
