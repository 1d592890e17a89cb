"""The items that stand in a mailbox: bare messages, envelopes, asks, and the runtime's own.

The run loop knows nothing of these kinds. It looks up `table[type(item)]` and calls what it finds: a user's handler
for a message, `run` for everything else.
"""

from __future__ import annotations

import asyncio
import types
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import msgspec

from ..errors import AskTimeout, BadMessage, HoldfastError, SpecError, UnknownMessage, shown, type_name
from ..values.saved_refs import OneOfItsKind
from .message import Message, MessageText, Refusal, descended, message_name, message_of

if TYPE_CHECKING:
    from ..exit_reasons import ExitReason
    from .cell import Cell
    from .context import ActorContext

R = TypeVar("R")

Chain = tuple[tuple[str, int], ...]
"""Who waits for this ask, nearest first: (address, turn)."""

LEAVE = object()
"""Returned by an item that took its actor off the run queue: the loop goes on with the next actor."""


class Item:
    """Anything in a mailbox that is no message: it runs itself, in its turn."""

    __slots__ = ()
    of_life: ClassVar[bool] = True
    """Whether it concerns one life only, and is dropped when that ends; messages stay with the address."""
    is_command: ClassVar[bool] = False
    """Whether it stands at the front of the queue for a command, ahead of all messages."""
    ends_turn: ClassVar[bool] = False
    """Whether it is what is left of the turn before: nothing, not even a command, comes between the two."""
    message: Any = None
    """The message that it brings, if it does."""
    sender: Any = None
    """The cell of the actor that has sent it, if one has."""
    chain: Chain = ()
    """The turns that wait for its turn."""
    is_ask: bool = False
    """Whether somebody waits for an answer to it."""
    comes_again: ClassVar[bool] = False
    """Whether the life at another place is told of it, too: a move does not wait until it was obeyed."""
    is_followed: ClassVar[bool] = False
    """Whether its turn is a span of a trace."""
    is_cancelled: bool = False
    """Whether it has come to nothing while it waited, so that its turn does nothing."""
    stops: ExitReason | None = None
    """Why the life has to end in good order, if that is what it commands."""

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        """Do the item's work; a coroutine is stepped by the loop, LEAVE takes the actor off the run queue."""
        raise TypeError(f"{type(item).__name__} cannot be run")

    def undelivered(self, cell: Cell, reason: str) -> None:
        """The address is gone before the item's turn came."""

    def hook(self) -> str:
        """The actor's hook that it calls, if that is what it does."""
        return ""

    def brings(self) -> str:
        """The type of the message that it brings."""
        return type_name(type(self.message))

    def stashed(self) -> None:
        """Its turn puts it aside: it will come again, out of its order."""

    def fail(self, error: Any) -> None:
        """Its turn has crashed the actor: whoever waits for it hears of that."""

    def ignored(self, cell: Cell, why: str) -> bool:
        """Its turn has said that the actor does not want to live; False: it may not say that."""
        return False

    def is_start(self) -> bool:
        """Whether its turn is the start of a life: if that fails, there is nothing that `on_stop` could take down."""
        return False


def item_name(item: object) -> str:
    """What a mailbox item is, in a word: the type of the message in it, or the hook that it runs."""
    if isinstance(item, MessageText):
        return item.type_name
    message = message_of(item)
    if message is not None:
        return type_name(type(message))
    return (item.hook() if isinstance(item, Item) else "") or type_name(type(item))


Handler = Callable[[Any, Any], object]


class Table(dict[type, Handler]):
    """Handlers by the type of what stands in the mailbox.

    Items run themselves, and a derived message goes to the handler of its base; both are found once and remembered.
    """

    def __init__(self) -> None:
        super().__init__({Envelope: Envelope.run, Ask: Ask.run})
        self.named: dict[str, type[Message[Any]]] = {}  # found by wire name so far; the codec's

    def __missing__(self, kind: type) -> Handler:
        if issubclass(kind, Item):
            self[kind] = kind.run
        else:
            found = next((self[base] for base in kind.__mro__[1:] if base in self), None)
            if found is None:
                return unhandled  # Not remembered: what is in the table is admitted without another look.
            self[kind] = found
        return self[kind]

    def knows(self, kind: type) -> bool:
        """Whether messages of this type have a handler."""
        return self[kind] is not unhandled

    def kind_named(self, name: str) -> type[Message[Any]]:
        """The handled message type with this wire name, or one that is loaded and descends from such a type.

        Raises:
            UnknownMessage: there is none.
        """
        kind = self.named.get(name)
        if kind is None:
            handled = [known for known in self if issubclass(known, Message)]
            kind = next((one for one in descended(*handled) if message_name(one) == name), None)
            if kind is None:
                raise UnknownMessage("the actor", name.replace(":", "."))
            self.named[name] = kind
            self[kind]  # Whoever looks for its handler finds that in the table.
        return kind


class AnyTable(Table):
    """The table of an actor whose class is not known here: its home decides what is unknown."""

    def __contains__(self, kind: object) -> bool:
        return True

    def knows(self, kind: type) -> bool:
        return True


def message_in(item: Any) -> Any:
    """What an entry of a mailbox brings: a message is its own item, and its fields may have any names.

    What brings none is that itself.
    """
    return item.message if isinstance(item, Item) and item.message is not None else item


def chain_of(item: Any) -> Chain:
    """The turns that wait for the turn of an entry of a mailbox."""
    return item.chain if isinstance(item, Item) else ()


def waiters(chain: Chain) -> tuple[str, ...]:
    """The addresses of the turns in a chain; what may stand behind them is none."""
    return tuple(path for path, _ in chain if path.startswith("/"))


def unhandled(actor: Any, message: Any) -> object:
    """Stands in the table for types without a handler."""
    ctx: ActorContext = actor.ctx
    cell = ctx._cell
    sender = cell.item.sender if isinstance(cell.item, Item) else None
    cell.node.dead_letter(cell, message, f"{type(actor).__name__} has no handler for it", sender)
    return None


class Envelope(Item, msgspec.Struct, eq=False):
    """A message whose sender is known. (A struct, as an ask is: it is made with every send, and made at once.)"""

    of_life = False

    message: Any
    sender: Any  # the sending actor's Cell

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        message = item.message
        return actor._table[type(message)](actor, message)

    def undelivered(self, cell: Cell, reason: str) -> None:
        cell.undelivered(self.message, reason, self.sender)


Coroutine_ = types.CoroutineType


NO_DEADLINE = 0.0
"""Of an ask that has none yet: `Deadlines.add` sets it."""


class Ask(Item, msgspec.Struct, eq=False):
    """A message that somebody waits for: exactly one outcome reaches `future`."""

    of_life = False
    is_ask = True

    message: Any
    sender: Any  # the asking actor's Cell; None from outside
    chain: Chain
    timeout: float
    deadline: float  # on the loop's clock
    future: Any  # asyncio.Future; what else there may be has `done()` too
    to: Any = None  # the Cell that is asked
    started: int = False  # True: a turn may have begun; a number: it was handed on so, and the host of `to` may know

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        cell: Cell = actor.ctx._cell
        if item.deadline <= cell.node.now:  # Nobody waits any more: not run (unless the wait was only cancelled).
            item.expire()
            return None
        item.started = True
        message = item.message
        handler = actor._table[type(message)]
        if handler is unhandled:
            item.fail(UnknownMessage(cell.path, type_name(type(message))))
            return None
        try:
            result = handler(actor, message)
        except Refusal as no:
            item.fail(no)
            return None
        if type(result) is Coroutine_:
            return _finish(cell, item, result)
        if cell.item is item:  # Else the ask was forwarded or stashed: it is not ours to answer any more.
            item.answer(result)
        return None

    @property
    def is_done(self) -> bool:
        """Whether the outcome is known, or nobody waits for it."""
        return self.future.done()  # type: ignore[no-any-return]  # a bool, of whatever future it is

    def answer(self, reply: object) -> None:
        """Hand the reply to the asker; a late one is dropped and counted."""
        if type(reply) is AskHandle:
            return  # The handler keeps the handle and answers later.
        if not self.future.done():
            self.future.set_result(reply)
        elif self.to is not None:
            self.to.node.numbers.late_replies += 1

    def fail(self, error: BaseException) -> None:
        """End the wait with a typed failure."""
        if not self.future.done():
            self.future.set_exception(error)
            self.tell_failure(error)

    def tell_failure(self, error: BaseException) -> None:
        """Tell whoever watches the asks of the node that this one has failed."""
        if self.to is not None and (watcher := self.to.node.deadlines.watcher) is not None:
            watcher(self, error)

    def expire(self) -> None:
        """The deadline has passed; a turn that has not begun will not begin."""
        started = self.started
        is_sure = not started or (started is not True and not self.to.host.may_have_begun(self.to, self))
        self.deadline = 0.0
        if started and is_sure:
            self.to.host.withdraw(self.to, self, self._end_late)
        else:
            self._end_late(is_sure)

    def _end_late(self, is_sure: bool) -> None:
        """Fail as an ask whose time is over; `is_sure`: its turn has not begun, and never will."""
        why = "" if is_sure else self.to.host.holds_back(self.to)
        self.fail(AskTimeout(self.to.path, self.timeout, False if is_sure else None, why))

    def undelivered(self, cell: Cell, reason: str) -> None:
        self.fail(cell.stopped_error(reason))


def in_next_pass(outcome: asyncio.Future[R]) -> asyncio.Future[R]:
    """The same outcome, in the next pass of the loop.

    An ask that is refused at the call ends so: who asks again and again until it gets through leaves the loop to those
    for whom it waits.
    """
    later: asyncio.Future[R] = outcome.get_loop().create_future()
    outcome.get_loop().call_soon(_hand_on, outcome, later)
    return later


def _hand_on(outcome: asyncio.Future[Any], later: asyncio.Future[Any]) -> None:
    error = outcome.exception()
    if later.done():
        return
    if error is not None:
        later.set_exception(error)
    else:
        later.set_result(outcome.result())


async def _finish(cell: Cell, ask: Ask, handler: Coroutine[Any, Any, object]) -> None:
    """The turn of an async handler that was asked."""
    try:
        reply = await handler
    except Refusal as no:
        ask.fail(no)
    else:
        if cell.item is ask:
            ask.answer(reply)


class ReplyHandle(OneOfItsKind, Generic[R]):
    """The right to answer one ask later, from `ctx.reply_handle`, for the actor that was asked.

    `return self.ctx.reply_handle()` ends the turn without a reply. The actor keeps the handle, in a key variable if it
    has recovery, until it answers; a handle of an ask that is over does nothing. It cannot be sent from one process to
    another, nor by an actor with recovery: `ctx.forward` has another actor answer.
    """

    __slots__ = ()

    def reply(self, value: R) -> None:
        """Answer with a value; a second answer and one after the deadline are dropped."""
        raise NotImplementedError

    def fail(self, error: HoldfastError) -> None:
        """Answer with a Refusal, or another error of the library, which the asker's `await` raises.

        Raises:
            SpecError: it is no such error.
        """
        raise NotImplementedError


def require_error(error: object) -> None:
    """Refuse what is no answer by an error. Raises SpecError."""
    if not isinstance(error, HoldfastError):
        if isinstance(error, type) and issubclass(error, HoldfastError):
            hint = f"give an instance, {error.__name__}(...)"
        else:
            hint = "derive a class of your own from hf.Refusal, or raise the exception in the turn, which is a crash"
        raise SpecError("ReplyHandle.fail", f"takes a Refusal or another HoldfastError, not {shown(error)}: {hint}")


class AskHandle(ReplyHandle[R]):
    """The right to answer an ask of which this process has the asker's end."""

    __slots__ = ("_ask",)

    def __init__(self, ask: Ask | None) -> None:
        self._ask = ask

    @property
    def ask(self) -> Ask | None:
        """The ask that is to be answered; None if nobody waits."""
        return self._ask

    def reply(self, value: R) -> None:
        if self._ask is not None:
            self._ask.answer(value)

    def fail(self, error: HoldfastError) -> None:
        require_error(error)
        if self._ask is not None:
            self._ask.fail(error)


def refuse(ctx: ActorContext, error: HoldfastError) -> ReplyHandle[Any]:
    """Answer the call in hand with an error; if nobody has asked, that is logged. The actor goes on."""
    handle: ReplyHandle[Any] = ctx.reply_handle()
    fail(ctx, handle, ctx._item, error)
    return handle


def fail(ctx: ActorContext, handle: ReplyHandle[Any], item: object, error: HoldfastError) -> None:
    """Answer by an error through a handle for `item`; if nobody has asked, and it is the call that is wrong, log it."""
    handle.fail(error)
    if isinstance(handle, AskHandle) and handle.ask is None and isinstance(error, (Refusal, BadMessage, SpecError)):
        ctx._cell.node.refused(ctx._cell, item, error)
