"""The stored record of a home: the snapshot, what the home knew then, and the journal behind it."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import HoldfastError, StartFailed
from ...actors.events import SnapshotDamaged
from ...actors.persistence import UNFIT
from ..durable_links import Tie
from ..durable_timers import Saved
from ..encoding.compression import PLAIN, compressor, decompress
from ..inputs import Contained, spread
from ..journal import DamagedStore, Entry
from ..journal import Saved as Journaled
from ..protocol import DOWN, EXIT, OK, STASHED, TICK, TIMED, Answer, Came, Clock, Snapshot, came, timed, untimed
from ..schema import as_shape, first_of, kind_in, shape_name
from ..upgrade.mapping import BodyMapper, NotMapped
from ..upgrade.old_records import OldRecords
from .shared_blocks import Place

if TYPE_CHECKING:
    from ..home.switch import Switch

FORMAT = 1
IMAGES = 2
"""The format of snapshots that an older holdfast would take for empty: in blocks, or compressed."""


TRAPS, REPLACED = 1, 2
"""What may be true of a snapshot: the actor traps exits; its state was put in place from outside."""


class ClassRecord(msgspec.Struct, array_like=True, frozen=True):
    """What a snapshot says of the class whose state it is.

    Attributes:
        kind: the class, as "module:Class"; "" if nobody has said.
        variables: those that it had when `__init__` had run.
        shapes: the fields of its messages (see `schema.py`).
    """

    kind: str = ""
    variables: list[str] = []
    shapes: dict[str, list[Any]] = {}


class Meta(msgspec.Struct, array_like=True, frozen=True):
    """A snapshot, with what the home knew when it came.

    A large state is not in `state`, but in `blocks`: places in packs. `earlier` packs are needed by older snapshots.
    `codec`: how `state` is compressed, and `length` what it was before.

    `time` (Unix) is when it was made, 0 in stores of before: timers have run on since. `owed`: inputs that are to be
    answered later, with the address that has asked and their origin.

    `turn` is the one it is restored after; its state is that after `base`, which is earlier if the turns in between
    were undone (stores of before do not say). An empty `state` stands for none: the actor begins afresh. `marks`:
    what is true of it, TRAPS and REPLACED (a bool in stores of before, which is the former).

    `made`: of what class its state is; stores of before do not say. `over`: inputs that it contains, and that stand in
    a row of the journal with others. `claims`: timers that ran after `turn`, and that a later turn has cancelled.
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
    blocks: list[Place] = []
    earlier: list[int] = []
    codec: int = PLAIN
    length: int = 0
    time: float = 0.0
    owed: dict[int, tuple[str, str]] = {}
    ties: list[Tie] = []
    marks: int | bool = 0
    made: ClassRecord = ClassRecord()
    over: list[int] = []
    claims: dict[str, Clock] = {}

    @property
    def traps(self) -> bool:
        """Whether the actor traps exits."""
        return bool(self.marks & TRAPS)

    @property
    def is_replaced(self) -> bool:
        """Whether the state was put in place from outside: no replay of earlier turns leads to it."""
        return bool(self.marks & REPLACED)

    @property
    def has_state(self) -> bool:
        """Whether there is a state; else the actor begins afresh."""
        return bool(self.state or self.blocks)


def decode_meta(data: bytes) -> Meta:
    """A snapshot as the store has it.

    Raises:
        HoldfastError: it is of a format that this holdfast does not know, or damaged. It stays as it is.
    """
    try:
        meta = msgspec.msgpack.decode(data, type=Meta)
        if meta.format not in (FORMAT, IMAGES):
            raise HoldfastError(f"a snapshot has format {meta.format}, which this holdfast does not know")
        if meta.codec == PLAIN:
            return meta
        state = decompress(meta.codec, meta.state, meta.length)
    except (msgspec.DecodeError, msgspec.ValidationError, ValueError) as error:
        raise HoldfastError(f"a snapshot cannot be read: {error}") from error
    return msgspec.structs.replace(meta, state=state, codec=PLAIN, length=0)


def encode_meta(meta: Meta, compress: bool | int) -> bytes:
    """A snapshot as the store will have it."""
    if compress and meta.state:
        codec, state = compressor(compress)(meta.state)
        if codec != PLAIN:
            meta = msgspec.structs.replace(meta, format=IMAGES, codec=codec, length=len(meta.state), state=bytes(state))
    return msgspec.msgpack.encode(meta)


def meta_now(home: Switch, turn: int, stash: list[int], state: bytes = b"") -> Meta:
    """A snapshot of the state after `turn`, with what the home knows at this moment."""
    timers, topics = outlasting(home)
    epoch, now = home.journal.epoch, home.node.clock.wall()
    return Meta(
        FORMAT,
        turn,
        home.ledger.next_id,
        stash,
        timers,
        topics,
        epoch,
        state,
        turn,
        time=now,
        owed=home.calls.debts(),
        ties=home.ties.saved(turn),
        claims=home.timers.claims(turn),
        made=ClassRecord(home.shapes.kind, [] if home.ledger.newest is None else home.ledger.newest.made.variables),
    )


def cut(home: Switch, state: bytes, record: Snapshot) -> None:
    """A snapshot is complete: keep it durably, then forget what it contains.

    Raises:
        HoldfastError: it could not be kept; the older snapshot and the whole journal are still there.
    """
    meta = meta_now(home, record.turn, record.stash, state)
    keep(home, msgspec.structs.replace(meta, earlier=home.images.earlier(), **made_by(home, record)))


def keep(home: Switch, meta: Meta) -> None:
    """Keep a snapshot, and as many older ones as the method says.

    Raises:
        HoldfastError: it could not be kept, and nothing has changed.
    """
    older = home.ledger.newest
    put(home, meta, home.method.keep)
    # In a store that lasts it is read back when it is wanted.
    home.ledger.older = older if home.method.keep > 1 and not home.journal.durable else None
    home.images.tidy()


def made_by(home: Switch, record: Snapshot) -> dict[str, Any]:
    """Whose state a snapshot is, as the life says that has made it."""
    if record.kind:
        home.shapes.kind = record.kind
    return {"made": ClassRecord(home.shapes.kind, record.variables), "marks": marks_of(record)}


def marks_of(record: Snapshot) -> int:
    """What a life says is true of its snapshot."""
    return TRAPS * record.traps | REPLACED * record.is_replaced


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
    contained = Contained(meta.turn)
    if home.journal.durable:
        made = msgspec.structs.replace(meta.made, shapes=home.shapes.saved(meta.turn))
        meta = msgspec.structs.replace(meta, made=made)
        home.journal.barrier()  # From here on it is known where everything stands.
        contained = home.ledger.contained_in(meta.turn)
        drop = home.ledger.needless(contained)
        meta = msgspec.structs.replace(meta, over=home.ledger.over_after(contained))
        home.journal.cut(home.path, encode_meta(meta, home.method.compress), drop, turn=meta.turn, keep=keep)
    home.images.cancel()
    home.ledger.begin_with(meta, contained)
    home.timers.forget(meta.turn)


def go_back(home: Switch, meta: Meta) -> None:
    """Between two lives: timers, subscriptions and ties are those of the snapshot again, as the state is."""
    home.outputs.kept.clear()  # What has not taken effect yet is undone, too.
    before, home.topics = home.topics, dict.fromkeys(meta.topics)
    home.leave_topics(before)
    home.timers.replace(meta.timers)
    home.ties.go_back(meta.ties)


def load(home: Switch, planted: Journaled | None = None) -> None:
    """Take up where the store left off, or (in memory) where something else says."""
    if planted is not None and not home.journal.durable:
        saved, newest = planted, None if planted.snapshot is None else decode_meta(planted.snapshot)
    else:
        saved, newest = load_newest(home)
    timers: dict[str, Saved] = {}
    if newest is not None:
        meta = newest
        home.ledger.begin_after(meta)
        home.topics, home.calls.owed = dict.fromkeys(meta.topics), dict(meta.owed)
        home.ties.replace(meta.ties)
        home.shapes.loaded(meta.made.kind, meta.made.shapes)
        timers = {
            key: (name, body, left - elapsed(home, meta.time), interval)
            for key, (name, body, left, interval) in meta.timers.items()
        }
        home.shapes.old.timers |= home.shapes.timer_mappers(meta.timers, meta.made.shapes)
        for key, clock in meta.claims.items():
            home.timers.cancelled(meta.turn + 1, key, clock)
    for position, entry in saved.entries:
        _reload(home, position, entry, timers)
    home.ledger.read = home.ledger.next_id
    home.ties.untie()
    for key, (name, body, left, interval) in timers.items():
        home.timers.start(key, name, body, max(0.0, left), interval)
    home.shapes.kind = home.shapes.kind or kind_in(home)


def elapsed(home: Switch, since: float) -> float:
    """Seconds since a moment that a store of before may not have (0), by a clock that may have been set back."""
    return max(0.0, home.node.clock.wall() - since) if since else 0.0


def load_newest(home: Switch) -> tuple[Journaled, Meta | None]:
    """The newest snapshot that can be used, with the journal since then; an event says if it is not the newest.

    Raises:
        DamagedStore: none can.
    """
    reason, tried = "", set[bytes]()
    for older in range(home.method.keep + 2):  # More may be there for a moment, and some were passed over already.
        saved = home.journal.load(home.path, older=older)
        reason = reason or saved.passed_over
        if saved.snapshot is None:
            return saved, None
        if saved.snapshot in tried:
            continue
        tried.add(saved.snapshot)
        try:
            meta = decode_meta(saved.snapshot)
            home.images.fetch(meta)
        except HoldfastError as error:
            reason = reason or str(error)
            continue
        if reason:
            home.node.emit(SnapshotDamaged(home.path, saved.turn, reason))
        home.images.loaded(meta)
        return saved, meta
    raise DamagedStore(home.path, home.path, None, f"no snapshot is left: {reason}")


def begin_with_older(home: Switch) -> None:
    """The newest snapshot turns out to be damaged: have the next life begin with the one before it, and replay more.

    Raises:
        DamagedStore: none can be used. StoreFailed: the store has failed.
    """
    home.journal.barrier()  # From here on all that is known stands there.
    saved, newest = load_newest(home)
    home.ledger = home.ledger.read_anew(newest, saved.entries)
    old = home.shapes.old  # What is open was mapped when the home was read.
    for name, rows in ({} if newest is None else newest.made.shapes).items():
        old.read(name, first_of([as_shape(row) for row in rows]))
    for _, entry in saved.entries:
        for one in spread(entry):
            match one:
                case ("shape", str() as name, shape):
                    old.read(name, as_shape(shape))
                case ("in", int() as key, *_) if key in home.ledger.open:
                    pass
                case _:
                    _note_old(old, one)
    take_over(home)


def _reload(home: Switch, position: int, entry: Entry, timers: dict[str, Saved]) -> None:
    """Take one journal entry up again, in order."""
    values: tuple[Any, ...] = entry
    ledger = home.ledger
    known = ledger.read_entry(position, values)
    match values:
        case ("ins", *_):
            for one in spread(entry):
                _note_old(home.shapes.old, one)
        case ("in", _, kind, _, body, _, _, origin, *_):
            _note_old(home.shapes.old, entry)
            if kind == TICK and origin in timers and not timers[origin][3]:
                del timers[origin]
            if kind in (EXIT, DOWN):
                told = msgspec.msgpack.decode(body)
                if not told.get("recovering"):
                    home.ties.over(told.get("verb", "link"), told["source"])
        case ("shape", name, shape):
            home.shapes.read(name, as_shape(shape), position)
        case ("got", *_):
            _note_old(home.shapes.old, entry)
        case ("kept", origin, name, body, sender):
            if (mapper := home.shapes.old.mapper(name)) is not None:
                home.shapes.old.kept[origin] = mapper
            home.homes.rejoin.read(home, position, origin, name, body, sender)
        case ("tie", turn, verb, path):
            ledger.positions_of(turn).append(position)
            home.ties.turn(turn, verb, path)
        case ("later", turn, key):
            ledger.positions_of(turn).append(position)
            source = ledger.turns[turn].input
            if source.sender is not None:
                home.calls.owed[key] = (source.sender, source.origin)
        case ("replied", turn, key):
            ledger.positions_of(turn).append(position)
            home.calls.owed.pop(key, None)
        case ("op", turn, verb, key, name, body, seconds, interval, *when):
            ledger.positions_of(turn).append(position)
            match verb:
                case "timer":
                    timers[key] = (name, body, seconds - elapsed(home, *when or (0.0,)), interval)
                    home.shapes.old.timers.pop(key, None)
                    if (mapper := home.shapes.old.mapper(name)) is not None:
                        home.shapes.old.timers[key] = mapper
                    home.timers.made_again(key)
                case "cancel":
                    if (timer := timers.pop(key, None)) is not None:
                        home.timers.cancelled(turn, key, (timer[0], timer[1], timer[3]))
                case "subscribe":
                    home.topics[key] = None
                case _:
                    home.topics.pop(key, None)
        case _:
            if not known:
                raise HoldfastError(f"{home.path}: journal entry {position} is of an unknown kind {entry[0]!r}")


def _note_old(old: OldRecords, entry: Entry) -> None:
    """Note what maps an input or an outcome, if it was written otherwise than it would be now."""
    values: tuple[Any, ...] = entry
    match values:
        case ("in", key, _, name, *_):
            if name and (mapper := old.mapper(name)) is not None:
                old.inputs[key] = mapper
        case ("got", turn, k, kind, name, _, *_):
            name = shape_name(Answer(kind, name))
            if name and (mapper := old.mapper(name)) is not None:
                old.outcomes[turn, k] = mapper
        case _:
            pass


def take_over(home: Switch) -> str:
    """Map what was read of a home and was written otherwise than it would be now; what that was, in words.

    Raises:
        StartFailed: something of it cannot be read by its class; the difference in words. Nothing was changed.
    """
    try:
        return "; ".join(_taken_over(home, home.shapes.all_read()))
    except NotMapped as error:
        raise StartFailed(home.path, f"{UNFIT}: {error}") from error


def _taken_over(home: Switch, old: OldRecords) -> list[str]:
    if not (old.inputs or old.outcomes or old.timers or old.kept):
        return []
    ledger, clocks, messages = home.ledger, home.timers.saved(), home.homes.rejoin.kept_for(home.path)
    ended = (turn.input for turn in ledger.turns.values() if turn.status in (OK, STASHED) and home.method.replays)
    sources = {source.id: source for source in (*ended, *ledger.open.values())}
    counts = Counter[BodyMapper]()

    def mapped(mapper: BodyMapper, body: bytes) -> bytes:
        counts[mapper] += 1
        return mapper.mapped(body)

    def outcome(mapper: BodyMapper, answer: Came) -> Came:
        own, when = untimed(answer)
        own = Answer(own.kind, mapper.name.rpartition(" ")[2], mapped(mapper, own.body))
        return came(timed(own, when) if answer.kind.startswith(TIMED) else own, answer.nth, answer.after)

    inputs = {key: mapped(one, sources[key].body) for key, one in old.inputs.items() if key in sources}
    outcomes = {key: outcome(one, ledger.outcomes[key]) for key, one in old.outcomes.items() if key in ledger.outcomes}
    timers = {key: (one.name, mapped(one, clocks[key][1])) for key, one in old.timers.items() if key in clocks}
    kept = {
        origin: messages[origin]._replace(name=one.name, body=mapped(one, messages[origin].body))
        for origin, one in old.kept.items()
        if origin in messages
    }
    for key, body in inputs.items():  # From here on nothing can fail.
        source = sources[key]
        ledger.journal_bytes += len(body) - len(source.body)
        source.name, source.body = old.inputs[key].name, body
    ledger.outcomes.update(outcomes)
    home.timers.map(timers)
    messages.update(kept)
    return [f"{count} of {mapper.written}{mapper.change}" for mapper, count in counts.items()]
