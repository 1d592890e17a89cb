"""What goes over a line: tells, asks, publications and watches between the actors of two programs.

They are the frames that cross the border of a process; here they carry names as text, for a line outlives a connection.
An ask to a recorded actor has a name for good: if the other system is led by another program meanwhile, it comes again
under that name, and has one outcome. What was sent to other actors then ends with `NoConnection`, handled or not.
"""

from __future__ import annotations

import dataclasses
import math
import secrets
import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, Protocol, cast

import msgspec

from ...actors.control.trace_tail import enveloped
from ...actors.errors import (
    ONLY_MESSAGES,
    BadMessage,
    BadReply,
    ConnectionFull,
    ConnectionLost,
    HoldfastError,
    NotGranted,
    UnknownMessage,
    Unreachable,
    type_name,
)
from ...actors.events import ConnectionLimited
from ...actors.exit_reasons import NoConnection, pack_exit
from ...actors.kernel import links
from ...actors.kernel.cell import ANY, RUNNING, Cell, Order
from ...actors.kernel.codec import Parcel, encode_special, unencodable
from ...actors.kernel.envelope import AnyTable, Ask
from ...actors.kernel.message import Message, RuntimeOrder, message_name
from ...actors.process.wire import frames
from ...actors.process.wire.frames import BadFrame
from ...actors.process.wire.peer import (
    Accepted,
    OutsideHost,
    OutsidePlace,
    Peer,
    RelayedAsk,
    RemoteHome,
    obey,
)
from ...actors.process.wire.worker_gate import is_at_or_below, is_order
from ...checkpoint.home.ask_recovery import LASTING, FarId, FarOut, RejoinedAsk, lasting_number, origin_asked_by
from ...checkpoint.home.pending_asks import ACCEPTED, SwitchAsk
from ...checkpoint.home.recorded_home import switch_of
from ...checkpoint.inputs import Batch
from ...checkpoint.protocol import MESSAGE, REPLY, Answer
from .inflow import FULL_SECONDS, MOST_HELD, SLICE, ConnectionLimits, Inflow
from .line import MOST_BYTES, NOBODY, WINDOW_BYTES, Boot, Line, LineBatch, Note

if TYPE_CHECKING:
    import asyncio

    from ...actors.control.orders_lane import QueuedOrder
    from ...actors.kernel.node import Node
    from ...checkpoint.home.homes import Homes

NEW, AGAIN = b"\x00", b"\x01"
"""The first byte of an item: whether it may have come before, to another program that led the system."""
PASSING, ASKED, TOLD = 0, 1, 2
"""The number in an ask's frame: its name is void with the run of its program, is not, or it is a message that is kept
there until it is accepted here."""
COMMANDS: Final = frozenset(
    ("monitor", "demonitor", "link", "unlink", "exit", "down", "subscribe", "unsubscribe", "settled", "limited")
)  # fmt: skip
"""What one system may want of the actors of another one."""
ENDS: Final = frozenset(("exit", "down"))
"""How one system tells another that an actor has ended."""
SPEAKER: Final = {
    "monitor": "watcher", "demonitor": "watcher", "link": "peer", "unlink": "peer", "exit": "source", "down": "source"
}  # fmt: skip
"""Where a command has the address of the actor that wants it, unless that is the one that it is addressed to."""
LONGEST_TOPIC: Final = 4096
"""In characters, of a topic that another program may subscribe to."""
_DECODER: Final[msgspec.msgpack.Decoder[frames.AnyFrame]] = msgspec.msgpack.Decoder(frames.AnyFrame)
_MESSAGES: Final = frozenset(
    (
        frames.tagged(frames.Tell),
        frames.tagged(frames.Ask),
        frames.tagged(frames.Offer),
        frames.tagged(frames.Publish),
    )
)
"""How the frames of messages begin."""


class FindName(Message[str]):
    """Asks a system, at its first address, for the address of the actor that has a name there."""

    registered: str


FIND_NAME: Final = message_name(FindName)
ASKED_FOR: Final = "names asked for"
"""A fact that is noted anew before a name is answered: if another leads, that cannot be, and nobody is answered."""


class TextNames:
    """The names of a line: each is its own text."""

    kinds: dict[type, int] = {}  # noqa: RUF012  # nothing is ever put in: no name has a number

    def to_wire(self, text: str) -> frames.Name:
        """The text itself, for names have no numbers here."""
        return text

    def from_wire(self, name: frames.Name) -> str:
        """The text. Raises BadFrame: it is a number."""
        if not isinstance(name, str):
            raise BadFrame(f"name {name} on a line")
        return name


class LineConnection:
    """A line, to those who send frames."""

    def __init__(self, far: FarLine) -> None:
        self._far = far
        self.names = TextNames()
        self._encode = msgspec.msgpack.Encoder(enc_hook=encode_special).encode

    @property
    def is_open(self) -> bool:
        """Whether anybody may still hear what is sent."""
        return not self._far.is_closed

    def send(self, frame: frames.Frame, actor: str = "") -> None:
        """Send a frame.

        Raises:
            BadMessage: its payload cannot be coded or is too large; nothing is sent.
        """
        if isinstance(frame, frames.Ask):
            frame.until -= self._far.node.clock.machine()  # Two machines have none in common: what is left goes over.
        try:
            data = self._encode(frame)
        except Exception as error:  # Whatever a payload raises while it is encoded means that it cannot be.
            payload = frame.body if isinstance(frame, (frames.Tell, frames.Ask, frames.Reply)) else frame
            raise BadMessage(actor, type_name(type(payload)), unencodable(payload, error)) from error
        if len(data) > self._far.most:
            match frame:
                case frames.Tell() | frames.Ask() | frames.Offer() | frames.Publish():
                    name = str(frame.name).replace(":", ".")
                case _:
                    name = type_name(type(frame))
            raise BadMessage(actor, name, self._far.too_large(len(data)))
        self._far.put(frame, data)

    @property
    def has_room(self) -> bool:
        """Whether the other system keeps up."""
        line = self._far.line
        return line is None or line.has_room

    def room(self) -> asyncio.Future[None] | None:
        """None while the other system keeps up; else a future that ends when it does again."""
        line = self._far.line
        return None if line is None else line.room()


class FarTable(AnyTable):
    """The table of an actor of another system: it takes all messages but orders."""

    def __contains__(self, kind: object) -> bool:
        return self.knows(kind)  # type: ignore[arg-type]  # a message's type

    def knows(self, kind: type) -> bool:
        return issubclass(kind, Message) and not issubclass(kind, RuntimeOrder)


FAR_TABLE: Final = FarTable()


class FarHome(RemoteHome):
    """The home of an address is in another system."""

    def faulted(self, cell: Cell, by: str) -> None:
        """Nobody kills an actor of another system."""


def _not_granted(cell: Cell, order: str) -> NotGranted:
    return NotGranted(cell.path, order, "another program", ONLY_MESSAGES)


class FarPlace(OutsidePlace):
    """Wherever another system has an actor: it is not ours to end or to control."""

    kind = "another system"

    def require_order(self, cell: Cell, order: Order) -> None:
        raise _not_granted(cell, order)

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        call.ask.fail(_not_granted(cell, "an order"))

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        if verb in COMMANDS:
            super().told(cell, verb, data)


class FarHost(OutsideHost):
    """The host of stand-ins for actors of another system."""

    def __init__(self, peer: FarLine) -> None:
        super().__init__(peer)
        self.home, self.place = FarHome(peer), FarPlace(peer)


class FarAsk(RejoinedAsk, eq=False):
    """An ask of another system to a recorded actor: its outcome is kept until that system has it."""

    @classmethod
    def arrived(cls, frame: frames.Ask, asker: Cell, cell: Cell, homes: Homes, run: int) -> FarAsk:
        """The ask in a frame; its message is decoded behind it."""
        left = frame.until - homes.node.clock.machine()
        ask = cls(None, asker, frame.chain, left, homes.node.loop.time() + left, None, cell)
        ask.future, ask.until, ask.homes = ask, frame.until, homes
        ask.asker, ask.turn, ask.k = asker.path, frame.id, run
        homes.far.begin(FarId(ask.asker, ask.turn, ask.k), ask.until)
        return ask


class KeptTell(RelayedAsk, eq=False):
    """A message of a recorded actor to another system, which answers when it has accepted it."""

    far: Any = None
    origin: str = ""

    def answer_raw(self, body: bytes) -> None:
        """The other program has accepted it for good."""
        self._over("")

    def fail(self, error: BaseException) -> None:
        """It has not been sent: it stays kept."""

    def fail_raw(self, kind: str, name: str, body: bytes) -> None:
        """It is refused, for good."""
        self._over(str(self.far.codec.decode_error(kind, name, body)))

    def _over(self, problem: str) -> None:
        if self.is_over:
            return
        self.is_over = True
        far: FarLine = self.far
        if problem:
            far.node.dead_letter(self.to, self.message, problem, self.sender)
        far.kept_is_over(self)


@dataclasses.dataclass(slots=True)
class Unsent:
    """What waits until the other program has answered.

    Attributes:
        items: in order.
        size: of all of them, in bytes.
        asks: the numbers of the asks among them.
        fresh: asks of recorded actors that are not among them, and that nobody has been sent yet.
    """

    items: list[bytes] = dataclasses.field(default_factory=list)
    size: int = 0
    asks: set[int] = dataclasses.field(default_factory=set)
    fresh: set[int] = dataclasses.field(default_factory=set)


class LineOwner(Protocol):
    """What a line needs of whoever has all lines of a program."""

    @property
    def node(self) -> Node:
        """The node whose actors use it."""
        ...

    @property
    def name(self) -> str:
        """The name of this program."""
        ...

    @property
    def boot(self) -> Boot:
        """The incarnation of this program."""
        ...

    @property
    def homes(self) -> Homes | None:
        """The recorded actors here, if there can be any."""
        ...

    @property
    def limits(self) -> ConnectionLimits:
        """How much another program may have outstanding here."""
        ...

    def next_number(self) -> int:
        """A number for a line that begins: it rises."""
        ...

    def hand_back(self, ask: SwitchAsk) -> None:
        """Take an ask of a recorded actor that is out when its line is closed."""
        ...

    def overrun(self, far: FarLine, problem: str) -> None:
        """End a line whose other end does not keep to what it may, and say in what."""
        ...

    def await_actor(self, path: str, then: Callable[[], None]) -> bool:
        """Have something done when somebody is started at an address; False: nobody will be soon."""
        ...


class FarLine(Peer):
    """A line to another program, with the stand-ins for its actors.

    Args:
        owner: has all lines of this program.
        name: the name of the other one: the first part of its addresses.
        post: posts bytes to the other program; they may get lost. It may be reached by another way later: `post_bytes`.

    Attributes:
        theirs: the incarnation of the other program; NOBODY until it has answered.
        numbers: of the line, as this end counts and as the other one does: an end that begins anew counts on.
        line: the line to that; None until then.
        heard: when something of it has last come, on the loop's clock.
        is_lost: whether it has not answered for long.
        is_closed: whether nothing goes over any more.
        is_closing: whether this program ends: it takes in nothing new, and still answers.
        most: the largest item that can be sent, in bytes.
        inflow: what the other program has outstanding here.
    """

    def __init__(self, owner: LineOwner, name: str, post: Callable[[bytes], None]) -> None:
        super().__init__(owner.node)
        self._owner = owner
        self.name = name
        self.post_bytes = post
        self.theirs = NOBODY
        self.numbers = (owner.next_number(), 0)
        self.line: Line | None = None
        self.heard = owner.node.loop.time()
        self.is_lost = False
        self.is_closed = False
        self.is_closing = owner.homes is not None and owner.homes.far.is_closing
        self.most = MOST_BYTES
        self.inflow = Inflow(owner.limits)
        self._unsent = Unsent()
        self._oldest: tuple[int | None, float] = (None, 0.0)
        self._last_id = secrets.randbits(40) << 12  # A late reply to an earlier run names nothing of this one.
        self._cells: weakref.WeakValueDictionary[str, Cell] = weakref.WeakValueDictionary()
        self._host = FarHost(self)
        self.join(cast("Any", LineConnection(self)))
        self._takers: dict[type[frames.Frame], Callable[[Any, bool], None]] = {
            frames.Tell: self._take_tell,
            frames.Ask: self._take_ask,
            frames.Offer: self._take_offer,
            frames.Publish: self._take_publication,
            frames.Reply: lambda frame, again: self.on_reply(frame),
            frames.Failure: lambda frame, again: self.on_failure(frame),
            frames.Command: self._take_command,
        }

    def stand_in(self, path: str) -> Cell:
        """The stand-in for an actor of the other program."""
        cell = self._cells.get(path)
        if cell is None:
            cell = self._cells[path] = Cell(self.node, None, path, self._host)
            cell.state, cell.admit, cell.table = RUNNING, self._host.home.admit, FAR_TABLE
            cell.extra().outlet = self.connection  # A `send` waits while the other program does not keep up.
        return cell

    # -- out --------------------------------------------------------------------------------------------------------

    def put(self, frame: frames.Frame, data: bytes) -> None:
        """Have a frame go over, now or when the other program has answered.

        Raises:
            Unreachable: it has not answered for long, and nobody waits for what the frame comes to.
        """
        if self.is_closing and isinstance(frame, frames.Command) and frame.verb in ENDS:
            return  # The program ends, and nobody says that its actors do: the end of the line is NoConnection there.
        if self.is_closed and isinstance(frame, (frames.Reply, frames.Failure, frames.Command)):
            return  # Nobody is there who would care.
        if self.is_closed or (self.is_lost and isinstance(frame, (frames.Tell, frames.Offer, frames.Publish))):
            raise Unreachable(f"/{self.name}", "the connection is closed" if self.is_closed else "it does not answer")
        if self.line is not None:
            if isinstance(frame, (frames.Reply, frames.Failure)):
                self.inflow.answered(frame.id)
                self.line.put(NEW + data)
            elif _passes(frame):
                self.line.put(NEW + data)
            else:
                self.line.put_message(NEW + data)
            return
        if self._unsent.size > WINDOW_BYTES:
            raise Unreachable(f"/{self.name}", "too much waits for it already")
        self._unsent.items.append(NEW + data)
        self._unsent.size += len(data)
        if isinstance(frame, frames.Ask):
            self._unsent.asks.add(frame.id)

    def command(self, path: str, verb: str, data: dict[str, Any]) -> None:
        """Tell the other program what an actor here, or one of its own, wants."""
        self.connection.send(frames.Command(path, verb, data))

    def deliver(self, which: FarId, answer: Answer) -> None:
        """Send the outcome of an ask to a recorded actor here; it is kept until the other program has it."""
        homes, line = self._owner.homes, self.line
        if homes is None or line is None or which.run not in (LASTING, run_number(self.theirs)):
            return  # It asks again when it is back; or it has been started anew, and nobody there waits.
        frame: frames.Frame
        if answer.kind == REPLY:
            frame = frames.Reply(which.number, msgspec.Raw(answer.body))
        else:
            frame = frames.Failure(which.number, answer.kind, answer.name, msgspec.Raw(answer.body))
        data = msgspec.msgpack.encode(frame)
        if len(data) > self.most:
            error = BadReply("the recorded actor", "what it was asked", self.too_large(len(data)))
            kind, name, body = self.codec.encode_error(error)
            data = msgspec.msgpack.encode(frames.Failure(which.number, kind, name, msgspec.Raw(body)))
        self.inflow.answered(which.number)
        # A recorded asker says by itself when it has the outcome for good.
        arrived = None if which.run == LASTING else lambda: homes.far.settled(which)
        line.put(NEW + data, arrived)

    def _send_ask(self, cell: Cell, path: str, ask: Ask, number: int) -> None:
        if isinstance(ask, SwitchAsk):
            self.ask_lasting(ask, again=False)
        else:
            super()._send_ask(cell, path, ask, number)

    def ask_lasting(self, ask: SwitchAsk, *, again: bool) -> None:
        """Ask what a recorded actor asks, under the name that its ask has for good."""
        key = lasting_number(origin_asked_by(ask))
        asker = ask.asker
        ask.settled = lambda: self.command(asker, "settled", {"number": key})
        self._put_ask(key, ask, again=again)

    def tell_lasting(self, out: FarOut, *, again: bool) -> None:
        """Tell what a recorded actor tells; it is kept until it is accepted."""
        told = KeptTell(Parcel(out.name, out.body), self.node.cell_at(out.sender), (), math.inf, math.inf, None)
        told.to, told.future, told.far, told.origin = self.stand_in(out.to), told, self, out.origin
        self._put_ask(lasting_number(out.origin), told, again=again)

    def kept_is_over(self, told: KeptTell) -> None:
        """The other program has accepted what was kept for it, or never will."""
        homes, key, sender = self._owner.homes, lasting_number(told.origin), told.sender.path
        if homes is not None:
            homes.far.accepted(self.name, told.origin, lambda: self.command(sender, "settled", {"number": key}))

    def _put_ask(self, key: int, ask: Ask, *, again: bool) -> None:
        """Send an ask under this number, now or when the other program has answered."""
        self.pending[key] = ask
        ask.started = True
        if self.line is not None:
            self.line.put_message((AGAIN if again else NEW) + self._ask_frame(key, ask))
        elif not again:
            self._unsent.fresh.add(key)

    def _ask_frame(self, key: int, ask: Ask) -> bytes:
        """The frame of an ask under this number."""
        until = self.node.clock.on_machine(ask.deadline) - self.node.clock.machine()
        name, body = self._payload(ask.message)
        sender = None if ask.sender is None else ask.sender.path
        kind = TOLD if isinstance(ask, KeptTell) else ASKED if isinstance(ask, SwitchAsk) else PASSING
        assert ask.to is not None
        frame = frames.Ask(key, ask.to.path, name, body, until, kind, sender, ask.chain)
        return msgspec.msgpack.encode(frame, enc_hook=encode_special)

    def too_large(self, size: int) -> str:
        """Why something cannot be sent that has so many bytes."""
        return f"it has {size} bytes, the limit between systems is {self.most} here; send it in parts"

    def say(self, note: Note = "") -> None:
        """Post a batch without items: a greeting as long as the other program has not answered."""
        if self.line is not None:
            self.line.say(note)
        else:
            self._post(1, (), note)

    def _post(self, first: int, items: tuple[bytes, ...], note: Note) -> None:
        got = 0 if self.line is None else self.line.got
        if not note and self.inflow.is_full:
            note = "full"
        ours, theirs = self.numbers
        batch = LineBatch(self._owner.name, self._owner.boot, self.theirs, got, first, items, note, ours, theirs)
        self.post_bytes(msgspec.msgpack.encode(batch))

    # -- whom it leads to -------------------------------------------------------------------------------------------

    def begin(self, theirs: Boot, number: int) -> None:
        """The other program has answered: send it what waits, and again what was asked of the one before it."""
        self.theirs = theirs
        self.numbers = (self.numbers[0], number)
        self.line = Line(self.node.loop, self._post, self._take)
        self.alive()
        self._ask_again()
        unsent, self._unsent = self._unsent, Unsent()
        for data in unsent.items:
            self.line.put_message(data)
        for cell in list(self._cells.values()):
            self._watch_again(cell)

    def is_with(self, batch: LineBatch) -> bool:
        """Whether a batch is of the line that there is, and not of one before it."""
        return self.theirs == batch.boot and self.numbers == (batch.to_line, batch.line)

    def alive(self) -> None:
        """Something of the other program has come."""
        self.heard, self.is_lost = self.node.loop.time(), False

    def end(self, why: str) -> None:
        """The line leads nowhere any more: whoever was reached over it may have ended; asks go over the next one."""
        if self.line is not None:
            self.line.close()
            self.numbers = (self._owner.next_number(), 0)
        self.line, self.theirs = None, NOBODY
        if self.inflow.beginning is not None:
            self.inflow.beginning.cancel()
        self.inflow = Inflow(self.inflow.limits)
        self._suspect()
        for key, ask in list(self.pending.items()):
            if type(ask.message) is Accepted:
                self.pending.pop(key).fail(ConnectionLost(f"/{self.name}", why))

    def unaccepted_for(self) -> float:
        """For how many seconds the other program has neither accepted nor refused the oldest message that waits so.

        It is looked at now and then: the time since the first look that found the message.
        """
        now = self.node.loop.time()
        oldest = next((key for key, ask in self.pending.items() if type(ask.message) is Accepted), None)
        if oldest is None or oldest != self._oldest[0]:
            self._oldest = oldest, now
        return now - self._oldest[1]

    def lose(self) -> None:
        """The other program has not answered for long: whoever watches actors there is told of the suspicion, once."""
        if not self.is_lost:
            self.is_lost = True
            self._suspect()

    def close(self) -> None:
        """Nothing goes over any more, and nobody waits for what would come."""
        if self.is_closed:
            return
        if self.line is not None:
            self.line.flush()
        self.say("bye")
        self.is_closed = True
        self.end("the connection was closed")
        for key, ask in list(self.pending.items()):
            if isinstance(ask, SwitchAsk):  # It waits for the next connection, as long as its turn does.
                del self.pending[key]
                self._owner.hand_back(ask)
        self.fail_pending(ConnectionLost(f"/{self.name}", str(NoConnection(self.name))))

    def _suspect(self) -> None:
        """Tell of the suspicion: EXIT over links, DOWN to monitors; and those there watch nobody here any more."""
        reason = NoConnection(self.name)
        for cell in list(self._cells.values()):
            if cell.more is None or not cell.more.has_more:
                continue
            links.announce(cell, reason, recovering=False)
            for watch in list(cell.more.ties.watching):
                watch.forget()
                if watch.target.more is not None and watch in watch.target.more.ties.monitors:
                    watch.target.more.ties.monitors.remove(watch)
            for topic in list(cell.more.belongings.topics):
                self.node.topics.unsubscribe(topic, cell)

    def _watch_again(self, cell: Cell) -> None:
        """Who waits for the real end of an actor there goes on waiting."""
        if cell.more is not None and cell.more.has_more:
            for watch in cell.more.ties.monitors:
                cell.host.told(cell, "monitor", {"watcher": watch.watcher.path, "for_good": watch.for_good})

    def _ask_again(self) -> None:
        """Ask the new program what was asked of the one before it, in the same order and under the same names."""
        assert self.line is not None
        for key, ask in list(self.pending.items()):
            if not ask.is_done and ask.to is not None and key not in self._unsent.asks:
                self.line.put_message((NEW if key in self._unsent.fresh else AGAIN) + self._ask_frame(key, ask))

    # -- in ---------------------------------------------------------------------------------------------------------

    def hear(self, batch: LineBatch) -> None:
        """Take a batch of the incarnation that the line leads to."""
        self.alive()
        if self.line is not None:
            self.line.hear(batch)

    def _take(self, data: bytes) -> None:
        """Take an item, unless it is a message and others wait: then it waits behind them."""
        inflow = self.inflow
        if inflow.left > 0 and not inflow.held and not inflow.is_full:
            inflow.left -= 1
            if inflow.beginning is None:
                inflow.beginning = self.node.loop.call_soon(self._begin_round)
            self._take_now(data)
            return
        if _is_answer(data):
            self._take_now(data)
            return
        inflow.hold(data)
        if inflow.held_bytes > MOST_HELD and self.line is not None:
            self._owner.overrun(self, f"{inflow.held_bytes} bytes of messages wait here, and it does not hold back")

    def _begin_round(self) -> None:
        """Take what waits of the messages, as much as one program may in one round of the loop."""
        inflow, loop = self.inflow, self.node.loop
        inflow.beginning = None
        inflow.left = SLICE
        if inflow.is_full and inflow.has_room():
            inflow.is_full = False
            if self.line is not None:
                self.line.say()
        while inflow.held and inflow.left > 0 and not inflow.is_full and inflow is self.inflow:
            inflow.left -= 1
            self._take_now(inflow.next())
        if inflow is not self.inflow:
            return  # The line has ended.
        if inflow.is_full:
            if self.line is not None:
                self.line.say()
            inflow.beginning = loop.call_later(FULL_SECONDS, self._begin_round)
        elif inflow.held:
            inflow.beginning = loop.call_soon(self._begin_round)

    def take_rest(self) -> None:
        """The other program ends the line in good order: take what still waits of its messages, as far as it may."""
        inflow = self.inflow
        while inflow.held and not inflow.is_full and inflow is self.inflow:
            self._take_now(inflow.next())

    def _take_now(self, data: bytes) -> None:
        try:
            frame = _DECODER.decode(memoryview(data)[1:])
            take = self._takers.get(type(frame))
            if take is None:
                raise BadFrame(f"a {type(frame).__name__} on a line")
            if self.is_closing and isinstance(frame, (frames.Tell, frames.Ask, frames.Offer, frames.Publish)):
                return  # Whoever asks, asks whoever leads this system next.
            self._check_addresses(frame)
            take(frame, data[:1] == AGAIN)
        except (BadFrame, msgspec.MsgspecError) as error:
            self.node.dead_letter(self.stand_in(f"/{self.name}"), data, f"not understood: {error}")

    def _check_addresses(self, frame: frames.Frame) -> None:
        """See that the other program speaks for its own actors only, and to actors here: it is no way to others.

        Raises:
            BadFrame: it does not, or an address is missing.
        """
        if isinstance(frame, frames.Command):
            speaks = SPEAKER.get(frame.verb)
            self._check_within(frame.to, self._owner.name if speaks else self.name)
            if speaks:
                self._check_within(frame.data.get(speaks), self.name)
        elif isinstance(frame, (frames.Tell, frames.Ask, frames.Offer, frames.Publish)):
            if not isinstance(frame, frames.Publish):
                self._check_within(frame.to, self._owner.name)
            if frame.sender is not None:
                self._check_within(frame.sender, self.name)
            if isinstance(frame, frames.Ask) and math.isnan(frame.until):
                raise BadFrame("an ask until nan")

    def _check_within(self, path: object, system: str) -> None:
        if not isinstance(path, str) or not is_at_or_below(path, f"/{system}"):
            raise BadFrame(f"{path!r} is no address of {system}")

    def _receiver(self, to: frames.Name) -> Cell:
        """The actor here that something is for."""
        return self.node.cell_at(self.connection.names.from_wire(to))

    def _receiver_now(self, to: frames.Name, then: Callable[[], None]) -> Cell | None:
        """The actor here that something is for; None if it is not there yet, but may be soon: `then` is called then."""
        path = self.connection.names.from_wire(to)
        homes = self._owner.homes
        if homes is not None and homes.is_unopened(now := homes.addresses.now(path)):
            homes.far.when_opened(now, then)
            return None
        cell = self.node.find(path)
        if (cell is None or cell.is_dead) and self._owner.await_actor(path, then):
            return None
        return self.node.nowhere(path) if cell is None else cell

    def _take_tell(self, frame: frames.Tell, again: bool) -> None:
        if self._refuses_order(frame.name):
            self.node.dead_letter(self._receiver(frame.to), frame, "an order of another system")
        elif (cell := self._receiver_now(frame.to, lambda: self._take_tell(frame, again))) is not None:
            self.on_tell(cell, frame, None)
            self.inflow.sent(cell, memoryview(frame.body).nbytes)

    def _take_ask(self, frame: frames.Ask, again: bool) -> None:
        left = frame.until
        frame.until += self.node.clock.machine()
        if frame.number != TOLD:  # What is kept there is not refused: it waits.
            problem = self._too_many_asks(frame, left)
            if problem:
                self._refused("asks", problem)
                self._fail(frame, ConnectionFull(f"/{self._owner.name}", f"/{self.name}", problem))
                return
        self._ask_now(frame, again)

    def _too_many_asks(self, frame: frames.Ask, left: float) -> str:
        """Why no more asks of the other program are taken; an empty text if they are."""
        limits = self.inflow.limits
        if self.line is not None and self.line.waiting_bytes > limits.message_bytes:
            return f"it has not taken the {self.line.waiting_bytes} bytes of outcomes that wait for it"
        now = self.node.loop.time()
        if not self.inflow.asked(frame.id, now + left, now):
            return f"{limits.asks} of its asks have no outcome yet"
        if (
            frame.number == ASKED
            and self._owner.homes is not None
            and self._owner.homes.far.keeps_answers(self.name, limits.asks)
        ):
            return f"{limits.asks} outcomes are kept for its recorded actors, which do not say that they have them"
        return ""

    def _refused(self, what: str, problem: str) -> None:
        """Tell, once in the life of a line for each kind, that the other program wants more than it may."""
        if what not in self.inflow.told:
            self.inflow.told.add(what)
            self.node.emit(ConnectionLimited(f"/{self.name}", what, problem))
            self.command(f"/{self._owner.name}", "limited", {"what": what, "problem": problem})

    def _ask_now(self, frame: frames.Ask, again: bool) -> None:
        path = self.connection.names.from_wire(frame.to)
        if self._refuses_order(frame.name):
            self._fail(frame, UnknownMessage(path, str(frame.name).replace(":", ".")))
            return
        if frame.name == FIND_NAME:
            self._find_name(frame)
            return
        cell = self._receiver_now(frame.to, lambda: self._ask_now(frame, again))
        if cell is None:
            return
        homes = self._owner.homes
        if again and (homes is None or switch_of(cell) is None):
            if frame.number == TOLD:
                self.connection.send(frames.Reply(frame.id, msgspec.Raw(ACCEPTED.body)))  # Once at most.
            else:
                self._fail(frame, ConnectionLost(path, str(NoConnection(self._owner.name))))
            return
        if homes is not None and (again or frame.number != PASSING):
            which = self._named(frame)
            known = homes.far.outcome(which)
            if known is not None:
                self.deliver(which, known)
            if known is not None or homes.far.is_open(which):
                return
            if again and homes.far.has_forgotten(which):
                self._fail(frame, ConnectionLost(path, "its outcome was given up, for nobody took it for long"))
                return
        if frame.number == TOLD:
            self._take_kept(cell, frame, self._named(frame))
        else:
            self.on_ask(cell, frame, None)
        self.inflow.sent(cell, memoryview(frame.body).nbytes)

    def _find_name(self, frame: frames.Ask) -> None:
        """Say who has a name here, once it is sure that this program leads the system."""
        homes, wanted = self._owner.homes, self.codec.decode(FindName, frame.body).registered
        if homes is None or not homes.journal.durable or homes.journal.engine.safe_at != "sync":
            self._answer_name(frame, wanted, None)  # No other program can lead it.
            return
        try:
            homes.journal.note(ASKED_FOR, b"")
            synced = homes.journal.engine.synced()
        except HoldfastError as error:
            self._answer_name(frame, wanted, error)
            return
        if synced is None:
            self._answer_name(frame, wanted, None)
        else:
            synced.add_done_callback(
                lambda done: self._answer_name(frame, wanted, None if done.cancelled() else done.exception())
            )

    def _answer_name(self, frame: frames.Ask, wanted: str, error: BaseException | None) -> None:
        try:
            if error is not None:
                raise ConnectionLost(f"/{self._owner.name}", "it may be led by another program")
            path = self.node.shown(wanted).path
        except HoldfastError as problem:
            self._fail(frame, problem)
        else:
            self.connection.send(frames.Reply(frame.id, msgspec.Raw(msgspec.msgpack.encode(path))))

    def ask_in(self, frame: frames.Ask, cell: Cell, page: memoryview | None) -> RelayedAsk:
        homes = self._owner.homes
        if homes is None or switch_of(cell) is None:
            return super().ask_in(frame, cell, page)
        return FarAsk.arrived(frame, self._asker(frame), cell, homes, self._named(frame).run)

    def _named(self, frame: frames.Ask) -> FarId:
        """The name of an ask that has come, by which it is known when it comes again."""
        run = run_number(self.theirs) if frame.number == PASSING else LASTING
        return FarId(self._asker(frame).path, frame.id, run)

    def _take_kept(self, cell: Cell, frame: frames.Ask, which: FarId) -> None:
        """Take in a message that the other system keeps until it is accepted: once, if its receiver is recorded."""
        name, body, sender = self.connection.names.from_wire(frame.name), bytes(frame.body), self._asker(frame)
        homes, switch = self._owner.homes, switch_of(cell)
        try:
            if switch is None or homes is None:
                message = self.codec.message_in(cell, name, body)
                cell.admit(cell, enveloped(message, sender, frame.chain))
                self.connection.send(frames.Reply(frame.id, msgspec.Raw(ACCEPTED.body)))
                return
            if cell.table is not ANY:
                cell.table.kind_named(name)
            append = Batch()
            bound = switch.intake.bound
            if bound is None or bound.makes_room(None, name, body, sender.path):
                source = switch.record(MESSAGE, name, body, sender.path, append)
                source.chain = frame.chain
                append.after.append(lambda: switch.admitted(source))
            homes.far.answered(which, ACCEPTED, append)
            append.commit(homes.journal)
        except HoldfastError as error:
            self._fail(frame, error)

    def _asker(self, frame: frames.Ask) -> Cell:
        return self.stand_in(f"/{self.name}" if frame.sender is None else self.connection.names.from_wire(frame.sender))

    def _fail(self, frame: frames.Ask | frames.Offer | frames.Publish, error: HoldfastError) -> None:
        kind, name, body = self.codec.encode_error(error)
        self.connection.send(frames.Failure(frame.id, kind, name, msgspec.Raw(body)))

    def _take_offer(self, frame: frames.Offer, again: bool) -> None:
        if self._refuses_order(frame.name):
            self._fail(frame, UnknownMessage(str(frame.to), str(frame.name).replace(":", ".")))
        elif (cell := self._receiver_now(frame.to, lambda: self._take_offer(frame, again))) is not None:
            self._offer_to([cell], frame)

    def _take_publication(self, frame: frames.Publish, again: bool) -> None:
        if self._refuses_order(frame.name):
            self._fail(frame, UnknownMessage(frame.topic, str(frame.name).replace(":", ".")))
        else:
            self._offer_to(self.node.topics.subscribers(frame.topic), frame, frame.topic)

    def _offer_to(self, cells: Sequence[Cell], frame: frames.Offer | frames.Publish, topic: str | None = None) -> None:
        """Hand on a message whose sender waits until it is accepted: as long as it waits for room it is outstanding."""
        if not self.inflow.asked(frame.id, math.inf, 0.0):
            self._refused("asks", problem := f"{self.inflow.limits.asks} of its messages wait for room")
            self._fail(frame, ConnectionFull(f"/{self._owner.name}", f"/{self.name}", problem))
            return
        self.on_offer(cells, frame, topic)
        for cell in cells:
            self.inflow.sent(cell, memoryview(frame.body).nbytes)

    def _take_command(self, frame: frames.Command, again: bool) -> None:
        path = self.connection.names.from_wire(frame.to)
        match frame.verb:
            case "subscribe" | "unsubscribe":
                self._take_subscription(self.stand_in(path), frame)
            case "limited":
                what, problem = str(frame.data.get("what")), str(frame.data.get("problem"))
                self.node.emit(ConnectionLimited(f"/{self.name}", what, problem))
            case "settled":
                number = frame.data.get("number")
                if self._owner.homes is not None and isinstance(number, int):
                    self._owner.homes.far.settled(FarId(path, number, LASTING))
            case "monitor" | "link" if not self._may_tie(frame):
                source, reason = frame.to, pack_exit(NoConnection(self._owner.name))
                told = "down" if frame.verb == "monitor" else "exit"
                data = {"source": source, "reason": reason, "recovering": False}
                if told == "down":
                    data["for_good"] = bool(frame.data.get("for_good"))
                self.command(str(frame.data[SPEAKER[frame.verb]]), told, data)
            case verb if verb in COMMANDS:
                obey(self.node, self._receiver(frame.to), path, frame)
            case verb:
                raise BadFrame(f"another system may not {verb}")

    def _take_subscription(self, cell: Cell, frame: frames.Command) -> None:
        """An actor there wants what is published on a topic here, or wants it no more."""
        topic, topics, most = frame.data.get("topic"), self.node.topics, self.inflow.limits.subscriptions
        if not isinstance(topic, str) or not topic.startswith("/") or len(topic) > LONGEST_TOPIC:
            raise BadFrame(f"the topic {topic!r:.100}")
        if frame.verb == "unsubscribe":
            topics.unsubscribe(topic, cell)
        elif topics.has(topic, cell) or self.inflow.topics.may_add(
            most, lambda: sum(len(one.more.belongings.topics) for one in self._tied())
        ):
            topics.subscribe(topic, cell)
        else:
            self._refused("subscriptions", f"its actors have {most} subscriptions")

    def _may_tie(self, frame: frames.Command) -> bool:
        """Whether an actor there may have one more monitor or link here."""
        most = self.inflow.limits.ties
        if self.inflow.ties.may_add(
            most, lambda: sum(len(one.more.ties.watching) + len(one.more.ties.links) for one in self._tied())
        ):
            return True
        self._refused("ties", f"its actors have {most} monitors and links")
        return False

    def _tied(self) -> Iterator[Any]:
        """The stand-ins that have ties or subscriptions here."""
        return (cell for cell in list(self._cells.values()) if cell.more is not None and cell.more.has_more)

    def _refuses_order(self, name: frames.Name) -> bool:
        """Whether a message is an order to the runtime: no other system gives any here."""
        return is_order(self.connection.names.from_wire(name))


def _passes(frame: frames.Frame) -> bool:
    """Whether a frame is no message: it goes past those that wait until the other program takes more."""
    return isinstance(frame, frames.Command) and frame.verb in ("settled", "limited")


def _is_answer(data: bytes) -> bool:
    """The same of an item that has come; malformed ones are for whoever takes them."""
    if data[1:3] in _MESSAGES:  # Most that wait are messages, and they are decoded when it is their turn.
        return False
    try:
        frame = _DECODER.decode(memoryview(data)[1:])
    except msgspec.MsgspecError:
        return True
    return isinstance(frame, (frames.Reply, frames.Failure)) or _passes(frame)


def run_number(boot: Boot) -> int:
    """The number of an incarnation."""
    return int(boot.token, 16)
