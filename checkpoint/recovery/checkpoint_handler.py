"""The checkpoint handler as an actor: it decides when an actor is due, and has its snapshot taken.

What it knows stands in the homes (`snapshot_schedule.py`); a snapshot that is under way when it dies ends without it.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING

from ...actors.exit_reasons import ExitReason
from ...actors.kernel.actor import on
from ...actors.kernel.message import Message
from ..protocol import SnapshotNow
from ..snapshot.snapshot_schedule import nobody
from .part import RecoveryPart

if TYPE_CHECKING:
    from ..home.homes import Homes
    from ..home.switch import Switch


class LookForDue(Message):
    """It is time to look at the homes that may be due: it is `when`, also if a timer fires a little early."""

    when: float


class CheckpointHandler(RecoveryPart):
    """Has snapshots taken: by time, number of messages, bytes of journal, and on demand."""

    def __init__(self, homes: Homes) -> None:
        super().__init__(homes)
        self._heap: list[tuple[float, str]] = []  # when to look at which address, at the latest
        self._next: dict[str, float] = {}  # what of the heap is meant
        self._timer: float = 0.0
        self._handle: object = None

    def on_start(self, restored: bool) -> None:
        """Take over what the homes know."""
        self._homes.on_home = self._arm
        for home in self._homes:
            self._arm(home)

    def on_stop(self, reason: ExitReason) -> None:
        """The next one looks at everything."""
        self._homes.on_home = nobody
        for home in self._homes:
            home.due.on_want = nobody

    def _arm(self, home: Switch) -> None:
        """Look at this home as soon as it says so, and when its interval is over."""
        if self.ctx._closed or not home.method.snapshots:  # Killed: the next one looks at everything.
            return
        home.due.on_want = self._arm
        now = self.ctx._cell.node.loop.time()
        due = home.due.when(now)
        self._at(home.path, due if due is not None else now + home.method.interval)

    def _at(self, path: str, when: float) -> None:
        self._next[path] = when
        heapq.heappush(self._heap, (when, path))
        if not self._timer or when < self._timer:
            self._wake(when)

    def _wake(self, when: float) -> None:
        loop = self.ctx._cell.node.loop
        self._timer = when
        if self._handle is not None:
            self._handle.cancel()  # type: ignore[attr-defined]
        self._handle = self.ctx.tell_after(max(0.0, when - loop.time()), LookForDue(when))

    @on(LookForDue)
    def look(self, message: LookForDue) -> None:
        """Ask those who are due."""
        # Without `when`, a timer of a nanosecond would follow, and another one while the clock does not move.
        now = max(message.when, self.ctx._cell.node.loop.time())
        self._timer, self._handle = 0.0, None
        while self._heap and self._heap[0][0] <= now:
            when, path = heapq.heappop(self._heap)
            if self._next.get(path) != when:
                continue
            del self._next[path]
            home = self._homes.at(path)
            if home is not None and home.method.snapshots:
                self._consider(home, now)
        if self._heap and not self._timer:
            self._wake(self._heap[0][0])

    def _consider(self, home: Switch, now: float) -> None:
        due = home.due.when(now)
        if due is not None and due <= now and home.life.port is not None:
            home.due.asked_at = home.due.last_at = now
            home.life.port.to_life(SnapshotNow(urgent=True))
            due = None
        self._at(home.path, due if due is not None else now + home.method.interval)
