"""Draws up the turns of a run as they happen: who handled what, what it changed, and what each has followed from."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import re
import reprlib
from collections import deque
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor
from ...actors.kernel.cell import Cell, Order
from ...actors.kernel.codec import Parcel
from ...actors.kernel.context import ActorContext
from ...actors.kernel.envelope import Ask, Item, ReplyHandle
from ...actors.kernel.lifecycle import FirstTurn
from ...actors.kernel.loop import TurnRemains
from ...actors.kernel.message import Message, message_of
from ...actors.kernel.node import Node
from ...actors.kernel.ref import ActorRef, current
from ...actors.kernel.timers import Tick
from ...checkpoint.life.recorded_context import RecordedContext
from ...checkpoint.life.recorded_inbox import Fed
from ..library_code import is_module_of_library
from ..probes import ProbeActor
from ..schedules.turn_log import told
from ..swaps import Swaps
from ..turns import Substitute, TurnWatcher

BRIEF: Final = reprlib.Repr()
BRIEF.maxother = BRIEF.maxstring = 60
PATH: Final = re.compile(r"/[\w$./-]*[\w$]")
NEVER: Final = 1 << 62
"""A moment after the end of the run."""


class TurnCause(NamedTuple):
    """What a turn follows from: what another one had done up to a moment.

    Attributes:
        at: the moment from which on it does.
        row: the number of the other turn.
        until: the moment.
    """

    at: int
    row: int
    until: int


@dataclasses.dataclass(slots=True)
class ChartRow:
    """One turn.

    Attributes:
        at: when it began, in seconds on the virtual clock.
        path: whose it is.
        sender: the address of who sent what it handles; "": nobody in the system.
        what: what it handles.
        change: what it changed, in words.
        crashed: whether it has ended the life of its actor.
        is_library: whether it is the library's own, and ends no life of a user's actor.
        is_probe: whether it is that of a probe, which tells the test.
        causes: what it follows from.
        place: what its program is called, before the address; "": it has no name.
        sender_place: the same of the sender.
    """

    at: float
    path: str
    sender: str
    what: str
    change: str = ""
    crashed: bool = False
    is_library: bool = False
    is_probe: bool = False
    causes: list[TurnCause] = dataclasses.field(default_factory=list)
    place: str = ""
    sender_place: str = ""

    @property
    def name(self) -> str:
        """Whose turn it is, with the program."""
        return self.place + self.path

    @property
    def source(self) -> str:
        """Who has sent what it handles, with the program; "" if nobody in the system has."""
        return self.sender_place + self.sender if self.sender else ""


@dataclasses.dataclass(slots=True)
class SentMessage:
    """A message on its way.

    Attributes:
        row: the turn that has sent it; -1: it is the test's.
        moment: when.
        to: whom.
        is_ask: whether somebody waits for a reply.
        is_answered: whether it has been handled to the end.
    """

    row: int
    moment: int
    to: str
    is_ask: bool
    is_answered: bool = False


class OpenTurn(NamedTuple):
    """A turn that has begun.

    Attributes:
        number: of its row.
        life: of its actor.
        state: of its actor, before it.
        is_of_user: whether the class of its actor is the user's.
        sent: what it handles, as that was sent.
    """

    number: int
    life: int
    state: dict[str, str]
    is_of_user: bool
    sent: SentMessage | None


Way = tuple[str, str, str]
"""The sender ("": the test, or nobody), the receiver, and the class of a message: such messages keep their order."""


class Recorder(TurnWatcher):
    """Draws up the rows of a run as its turns happen.

    Attributes:
        rows: the turns, in the order in which they began.
        last: the newest turn of each address.
        heard: what the test has got to know: whom it has asked, and a turn that has brought the reply.
        asks: the futures that the test has got, with the address that was asked.
        refused: the errors that asks have ended with, and who was asked.
        sent: all that was asked, for who waits for it.
        orders: by address, the turns that have ordered its actor to stop.
    """

    def __init__(self) -> None:
        self.rows: list[ChartRow] = []
        self.last: dict[str, int] = {}
        self.heard: list[tuple[str, int]] = []
        self.asks: dict[int, tuple[asyncio.Future[Any], str]] = {}  # by their ids
        self.refused: list[tuple[BaseException, str]] = []
        self.sent: list[SentMessage] = []
        self._moment = 0
        self.orders: dict[str, list[TurnCause]] = {}
        self._asked: dict[
            int, tuple[Ask, int, SentMessage | None]
        ] = {}  # by their ids, with the turns that handle them
        self._open: dict[Cell, OpenTurn] = {}
        self._ways: dict[Way, deque[SentMessage]] = {}
        self._newest: dict[Way, SentMessage] = {}
        self._places: dict[object, str] = {}  # what is written before the addresses of a node

    def call(self, node: Node, name: str) -> None:
        """The program of a node has this name, or none."""
        if name:
            self._places[node] = f"{name}:"

    def _place_of(self, sender: Cell | None, place: str) -> str:
        """Where the sender of a message is that is handled in a place: there, or where its address had a turn last."""
        if sender is None or sender.path.split("/", 2)[1:2] == [sender.node.name]:
            return place
        return self.rows[self.last[sender.path]].place if sender.path in self.last else ""

    # -- what is sent and answered ----------------------------------------------------------------------------------

    def listen(self) -> Callable[[], None]:
        """Hear of what is sent, of timers and of replies. Returns what ends that."""
        swaps = Swaps()
        for name in ("tell", "send", "ask"):
            swaps.put(ActorRef, name, self._sending(getattr(ActorRef, name), is_ask=name == "ask"))
        for name in ("tell_after", "every"):
            swaps.put(ActorContext, name, self._setting(getattr(ActorContext, name)))
        for kind in (ActorContext, RecordedContext):
            swaps.put(kind, "forward", self._forwarding(vars(kind)["forward"]))
        swaps.put(ActorRef, "_order", self._ordering(ActorRef._order))
        swaps.put(Ask, "answer", self._answering(Ask.answer))
        swaps.put(Ask, "fail", self._failing(Ask.fail))
        return swaps.undo

    def _sending(self, send: Any, *, is_ask: bool) -> Any:
        @functools.wraps(send)
        def noted(ref: ActorRef[Any], message: Any, *rest: Any, **options: Any) -> Any:
            sender = current.get(None)
            self._note("" if sender is None else sender.path, ref.path, message, is_ask=is_ask)
            made = send(ref, message, *rest, **options)
            if is_ask and sender is None and isinstance(made, asyncio.Future):
                self.asks[id(made)] = made, ref.path
            return made

        return noted

    def _setting(self, set_timer: Any) -> Any:
        @functools.wraps(set_timer)
        def noted(ctx: ActorContext, seconds: float, message: Message[Any]) -> Any:
            self._note(ctx.path, ctx.path, message)
            return set_timer(ctx, seconds, message)

        return noted

    def _forwarding(self, forward: Any) -> Any:
        @functools.wraps(forward)
        def noted(ctx: ActorContext, to: ActorRef[Any]) -> None:
            item = ctx._cell.item
            sender = item.sender if isinstance(item, Item) else None
            self._note("" if sender is None else sender.path, to.path, message_of(item), is_ask=True)
            forward(ctx, to)

        return noted

    def _ordering(self, give_order: Any) -> Any:
        @functools.wraps(give_order)
        def noted(ref: ActorRef[Any], order: Order) -> None:
            row = self._row_here()
            if row >= 0:
                self._moment += 1
                self.orders.setdefault(ref.path, []).append(TurnCause(self._moment, row, self._moment))
            give_order(ref, order)

        return noted

    def _answering(self, answer: Any) -> Any:
        @functools.wraps(answer)
        def noted(ask: Ask, reply: object) -> None:
            if not isinstance(reply, ReplyHandle) and not ask.future.done():
                _, number, sent = self._asked.get(id(ask), (ask, -1, None))
                if sent is not None:
                    sent.is_answered = True
                whom = "" if ask.sender is None else ask.sender.path
                for row in {number, self._row_here()} - {-1}:
                    self._tell(row, whom, self.asks[id(ask.future)][1] if id(ask.future) in self.asks else "")
            answer(ask, reply)

        return noted

    def _failing(self, fail: Any) -> Any:
        @functools.wraps(fail)
        def noted(ask: Ask, error: BaseException) -> None:
            if ask.to is not None:
                self.refused.append((error, ask.to.path))
            fail(ask, error)

        return noted

    def _row_here(self) -> int:
        """The turn that runs; -1: none, or one of before."""
        ctx = current.get(None)
        return -1 if ctx is None or ctx._cell not in self._open else self._open[ctx._cell].number

    def _note(self, sender: str, to: str, message: object, *, is_ask: bool = False) -> None:
        self._moment += 1
        sent = SentMessage(self._row_here(), self._moment, to, is_ask)
        way = sender, to, _name(type(message).__qualname__)
        self._ways.setdefault(way, deque()).append(sent)
        self._newest[way] = sent
        if is_ask:
            self.sent.append(sent)

    def _tell(self, row: int, to: str, asked: str) -> None:
        """What a turn has replied is known to an actor, or to the test, which had asked whom."""
        self._moment += 1
        if not to:
            self.heard.append((asked, row))
        elif (told_row := self.last.get(to, -1)) >= 0:
            self.rows[told_row].causes.append(TurnCause(self._moment, row, self._moment))

    # -- turns ------------------------------------------------------------------------------------------------------

    def begins(self, cell: Cell, item: Any) -> Substitute | None:
        message = _message(cell, item)
        what, sender = _what(cell, item, message), item.sender if isinstance(item, Item) else None
        is_own = message is None or is_module_of_library(type(message).__module__)
        source, number = "" if sender is None else sender.path, len(self.rows)
        place = self._places.get(cell.node, "")
        row = ChartRow(cell.node.loop.time(), cell.path, source, what, is_library=is_own, place=place)
        row.sender_place = self._place_of(sender, place)
        self._moment += 1
        before = self.last.get(cell.path, -1)
        if before < 0:
            before = self.last.get(cell.path.rpartition("/")[0], -1)  # Who has started it.
        if before >= 0:
            row.causes.append(TurnCause(self._moment, before, self._moment))
        name = item.feed.name if isinstance(item, Fed) else type(message).__qualname__
        sent = None if message is None else self._taken(cell, item, source, _name(name))
        if sent is not None and sent.row >= 0:
            row.causes.append(TurnCause(self._moment, sent.row, sent.moment))
        if message is None:
            row.causes += self.orders.get(cell.path, ())
        if isinstance(item, TurnRemains):
            row.causes += self._behind_error(item.error)
        is_of_user = cell.actor is not None and not is_module_of_library(type(cell.actor).__module__)
        if type(item) is Ask:
            self._asked[id(item)] = item, number, sent
        self._open[cell] = OpenTurn(number, cell.life, _state(cell), is_of_user, sent)
        self.last[cell.path] = number
        self.rows.append(row)
        return None

    def _behind_error(self, error: BaseException | None) -> list[TurnCause]:
        """What the actors have done, or who has ordered them to stop, that an error names."""
        found: list[TurnCause] = []
        for path in paths_in(str(error)):
            found += self.orders.get(path, ())
            if path in self.last:
                found.append(TurnCause(self._moment, self.last[path], self._moment))
        return found

    def _taken(self, cell: Cell, item: Any, source: str, name: str) -> SentMessage | None:
        """Where the message of this turn was sent."""
        ways = [] if isinstance(item, Tick) else [(source, cell.path, name)]
        for way in (*ways, (cell.path, cell.path, name)):
            waiting = self._ways.get(way)
            if waiting:
                return waiting.popleft()
            if way in self._newest:  # It came twice, or again and again.
                return self._newest[way]
        return None

    def ended(self, cell: Cell, item: Any) -> None:
        turn = self._open.pop(cell, None)
        if turn is None:
            return
        row, before, sent = self.rows[turn.number], turn.state, turn.sent
        has_ended = cell.actor is None or cell.life != turn.life
        after = {} if has_ended else _state(cell)
        parts = [f"{name}: {before.get(name, '-')} -> {now}" for name, now in after.items() if before.get(name) != now]
        row.change = "its life ends" if has_ended else ", ".join(parts)
        row.crashed = has_ended
        row.is_library &= not (has_ended and turn.is_of_user)
        row.is_probe = isinstance(cell.actor, ProbeActor)
        if row.is_library and isinstance(item, FirstTurn | Fed) and _has_hook(cell.actor):
            row.what, row.is_library = "on_start", False
        if sent is not None and sent.is_ask and not has_ended and type(item) is not Ask:
            sent.is_answered = True
            self._tell(turn.number, row.sender, row.path)


def paths_in(text: str) -> list[str]:
    """What may be addresses in a text."""
    return PATH.findall(text)


def _name(qualname: str) -> str:
    """The last part of the name of a class, as a class or a store has it."""
    return qualname.rpartition(":")[2].rpartition(".")[2]


def _message(cell: Cell, item: Any) -> Message[Any] | None:
    """The message that a turn handles, decoded if a store or a frame has brought it."""
    message = message_of(item)
    if message is not None:
        return message
    packed = item.message if isinstance(item, Item) else None
    if isinstance(item, Fed) and packed is None and item.feed.name:
        packed = Parcel(item.feed.name, bytes(item.feed.body))
    if not isinstance(packed, Parcel):
        return None
    try:
        opened = cell.node.codec.opened(cell, packed)
    except HoldfastError:  # The chart says its class.
        return None
    return opened if isinstance(opened, Message) else None


def _what(cell: Cell, item: Any, message: Message[Any] | None) -> str:
    if isinstance(item, TurnRemains):
        return "its turn goes no further" if item.error is None else f"its turn raises {BRIEF.repr(item.error)}"
    return told(cell, item) if message is None else BRIEF.repr(message)


def _has_hook(actor: Any) -> bool:
    """Whether the `on_start` of an actor is its own."""
    return isinstance(actor, Actor) and not is_module_of_library(type(actor).on_start.__module__)


def _state(cell: Cell) -> dict[str, str]:
    """The variables of an actor, in brief. Reading them calls code of theirs, which may raise."""
    actor = cell.actor
    if actor is None or is_module_of_library(type(actor).__module__):  # What is ours is no news to its user.
        return {}
    found: dict[str, str] = {}
    for name, value in vars(actor).items():
        if name.startswith("__") or name in ("ctx", "_table"):
            continue
        try:
            found[name] = BRIEF.repr(value)
        except Exception as error:  # A repr of the user's: the chart says so and goes on.
            found[name] = f"<{type(error).__name__} in its repr>"
    return found
