"""The message switch: the home of one recorded actor. It admits, records, holds, forwards and replays.

It outlives every life of its actor. Orders that make "nothing lost, nothing twice" true:
an input is journaled before it is fed, or (of an ask) before anything that comes of it leaves; a turn's end, its
outputs' numbers and the inputs they become at other recorded actors are one append; a reply leaves behind that append;
the journal is cut only behind a snapshot that is safe.

What is known stands in `InputLedger` and `PresentLife`, with the decisions; here they are carried out.
"""

from __future__ import annotations

import asyncio
import functools
import math
from threading import get_ident
from typing import TYPE_CHECKING, Any

from ...actors.errors import AskDeadlock, HoldfastError, ReplayDiverged, StartIgnored
from ...actors.events import RecoveryFailed
from ...actors.exit_reasons import crash
from ...actors.kernel.cell import Cell
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import Ask, Chain, Item, waiters
from ...actors.kernel.loop import running_loop
from ...actors.kernel.message import message_name
from ...actors.kernel.node import cell_kind
from ..durable_links import DurableTies
from ..durable_timers import Timers
from ..inputs import Batch, HomeJournal, Input, Turn
from ..journal import Saved
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
    Answer,
    Closed,
    EndWanted,
    GivenUp,
    Glanced,
    Go,
    Hooked,
    Ignored,
    LeavesTurn,
    Live,
    Marked,
    Out,
    Performed,
    PipeDone,
    Released,
    Restore,
    Retried,
    Snapshot,
    ToHome,
    TurnEnd,
    Unreadable,
    Unsaved,
    Waits,
    Wanted,
    answer_digest,
    pieces,
)  # fmt: skip
from ..schema import Shapes, shape_name, start_name
from ..snapshot.shared_blocks import can_lend
from ..snapshot.snapshot_blocks import SnapshotImages
from ..snapshot.snapshot_receiver import SnapshotReceiver
from ..snapshot.snapshot_record import load
from ..snapshot.snapshot_schedule import SnapshotSchedule
from ..snapshot.state_image import IMAGE_BYTES
from ..upgrade.present_classes import REPLY_TO
from .admission import taken_up
from .capacity import Limit
from .disposal import lose, put_into_quarantine, undo_begun
from .held_messages import Intake, inlet, let_go
from .input_ledger import InputLedger, stop_entry
from .life_ports import SENT
from .outputs import Outputs
from .pending_asks import PendingCalls, SwitchAsk, answer_ask, origin_of
from .present_life import LifePort, PresentLife, is_end_of
from .replay import PacedReplay, is_as_before, is_same_reply
from .replay_filter import declared, turns_to_replay

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ...actors.exit_reasons import ExitReason
    from .homes import Homes


class Switch:
    """The home of one recorded actor."""

    def __init__(
        self, homes: Homes, cell: Cell, method: Method, journal: HomeJournal, saved: Saved | None = None
    ) -> None:
        self.homes, self.node = homes, homes.node
        self.path = path = cell.path
        self.cell: Cell | None = cell
        self.method, self.journal = method, journal
        self.ledger = InputLedger(path)
        self.life = PresentLife()
        self.intake = Intake()
        self.calls = PendingCalls(self)
        self.timers = Timers(self)
        self.topics: dict[str, None] = {}
        self.ties = DurableTies(self)
        self.outputs = Outputs(self)
        self.limit = Limit(self)
        self.replay = PacedReplay(self)
        self.images = SnapshotImages(self)
        self.due = SnapshotSchedule(self)
        self.arrival = SnapshotReceiver(self)
        self.shapes = Shapes(self)
        load(self, saved)

    def readdress(self, path: str) -> None:
        """Its actor has another address from now on."""
        self.path = self.ledger.path = path
        for one in self.intake.inlets.values():
            one.name = path
        if self.intake.between is not None:
            self.intake.between.renamed(path)

    def begin_at(self, cell: Cell, method: Method) -> None:
        """Have the next life begin there, and work as this method says from now on."""
        self.cell, self.method = cell, method
        self.limit.at = method.trigger

    def leave_topics(self, topics: Iterable[str]) -> None:
        """Have nothing come in any more on those topics that neither the class subscribes to nor the actor."""
        for topic in topics:
            if self.cell is not None and topic not in self.intake.class_topics and topic not in self.topics:
                self.node.topics.unsubscribe(topic, inlet(self, topic))

    @property
    def turn(self) -> int:
        """The number of the last ended turn."""
        return self.ledger.turn

    @property
    def has_past(self) -> bool:
        """Whether something is recorded that a next life goes on with."""
        return self.method.records and not self.ledger.is_new

    @property
    def turns(self) -> dict[int, Turn]:
        """The ended turns since the newest snapshot."""
        return self.ledger.turns

    @property
    def open(self) -> dict[int, Input]:
        """The inputs without an end, in admission order."""
        return self.ledger.open

    # -- admission --------------------------------------------------------------------------------------------------

    def admit(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`: number, journal, and feed unless the actor is being recovered."""
        node = self.node
        if get_ident() != node.thread or running_loop() is not node.loop:
            node.check_caller(self.path)
        message, sender = item, None
        ask: Any = None
        chain: Chain = ()
        if isinstance(item, Item):  # Else it is the message itself. (To ask for a struct's class takes longer.)
            message, sender, chain = item.message, item.sender, item.chain
            if item.is_ask:
                ask = item
                if chain and self.waits(ask):
                    ask.fail(AskDeadlock(self.path, waiters(chain)))
                    return
        kind = type(message)
        if kind is Parcel:
            name, body = message.name, message.body
        else:
            if kind not in cell.table:
                cell.require(message)
            name, body = message_name(kind), node.codec.encode(message, self.path)
        if self.ledger.journal_bytes >= self.limit.at and not self.limit.has_room(ask):
            return
        origin, bound = None if sender is None else sender.path, self.intake.bound
        if bound is not None and not bound.makes_room(ask, name, body, origin):
            return
        if ask is None:
            told = self.record(MESSAGE, name, body, origin)
            if chain:
                told.chain = chain
            self.forward(told)
        else:
            self.take(ask, name, body, origin)

    def take(self, ask: Ask, name: str, body: bytes, sender: str | None) -> None:
        """Admit an ask for which there is room."""
        origin = origin_of(ask) if isinstance(ask, SwitchAsk) else ""
        try:
            if not origin and self.journal.durable and self.outputs.rows.let_ahead(ask, name, body, sender):
                return
            source = self.record(MESSAGE, name, body, sender, origin=origin)
        except HoldfastError as error:  # The store has no room, or has failed.
            ask.fail(error)
            return
        self.awaits(source, ask)
        self.forward(source)

    def awaits(self, source: Input, ask: Ask) -> None:
        """Have an input answer an ask, which knows it by its number if nobody has begun it elsewhere."""
        source.ask, source.chain = ask, ask.chain
        if ask.started is False:
            ask.started = source.id + 1

    def waits(self, ask: Ask) -> bool:
        """Whether a turn of ours waits for this ask."""
        return any(path == self.path and number in self.ledger.open for path, number in ask.chain)

    @property
    def is_at_limit(self) -> bool:
        """Whether senders wait until the next snapshot has cut the journal."""
        return self.limit.is_reached and not self.limit.makes_room() and self.method.snapshots

    def takes_now(self, ask: Ask, out: Out, sender: str | None) -> bool:
        """Whether an ask does not have to wait, and nothing is lost for it, whatever the policy."""
        bound = self.intake.bound
        if self.is_at_limit or (bound is not None and bound.is_full):
            return False
        return bound is None or bound.makes_room(ask, out.name, out.body, sender)

    @property
    def has_room(self) -> bool:
        """Whether a message would be taken now: the journal has room, and the mailbox."""
        return not self.is_at_limit and (self.intake.bound is None or self.intake.bound.has_room)

    def room(self) -> asyncio.Future[None] | None:
        """For `send`: None while there is room."""
        if self.is_at_limit:
            return self.limit.wait()
        return None if self.intake.bound is None else self.intake.bound.room()

    def record(
        self, kind: str, name: str, body: bytes, sender: str | None, batch: Batch | None = None, origin: str = ""
    ) -> Input:
        """Number and journal an input."""
        source = self.ledger.admit(kind, name, body, self.node.clock.wall(), sender, origin)
        if self.intake.bound is not None:
            self.intake.bound.added(source)
        if self.journal.durable:
            source.held = True
            self.intake.last = source
            if name and name not in self.shapes.noted:
                self.note_shape(name, batch)
                self.note_reply(name, batch)
            if batch is not None:
                self.outputs.rows.close()
                source.positions = []
                batch.add(self.path, source.entry(), source.positions)
            else:
                self.outputs.rows.admit(source)
        return source

    def note_shape(self, name: str, batch: Batch | None = None) -> None:
        """Have the fields of a type of messages, or of outcomes, stand in front of the first one that is journaled."""
        entry = self.shapes.entry(name)
        if entry is None:
            return
        own = Batch() if batch is None else batch
        position: list[int] = []
        own.add(self.path, entry, position)
        self.shapes.stands_at(name, position)
        if batch is None:
            own.commit(self.journal)

    def note_reply(self, name: str, batch: Batch | None = None) -> None:
        """The same of what is replied to a type of messages: such replies are compared when they are made again."""
        shape = self.shapes.now(REPLY_TO + name)
        if shape is not None and any(row.fields for row in shape):
            self.note_shape(REPLY_TO + name, batch)

    def note(self, turn: int, entry: tuple[Any, ...], batch: Batch) -> None:
        """Have an entry that belongs to a turn journaled, if anything is."""
        if self.journal.durable:
            self.outputs.rows.close()
            batch.add(self.path, entry, self.ledger.positions_of(turn))

    def admitted(self, source: Input) -> None:
        """An input is as safe now as it has to be."""
        source.held = False
        if source.id in self.ledger.open:
            self.forward(source)

    def forward(self, source: Input) -> None:
        """Feed an input that is safe, unless they are held."""
        if source.held:
            return
        life, bound, rests = self.life, self.intake.bound, self.calls.rests
        if rests.wanted and rests.takes(source):
            return
        port = life.port
        if life.is_released and port is not None and (bound is None or bound.may_feed(source)):
            port.take(source)
        if rests.wanted or self.calls.long:
            rests.show((source,))

    def changes_nothing(self, source: Input) -> bool:
        """Whether an input is a message that waits, and whose handler is declared to change nothing."""
        kind = None if self.cell is None else cell_kind(self.cell)
        if kind is None or source.kind != MESSAGE or source.held or source.id == self.ledger.begun:
            return False
        handles = declared(kind, source.name)
        is_free = not source.is_late and source.id not in self.ledger.stashed()
        return handles is not None and handles.readonly and is_free

    def push(self, item: Item) -> None:
        """An EXIT or DOWN is an input too."""
        given = taken_up(self, item)
        if given is not None:
            self.forward(self.record(*given, None))

    # -- recovery ---------------------------------------------------------------------------------------------------

    @property
    def progress(self) -> object:
        """How far the present life has come with what was handled before; a pause that is repeated counts as a step."""
        if self.replay.pauses_at(self.life.seen_turn):
            return object()
        return self.life.seen_turn, self.life.seen_k, self.life.port is not None

    def prepare(self) -> asyncio.Future[float]:
        """A new life begins: hold what comes. The future ends when it is live, with the seconds its restore took."""
        self.images.mapped()
        self.replay.cancel()
        self.arrival.cancel()  # The last life may have died in the middle of a snapshot.
        self.due.restarted()
        self.timers.resume()
        if self.life.has_ended:
            self.forget_end()
        live: asyncio.Future[float] = self.node.loop.create_future()
        self.life.expect(live)
        self.life.token = self.node.numbers.next_token()
        return live

    def restore_records(self, *, maps: bool = True) -> list[Restore]:
        """The state to begin with; none if there is no snapshot.

        With `maps` a large one is lent to a life that maps it; else, or if that cannot be, it comes in pieces.
        """
        newest = self.ledger.newest
        if newest is None or not newest.has_state:
            return []
        lent = None
        if maps and (newest.blocks or len(newest.state) >= IMAGE_BYTES) and can_lend():
            lent = self.images.lend(newest.blocks) if newest.blocks else self.images.lend_value(newest.state)
        if lent is not None:
            parts = [Restore(b"", image=lent)]
        elif newest.blocks:
            parts = list(self.images.restore(newest.blocks))
        else:
            parts = [Restore(piece) for piece in pieces(newest.state)]
        parts[0].timers, parts[0].traps = self.timers.at(newest), newest.traps
        parts[0].variables = newest.made.variables
        return parts

    def attach(self, port: LifePort) -> None:
        """The life is constructed and restored: feed it what it has to handle again, then `Go`."""
        ledger = self.ledger
        self.life.attach(port)
        for key in ledger.stash:
            if key in ledger.open:
                port.to_life(ledger.open[key].feed())
        recovered, first = not ledger.is_new, ledger.start()
        if ledger.is_new and first is None:  # Messages may have come before it.
            self.shapes.kind = start_name(self.cell)
            first = self.record(START, "", self.shapes.kind.encode(), None)
            first.held = False  # Nobody waits for it, and what it leads to is safe only behind it.
        again = turns_to_replay(self)
        self.life.replayed = len(again)
        self.replay.begin(port, again, functools.partial(self._caught_up, port, first, recovered))

    def _caught_up(self, port: LifePort, first: Input | None, recovered: bool) -> None:
        """All that was handled before has been fed again."""
        if first is not None:
            port.to_life(first.feed())
        gone, begun = self.ledger.ended_in_the_stash(), -1 if first is not None else self.ledger.begun
        ledger, own = self.ledger, self.ledger.own_end
        timers = self.timers.after(ledger.turn)
        spent = self.replay.spent_before(math.inf)
        port.to_life(Go(recovered, ledger.turn, gone, timers, begun, own.wanted, own.past, spent))

    def let_at(self) -> None:
        """Let the actor at what is new, if nobody else has a say in that."""
        if self.life.may_be_released:
            self._release()

    def _release(self) -> None:
        """Let new inputs at the actor: first the turn that had begun to send, then the others as they were admitted."""
        self.life.is_released = True
        holding = let_go(self)
        if holding is not None:
            holding.report()
        ledger, port, bound = self.ledger, self.life.port, self.intake.bound
        assert port is not None
        pipes = tuple(sorted(ledger.pipes_done.get(ledger.turn + 1, ())))
        begun = ledger.begun
        for index, source in enumerate(ledger.waiting()):
            if bound is None or bound.may_feed(source):
                if source.id == begun and port.begins:
                    self.life.owed = len(ledger.released)
                port.to_life(source.feed(-1, pipes if index == 0 else (), has_begun=source.id == begun))
        if not self.life.owed:
            self.life.settle()
        if bound is not None:
            bound.refill()
        self.due.on_want(self)
        self.ties.tie()
        for come in self.node.awaited.pop(self.path, ()):
            come()
        if holding is not None:
            holding.let_in()

    def died(self, running: int, ordered: bool, reason: ExitReason, *, has_hung: bool = False) -> None:
        """The life is over.

        `running` is the input in hand, -1 if none; `ordered`: it was not its doing; `has_hung`: that turn did not end.
        """
        self._doubt()
        ends = self.ledger.own_end.wanted
        self.life.has_ended = ends is not None and self.life.is_live and is_end_of(ends.exit_reason, reason)
        self.life.die()
        self.calls.rests.abandon()
        self.replay.cancel()
        if self.intake.bound is not None:
            self.intake.bound.restart()
        most = self.method.most_deliveries(has_hung=has_hung)
        poison = self.ledger.count_death(running, is_ordered=ordered, most=most)
        if poison is not None:
            put_into_quarantine(self, poison)

    def _doubt(self) -> None:
        """The life is over: what it was given may have begun, if it is not known what it has said last."""
        port, begun = self.life.port, self.ledger.open.get(self.ledger.begun)
        is_unknown = port is not None and port.begins and (port.is_far or not self.life.counts)
        given = self.ledger.open.values() if is_unknown and self.life.is_released else ()
        for source in (*given, *(() if begun is None else (begun,))):
            if source.ask is not None and not source.is_late:
                source.ask.started = True

    def rests_in(self, running: int) -> bool:
        """Whether the turn of this input waits until a moment or for a message: for days, if that is wanted."""
        return running == self.ledger.begun and self.calls.rests.is_busy

    def in_hand(self, running: int) -> int:
        """The input in hand; -1: none. `running` is what the life's place says, which knows of no turn that rests."""
        return self.ledger.begun if running < 0 and self.calls.rests.is_busy else running

    # -- what the life says -----------------------------------------------------------------------------------------

    def from_life(self, record: ToHome) -> None:
        """Take what the life says, in order."""
        life = self.life
        if not life.counts:
            return  # What it became is not what it was: above all, its snapshots must not be kept.
        try:
            if type(record) is TurnEnd:  # Before a `match`, which takes longer: there is one for each message.
                self._turn_end(record)
                if self.method.every:
                    self.due.count(self.ledger.turn)
                return
            match record:
                case Released():
                    self._released(record)
                case Snapshot():
                    self.arrival.take(record)
                case Live():
                    self.calls.keep_promises(record.promises)
                    life.come_up(record.restore_seconds)
                    self.images.mapped()
                    if life.port is not None and life.port.is_far:
                        self.images.let_go_of_stored()
                    self.let_at()
                case PipeDone():
                    self.outputs.work_done(record)
                case Performed():
                    self.calls.performed(record)
                case Retried():
                    self.calls.retried(record)
                case GivenUp():
                    self.calls.give_up(record)
                case Unreadable():
                    raise ReplayDiverged(self.path, record.turn, record.k, record.problem)
                case Glanced():
                    self.calls.rests.glanced(record)
                case Hooked():
                    self.outputs.hooked(record)
                case Unsaved():
                    self.due.failed(record.problem)
                case Marked():
                    self.images.mark(record)
                case Waits():
                    life.waits(record.heard)
                    self._show()
                case LeavesTurn():
                    self.calls.strand()
                case Ignored():
                    life.fail(StartIgnored(self.path, record.why))
                case Wanted() | Closed() | TurnEnd():
                    pass  # for whoever begins lives, or hands them over; the end of a turn was taken above
        except ReplayDiverged as error:
            life.diverged = error
            if life.fail(error):
                return  # Whoever waits for it tells of it, and ends the life: its supervisor is not to hear of a kill.
            self.node.emit(RecoveryFailed(self.path, str(error)))
            if self.cell is not None:
                self.cell.host.place.end(self.cell, crash(error))

    def _released(self, record: Released) -> None:
        batch, known = Batch(), len(self.ledger.released)
        self._take(record.turn, record.id, record.outs, batch)
        if record.turn > self.ledger.turn and len(self.ledger.released) > known:
            self.note(record.turn, self.ledger.released_entry(record.turn, known), batch)
        batch.commit(self.journal)
        if self.life.owed and self.life.seen_of(record.turn) >= self.life.owed:
            self.life.settle()
            self._show()

    def _show(self) -> None:
        """What changes nothing is answered beside a turn of an earlier life as soon as that has come so far again."""
        if self.life.owed and self.life.comes_so_far(self.ledger.turn + 1):
            self.calls.rests.show(self.ledger.open.values())

    def _take(self, turn: int, key: int, outs: list[Out], batch: Batch) -> None:
        """Let new outputs out; drop those that are out already."""
        ledger = self.ledger
        if any(out.verb == "cancel" for out in outs):  # Lives may know a timer of a hook by other names.
            outs = [self.timers.known_as(out) if out.verb == "cancel" else out for out in outs]
        again = ledger.compare_outputs(turn, key, outs, functools.partial(is_as_before, self))
        if turn <= ledger.turn or self.life.owed:
            self.life.see_again(turn, outs[-1].k if outs else 0)
        for out in outs[:again]:
            if out.verb in AWAITED:
                self.calls.join(turn, key, out)
        for out in outs[again:]:
            if self.journal.durable and out.name not in self.shapes.noted and out.verb in SENT:
                self.note_shape(out.name, batch)
            self.outputs.execute(turn, key, out, batch)

    def _turn_end(self, end: TurnEnd) -> None:
        ledger = self.ledger
        if end.turn <= ledger.turn:  # It was handled again, and must have sent just what it sent before.
            self._take(end.turn, end.id, end.outs, Batch())
            ledger.judge_replay(end, self.life.seen_of(end.turn), self._error, functools.partial(is_same_reply, self))
            return
        source = ledger.open.get(end.id)
        if source is None:
            raise HoldfastError(f"{self.path}: the life ended turn {end.turn} with unknown input {end.id}")
        if source.kind == START and end.status == FAILED:
            return  # Its start failed, and will be tried again.
        is_durable = self.journal.durable
        is_quiet = not end.outs and end.ends is None and not ledger.released
        if is_quiet and source.ask is None and self.intake.bound is None:
            # The shortest way: nothing leaves, nobody waits.
            if not is_durable:
                ledger.end_turn(source, end.turn, end.status, end.state)
                if end.status == DROPPED:
                    self._lose(source, end)
                return
            if end.status == OK and not end.state:
                ledger.end_turn(source, end.turn, OK)
                self.outputs.rows.end_quietly(end.turn, source.id)
                return
        batch = Batch()
        if end.outs or ledger.released:
            self._take(end.turn, end.id, end.outs, batch)
        if self.life.owed:
            ledger.judge_begun(end, self.life.seen_of(end.turn), self.life.owed)
            self.life.owed = 0
            self.life.settle()
        if end.ends is not None:
            self._end_with(end.ends, batch)
        was_asked = source.ask is not None and end.status == OK
        if is_durable and end.answer.kind == "refusal":
            self.note_shape(shape_name(end.answer), batch)
        self.end_turn(source, end.turn, end.status, batch, end.state, answer_digest(end.answer) if was_asked else 0)
        if end.answer.kind == LATER:
            self.calls.owe(source, end.turn, batch)
        elif end.status != STASHED:
            self._lose(source, end)
            self.give(source, end.answer, batch)
        batch.commit(self.journal)

    def end_turn(self, source: Input, number: int, status: str, batch: Batch, state: int = 0, reply: int = 0) -> None:
        """A turn is over: its end record."""
        turn = self.ledger.end_turn(source, number, status, state, reply)
        if self.intake.bound is not None:
            batch.after.append(functools.partial(self.intake.bound.ended, source))
        if self.journal.durable and (status == STASHED or not self.outputs.rows.end_with_input(number, turn, batch)):
            self.outputs.rows.close()
            batch.add(self.path, turn.entry(number), self.ledger.positions_of(number))

    def _end_with(self, ends: EndWanted | None, batch: Batch) -> None:
        """Journal that the actor is to end, as a turn has said, or (None) that this is over."""
        position = self.ledger.end_with(ends)
        if self.journal.durable:
            self.outputs.rows.close()
            batch.add(self.path, stop_entry(ends), position)

    def forget_end(self) -> None:
        """The end that a turn has asked for is over: whoever supervises the actor has decided what comes of it."""
        if self.ledger.own_end.wanted is not None:
            batch = Batch()
            self._end_with(None, batch)
            batch.commit(self.journal)

    def end_without_turn(self, source: Input, answer: Answer, batch: Batch) -> None:
        """End an input that will not be handled: it gets an end record all the same."""
        self.ledger.withdraw(source)
        if self.intake.bound is not None:
            self.intake.bound.ended(source)
        if self.journal.durable:
            position: list[int] = []
            self.ledger.drop(position)  # Perhaps they stand nowhere yet.
            self.ledger.drop_input(source)
            batch.add(self.path, ("drop", source.id), position)
        self.give(source, answer, batch)

    def undo_begun(self, why: str) -> None:
        """Undo the turn in hand between two lives, for the state that it began with is gone."""
        undo_begun(self, why)

    def _lose(self, source: Input, end: TurnEnd) -> None:
        """What the life could make nothing of is a dead letter, if nobody waits who could hear of it."""
        if end.status == DROPPED and source.ask is None and end.answer.kind != NOTHING:
            lose(self, source, self._error(end.answer))

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
