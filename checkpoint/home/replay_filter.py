"""Decides which turns a replay leaves out: those that changed nothing, or were overwritten by later ones.

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
from ..inputs import Turn
from ..protocol import MESSAGE, OK, STASHED, Out

if TYPE_CHECKING:
    from ...actors.kernel.codec import Codec
    from .switch import Switch

PIPE_DIGEST = Out(1, "pipe", "").digest()
"""Of background work that a turn has begun: its result is an input, so that turn cannot be left out."""


class Skipped(NamedTuple):
    """Numbers of turns to leave out, and why a message could not be looked into."""

    readonly: set[int]
    superseded: set[int]
    problem: str = ""


def turns_to_replay(home: Switch) -> list[tuple[int, Turn]]:
    """The turns to replay, in order; an event tells of those that are not."""
    chosen = turns_to_skip(home)
    if home.node.events.has_listeners and any(chosen):
        counts = len(chosen.readonly), len(chosen.superseded)
        home.node.emit(TurnsSkipped(home.path, *counts, chosen.problem))
    return home.ledger.replayed(chosen.readonly | chosen.superseded)


def turns_to_skip(home: Switch) -> Skipped:
    """The ended turns of a home that a replay may leave out."""
    skips = home.method.skip and not home.method.check_replay  # States in between are compared, too.
    kind = cell_kind(home.cell) if home.cell is not None and skips else None
    if kind is None or not any(one.readonly or one.supersedes is not None for one in kind._declared.values()):
        return Skipped(set(), set())
    return choose(home.ledger.turns, kind, home.node.codec)


def choose(turns: dict[int, Turn], kind: type[Actor], codec: Codec) -> Skipped:
    """The ended turns that a replay to an actor of this class may leave out."""
    chosen, problem = Skipped(set(), set()), ""
    later: set[Hashable] = set()  # keys that are written again before anybody looks
    for number, turn in reversed(turns.items()):
        if turn.status not in (OK, STASHED):
            continue  # Not replayed anyway.
        declared = _declared(kind, turn)
        if declared is not None and declared.readonly and PIPE_DIGEST not in turn.digests:
            chosen.readonly.add(number)
            continue
        if declared is None or declared.supersedes is None or turn.digests:
            later.clear()
            continue
        try:
            key = (declared.kind, _key(kind, turn, declared.supersedes, codec))
            is_written_again = key in later
        except Exception as error:  # The user's own function, or a value that is no key.
            problem = f"the key of {turn.input.name} cannot be had: {error!r}"
            later.clear()
            continue
        if is_written_again:
            chosen.superseded.add(number)
        later.add(key)
    return chosen._replace(problem=problem)


def _declared(kind: type[Actor], turn: Turn) -> Handles | None:
    """What the handler of a turn has declared; None if it was no message, or was put aside."""
    return None if turn.status != OK or turn.input.kind != MESSAGE else declared(kind, turn.input.name)


def declared(kind: type[Actor], name: str) -> Handles | None:
    """What the handler of messages of this type has declared, in an actor of this class."""
    try:
        message = kind._table.kind_named(name)
    except UnknownMessage:  # The code has changed since; the life will say so.
        return None
    return next((kind._declared[base] for base in message.__mro__ if base in kind._declared), None)


def _key(kind: type[Actor], turn: Turn, by: Any, codec: Codec) -> Hashable:
    if by is True:
        return None
    message = codec.decode(kind._table.kind_named(turn.input.name), turn.input.body)
    return cast("Hashable", getattr(message, by) if isinstance(by, str) else by(message))
