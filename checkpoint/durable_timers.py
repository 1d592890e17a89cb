"""The timers of a recorded actor: they belong to its address, and their clock runs on whoever lives there."""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

import msgspec

from .inputs import Batch, Input, TimerState
from .protocol import TICK, Answer, Clock, Out

if TYPE_CHECKING:
    from .home.switch import Switch
    from .snapshot.snapshot_record import Meta

Saved = tuple[str, bytes, float, float]
"""A timer in a snapshot: type name and body of its message, seconds left, interval."""


HOOKS: Final = re.compile(r"(?P<turn>\d+)[a-z_]*?(?P<said>[0-9a-f]{8})\.\d+")
"""The key of a timer that a hook wants: the turn behind which it ran, which hook, and what the timer says."""
BEGUN: Final = re.compile(r"\d+")


def said_by(name: str, body: bytes, interval: float) -> str:
    """What a timer says, in short."""
    return f"{zlib.crc32(body, zlib.crc32(f'{name}|{interval}'.encode())):08x}"


def made_by(key: str) -> int:
    """The turn that has made a timer, or behind which a hook has; -1 if its key does not say."""
    made = BEGUN.match(key)
    return -1 if made is None else int(made[0])


class Timers:
    """The timers of one home."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._states: dict[str, TimerState] = {}
        self._made: set[str] = set()  # by hooks, since the last snapshot
        self._same: dict[str, str] = {}  # timers that a hook wanted, and which they are
        self._over: dict[str, tuple[int, Clock]] = {}  # cancelled since the last snapshot, and by which turn
        self.claimed: set[str] = set()  # timers that the present life's hooks have wanted

    def operate(self, out: Out) -> None:
        """Start or cancel one, as an ended turn wants it."""
        if out.verb == "timer":
            self.start(out.to, out.name, out.body, out.seconds, out.interval)
        else:
            timer = self._states.pop(out.to, None)
            if timer is not None and timer.handle is not None:
                timer.handle.cancel()

    # -- of hooks, which run at each life ---------------------------------------------------------------------------

    def is_new(self, out: Out) -> bool:
        """Whether a timer that a hook wants is really one more: not one that ran, or had come, when its life began.

        One that ran then, and does not run now, was cancelled or has come in a turn that is handled again.
        """
        wanted = self._same.get(out.to, out.to)
        if out.to in self._same or wanted in self._states or wanted in self._made:
            self.claimed.add(wanted)
            return False
        clock = (out.name, out.body, out.interval)
        for key, other in self.after(made_by(out.to)).items():
            if other == clock and key not in self.claimed:
                self.claimed.add(key)
                self._same[out.to] = key
                return False
        self._made.add(out.to)
        self.claimed.add(out.to)
        return True

    def known_as(self, out: Out) -> Out:
        """The same order, for the timer that it means."""
        key = self._same.get(out.to)
        if key is None and out.to not in self._states and out.to not in self._made:
            key = self._meant(out.to)
        return out if key is None else msgspec.structs.replace(out, to=key)

    def _meant(self, key: str) -> str | None:
        """What a hook was given before this process began, for a timer that ran already: the one that says the same."""
        made = HOOKS.fullmatch(key)
        clocks = {} if made is None else self.after(int(made["turn"]))
        if made is None or key in clocks:
            return None
        alike = (other for other, clock in clocks.items() if made_by(other) >= 0 and said_by(*clock) == made["said"])
        return next(alike, None)

    def made_again(self, key: str) -> None:
        """The journal has this one."""
        if not key.partition(".")[0].isdigit():  # Else a turn has made it.
            self._made.add(key)

    def cancelled(self, turn: int, key: str, clock: Clock | None = None) -> None:
        """A turn has cancelled one; `clock`: what it says, if that is not known here yet."""
        clock = clock or self._clock_of(key)
        if clock is not None:
            self._over[key] = turn, clock

    def _clock_of(self, key: str) -> Clock | None:
        state, home = self._states.get(key), self._home
        if state is not None:
            return state.name, state.body, state.interval
        kept = (out for out in home.outputs.kept if out.verb == "timer" and out.to == key)
        ticks = (source for source in home.ledger.open.values() if source.kind == TICK and source.origin == key)
        return next(((out.name, out.body, out.interval) for out in kept), None) or next(
            ((source.name, source.body, 0.0) for source in ticks), None
        )

    def claims(self, turn: int) -> dict[str, Clock]:
        """Those that ran after this turn, and that a later one has cancelled."""
        return {key: clock for key, (by, clock) in self._over.items() if made_by(key) <= turn < by}

    def after(self, turn: int) -> dict[str, Clock]:
        """Those that ran after this turn, or had come and waited, whatever later ones have done since."""
        clocks = {key: clock for key, clock in self._running().items() if made_by(key) <= turn} | self.claims(turn)
        for number, ended in self._home.ledger.turns.items():
            source = ended.input
            if source.kind == TICK and made_by(source.origin) <= turn < number:
                clocks.setdefault(source.origin, (source.name, source.body, 0.0))
        return clocks

    def forget(self, turn: int) -> None:
        """A snapshot of the state after this turn is kept: no life begins before that any more."""
        self._over = {key: over for key, over in self._over.items() if over[0] > turn}

    def _running(self) -> dict[str, Clock]:
        """All of them, and those that have come and wait to be handled."""
        clocks = {key: (one.name, one.body, one.interval) for key, one in self._states.items()}
        for source in self._home.ledger.open.values():
            if source.kind == TICK:
                clocks.setdefault(source.origin, (source.name, source.body, 0.0))
        return clocks

    def at(self, meta: Meta) -> dict[str, Clock]:
        """Those that ran when a snapshot was taken, or had come and waited."""
        clocks = {key: (name, body, interval) for key, (name, body, _, interval) in meta.timers.items()}
        clocks |= meta.claims
        for source in self._home.ledger.handled_and_open():
            if source.kind == TICK and source.id < meta.next_id:
                clocks.setdefault(source.origin, (source.name, source.body, 0.0))
        return {key: clock for key, clock in clocks.items() if made_by(key) <= meta.turn}

    # -- over lives -------------------------------------------------------------------------------------------------

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
            if self._waiting(key):
                return  # One waits already.
        else:
            del self._states[key]
        home.forward(home.record(TICK, timer.name, timer.body, None, origin=key))

    def drop_ticks(self, timer: str, running: int, batch: Batch) -> None:
        """Ticks of a cancelled timer that wait do not come any more; the life forgets them by itself."""
        for source in self._waiting(timer):
            if source.id != running:
                self._home.end_without_turn(source, Answer(), batch)

    def _waiting(self, key: str) -> list[Input]:
        """Ticks of a timer that wait. One that was put aside is a message like any other."""
        ledger = self._home.ledger
        ticks = [source for source in ledger.open.values() if source.kind == TICK and source.origin == key]
        aside = ledger.stashed() if ticks else ()
        return [source for source in ticks if source.id not in aside]

    def pause(self) -> None:
        """The address is given up: what remains runs on with the next life."""
        now = self._home.node.loop.time()
        for timer in self._states.values():
            if timer.handle is not None:
                timer.handle.cancel()
                timer.handle = None
                timer.due -= now

    def resume(self) -> None:
        """A life begins: what was stopped with the address runs on, and its hooks want theirs again."""
        self.claimed.clear()
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
        self._made.clear()
        self._same.clear()
        self._over.clear()
        waiting = {source.origin for source in self._home.ledger.open.values() if source.kind == TICK}
        self._states = {
            key: TimerState(name, body, max(0.0, left), interval)
            for key, (name, body, left, interval) in saved.items()
            if interval > 0 or key not in waiting  # Else it would come twice.
        }

    def map(self, said: Mapping[str, tuple[str, bytes]]) -> None:
        """Have these timers say something else: type name and body, by key."""
        for key, (name, body) in said.items():
            self._states[key].name, self._states[key].body = name, body

    def saved(self) -> dict[str, Saved]:
        """All of them, with the time that is left."""
        now = self._home.node.loop.time()
        return {key: (one.name, one.body, one.due - now, one.interval) for key, one in self._states.items()}
