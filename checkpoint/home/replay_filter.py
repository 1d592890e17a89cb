"""What a replay leaves out: turns that changed nothing, and turns whose change a later one has written over.

A superseded turn is left out only if nothing that is replayed between it and the one that supersedes it could have
seen what it wrote: turns between the two are left out themselves, or supersede something and so do not look.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from ...actors.errors import UnknownMessage
from ...actors.events import TurnsSkipped
from ...actors.kernel.actor import Actor, Handles
from ...actors.kernel.node import cell_kind
from ..inputs import OVERHEAD, Turn
from ..protocol import MESSAGE, OK, STASHED, Out

if TYPE_CHECKING:
    from .switch import Switch

PIPE_DIGEST = Out(1, "pipe", "").digest()
"""Of background work that a turn has begun: its result is an input, so that turn cannot be left out."""


class Skipped(NamedTuple):
    """Numbers of turns to leave out, and why a message could not be looked into."""

    readonly: set[int]
    superseded: set[int]
    problem: str = ""


class Skipping:
    """What the replays of one home leave out."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._looked_at = -1  # the number of turns kept when it was last tried to keep fewer

    def choose(self) -> Skipped:
        """The ended turns that a replay may leave out."""
        home = self._home
        skips = home.method.skip and not home.method.check_replay  # States in between are compared, too.
        kind = cell_kind(home.cell) if home.cell is not None and skips else None
        chosen = Skipped(set(), set())
        if kind is None or not any(one.readonly or one.supersedes is not None for one in kind._declared.values()):
            return chosen
        problem = ""
        later: set[Hashable] = set()  # keys that are written again before anybody looks
        for number, turn in reversed(home.turns.items()):
            if turn.status not in (OK, STASHED):
                continue  # Not replayed anyway.
            declared = self._declared(kind, turn)
            if declared is not None and declared.readonly and PIPE_DIGEST not in turn.digests:
                chosen.readonly.add(number)
                continue
            if declared is None or declared.supersedes is None or turn.digests:
                later.clear()
                continue
            try:
                key = (declared.kind, self._key(kind, turn, declared.supersedes))
                is_written_again = key in later
            except Exception as error:  # The user's own function, or a value that is no key.
                problem = f"the key of {turn.input.name} cannot be had: {error!r}"
                later.clear()
                continue
            if is_written_again:
                chosen.superseded.add(number)
            later.add(key)
        return chosen._replace(problem=problem)

    def _declared(self, kind: type[Actor], turn: Turn) -> Handles | None:
        """What the handler of a turn has declared; None if it was no message, or was put aside."""
        if turn.status != OK or turn.input.kind != MESSAGE:
            return None
        try:
            message = kind._table.kind_named(turn.input.name)
        except UnknownMessage:  # The code has changed since; the life will say so.
            return None
        return next((kind._declared[base] for base in message.__mro__ if base in kind._declared), None)

    def _key(self, kind: type[Actor], turn: Turn, by: Any) -> Hashable:
        if by is True:
            return None
        message = self._home.node.codec.decode(kind._table.kind_named(turn.input.name), turn.input.body)
        return cast("Hashable", getattr(message, by) if isinstance(by, str) else by(message))

    def left(self) -> list[tuple[int, Turn]]:
        """The turns to replay, in order; an event tells of those that are not."""
        chosen = self.choose()
        self._tell(chosen)
        out = chosen.readonly | chosen.superseded
        turns = self._home.turns.items()
        return [(number, turn) for number, turn in turns if turn.status in (OK, STASHED) and number not in out]

    def _tell(self, chosen: Skipped) -> None:
        home = self._home
        if home.node.events.has_listeners and any(chosen):
            counts = len(chosen.readonly), len(chosen.superseded)
            home.node.emit(TurnsSkipped(home.path, *counts, chosen.problem))

    def compact(self) -> None:
        """The journal is full: give up what no replay needs. (On a disk it stays until the next snapshot.)"""
        home = self._home
        count = len(home.turns)
        if not home.is_released or abs(count - self._looked_at) < max(16, count // 8):
            return  # During a replay they may still be wanted; and each look costs as much as there are turns.
        chosen = self.choose()
        for number in chosen.readonly | chosen.superseded:
            source = home.turns.pop(number).input
            home.bytes -= len(source.body) + OVERHEAD
            known = home.positions.pop(number, [])
            if home.journal.durable:
                home.dropped += (known, source.positions)
            home.pipes_done.pop(number, None)
            for key in [key for key in home.calls.outcomes if key[0] == number]:
                del home.calls.outcomes[key]
        self._looked_at = len(home.turns)
