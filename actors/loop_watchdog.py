"""A thread that looks now and then at what blocks the event loop.

Nothing is measured per message: a turn that is seen twice, in the very same call, without the loop having come to
anything else in between, has been going on all the while.
"""

from __future__ import annotations

import sys
import threading
import types
from time import monotonic
from typing import TYPE_CHECKING, Any

from .errors import type_name
from .events import LoopLagged, TurnSlow
from .kernel import loop as run_loop
from .kernel.envelope import message_in
from .seconds import check_seconds

if TYPE_CHECKING:
    from .kernel.node import Node

LOOKS = 4
"""How often a turn is looked at within the time it may take."""
TURN = run_loop.run_turns.__code__
"""In its frame: the cell. The frame above it is the handler's, or that of the item it is in; new for each turn."""
RUNNER = run_loop.Runner._step.__code__
"""In its frame: the turn that the runner has."""


def check_limits(**limits: float | None) -> None:
    """Refuse limits that are neither None nor a number > 0. Raises SpecError."""
    for name, limit in limits.items():
        if limit is not None:
            check_seconds("ActorSystem", name, limit)


class Sighting:
    """A turn that the watching thread has found, and for how long it has been seen to go on."""

    __slots__ = ("address", "frame", "is_told", "message", "since", "until")

    def __init__(self, frame: types.FrameType, address: str, message: str) -> None:
        self.frame, self.address, self.message = frame, address, message
        self.since = self.until = monotonic()
        self.is_told = False


class LoopWatch:
    """Tells of turns that occupy the loop, and of a loop that lags. Off unless it is asked for.

    Args:
        node: whose loop and events.
        lag: seconds by which the loop may come late before LoopLagged is told; None: it is not watched.
        turns: seconds a turn may occupy the loop before TurnSlow is told; None: they are not watched.
    """

    def __init__(self, node: Node, lag: float | None, turns: float | None) -> None:
        self._node, self._lag, self._turns = node, lag, turns
        self._over = threading.Event()
        self._loop_thread = threading.get_ident()
        self._thread: threading.Thread | None = None
        self._timer: Any = None
        self._let_go = True  # whether the loop has come to something else since the last look

    def open(self) -> None:
        """Begin to watch the loop that runs in this thread."""
        if self._lag is not None:
            self._arm(self._lag)
        if self._turns is not None:
            self._thread = threading.Thread(target=self._look, name="holdfast watch", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop watching, and wait for the watching thread to end."""
        self._over.set()
        if self._timer is not None:
            self._timer.cancel()
        if self._thread is not None:
            self._thread.join()

    # -- the loop ---------------------------------------------------------------------------------------------------

    def _arm(self, lag: float) -> None:
        loop = self._node.loop
        self._timer = loop.call_later(lag, self._came, monotonic() + lag, lag)

    def _came(self, due: float, lag: float) -> None:
        late = monotonic() - due
        if late > lag:
            self._node.emit(LoopLagged(f"/{self._node.name}", late))
        self._arm(lag)

    # -- the turns (in the watching thread) -------------------------------------------------------------------------

    def _look(self) -> None:
        limit = self._turns
        assert limit is not None
        seen: Sighting | None = None
        while not self._over.wait(limit / LOOKS):
            now = monotonic()  # Before the look: what is seen there has gone on until then.
            found = _running(sys._current_frames().get(self._loop_thread))
            let_go, self._let_go = self._let_go, found is None
            if found is None:
                seen = None
                continue
            self._node.loop.call_soon_threadsafe(self._lets_go)
            if seen is None or let_go or found.frame is not seen.frame:
                seen = found
                continue
            seen.until = now
            if not seen.is_told and now - seen.since >= limit:
                seen.is_told = True
                self._node.loop.call_soon_threadsafe(self._tell, seen)

    def _lets_go(self) -> None:
        self._let_go = True

    def _tell(self, seen: Sighting) -> None:
        """Comes to run when the turn has let the loop go, behind what else was due: that time is none of the turn's."""
        self._node.emit(TurnSlow(seen.address, seen.message, seen.until - seen.since))


def _running(frame: types.FrameType | None) -> Sighting | None:
    """The turn in a stack."""
    above: types.FrameType | None = None
    while frame is not None:
        code = frame.f_code
        if code is TURN and above is not None:
            cell, item = frame.f_locals.get("cell"), frame.f_locals.get("item")
            return Sighting(above, *_named(cell, item)) if cell is not None else None
        if code is RUNNER and above is not None:
            turn = frame.f_locals.get("turn")
            if turn is None:
                return None
            return Sighting(above, *_named(turn.cell, turn.item))
        above, frame = frame, frame.f_back
    return None


def _named(cell: Any, item: Any) -> tuple[str, str]:
    return cell.path, type_name(type(message_in(item)))
