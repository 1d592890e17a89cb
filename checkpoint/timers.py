"""The timers of a recorded actor: they belong to its address, and their clock runs on whoever lives there."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .inputs import Batch, TimerState
from .records import TICK, Answer, Out

if TYPE_CHECKING:
    from .switch import Switch

Saved = tuple[str, bytes, float, float]
"""A timer in a snapshot: type name and body of its message, seconds left, interval."""


class Timers:
    """The timers of one home."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._states: dict[str, TimerState] = {}

    def operate(self, out: Out) -> None:
        """Start or cancel one, as an ended turn wants it."""
        if out.verb == "timer":
            self.start(out.to, out.name, out.body, out.seconds, out.interval)
        else:
            timer = self._states.pop(out.to, None)
            if timer is not None and timer.handle is not None:
                timer.handle.cancel()

    def start(self, key: str, name: str, body: bytes, left: float, interval: float) -> None:
        """A tick comes in `left` seconds."""
        loop = self._home.node.loop
        timer = self._states[key] = TimerState(name, body, loop.time() + left, interval)
        timer.handle = loop.call_at(timer.due, self._tick, key)

    def _tick(self, key: str) -> None:
        timer, home = self._states.get(key), self._home
        if timer is None:
            return
        if timer.interval > 0:
            timer.due = max(timer.due + timer.interval, home.node.loop.time())
            timer.handle = home.node.loop.call_at(timer.due, self._tick, key)
            if any(source.origin == key for source in home.open.values() if source.kind == TICK):
                return  # One waits already.
        else:
            del self._states[key]
        home.forward(home.record(TICK, timer.name, timer.body, None, origin=key))

    def drop_ticks(self, timer: str, running: int, batch: Batch) -> None:
        """Ticks of a cancelled timer that wait do not come any more; the life forgets them by itself."""
        home = self._home
        for source in list(home.open.values()):
            if source.kind == TICK and source.origin == timer and source.id != running:
                home.ends.without_turn(source, Answer(), batch)

    def pause(self) -> None:
        """The address is given up: what remains runs on with the next life."""
        now = self._home.node.loop.time()
        for timer in self._states.values():
            if timer.handle is not None:
                timer.handle.cancel()
                timer.handle = None
                timer.due -= now

    def resume(self) -> None:
        """A life begins: what was stopped with the address runs on."""
        loop = self._home.node.loop
        for key, timer in self._states.items():
            if timer.handle is None:
                timer.due += loop.time()
                timer.handle = loop.call_at(timer.due, self._tick, key)

    def replace(self, saved: dict[str, Saved]) -> None:
        """Have these instead of those there are; they run on with the next life."""
        for timer in self._states.values():
            if timer.handle is not None:
                timer.handle.cancel()
        waiting = {source.origin for source in self._home.open.values() if source.kind == TICK}
        self._states = {
            key: TimerState(name, body, max(0.0, left), interval)
            for key, (name, body, left, interval) in saved.items()
            if interval > 0 or key not in waiting  # Else it would come twice.
        }

    def saved(self) -> dict[str, Saved]:
        """All of them, with the time that is left."""
        now = self._home.node.loop.time()
        return {key: (one.name, one.body, one.due - now, one.interval) for key, one in self._states.items()}
