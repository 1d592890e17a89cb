"""What a home keeps in the store: the snapshot with what the home knew then, and the journal behind it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from ..actors.errors import HoldfastError
from .inputs import OVERHEAD, Input, Turn
from .journal import Entry
from .journal import Saved as Journaled
from .records import PIPE, STASHED, TICK, Answer, Snapshot
from .timers import Saved

if TYPE_CHECKING:
    from .switch import Switch

FORMAT = 1


class Meta(msgspec.Struct, array_like=True, frozen=True):
    """A snapshot, with what the home knew when it came.

    `turn` is the one it is restored after; its state is that after `base`, which is earlier if the turns in between
    were undone (stores of before do not say). An empty `state` stands for none: the actor begins afresh.
    """

    format: int
    turn: int
    next_id: int
    stash: list[int]
    timers: dict[str, Saved]
    topics: list[str]
    epoch: int
    state: bytes
    base: int = -1


def decode_meta(data: bytes) -> Meta:
    """A snapshot as the store has it."""
    return msgspec.msgpack.decode(data, type=Meta)


def cut(home: Switch, state: bytes, record: Snapshot) -> None:
    """A snapshot is complete: keep it durably, then forget what it contains.

    Raises:
        HoldfastError: it could not be kept; the older snapshot and the whole journal are still there.
    """
    turn, older = record.turn, home.newest
    timers, topics = outlasting(home)
    meta = Meta(FORMAT, turn, home.next_id, record.stash, timers, topics, home.journal.epoch, state, turn)
    put(home, meta, home.method.keep)
    # In a store that lasts it is read back when it is wanted.
    home.older = older if home.method.keep > 1 and not home.journal.durable else None


def outlasting(home: Switch) -> tuple[dict[str, Saved], list[str]]:
    """Timers and topics as they are after the last turn, though some of it may not have taken effect yet."""
    timers, topics = home.timers.saved(), dict(home.topics)
    for out in home.outputs.kept:
        match out.verb:
            case "timer":
                timers[out.to] = (out.name, out.body, out.seconds, out.interval)
            case "cancel":
                timers.pop(out.to, None)
            case "subscribe":
                topics[out.to] = None
            case _:
                topics.pop(out.to, None)
    return timers, list(topics)


def put(home: Switch, meta: Meta, keep: int) -> None:
    """Have the next life begin with this, and forget the turns up to `meta.turn`; `keep` as in `Journal.cut`.

    Raises:
        HoldfastError: it could not be kept, and nothing has changed.
    """
    covered = [number for number in home.turns if number <= meta.turn]
    if home.journal.durable:
        home.journal.barrier()  # From here on it is known where everything stands.
        drop = [*(position for known in home.dropped for position in known)]
        drop += [*(position for number in covered for position in home.positions.get(number, ()))]
        for number in covered:
            source = home.turns[number].input
            if source.id not in home.open:  # Else it is stashed, and not handled yet.
                drop.extend(source.positions)
        home.journal.cut(home.path, msgspec.msgpack.encode(meta), drop, turn=meta.turn, keep=keep)
    home.dropped.clear()
    home.newest, home.stash = meta, meta.stash
    done = (home.turns.pop(number) for number in covered)
    home.bytes -= sum(len(turn.input.body) + OVERHEAD for turn in done if turn.status != STASHED)
    for known in (home.positions, home.pipes_done):
        for number in [number for number in known if number <= meta.turn]:
            del known[number]
    for key in [key for key in home.calls.outcomes if key[0] <= meta.turn]:
        del home.calls.outcomes[key]


def load(home: Switch, planted: Journaled | None = None) -> None:
    """Take up where the store left off, or (in memory) where something else says."""
    saved = planted if planted is not None and not home.journal.durable else home.journal.load(home.path)
    timers: dict[str, Saved] = {}
    if saved.snapshot is not None:
        meta = home.newest = decode_meta(saved.snapshot)
        home.turn, home.next_id, home.stash, timers = meta.turn, meta.next_id, meta.stash, dict(meta.timers)
        home.topics = dict.fromkeys(meta.topics)
    for position, entry in saved.entries:
        _reload(home, position, entry, timers)
    for source in home.open.values():
        home.bytes += len(source.body) + OVERHEAD
    for turn in home.turns.values():
        if turn.status != STASHED:
            home.bytes += len(turn.input.body) + OVERHEAD
    for key, (name, body, left, interval) in timers.items():
        home.timers.start(key, name, body, max(0.0, left), interval)


def _reload(home: Switch, position: int, entry: Entry, timers: dict[str, Saved]) -> None:
    """One journal entry, read again in order."""
    values: tuple[Any, ...] = entry
    match values:
        case ("in", key, kind, name, body, when, sender, origin):
            source = home.open[key] = Input(key, kind, name, body, when, sender)
            source.origin = origin
            source.positions = [position]
            home.next_id = max(home.next_id, key + 1)
            if kind == TICK and origin in timers and not timers[origin][3]:
                del timers[origin]
            if kind == PIPE:
                turn, k = map(int, origin.split("."))
                home.pipes_done.setdefault(turn, set()).add(k)
        case ("end", turn, key, status, digests, *more):
            if key not in home.open:
                return
            past = home.turns[turn] = Turn(home.open[key], status, list(digests), *more)
            home.positions_of(turn).append(position)
            past.input.turn = home.turn = turn
            home.partial, home.partial_id = [], -1
            if status != STASHED:
                del home.open[key]
        case ("out", turn, key, digests):
            home.positions_of(turn).append(position)
            if turn > home.turn:
                home.partial, home.partial_id = list(digests), key
        case ("got", turn, k, kind, name, body):
            home.positions_of(turn).append(position)
            home.calls.outcomes[turn, k] = Answer(kind, name, body)
        case ("drop", key):
            dropped = home.open.pop(key, None)
            home.dropped += ([] if dropped is None else dropped.positions, [position])
        case ("op", turn, verb, key, name, body, seconds, interval):
            home.positions_of(turn).append(position)
            match verb:
                case "timer":
                    timers[key] = (name, body, seconds, interval)
                case "cancel":
                    timers.pop(key, None)
                case "subscribe":
                    home.topics[key] = None
                case _:
                    home.topics.pop(key, None)
        case _:
            raise HoldfastError(f"{home.path}: journal entry {position} is of an unknown kind {entry[0]!r}")
