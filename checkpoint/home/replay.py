"""Replay: what was handled since the snapshot is fed again, as fast as it goes or as it once came.

Source: Zou and Bai, who wait between two messages as long as there was between them when they were recorded.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from ...actors.events import ReplayPaced
from ..inputs import Turn

if TYPE_CHECKING:
    from ..protocol import LifePort
    from .switch import Switch

TELL_EVERY = 1.0
"""Seconds between two events that tell how long a paced replay will still take, at least."""


class PacedReplay:
    """The replay to the present life of one home."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._waiting: deque[tuple[float, int, Turn]] = deque()  # due on the loop's clock, number, turn
        self._handle: asyncio.TimerHandle | None = None
        self._told_at = float("-inf")
        self._fed = -1  # the last turn that was fed

    def begin(self, port: LifePort, turns: Iterable[tuple[int, Turn]], then: Callable[[], None]) -> None:
        """Feed ended turns in turn order, then call `then`.

        Each is due as long after the first as it was when they were recorded, divided by the speed: a handler that
        takes its time does not add to that, and all of it never takes longer than what was recorded did.
        """
        speed = self._home.method.speed
        if not speed:
            for number, turn in turns:
                self._feed(port, number, turn)
            then()
            return
        due = self._home.node.loop.time()
        last: float | None = None
        for number, turn in turns:
            when = turn.input.time
            if last is not None and when > last:  # Turns need not be in the order of admission; clocks may be set back.
                due += (when - last) / speed
            last = when if last is None else max(last, when)
            self._waiting.append((due, number, turn))
        self._told_at = float("-inf")
        self._go_on(port, then)

    def _feed(self, port: LifePort, number: int, turn: Turn) -> None:
        pipes = self._home.ledger.pipes_done.get(number, ())
        port.to_life(turn.input.feed(number, tuple(sorted(pipes)), was_asked=turn.reply != 0))
        self._fed = number

    def pauses_at(self, turn: int) -> bool:
        """Whether all that was fed is handled, up to this turn, and it is not yet time for the next."""
        return self._handle is not None and self._fed <= turn

    def _go_on(self, port: LifePort, then: Callable[[], None]) -> None:
        home, waiting = self._home, self._waiting
        self._handle = None
        if home.life.port is not port:
            return  # That life is over, or not the one any more.
        now = home.node.loop.time()
        while waiting and waiting[0][0] <= now:
            _, number, turn = waiting.popleft()
            self._feed(port, number, turn)
        if not waiting:
            then()
            return
        if home.node.events.has_listeners and now - self._told_at >= TELL_EVERY:
            self._told_at = now
            home.node.emit(ReplayPaced(home.path, len(waiting), waiting[-1][0] - now, home.ledger.backlog(-1)))
        self._handle = home.node.loop.call_at(waiting[0][0], self._go_on, port, then)

    def cancel(self) -> None:
        """Feed nothing more: that life is over."""
        self._waiting.clear()
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None
