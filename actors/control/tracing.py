"""A tap on one actor: what it counts (`statistics`) and tells (`trace`).

While nobody looks there is no tap, and nothing is tested for one: handlers are looked up in another table, messages are
let in by another function, and `ctx` is of another class, for as long as the tap is on.
"""

from __future__ import annotations

import bisect
import dataclasses
import time
import types
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, cast

from ..errors import type_name
from ..events import EventHub, EventStream, MessageIn, MessageOut, TurnBegan, TurnEnded
from ..kernel import mailbox
from ..kernel.codec import Parcel
from ..kernel.context import ActorContext
from ..kernel.envelope import Handler, Item, Table, message_in, unhandled
from ..kernel.message import Message, Refusal

if TYPE_CHECKING:
    from ..kernel.cell import Admit, Cell

Coroutine_ = types.CoroutineType
TURN_BOUNDS: Final = (
    *(0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05),
    *(0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 25.0, 60.0),
)
"""Upper bounds in seconds by which turns are counted."""


@dataclasses.dataclass(frozen=True, slots=True)
class Statistics:
    """The counts of an actor's messages and turns since its statistics were switched on."""

    since: float
    """Unix time at which they were."""
    messages_in: int
    """Messages let into its mailbox."""
    messages_out: int
    """Messages it sent; replies are not among them."""
    turns: int
    """Messages it has handled to their end."""
    turn_seconds: float
    """How long those turns took altogether, waiting included."""
    longest_turn: float
    """How long the longest took, in seconds."""
    restarts: int
    """Lives that began since."""
    turn_times: tuple[int, ...] = (0,) * (len(TURN_BOUNDS) + 1)
    """How many turns took at most each of `TURN_BOUNDS` and more than the one before, and how many took longer."""

    def turn_quantile(self, share: float) -> float:
        """Tell within how many seconds this share of the turns (0.99: 99 %) has ended; 0.0 if there was none.

        It is the bound of `turn_times` that they kept, so it is at most two and a half times what it was, or 0.1 ms.
        """
        wanted = share * sum(self.turn_times)
        so_far = 0
        for bound, count in zip(TURN_BOUNDS, self.turn_times, strict=False):
            so_far += count
            if so_far >= wanted:
                return min(bound, self.longest_turn)
        return self.longest_turn


class TurnTap:
    """Counts and tells for one address; it outlives the lives there."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.counting = False
        self.hub = EventHub(self._listened_to)
        self.forget: Callable[[], None] = lambda: None  # called when nobody follows any more
        self._inner: Admit | None = None
        self._admit: Admit = self._admitted
        self._begin = 0.0
        self._tracing = False
        self._zero()

    def _zero(self) -> None:
        self._since, self._life = self.cell.node.clock.wall(), self.cell.life
        self._in = self._out = self._turns = 0
        self._seconds = self._longest = 0.0
        self._times = [0] * (len(TURN_BOUNDS) + 1)
        self._slowest, self._slowest_life = ("", 0.0), 0

    # -- on and off -------------------------------------------------------------------------------------------------

    def switch(self, counting: bool | None, tracing: bool | None) -> Statistics | None:
        """Begin or end counting and telling; None leaves it. Returns the counts if they are kept."""
        if tracing is not None:
            self._tracing = tracing
        if counting is not None:
            if counting and not self.counting:
                self._zero()
            self.counting = counting
        if self.is_on:
            self.attach()
        else:
            self.detach()
        return self.counts() if self.counting else None

    @property
    def is_on(self) -> bool:
        """Whether anybody wants to know."""
        return self.counting or self._tracing

    @property
    def wanted(self) -> dict[str, bool]:
        """What a new process of this actor has to be told."""
        return {"counting": self.counting, "tracing": self._tracing}

    def listen(self) -> EventStream:
        """Make a stream of what happens at the address from now on."""
        return self.hub.listen()

    def _listened_to(self, anybody: bool) -> None:
        self._tracing = anybody
        if not anybody:
            self.switch(None, None)
            self.forget()

    def close(self) -> None:
        """The address is gone: nothing more comes."""
        self.forget = lambda: None
        self.hub.close()

    def counts(self) -> Statistics:
        """The counts since statistics were switched on."""
        restarts = self.cell.life - self._life
        times = tuple(self._times)
        return Statistics(self._since, self._in, self._out, self._turns, self._seconds, self._longest, restarts, times)

    @property
    def slowest(self) -> tuple[str, float]:
        """The message type of the longest turn of the present or last life that was counted, and its seconds."""
        return self._slowest if self._slowest_life == self.cell.life else ("", 0.0)

    # -- where it is put in -----------------------------------------------------------------------------------------

    def attach(self) -> None:
        """Put the tap in, or what of it the present life and home lack."""
        if not self.is_on:
            return
        cell = self.cell
        actor: Any = cell.actor
        if actor is not None and cell.ctx is not None:
            actor._table = cell.table = TappedTable(type(actor)._table, self)
            kind = type(cell.ctx)
            if not issubclass(kind, TappedContext):
                _set_class(cell.ctx, _tapped(kind))
        node = cell.node
        if node.ports.uplink is not None and cell is node.root:
            return  # Its home is in another process: the messages are let in there.
        if cell.admit is not self._admit:
            if cell.admit is mailbox.admit_first:
                mailbox.queue_of(cell)
            self._inner, cell.admit = cell.admit, self._admit

    def detach(self) -> None:
        """Take the tap out of the actor's path, which costs nothing from then on."""
        cell = self.cell
        actor: Any = cell.actor
        if actor is not None and cell.ctx is not None:
            vars(actor).pop("_table", None)
            cell.table = type(actor)._table
            kind = type(cell.ctx)
            if issubclass(kind, TappedContext):
                _set_class(cell.ctx, kind.__bases__[1])
        if cell.admit is self._admit and self._inner is not None:
            cell.admit, self._inner = self._inner, None

    # -- what it sees -----------------------------------------------------------------------------------------------

    def _tell(self, event: Any) -> None:
        """To those who follow: here, or through the root."""
        if not self._tracing:
            return
        if self.cell.node.ports.uplink is not None:
            self.cell.node.emit(event)
        else:
            self.hub.emit(event)

    def _admitted(self, cell: Cell, item: Any) -> None:
        assert self._inner is not None
        self._inner(cell, item)  # First: it may refuse.
        self._in += 1
        self._tell(MessageIn(cell.path, _message(item)))

    def sent(self, to: str, message: object) -> None:
        """The actor has sent something."""
        self._out += 1
        self._tell(MessageOut(self.cell.path, to, message))

    @property
    def sent_so_far(self) -> int:
        """How many messages it has sent."""
        return self._out

    def begun(self, message: object) -> None:
        """Count and tell that a turn begins."""
        self._begin = time.perf_counter()
        self._tell(TurnBegan(self.cell.path, message))

    def ended(self, message: object, outcome: str) -> None:
        """Count and tell that a turn is over."""
        seconds = time.perf_counter() - self._begin
        self._turns += 1
        self._seconds += seconds
        self._times[bisect.bisect_left(TURN_BOUNDS, seconds)] += 1
        self._longest = max(self._longest, seconds)
        if self._slowest_life != self.cell.life or seconds > self._slowest[1]:
            self._slowest, self._slowest_life = (type_name(type(message)), seconds), self.cell.life
        self._tell(TurnEnded(self.cell.path, message, seconds, outcome))


def tap_of(cell: Cell) -> TurnTap:
    """The tap of an address, made now if there was none."""
    more = cell.extra()
    if more.tap is None:
        more.tap = TurnTap(cell)
    return more.tap


def _message(item: Any) -> object:
    message = message_in(item)
    return message.name.replace(":", ".") if isinstance(message, Parcel) else message


class TappedTable(Table):
    """A class's table with a look at every handler's begin and end."""

    def __init__(self, table: Table, tap: TurnTap) -> None:
        super().__init__()
        for kind, handler in table.items():
            self[kind] = handler if issubclass(kind, Item) else _watched(handler, tap)
        self._table, self._tap = table, tap

    def __missing__(self, kind: type) -> Handler:
        handler = self._table[kind]
        if handler is unhandled:
            return handler
        self[kind] = handler if issubclass(kind, Item) else _watched(handler, self._tap)
        return self[kind]


def _watched(handler: Handler, tap: TurnTap) -> Handler:
    def turn(actor: Any, message: Any) -> object:
        tap.begun(message)
        try:
            result = handler(actor, message)
        except BaseException as error:
            tap.ended(message, _outcome(error))
            raise
        if type(result) is Coroutine_:
            return _followed(result, message, tap)
        tap.ended(message, "done")
        return result

    return turn


async def _followed(turn: Any, message: Any, tap: TurnTap) -> object:
    try:
        result = await turn
    except BaseException as error:
        tap.ended(message, _outcome(error))
        raise
    tap.ended(message, "done")
    return result


def _outcome(error: BaseException) -> str:
    return "refused" if isinstance(error, Refusal) else f"crashed: {type(error).__name__}"


# -- what an actor sends ----------------------------------------------------------------------------------------------


class TappedContext:
    """What is laid over the class of a `ctx` to see what its actor sends."""

    __slots__ = ()

    def _tell(self, cell: Cell, message: Message[Any]) -> None:
        """Count and tell a message that goes out, and send it as the context does."""
        _own(self)._tell(cell, message)
        _tap(self).sent(cell.path, message)

    async def _send(self, cell: Cell, message: Message[Any]) -> None:
        """Count and tell a message that goes out, and send it as the context does."""
        await _own(self)._send(cell, message)
        _tap(self).sent(cell.path, message)

    def _ask(self, cell: Cell, message: Message[Any], timeout: float) -> Any:
        """Count and tell a message that goes out, and ask as the context does."""
        reply = _own(self)._ask(cell, message, timeout)
        _tap(self).sent(cell.path, message)
        return reply

    async def publish(self, topic: str, message: Message[Any]) -> None:
        """As the context's own: counted for each subscriber that is sent to from here, else once."""
        tap = _tap(self)
        before = tap.sent_so_far
        await _own(self).publish(topic, message)
        if tap.sent_so_far == before:
            tap.sent(topic, message)


def _own(ctx: Any) -> Any:
    return super(TappedContext, ctx)


def _tap(ctx: Any) -> TurnTap:
    return tap_of(ctx._cell)


def _tapped(kind: type[ActorContext]) -> type[ActorContext]:
    return cast("type[ActorContext]", type("TappedContext", (TappedContext, kind), {"__slots__": ()}))


def _set_class(ctx: ActorContext, kind: type) -> None:
    cast("Any", ctx).__class__ = kind
