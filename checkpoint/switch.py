"""The message switch: the home of one recorded actor. It admits, records, holds, forwards and replays.

It outlives every life of its actor. Orders that make "nothing lost, nothing twice" true:
an input is journaled before it is fed; a turn's end, its outputs' numbers and the inputs they become at other recorded
actors are one append; a reply leaves behind that append; the journal is cut only behind a snapshot that is safe.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from ..actors import links
from ..actors.cell import Cell
from ..actors.codec import Parcel
from ..actors.errors import (
    ActorStopped,
    AskDeadlock,
    AskTimeout,
    HoldfastError,
    MailboxFull,
    Quarantined,
    ReplayDiverged,
)
from ..actors.events import JournalFull, MessageQuarantined, RecoveryFailed, SnapshotFailed, SnapshotTaken
from ..actors.exits import pack_exit
from ..actors.mail import Ask, Envelope, Item
from ..actors.message import message_name
from ..actors.process.relay import RelayedAsk
from .asks import SwitchAsk
from .inputs import Batch, Input, TimerState, Turn
from .journal import Entry, Journal
from .method import Method
from .records import (
    DOWN,
    DROPPED,
    EXIT,
    FAILED,
    LATER,
    MESSAGE,
    NOTHING,
    OK,
    PIPE,
    REPLY,
    START,
    STASHED,
    TICK,
    Answer,
    Go,
    Live,
    Out,
    Outcome,
    PipeDone,
    Released,
    Restore,
    Snapshot,
    SnapshotNow,
    ToHome,
    ToLife,
    TurnEnd,
    Unsaved,
    pieces,
)

if TYPE_CHECKING:
    from ..actors.node import Node

OVERHEAD = 200
"""Bytes an input is counted with besides its payload."""


class LifePort(Protocol):
    """The way to the present life."""

    def to_life(self, record: ToLife) -> None:
        """Hand a record to the life; it is handled in order."""
        ...


class Switch:
    """The home of one recorded actor."""

    def __init__(self, node: Node, path: str, method: Method, journal: Journal) -> None:
        self.node, self.path, self.method, self.journal = node, path, method, journal
        self.cell: Cell | None = None
        self.port: LifePort | None = None
        self.turn = -1  # the last ended turn; `on_start` is turn 0
        self.turns: dict[int, Turn] = {}
        self.open: dict[int, Input] = {}  # inputs without an end, in admission order
        self.asks: dict[tuple[int, int], SwitchAsk] = {}
        self.outcomes: dict[tuple[int, int], Answer] = {}
        self.partial: list[int] = []  # digests of what the turn after `turn` has released
        self.partial_id = -1
        self.later: dict[int, Ask] = {}
        self.timers: dict[str, TimerState] = {}
        self.pipes_done: dict[int, set[int]] = {}
        self.topics: dict[str, None] = {}
        self.state: bytes | None = None
        self.state_turn = -1
        self.stash: list[int] = []
        self.live: asyncio.Future[float] | None = None
        self.live_at = 0.0
        self.is_released = False
        self.replayed = 0
        self.diverged: ReplayDiverged | None = None
        self.is_void = False  # a state that was put in place from outside could not be kept: this life does not count
        self.unsaved: list[str] = []  # why, for each of those
        self._next_id = 0
        self._bytes = 0
        self._waiters: list[asyncio.Future[None]] = []
        self._incoming: list[bytes] = []
        self._positions: dict[int, list[int]] = {}  # in the journal, of what belongs to a turn besides its input
        self._dropped: list[int] = []  # the same of inputs that ended without a turn
        self._full_told = False
        self._replay_k = 0
        self._replay_turn = -1
        self._load()

    # -- admission --------------------------------------------------------------------------------------------------

    def admit(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`: number, journal, and feed unless the actor is being recovered."""
        kind = type(item)
        if kind is Envelope:
            message, sender, ask = item.message, item.sender, None
        elif isinstance(item, Ask):
            message, sender, ask = item.message, item.sender, item
            if item.chain and self._waits(item):
                item.fail(AskDeadlock(self.path, tuple(path for path, _ in item.chain)))
                return
        else:
            message, sender, ask = item, None, None
        if type(message) is Parcel:
            name, body = message.name, message.body
        else:
            if type(message) not in cell.table:
                cell.require(message)
            name, body = message_name(type(message)), self.node.codec.encode(message, self.path)
        if self._bytes >= self.method.journal_limit and not self._make_room(ask):
            return
        source = self.record(MESSAGE, name, body, None if sender is None else sender.path)
        if ask is not None:
            source.ask, source.chain = ask, ask.chain
            ask.started = True
        self.forward(source)

    def _waits(self, ask: Ask) -> bool:
        """Whether a turn of ours waits for this ask."""
        return any(path == self.path and number in self.open for path, number in ask.chain)

    def _make_room(self, ask: Ask | None) -> bool:
        """The journal is at its limit: have a snapshot taken, and refuse until it is cut."""
        if not self._full_told:
            self._full_told = True
            self.node.emit(JournalFull(self.path, self.state_turn, self._bytes))
        if self.port is not None:
            self.port.to_life(SnapshotNow())
        error = MailboxFull(self.path, len(self.open))
        if ask is None:
            raise error
        ask.fail(error)
        return False

    def room(self) -> asyncio.Future[None] | None:
        """For `send`: None while the journal has room."""
        if self._bytes < self.method.journal_limit:
            return None
        if self.port is not None:
            self.port.to_life(SnapshotNow())
        future: asyncio.Future[None] = self.node.loop.create_future()
        self._waiters.append(future)
        return future

    def backlog(self, running: int) -> int:
        """Messages and ticks that wait; `running` is the input in hand, -1 if none."""
        return sum(source.kind in (MESSAGE, TICK) and source.id != running for source in self.open.values())

    def record(
        self, kind: str, name: str, body: bytes, sender: str | None, batch: Batch | None = None, origin: str = ""
    ) -> Input:
        """Number and journal an input."""
        key = self._next_id
        self._next_id = key + 1
        source = Input(key, kind, name, body, self.node.wall(), sender)
        source.origin = origin
        self.open[key] = source
        self._bytes += len(body) + OVERHEAD
        if self.journal.durable:
            entry = ("in", key, kind, name, body, source.time, sender, origin)
            if batch is not None:
                batch.add(self.path, entry, source.positions)
            else:
                source.positions.append(self.journal.append(((self.path, entry),))[0])
        return source

    def forward(self, source: Input) -> None:
        """Feed an input that is safe, unless they are held."""
        if self.is_released and self.port is not None:
            self.port.to_life(source.feed())

    def push(self, item: Item) -> None:
        """An EXIT or DOWN is an input too."""
        if isinstance(item, links.Exit):
            data: dict[str, Any] = {"source": item.source.path, "reason": pack_exit(item.reason)}
            kind = EXIT
        elif isinstance(item, links.Down):
            if not item.watch.active:
                return
            data = {
                "source": item.watch.target.path,
                "reason": pack_exit(item.reason),
                "recovering": item.recovering,
            }
            kind = DOWN
        else:
            raise HoldfastError(f"{type(item).__name__} cannot be journaled for {self.path}")
        self.forward(self.record(kind, "", msgspec.msgpack.encode(data), None))

    # -- recovery ---------------------------------------------------------------------------------------------------

    @property
    def is_new(self) -> bool:
        """Whether nothing was ever handled here."""
        return self.turn < 0 and self.state is None

    def prepare(self) -> asyncio.Future[float]:
        """A new life begins: hold what comes. The future ends when it is live, with the seconds its restore took."""
        self.is_released = False
        self.replayed = 0
        self.diverged = None
        self.is_void = False
        self._incoming.clear()  # The last life may have died in the middle of a snapshot.
        for key, timer in self.timers.items():
            if timer.handle is None:  # It was stopped together with its actor.
                timer.due += self.node.loop.time()
                timer.handle = self.node.loop.call_at(timer.due, self._tick, key)
        if self.live is not None and not self.live.done():
            self.live.cancel()
        self.live = self.node.loop.create_future()
        return self.live

    def restore_records(self) -> list[Restore]:
        """The state to begin with, in pieces; none if there is no snapshot."""
        return [] if self.state is None else [Restore(part) for part in pieces(self.state)]

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
            first = self.record(START, "", b"", None)
        for number, turn in self.turns.items():
            if turn.status in (OK, STASHED):
                port.to_life(turn.input.feed(number, tuple(sorted(self.pipes_done.get(number, ())))))
                self.replayed += 1
        if first is not None:
            port.to_life(first.feed())
        stashed = (turn.input.id for turn in self.turns.values() if turn.status == STASHED)
        port.to_life(Go(recovered, self.turn, tuple(key for key in stashed if key not in self.open)))

    def _release(self) -> None:
        """Let new inputs at the actor: first the turn that had begun to send, then the others as they were admitted."""
        self.is_released = True
        port = self.port
        assert port is not None
        stashed = {turn.input.id for turn in self.turns.values() if turn.status == STASHED} | set(self.stash)
        waiting = [one for one in self.open.values() if one.kind != START and one.id not in stashed]
        waiting.sort(key=lambda one: one.id != self.partial_id)
        pipes = tuple(sorted(self.pipes_done.get(self.turn + 1, ())))
        for index, source in enumerate(waiting):
            begun = source.id == self.partial_id
            port.to_life(source.feed(-1, pipes if index == 0 else (), has_begun=begun))

    def died(self, running: int, ordered: bool) -> None:
        """The life is over. `running` is the input whose turn it died in, -1 if none; `ordered`: we killed it."""
        self.port = None
        self.is_released = False
        source = self.open.get(running)
        if source is None or ordered or source.kind == START:
            return
        source.deliveries += 1
        if source.deliveries >= self.method.max_deliveries:
            self.node.emit(MessageQuarantined(self.path, source.name, source.deliveries))
            error = Quarantined(self.path, source.deliveries)
            # It uses up the number of its turn: what that has sent, and asks it has out, are not another's.
            batch = Batch()
            self._end(source, self.turn + 1, DROPPED, batch)
            self._give(source, Answer(*self.node.codec.encode_error(error)), batch)
            batch.commit(self.journal)

    def _end(self, source: Input, number: int, status: str, batch: Batch) -> None:
        """A turn is over: its end record."""
        turn = self.turns[number] = Turn(source, status, self.partial)
        self.partial, self.partial_id = [], -1
        self.turn = source.turn = number
        source.deliveries = 0
        if status != STASHED:
            del self.open[source.id]
        if self.journal.durable:
            entry = ("end", number, source.id, status, tuple(turn.digests))
            batch.add(self.path, entry, self._positions_of(number))

    def _positions_of(self, turn: int) -> list[int]:
        return self._positions.setdefault(turn, [])

    def _end_without_turn(self, source: Input, answer: Answer, batch: Batch) -> None:
        """An input that will not be handled: it gets an end record all the same."""
        del self.open[source.id]
        self._bytes -= len(source.body) + OVERHEAD
        self._dropped.extend(source.positions)
        batch.add(self.path, ("drop", source.id), self._dropped)
        self._give(source, answer, batch)

    def drop_all(self, why: str, *, keep_tells: bool = False) -> None:
        """Nobody lives here any more: whoever waits is told, the rest goes to dead letters.

        `keep_tells`: it is the actor's supervisor that has ended. Both may be started again, so what nobody waits for
        stays for the next life.
        """
        now, batch = self.node.loop.time(), Batch()
        if self.live is not None and not self.live.done():
            self.live.cancel()
        for timer in self.timers.values():
            if timer.handle is not None:
                timer.handle.cancel()
                timer.handle = None
                timer.due -= now  # what remains: it runs on with the next life
        cell = self.cell
        for source in list(self.open.values()):
            if source.kind == START or (keep_tells and source.ask is None):
                continue
            if source.ask is None and cell is not None and source.kind == MESSAGE:
                self._undelivered(cell, source, why)
            self._end_without_turn(source, Answer(*self.node.codec.encode_error(ActorStopped(self.path, why))), batch)
        batch.commit(self.journal)
        for ask in self.later.values():
            ask.fail(ActorStopped(self.path, why))
        self.later.clear()
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)

    def _undelivered(self, cell: Cell, source: Input, why: str) -> None:
        try:
            message = self.node.codec.decode(cell.table.kind_named(source.name), source.body)
        except (HoldfastError, msgspec.DecodeError):
            self.node.dead_letter(cell, Parcel(source.name, source.body), why)
        else:
            cell.undelivered(message, why)

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
                    self._snapshot(record)
                case Live():
                    self._live(record)
                case PipeDone():
                    self._pipe_done(record)
                case Unsaved():
                    self.node.emit(SnapshotFailed(self.path, record.problem))
        except ReplayDiverged as error:
            self.diverged = error
            self.node.emit(RecoveryFailed(self.path, str(error)))
            if self.live is not None and not self.live.done():
                self.live.set_exception(error)
            if self.cell is not None:
                self.cell.kill()

    def _live(self, record: Live) -> None:
        self.live_at = time.monotonic()
        if self.live is not None and not self.live.done():
            self.live.set_result(record.restore_seconds)
        self._release()

    def _released(self, record: Released) -> None:
        batch = Batch()
        self._take(record.turn, record.id, record.outs, batch)
        if record.turn > self.turn and self.journal.durable:
            entry = ("out", record.turn, record.id, tuple(self.partial))
            batch.add(self.path, entry, self._positions_of(record.turn))
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
                if known[out.k - 1] != out.digest():
                    raise ReplayDiverged(self.path, turn, out.k)
                self._replay_k = out.k
                if out.verb == "ask":
                    self._join(turn, out.k)
            elif ended:
                raise ReplayDiverged(self.path, turn, out.k)
            else:
                known.append(out.digest())
                self._execute(turn, key, out, batch)

    def _join(self, turn: int, k: int) -> None:
        """An ask that was made before the crash: answered from the journal, or when its pending call is."""
        answer = self.outcomes.get((turn, k))
        if answer is None and (turn, k) not in self.asks:
            # The root itself was restarted meanwhile, and whoever was asked keeps no journal.
            answer = Answer(*self.node.codec.encode_error(AskTimeout("(unknown since the restart)", 0.0, None)))
        if answer is not None and self.port is not None:
            self.port.to_life(Outcome(turn, k, answer))

    def _turn_end(self, end: TurnEnd) -> None:
        if end.turn <= self.turn:
            self._replayed(end)
            return
        source = self.open.get(end.id)
        if source is None:
            raise HoldfastError(f"{self.path}: the life ended turn {end.turn} with unknown input {end.id}")
        if source.kind == START and end.status == FAILED:
            return  # Its start failed, and will be tried again.
        batch = Batch()
        self._take(end.turn, end.id, end.outs, batch)
        self._end(source, end.turn, end.status, batch)
        if end.answer.kind == LATER:
            if source.ask is not None:
                self.later[end.id] = source.ask
        elif end.status != STASHED:
            self._give(source, end.answer, batch)
        batch.commit(self.journal)

    def _replayed(self, end: TurnEnd) -> None:
        """A turn was handled again: it must have sent just what it sent before."""
        self._take(end.turn, end.id, end.outs, Batch())
        past = self.turns.get(end.turn)
        seen = self._replay_k if self._replay_turn == end.turn else 0
        if past is None or seen != len(past.digests) or end.status != past.status:
            raise ReplayDiverged(self.path, end.turn, seen + 1)

    def _give(self, source: Input, answer: Answer, batch: Batch) -> None:
        """Answer the ask of an input, behind the append."""
        ask, source.ask = source.ask, None
        if ask is None or answer.kind == NOTHING:
            return
        if isinstance(ask, SwitchAsk):
            ask.give(answer, batch)
        else:
            batch.after.append(lambda: self._answer(ask, answer))

    def _answer(self, ask: Ask, answer: Answer) -> None:
        if isinstance(ask, RelayedAsk):
            if answer.kind == REPLY:
                ask.answer_raw(answer.body)
            else:
                ask.fail_raw(answer.kind, answer.name, answer.body)
            return
        codec = self.node.codec
        if answer.kind != REPLY:
            ask.fail(codec.decode_error(answer.kind, answer.name, answer.body))
            return
        try:
            reply = codec.decode_reply(type(ask.message), answer.body)
        except msgspec.DecodeError as error:
            ask.fail(HoldfastError(f"the reply of {self.path} does not fit its type: {error}"))
        else:
            ask.answer(reply)

    def outcome(self, turn: int, k: int, answer: Answer, batch: Batch | None) -> None:
        """An ask of ours has its outcome: journal it, then tell the turn that waits."""
        own = batch if batch is not None else Batch()
        self.asks.pop((turn, k), None)
        if turn > self.state_turn:  # Else it will not be replayed.
            self.outcomes[turn, k] = answer
            entry = ("got", turn, k, answer.kind, answer.name, answer.body)
            own.add(self.path, entry, self._positions_of(turn))
        own.after.append(lambda: self._tell_outcome(turn, k, answer))
        if batch is None:
            own.commit(self.journal)

    def _tell_outcome(self, turn: int, k: int, answer: Answer) -> None:
        if self.port is not None:
            self.port.to_life(Outcome(turn, k, answer))

    # -- outputs ----------------------------------------------------------------------------------------------------

    def _execute(self, turn: int, key: int, out: Out, batch: Batch) -> None:
        """Let one output take effect, when the append is safe."""
        node, cell = self.node, self.cell
        assert cell is not None
        match out.verb:
            case "tell":
                self._deliver(node.cell_at(out.to), out, batch)
            case "ask":
                self._ask(turn, key, out, batch)
            case "publish":
                for target in node.topics.subscribers(out.to):
                    self._deliver(target, out, batch)
            case "reply":
                ask = self.later.pop(int(out.to), None)
                source = self.open.get(int(out.to))
                if source is not None:  # Answered before its own turn has ended.
                    ask, source.ask = source.ask, None
                kind, _, name = out.name.partition("|")
                if isinstance(ask, SwitchAsk):
                    ask.give(Answer(kind, name, out.body), batch)
                elif ask is not None:
                    batch.after.append(lambda: self._answer(ask, Answer(kind, name, out.body)))
            case "forward":
                self._forward(key, out, batch)
            case "timer" | "cancel" | "subscribe" | "unsubscribe":
                entry = ("op", turn, out.verb, out.to, out.name, out.body, out.seconds, out.interval)
                batch.add(self.path, entry, self._positions_of(turn))
                if out.verb == "cancel":
                    self._drop_ticks(out.to, key, batch)
                batch.after.append(lambda: self._operate(out))
            case "monitor" | "watch" | "demonitor" | "unwatch" | "link" | "unlink":
                batch.after.append(lambda: self._connect(out))
            case "pipe":
                pass
            case verb:
                raise HoldfastError(f"{self.path}: unknown output {verb!r}")

    def _deliver(self, target: Cell, out: Out, batch: Batch, sender: str | None = None) -> None:
        """A message to another actor; to a recorded one it is journaled in the same append."""
        switch = switch_of(target)
        cell = self.cell if sender is None else self.node.cell_at(sender)
        assert cell is not None
        if switch is not None:
            source = switch.record(MESSAGE, out.name, out.body, cell.path, batch)
            batch.after.append(lambda: switch.forward(source))
            return

        def send() -> None:
            try:
                target.admit(target, Envelope(self.node.codec.message_in(target, out.name, out.body), cell))
            except HoldfastError as error:
                self.node.dead_letter(target, Parcel(out.name, out.body), str(error))

        batch.after.append(send)

    def _ask(self, turn: int, key: int, out: Out, batch: Batch) -> None:
        target = self.node.cell_at(out.to)
        source = self.open.get(key)
        chain = ((self.path, key), *(source.chain if source is not None else ()))
        ask = SwitchAsk.made(self, turn, out, chain, target)
        self.asks[turn, out.k] = ask
        self.node.deadlines.add(ask)
        switch = switch_of(target)
        if switch is None:
            batch.after.append(lambda: self._send_ask(target, ask))
        elif switch._waits(ask):
            ask.give(Answer(*self.node.codec.encode_error(AskDeadlock(out.to, tuple(p for p, _ in chain)))), batch)
        else:
            asked = switch.record(MESSAGE, out.name, out.body, self.path, batch)
            asked.ask, asked.chain = ask, chain
            ask.started = True
            batch.after.append(lambda: switch.forward(asked))

    def _send_ask(self, target: Cell, ask: SwitchAsk) -> None:
        parcel: Any = ask.message
        try:
            ctx = target.ctx
            if ctx is not None and ctx.turn_in(ask.chain):
                raise AskDeadlock(target.path, tuple(path for path, _ in ask.chain))
            ask.message = self.node.codec.message_in(target, parcel.name, parcel.body)
            target.admit(target, ask)
        except HoldfastError as error:
            ask.fail(error)

    def _forward(self, key: int, out: Out, batch: Batch) -> None:
        source = self.open.get(key)
        ask = source.ask if source is not None else None
        target = self.node.cell_at(out.to)
        if source is None or ask is None:
            self._deliver(target, out, batch, None if source is None else source.sender)
            return
        source.ask = None  # From now on it is the receiver's to answer.

        def send() -> None:
            try:
                message: Any = ask.message
                if type(message) is Parcel:
                    ask.message = self.node.codec.message_in(target, out.name, out.body)
                target.admit(target, ask)
            except HoldfastError as error:
                ask.fail(error)

        batch.after.append(send)

    def _connect(self, out: Out) -> None:
        cell, target = self.cell, self.node.cell_at(out.to)
        assert cell is not None
        match out.verb:
            case "monitor" | "watch":
                links.monitor(cell, target, for_good=out.verb == "watch")
            case "demonitor" | "unwatch":
                links.demonitor(cell, target, for_good=out.verb == "unwatch")
            case "link":
                links.link(cell, target)
            case _:
                links.unlink(cell, target)

    def _operate(self, out: Out) -> None:
        """Timers and subscriptions: they belong to the address and outlive its lives."""
        cell = self.cell
        match out.verb:
            case "timer":
                due = self.node.loop.time() + out.seconds
                self._start_timer(out.to, TimerState(out.name, out.body, due, out.interval))
            case "cancel":
                self._stop_timer(out.to)
            case "subscribe":
                self.topics[out.to] = None
                if cell is not None:
                    self.node.topics.subscribe(out.to, cell)
            case _:
                self.topics.pop(out.to, None)
                if cell is not None:
                    self.node.topics.unsubscribe(out.to, cell)

    def _start_timer(self, key: str, timer: TimerState) -> None:
        self.timers[key] = timer
        timer.handle = self.node.loop.call_at(timer.due, self._tick, key)

    def _stop_timer(self, key: str) -> None:
        timer = self.timers.pop(key, None)
        if timer is not None and timer.handle is not None:
            timer.handle.cancel()

    def _drop_ticks(self, timer: str, running: int, batch: Batch) -> None:
        """Ticks of a cancelled timer that wait do not come any more; the life forgets them by itself."""
        for source in list(self.open.values()):
            if source.kind == TICK and source.origin == timer and source.id != running:
                self._end_without_turn(source, Answer(), batch)

    def _tick(self, key: str) -> None:
        timer = self.timers.get(key)
        if timer is None:
            return
        if timer.interval > 0:
            timer.due = max(timer.due + timer.interval, self.node.loop.time())
            timer.handle = self.node.loop.call_at(timer.due, self._tick, key)
            if any(source.origin == key for source in self.open.values() if source.kind == TICK):
                return  # One waits already.
        else:
            del self.timers[key]
        self.forward(self.record(TICK, timer.name, timer.body, None, origin=key))

    def _pipe_done(self, record: PipeDone) -> None:
        done = self.pipes_done.setdefault(record.turn, set())
        if record.k not in done:
            done.add(record.k)
            origin = f"{record.turn}.{record.k}"
            self.forward(self.record(PIPE, record.name, record.body, self.path, origin=origin))

    # -- snapshots --------------------------------------------------------------------------------------------------

    def _snapshot(self, record: Snapshot) -> None:
        self._incoming.append(record.data)
        if not record.is_last:
            return
        state = b"".join(self._incoming)
        self._incoming.clear()
        covered = [number for number in self.turns if number <= record.turn]
        drop = [*self._dropped, *(position for number in covered for position in self._positions.get(number, ()))]
        for number in covered:
            source = self.turns[number].input
            if source.id not in self.open:  # Else it is stashed, and not handled yet.
                drop.extend(source.positions)
        try:
            if self.journal.durable:
                self.journal.cut(self.path, self._meta(state, record), drop, turn=record.turn)
        except HoldfastError as error:  # The older snapshot and the whole journal are still there.
            self.node.emit(SnapshotFailed(self.path, str(error)))
            if self.port is not None:
                self.port.to_life(SnapshotNow(at_once=False))
            if record.is_replaced and self.cell is not None:
                self.is_void, self.unsaved = True, [*self.unsaved, str(error)]
                self.cell.kill()
            return
        self._dropped.clear()
        self.state, self.state_turn, self.stash = state, record.turn, record.stash
        for number in covered:
            turn = self.turns.pop(number)
            self._positions.pop(number, None)
            if turn.status != STASHED:
                self._bytes -= len(turn.input.body) + OVERHEAD
            self.pipes_done.pop(number, None)
        for key in [key for key in self.outcomes if key[0] <= record.turn]:
            del self.outcomes[key]
        self._full_told = False
        waiters, self._waiters = self._waiters, []
        for waiter in waiters:
            if not waiter.done():
                waiter.set_result(None)
        if self.node.watched:
            self.node.emit(SnapshotTaken(self.path, record.turn, len(state), record.pause))

    def _meta(self, state: bytes, record: Snapshot) -> bytes:
        """The snapshot as it is stored: the state, and what the home knew after that turn."""
        now = self.node.loop.time()
        timers = {key: (one.name, one.body, one.due - now, one.interval) for key, one in self.timers.items()}
        return msgspec.msgpack.encode(
            (1, record.turn, self._next_id, record.stash, timers, list(self.topics), self.journal.epoch, state)
        )

    def _load(self) -> None:
        """Take up where the store left off."""
        saved = self.journal.load(self.path)
        timers: dict[str, tuple[str, bytes, float, float]] = {}
        if saved.snapshot is not None:
            _, self.turn, self._next_id, self.stash, timers, topics, _, self.state = msgspec.msgpack.decode(
                saved.snapshot, type=tuple[int, int, int, list[int], dict[str, Any], list[str], int, bytes]
            )
            self.state_turn = self.turn
            self.topics = dict.fromkeys(topics)
        for position, entry in saved.entries:
            self._reload(position, entry, timers)
        for source in self.open.values():
            self._bytes += len(source.body) + OVERHEAD
        for turn in self.turns.values():
            if turn.status != STASHED:
                self._bytes += len(turn.input.body) + OVERHEAD
        now = self.node.loop.time()
        for key, (name, body, left, interval) in timers.items():
            self._start_timer(key, TimerState(name, body, now + max(0.0, left), interval))

    def _reload(self, position: int, entry: Entry, timers: dict[str, tuple[str, bytes, float, float]]) -> None:
        """One journal entry, read again in order."""
        values: tuple[Any, ...] = entry
        match values:
            case ("in", key, kind, name, body, when, sender, origin):
                source = self.open[key] = Input(key, kind, name, body, when, sender)
                source.origin = origin
                source.positions.append(position)
                self._next_id = max(self._next_id, key + 1)
                if kind == TICK and origin in timers and not timers[origin][3]:
                    del timers[origin]
                if kind == PIPE:
                    turn, k = map(int, origin.split("."))
                    self.pipes_done.setdefault(turn, set()).add(k)
            case ("end", turn, key, status, digests):
                if key not in self.open:
                    return
                past = self.turns[turn] = Turn(self.open[key], status, list(digests))
                self._positions_of(turn).append(position)
                past.input.turn = self.turn = turn
                self.partial, self.partial_id = [], -1
                if status != STASHED:
                    del self.open[key]
            case ("out", turn, key, digests):
                self._positions_of(turn).append(position)
                if turn > self.turn:
                    self.partial, self.partial_id = list(digests), key
            case ("got", turn, k, kind, name, body):
                self._positions_of(turn).append(position)
                self.outcomes[turn, k] = Answer(kind, name, body)
            case ("drop", key):
                dropped = self.open.pop(key, None)
                self._dropped.extend((*(dropped.positions if dropped is not None else ()), position))
            case ("op", turn, verb, key, name, body, seconds, interval):
                self._positions_of(turn).append(position)
                match verb:
                    case "timer":
                        timers[key] = (name, body, seconds, interval)
                    case "cancel":
                        timers.pop(key, None)
                    case "subscribe":
                        self.topics[key] = None
                    case _:
                        self.topics.pop(key, None)
            case _:
                raise HoldfastError(f"{self.path}: journal entry {position} is of an unknown kind {entry[0]!r}")


def switch_of(cell: Cell) -> Switch | None:
    """The switch of a recorded actor's cell."""
    return getattr(cell.host, "switch", None)
