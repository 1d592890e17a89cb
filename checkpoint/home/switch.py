"""The message switch: the home of one recorded actor. It admits, records, holds, forwards and replays.

It outlives every life of its actor. Orders that make "nothing lost, nothing twice" true:
an input is journaled before it is fed; a turn's end, its outputs' numbers and the inputs they become at other recorded
actors are one append; a reply leaves behind that append; the journal is cut only behind a snapshot that is safe.
"""

from __future__ import annotations

import asyncio
import functools
import time
from typing import TYPE_CHECKING, Any

from ...actors.errors import DIVERGES, AskDeadlock, HoldfastError, ReplayDiverged, StartIgnored
from ...actors.events import RecoveryFailed
from ...actors.kernel.cell import Cell
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import Ask, Envelope, Item
from ...actors.kernel.message import message_name
from ..durable_links import Ties
from ..durable_timers import Timers
from ..inputs import OVERHEAD, Batch, HomeJournal, Input, Turn
from ..journal import Saved
from ..life.replay_guard import StateDiverged
from ..method import Method
from ..protocol import (
    AWAITED,
    DROPPED,
    FAILED,
    LATER,
    MESSAGE,
    NOTHING,
    OK,
    START,
    STASHED,
    TICK,
    Answer,
    Closed,
    Go,
    Hooked,
    Ignored,
    LifePort,
    Live,
    Marked,
    Out,
    PipeDone,
    Released,
    Restore,
    Snapshot,
    ToHome,
    TurnEnd,
    Unsaved,
    Wanted,
    answer_digest,
    pieces,
)  # fmt: skip
from ..schema import Shapes, start_name
from ..snapshot.snapshot_blocks import Images
from ..snapshot.snapshot_receiver import Arrival
from ..snapshot.snapshot_record import Meta, load
from ..snapshot.snapshot_schedule import Due
from .admission import submit, taken_up
from .capacity import HomeBound
from .disposal import Ends
from .held_messages import Holding, Inlet, let_go
from .journal_limit import Limit
from .outputs import Outputs, went_elsewhere
from .pending_asks import Calls, SwitchAsk, answer_ask, origin_of
from .quarantine import Quarantine
from .replay import Replay
from .replay_filter import Skipping

if TYPE_CHECKING:
    from ...actors.kernel.actor import Start
    from ...actors.kernel.node import Node
    from ..recovery.recoveries import Recoveries
    from .ask_recovery import Rejoin


class Switch:
    """The home of one recorded actor."""

    def __init__(self, node: Node, path: str, method: Method, journal: HomeJournal, saved: Saved | None = None) -> None:
        self.node, self.path, self.method, self.journal = node, path, method, journal
        self.cell: Cell | None = None
        self.port: LifePort | None = None
        self.turn = -1  # the last ended turn; `on_start` is turn 0
        self.turns: dict[int, Turn] = {}
        self.open: dict[int, Input] = {}  # inputs without an end, in admission order
        self.calls = Calls(self)
        self.partial: list[int] = []  # digests of what the turn after `turn` has released
        self.partial_id = -1
        self.later: dict[int, Ask] = {}
        self.owed: dict[int, tuple[str, str]] = {}  # as read back: asker and origin of what was to be answered later
        self.timers = Timers(self)
        self.outputs = Outputs(self)
        self.ties = Ties(self)
        self.ends = Ends(self)
        self.limit = Limit(self)
        self.bound: HomeBound | Holding | None = None
        self.holding: Holding | None = None  # stands as the bound while the actor is recovered
        self.inlets: dict[str, Inlet] = {}
        self.recoveries: Recoveries | None = None
        self.quarantine: Quarantine | None = None
        self.rejoin: Rejoin | None = None
        self.waits_for_release = False  # somebody else says when the actor gets what is new
        self.replay = Replay(self)
        self.skipping = Skipping(self)
        self.images = Images(self)
        self.due = Due(self)
        self.pipes_done: dict[int, set[int]] = {}
        self.topics: dict[str, None] = {}
        self.newest: Meta | None = None  # the snapshot to begin with
        self.older: Meta | None = None  # the one before it, if the store does not have it
        self.stash: list[int] = []
        self.live: asyncio.Future[float] | None = None
        self.live_at = 0.0
        self.is_released = False
        self.kept_back = False  # it is live, but waits for the others of its group
        self.replayed = self.next_id = self.bytes = 0
        self.diverged: ReplayDiverged | None = None
        self.is_void = False  # a state that was put in place from outside could not be kept: this life does not count
        self.unsaved: list[str] = []  # why, for each of those
        self.becomes: Start[Any] | None = None  # with what the next lives begin once its class's state has come
        self.arrival = Arrival(self)
        self.positions: dict[int, list[int]] = {}  # in the journal, of what belongs to a turn besides its input
        self.dropped: list[list[int]] = []  # the same of inputs that ended without a turn
        self.shapes = Shapes(self)
        self._replay_k, self._replay_turn = 0, -1
        load(self, saved)

    def use(self, method: Method) -> None:
        """Work as this method says, from now on."""
        self.method = method
        self.limit.at = method.trigger
        if method.every:  # Whoever does not want it does not pay for it.
            self.from_life = self._counting  # type: ignore[method-assign]
        else:
            self.__dict__.pop("from_life", None)

    def _counting(self, record: ToHome) -> None:
        type(self).from_life(self, record)
        if type(record) is TurnEnd:
            self.due.count(self.turn)

    # -- admission --------------------------------------------------------------------------------------------------

    def admit(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`: number, journal, and feed unless the actor is being recovered."""
        self.node.check_thread(self.path)
        message, sender, ask = item, None, None
        if isinstance(item, Ask):
            message, sender, ask = item.message, item.sender, item
            if item.chain and self.waits(item):
                item.fail(AskDeadlock(self.path, tuple(path for path, _ in item.chain)))
                return
        elif type(item) is Envelope:
            message, sender = item.message, item.sender
        if type(message) is Parcel:
            name, body = message.name, message.body
        else:
            if type(message) not in cell.table:
                cell.require(message)
            name, body = message_name(type(message)), self.node.codec.encode(message, self.path)
        if self.bytes >= self.limit.at and not self.limit.has_room(ask):
            return
        origin = None if sender is None else sender.path
        if self.bound is None or self.bound.makes_room(ask, name, body, origin):
            self.take(ask, name, body, origin)

    def take(self, ask: Ask | None, name: str, body: bytes, sender: str | None) -> None:
        """Admit a message for which there is room."""
        origin = origin_of(ask) if isinstance(ask, SwitchAsk) else ""
        try:
            source = self.record(MESSAGE, name, body, sender, origin=origin)
        except HoldfastError as error:  # The store has no room, or has failed.
            if ask is None:
                raise
            ask.fail(error)
            return
        if ask is not None:
            source.ask, source.chain = ask, ask.chain
        self.forward(source)

    def waits(self, ask: Ask) -> bool:
        """Whether a turn of ours waits for this ask."""
        return any(path == self.path and number in self.open for path, number in ask.chain)

    @property
    def is_at_limit(self) -> bool:
        """Whether senders wait until the next snapshot has cut the journal."""
        return self.limit.is_reached and not self.limit.makes_room() and self.method.snapshots

    @property
    def has_room(self) -> bool:
        """Whether a message would be taken now: the journal has room, and the mailbox."""
        return not self.is_at_limit and (self.bound is None or self.bound.has_room)

    def room(self) -> asyncio.Future[None] | None:
        """For `send`: None while there is room."""
        if self.is_at_limit:
            return self.limit.wait()
        return None if self.bound is None else self.bound.room()

    def backlog(self, running: int) -> int:
        """Messages and ticks that wait; `running` is the input in hand, -1 if none."""
        return sum(source.kind in (MESSAGE, TICK) and source.id != running for source in self.open.values())

    def record(
        self, kind: str, name: str, body: bytes, sender: str | None, batch: Batch | None = None, origin: str = ""
    ) -> Input:
        """Number and journal an input."""
        key = self.next_id
        self.next_id = key + 1
        source = Input(key, kind, name, body, self.node.clock.wall(), sender)
        if origin:
            source.origin = origin
        self.open[key] = source
        self.bytes += len(body) + OVERHEAD
        if self.bound is not None:
            self.bound.added(source)
        if self.journal.durable:
            entry = ("in", key, kind, name, body, source.time, sender, origin)
            source.positions, source.held = [], True
            if name and not self.shapes.knows(name):
                self.note_shape(name, batch)
            if batch is not None:
                batch.add(self.path, entry, source.positions)
            else:
                submit(self, source, entry)
        return source

    def note_shape(self, name: str, batch: Batch | None = None) -> None:
        """Have the fields of a type of messages, or of outcomes, stand in front of the first one that is journaled."""
        entry = self.shapes.entry(name)
        if entry is None:
            return
        own = Batch() if batch is None else batch
        position: list[int] = []
        own.add(self.path, entry, position)
        self.dropped.append(position)  # The next snapshot keeps it.
        if batch is None:
            own.commit(self.journal)

    def admitted(self, source: Input) -> None:
        """An input is as safe now as it has to be."""
        source.held = False
        if source.id in self.open:
            self.forward(source)

    def forward(self, source: Input) -> None:
        """Feed an input that is safe, unless they are held."""
        if source.held:
            return
        if self.is_released and self.port is not None and (self.bound is None or self.bound.may_feed(source)):
            if source.ask is not None and self.port.begins:
                source.ask.started = True
            self.port.to_life(source.feed())

    def push(self, item: Item) -> None:
        """An EXIT or DOWN is an input too."""
        given = taken_up(self, item)
        if given is not None:
            self.forward(self.record(*given, None))

    # -- recovery ---------------------------------------------------------------------------------------------------

    @property
    def has_state(self) -> bool:
        """Whether there is a state to begin with."""
        return self.newest is not None and self.newest.has_state

    @property
    def is_live(self) -> bool:
        """Whether the life has caught up, even if somebody else says when it gets what is new."""
        waits = self.waits_for_release or self.kept_back
        caught_up = self.port is not None and self.live is not None and self.live.done()
        return self.is_released or (waits and caught_up)

    @property
    def progress(self) -> object:
        """How far the present life has come with what was handled before; a pause that is repeated counts as a step."""
        if self.replay.pauses_at(self._replay_turn):
            return object()
        return self._replay_turn, self.port is not None

    @property
    def state_turn(self) -> int:
        """The turn that the next life begins after, apart from what is replayed to it; -1: none."""
        return self.newest.turn if self.newest is not None else -1

    @property
    def is_new(self) -> bool:
        """Whether nothing was ever handled here, or all of it was undone."""
        return self.turn == self.state_turn and not self.has_state

    def prepare(self) -> asyncio.Future[float]:
        """A new life begins: hold what comes. The future ends when it is live, with the seconds its restore took."""
        self.is_released = self.waits_for_release = False
        self.replayed = 0
        self.diverged = None
        self.is_void = False
        self.replay.cancel()
        self.arrival.cancel()  # The last life may have died in the middle of a snapshot.
        self.due.restarted()
        self.timers.resume()
        self.timers.claimed.clear()
        if self.live is not None and not self.live.done():
            self.live.cancel()
        self.live = self.node.loop.create_future()
        return self.live

    def restore_records(self) -> list[Restore]:
        """The state to begin with, in pieces; none if there is no snapshot."""
        newest = self.newest
        if newest is None or not newest.has_state:
            return []
        parts = (
            list(self.images.restore(newest.blocks)) if newest.blocks else [Restore(p) for p in pieces(newest.state)]
        )
        parts[0].timers, parts[0].traps = self.timers.at(newest), newest.traps
        parts[0].variables = newest.variables
        return parts

    def attach(self, port: LifePort) -> None:
        """The life is constructed and restored: feed it what it has to handle again, then `Go`."""
        self.port = port
        self._replay_turn = -1
        for key in self.stash:
            if key in self.open:
                port.to_life(self.open[key].feed())
        recovered = not self.is_new
        first = next((source for source in self.open.values() if source.kind == START), None)
        if self.is_new and first is None:  # Messages may have come before it.
            self.shapes.kind = start_name(self.cell)
            first = self.record(START, "", self.shapes.kind.encode(), None)
            first.held = False  # Nobody waits for it, and what it leads to is safe only behind it.
        again = self.skipping.left()
        self.replayed = len(again)
        self.replay.begin(port, again, functools.partial(self._caught_up, port, first, recovered))

    def _caught_up(self, port: LifePort, first: Input | None, recovered: bool) -> None:
        """All that was handled before has been fed again."""
        if first is not None:
            port.to_life(first.feed())
        stashed = (turn.input.id for turn in self.turns.values() if turn.status == STASHED)
        gone = tuple(key for key in stashed if key not in self.open)
        port.to_life(Go(recovered, self.turn, gone, self.timers.running()))

    def let_at(self) -> None:
        """Release the actor, unless somebody else has a say in it, or those that it may send to are not there yet."""
        if not self.waits_for_release and not self.kept_back:
            self.release()

    def release(self) -> None:
        """Let new inputs at the actor: first the turn that had begun to send, then the others as they were admitted."""
        self.is_released, self.waits_for_release = True, False
        holding = let_go(self)
        if holding is not None:
            holding.report()
        port = self.port
        assert port is not None
        stashed = self.stashed()
        waiting = [one for one in self.open.values() if one.kind != START and one.id not in stashed and not one.held]
        waiting.sort(key=lambda one: one.id != self.partial_id)
        pipes = tuple(sorted(self.pipes_done.get(self.turn + 1, ())))
        for index, source in enumerate(waiting):
            begun = source.id == self.partial_id
            if self.bound is None or self.bound.may_feed(source):
                if source.ask is not None and port.begins:
                    source.ask.started = True
                port.to_life(source.feed(-1, pipes if index == 0 else (), has_begun=begun))
        if self.bound is not None:
            self.bound.refill()
        self.due.on_want(self)
        self.ties.tie()
        if holding is not None:
            holding.let_in()

    def stashed(self) -> set[int]:
        """The inputs that the actor has put aside."""
        return {turn.input.id for turn in self.turns.values() if turn.status == STASHED} | set(self.stash)

    def died(self, running: int, ordered: bool) -> None:
        """The life is over. `running` is the input in hand, -1 if none; `ordered`: it was not its doing."""
        self.port = None
        self.is_released = False
        self.replay.cancel()
        if self.bound is not None:
            self.bound.restart()
        source = self.open.get(running)
        if source is not None:
            source.was_cut = True
        if source is None or ordered or source.kind == START:
            return
        source.deliveries += 1
        if source.deliveries >= self.method.max_deliveries:
            self.ends.quarantine(source)

    def end_turn(self, source: Input, number: int, status: str, batch: Batch, state: int = 0, reply: int = 0) -> None:
        """A turn is over: its end record."""
        turn = self.turns[number] = Turn(source, status, self.partial, state, reply)
        self.partial, self.partial_id = [], -1
        self.turn = source.turn = number
        source.deliveries = 0
        if status != STASHED:
            del self.open[source.id]
        if self.bound is not None:
            batch.after.append(functools.partial(self.bound.ended, source))
        if self.journal.durable:
            end = "end", number, source.id, status, tuple(turn.digests)
            batch.add(self.path, (*end, *turn.digests_of_end()), self.positions_of(number))

    def positions_of(self, turn: int) -> list[int]:
        """Where in the journal a turn's own entries stand."""
        return self.positions.setdefault(turn, [])

    # -- what the life says -----------------------------------------------------------------------------------------

    def from_life(self, record: ToHome) -> None:
        """Take what the life says, in order."""
        if self.diverged is not None or self.is_void:
            return  # What it became is not what it was: above all, its snapshots must not be kept.
        try:
            match record:
                case TurnEnd():
                    self._turn_end(record)
                case Released():
                    self._released(record)
                case Snapshot():
                    self.arrival.take(record)
                case Live():
                    self._live(record)
                case PipeDone():
                    self.outputs.work_done(record)
                case Hooked():
                    self.outputs.hooked(record)
                case Unsaved():
                    self.due.failed(record.problem)
                case Marked():
                    self.images.mark(record)
                case Ignored():
                    if self.live is not None and not self.live.done():
                        self.live.set_exception(StartIgnored(self.path, record.why))
                case Wanted() | Closed():
                    pass  # for whoever begins lives, or hands them over
        except ReplayDiverged as error:
            self.diverged = error
            if self.live is not None and not self.live.done():
                self.live.set_exception(error)  # Whoever waits for it tells of it.
            else:
                self.node.emit(RecoveryFailed(self.path, str(error)))
            if self.cell is not None:
                self.cell.kill()

    def _live(self, record: Live) -> None:
        self.live_at = time.monotonic()
        if self.live is not None and not self.live.done():
            self.live.set_result(record.restore_seconds)
        self.let_at()

    def _released(self, record: Released) -> None:
        batch = Batch()
        self._take(record.turn, record.id, record.outs, batch)
        if record.turn > self.turn and self.journal.durable:
            entry = ("out", record.turn, record.id, tuple(self.partial))
            batch.add(self.path, entry, self.positions_of(record.turn))
        batch.commit(self.journal)

    def _take(self, turn: int, key: int, outs: list[Out], batch: Batch) -> None:
        """Let new outputs out; compare and drop those that are out already."""
        ended = turn <= self.turn
        if ended:
            past = self.turns.get(turn)
            known = past.digests if past is not None else []
            if self._replay_turn != turn:
                self._replay_turn, self._replay_k = turn, 0
        else:
            if self.partial_id != key:
                if self.partial:
                    raise ReplayDiverged(self.path, turn, 1)
                self.partial_id = key
            known = self.partial
        for out in outs:
            if out.k <= len(known):
                if known[out.k - 1] != out.digest() and not went_elsewhere(self, out, known[out.k - 1]):
                    raise ReplayDiverged(self.path, turn, out.k)
                self._replay_k = out.k
                if out.verb in AWAITED:
                    self.calls.join(turn, key, out)
            elif ended:
                raise ReplayDiverged(self.path, turn, out.k)
            else:
                known.append(out.digest())
                self.outputs.execute(turn, key, out, batch)

    def _turn_end(self, end: TurnEnd) -> None:
        if end.turn <= self.turn:
            self._replayed(end)
            return
        source = self.open.get(end.id)
        if source is None:
            raise HoldfastError(f"{self.path}: the life ended turn {end.turn} with unknown input {end.id}")
        if source.kind == START and end.status == FAILED:
            return  # Its start failed, and will be tried again.
        if not end.outs and source.ask is None and not self.partial and self.bound is None and not self.journal.durable:
            # The shortest way: nothing leaves, nobody waits.
            self.turns[end.turn] = Turn(source, end.status, [], end.state)
            self.turn = source.turn = end.turn
            self.partial_id, source.deliveries = -1, 0
            if end.status != STASHED:
                del self.open[end.id]
                if end.status != OK:
                    self._lose(source, end)
            return
        batch = Batch()
        self._take(end.turn, end.id, end.outs, batch)
        was_asked = source.ask is not None and end.status == OK
        self.end_turn(source, end.turn, end.status, batch, end.state, answer_digest(end.answer) if was_asked else 0)
        if end.answer.kind == LATER:
            if source.ask is not None:
                self.later[end.id] = source.ask
                if self.journal.durable and isinstance(source.ask, SwitchAsk):
                    batch.add(self.path, ("later", end.turn, end.id), self.positions_of(end.turn))
        elif end.status != STASHED:
            self._lose(source, end)
            self.give(source, end.answer, batch)
        batch.commit(self.journal)

    def _replayed(self, end: TurnEnd) -> None:
        """A turn was handled again: it must have sent just what it sent before."""
        self._take(end.turn, end.id, end.outs, Batch())
        past = self.turns.get(end.turn)
        if end.status == FAILED and past is not None and past.input.kind == START and past.status != FAILED:
            return  # It has not become anything else: its start failed, and will be tried again.
        seen = self._replay_k if self._replay_turn == end.turn else 0
        if past is not None and end.status in (FAILED, DROPPED) and end.status != past.status:
            error = self._error(end.answer)
            what = "handling it again raised" if end.status == FAILED else "it cannot be handled any more:"
            hint = DIVERGES if end.status == FAILED else "the class has been changed since; what is recorded stays"
            cause = f"{past.input.name or past.input.kind} was handled well before the crash; {what} {error} ({hint})"
            raise ReplayDiverged(self.path, end.turn, seen + 1, cause)
        if past is None or seen != len(past.digests) or end.status != past.status:
            raise ReplayDiverged(self.path, end.turn, seen + 1)
        if end.state != past.state and end.state and past.state:
            raise StateDiverged(self.path, end.turn, past.input.name or past.input.kind)
        if past.reply and past.reply != answer_digest(end.answer):
            cause = f"the reply to {past.input.name} is not what it was before the crash; {DIVERGES}"
            raise ReplayDiverged(self.path, end.turn, seen + 1, cause)

    def _lose(self, source: Input, end: TurnEnd) -> None:
        """What the life could make nothing of is a dead letter, if nobody waits who could hear of it."""
        if end.status == DROPPED and source.ask is None and end.answer.kind != NOTHING:
            self.ends.lost(source.name, source.body, self._error(end.answer))

    def _error(self, answer: Answer) -> str:
        return str(self.node.codec.decode_error(answer.kind, answer.name, answer.body))

    def give(self, source: Input, answer: Answer, batch: Batch) -> None:
        """Answer the ask of an input, behind the append."""
        ask, source.ask = source.ask, None
        if ask is None or answer.kind == NOTHING:
            return
        if isinstance(ask, SwitchAsk):
            ask.give(answer, batch)
        else:
            batch.asks.append(ask)
            batch.after.append(lambda: answer_ask(self, ask, answer))
