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
from collections.abc import Callable
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec

from ...actors.control.trace_tail import enveloped
from ...actors.errors import (
    BadMessage,
    BadReply,
    ConnectionLost,
    HoldfastError,
    NotGranted,
    UnknownMessage,
    Unreachable,
    type_name,
)
from ...actors.exit_reasons import ExitReason, NoConnection
from ...actors.kernel import links
from ...actors.kernel.cell import ANY, RUNNING, Cell
from ...actors.kernel.codec import Parcel, encode_special, unencodable
from ...actors.kernel.envelope import AnyTable, Ask
from ...actors.kernel.message import Message, RuntimeOrder
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
    ("monitor", "demonitor", "link", "unlink", "exit", "down", "subscribe", "unsubscribe", "settled")
)  # fmt: skip
"""What one system may want of the actors of another one."""
SPEAKER: Final = {
    "monitor": "watcher", "demonitor": "watcher", "link": "peer", "unlink": "peer", "exit": "source", "down": "source"
}  # fmt: skip
"""Where a command has the address of the actor that wants it, unless that is the one that it is addressed to."""
_DECODER: Final[msgspec.msgpack.Decoder[frames.AnyFrame]] = msgspec.msgpack.Decoder(frames.AnyFrame)


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
            frame.until -= monotonic()  # The machines have no clock in common: what goes over is what is left.
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


class FarPlace(OutsidePlace):
    """Wherever another system has an actor: it is not ours to end or to control."""

    kind = "another system"

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        raise NotGranted(cell.path, "stop", "another system")

    def kill(self, cell: Cell) -> None:
        raise NotGranted(cell.path, "kill", "another system")

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        call.ask.fail(NotGranted(cell.path, "an order", "another system"))

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
        left = frame.until - monotonic()
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


class FarLine(Peer):
    """A line to another program, with the stand-ins for its actors.

    Args:
        node: the node whose actors use it.
        me: the name and the incarnation of this program.
        name: the name of the other one: the first part of its addresses.
        post: posts bytes to the other program; they may get lost.
        homes: the recorded actors here, if there can be any.

    Attributes:
        theirs: the incarnation of the other program; NOBODY until it has answered.
        line: the line to that; None until then.
        heard: when something of it has last come, on the loop's clock.
        is_lost: whether it has not answered for long.
        is_closed: whether nothing goes over any more.
        is_closing: whether this program ends: it takes in nothing new, and still answers.
        most: the largest item that can be sent, in bytes.
        hand_back: is given the asks of recorded actors that are out when it is closed.
        await_actor: has something done when somebody is started at an address; None: nobody will be soon.
    """

    def __init__(
        self, node: Node, me: tuple[str, Boot], name: str, post: Callable[[bytes], None], homes: Homes | None
    ) -> None:
        super().__init__(node)
        self._me, self._boot = me
        self.name = name
        self._post_bytes = post
        self._homes = homes
        self.theirs = NOBODY
        self.line: Line | None = None
        self.heard = node.loop.time()
        self.is_lost = False
        self.is_closed = self.is_closing = False
        self.await_actor: Callable[[str, Callable[[], None]], bool] = lambda path, then: False
        self.most = MOST_BYTES
        self.hand_back: Callable[[SwitchAsk], None] = lambda ask: None
        self._unsent = Unsent()
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
        if self.is_closed and isinstance(frame, (frames.Reply, frames.Failure, frames.Command)):
            return  # Nobody is there who would care.
        if self.is_closed or (self.is_lost and isinstance(frame, (frames.Tell, frames.Offer, frames.Publish))):
            raise Unreachable(f"/{self.name}", "the connection is closed" if self.is_closed else "it does not answer")
        if self.line is not None:
            self.line.put(NEW + data)
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
        homes, line = self._homes, self.line
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
        homes, key, sender = self._homes, lasting_number(told.origin), told.sender.path
        if homes is not None:
            homes.far.accepted(told.origin, lambda: self.command(sender, "settled", {"number": key}))

    def _put_ask(self, key: int, ask: Ask, *, again: bool) -> None:
        """Send an ask under this number, now or when the other program has answered."""
        self.pending[key] = ask
        ask.started = True
        if self.line is not None:
            self.line.put((AGAIN if again else NEW) + self._ask_frame(key, ask))
        elif not again:
            self._unsent.fresh.add(key)

    def _ask_frame(self, key: int, ask: Ask) -> bytes:
        """The frame of an ask under this number."""
        until = self.node.clock.on_machine(ask.deadline) - monotonic()
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
        batch = LineBatch(self._me, self._boot, self.theirs, got, first, items, note)
        self._post_bytes(msgspec.msgpack.encode(batch))

    # -- whom it leads to -------------------------------------------------------------------------------------------

    def begin(self, theirs: Boot) -> None:
        """The other program has answered: send it what waits, and again what was asked of the one before it."""
        self.theirs = theirs
        self.line = Line(self.node.loop, self._post, self._take)
        self.alive()
        self._ask_again()
        unsent, self._unsent = self._unsent, Unsent()
        for data in unsent.items:
            self.line.put(data)
        for cell in list(self._cells.values()):
            self._watch_again(cell)

    def alive(self) -> None:
        """Something of the other program has come."""
        self.heard, self.is_lost = self.node.loop.time(), False

    def end(self, why: str) -> None:
        """The line leads nowhere any more: whoever was reached over it may have ended; asks go over the next one."""
        if self.line is not None:
            self.line.close()
        self.line, self.theirs = None, NOBODY
        self._suspect()
        for key, ask in list(self.pending.items()):
            if type(ask.message) is Accepted:
                self.pending.pop(key).fail(ConnectionLost(f"/{self.name}", why))

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
                self.hand_back(ask)
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
                self.line.put((NEW if key in self._unsent.fresh else AGAIN) + self._ask_frame(key, ask))

    # -- in ---------------------------------------------------------------------------------------------------------

    def hear(self, batch: LineBatch) -> None:
        """Take a batch of the incarnation that the line leads to."""
        self.alive()
        if self.line is not None:
            self.line.hear(batch)

    def _take(self, data: bytes) -> None:
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
            self._check_within(frame.to, self._me if speaks else self.name)
            if speaks:
                self._check_within(frame.data.get(speaks), self.name)
        elif isinstance(frame, (frames.Tell, frames.Ask, frames.Offer, frames.Publish)):
            if not isinstance(frame, frames.Publish):
                self._check_within(frame.to, self._me)
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

    def _waits(self, to: frames.Name, then: Callable[[], None]) -> bool:
        """Whether the receiver is not there yet, but may be soon: then it is done when it is."""
        path = self.connection.names.from_wire(to)
        homes = self._homes
        if homes is not None and homes.is_unopened(path):
            homes.far.when_opened(path, then)
            return True
        cell = self.node.find(path)
        return (cell is None or cell.is_dead) and self.await_actor(path, then)

    def _take_tell(self, frame: frames.Tell, again: bool) -> None:
        if self._refuses_order(frame.name):
            self.node.dead_letter(self._receiver(frame.to), frame, "an order of another system")
        elif not self._waits(frame.to, lambda: self._take_tell(frame, again)):
            self.on_tell(self._receiver(frame.to), frame, None)

    def _take_ask(self, frame: frames.Ask, again: bool) -> None:
        frame.until += monotonic()
        self._ask_now(frame, again)

    def _ask_now(self, frame: frames.Ask, again: bool) -> None:
        path = self.connection.names.from_wire(frame.to)
        if self._refuses_order(frame.name):
            self._fail(frame, UnknownMessage(path, str(frame.name).replace(":", ".")))
            return
        if self._waits(frame.to, lambda: self._ask_now(frame, again)):
            return
        cell = self._receiver(frame.to)
        homes = self._homes
        which = self._named(frame)
        if again and (homes is None or switch_of(cell) is None):
            if frame.number == TOLD:
                self.connection.send(frames.Reply(frame.id, msgspec.Raw(ACCEPTED.body)))  # Once at most.
            else:
                self._fail(frame, ConnectionLost(path, str(NoConnection(self._me))))
            return
        if homes is not None and (again or frame.number != PASSING):
            known = homes.far.outcome(which)
            if known is not None:
                self.deliver(which, known)
            if known is not None or homes.far.is_open(which):
                return
        if frame.number == TOLD:
            self._take_kept(cell, frame, which)
            return
        self.on_ask(cell, frame, None)

    def ask_in(self, frame: frames.Ask, cell: Cell, page: memoryview | None) -> RelayedAsk:
        homes = self._homes
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
        homes, switch = self._homes, switch_of(cell)
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
        elif not self._waits(frame.to, lambda: self._take_offer(frame, again)):
            self.on_offer([self._receiver(frame.to)], frame)

    def _take_publication(self, frame: frames.Publish, again: bool) -> None:
        if self._refuses_order(frame.name):
            self._fail(frame, UnknownMessage(frame.topic, str(frame.name).replace(":", ".")))
        else:
            self.on_offer(self.node.topics.subscribers(frame.topic), frame, frame.topic)

    def _take_command(self, frame: frames.Command, again: bool) -> None:
        path = self.connection.names.from_wire(frame.to)
        match frame.verb:
            case "subscribe" | "unsubscribe":
                topics = self.node.topics
                change = topics.subscribe if frame.verb == "subscribe" else topics.unsubscribe
                change(str(frame.data.get("topic")), self.stand_in(path))
            case "settled":
                number = frame.data.get("number")
                if self._homes is not None and isinstance(number, int):
                    self._homes.far.settled(FarId(path, number, LASTING))
            case verb if verb in COMMANDS:
                obey(self.node, self._receiver(frame.to), path, frame)
            case verb:
                raise BadFrame(f"another system may not {verb}")

    def _refuses_order(self, name: frames.Name) -> bool:
        """Whether a message is an order to the runtime: no other system gives any here."""
        return is_order(self.connection.names.from_wire(name))


def run_number(boot: Boot) -> int:
    """The number of an incarnation."""
    return int(boot.token, 16)
