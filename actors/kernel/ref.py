"""Refs: the handles through which actors are reached."""

from __future__ import annotations

import asyncio
import contextvars
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeAlias

from typing_extensions import TypeVar

from ..errors import ActorRestarting, HoldfastError, SpecError, shown
from ..values.saved_refs import Addressed, hash_of_address
from .envelope import NO_DEADLINE, Ask, in_next_pass
from .message import Message

if TYPE_CHECKING:
    from .actor import Actor
    from .cell import Cell, Order
    from .context import ActorContext

A_co = TypeVar("A_co", bound="Actor", default=Any, covariant=True)
R = TypeVar("R")

Target: TypeAlias = "ActorRef[Any] | str"
"""Who is meant: a ref, or the address of whoever lives there by then."""

Restarting = Literal["wait", "fail"]
"""What an ask does at an actor that is between two lives."""

DEFAULT_TIMEOUT = 5.0
"""Seconds an ask waits when nothing else is said."""

current: contextvars.ContextVar[ActorContext] = contextvars.ContextVar("holdfast_current_actor")
"""The actor whose turn (or background task) this is. Set once in each life's own `contextvars.Context`."""


class ActorRef(Addressed, Generic[A_co]):
    """A handle on an address: it stays good over restarts, may travel in messages, and compares by address.

    What it sends takes one path: the address's `admit` (mailbox.py), its queue, and a turn (loop.py).
    """

    __slots__ = ("_cell", "_hash")

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._hash: int | None = None

    @property
    def path(self) -> str:
        """The address, such as `/app/bank/alice`."""
        return self._cell.path

    def tell(self, message: Message[Any]) -> None:
        """Send a message without waiting until it is accepted, and without a reply.

        Raises:
            UnknownMessage: the actor's class is known and has no handler for it.
            MailboxFull: the mailbox is bounded and refuses. Who cannot be told, because the mailbox is in another
                process, or the sender a recorded turn whose sends leave later, has a dead letter made of the message.
            BadMessage: the message cannot be coded and has to be.
            WrongThread, WrongLoop: the system runs in another thread, or in another loop of this one, and this call
                would have to wake it; see `ActorSystem.from_thread`. (While it is awake a tell from elsewhere to a task
                without recovery may pass unnoticed.)
        """
        cell = self._cell
        sender = current.get(None)
        if sender is None:
            cell.take_in(cell, message)
        else:
            sender._tell(cell, message)

    async def send(self, message: Message[Any]) -> None:
        """Send, and return when the message is accepted: the tell with back-pressure.

        Raises:
            ActorStopped: the address has ended for good.
            AskFailed: the process of its supervisor has ended, and nobody knows whether the message was accepted there.
            UnknownMessage, MailboxFull, BadMessage: as `tell`. WrongThread, WrongLoop: the system runs elsewhere.
        """
        cell = self._cell
        sender = current.get(None)
        if sender is not None:
            await sender._send(cell, message)
            return
        cell.node.check_caller(cell.path)
        while (room := cell.room()) is not None:
            await room
        if type(message) not in cell.table:
            cell.require(message)
        try:
            accepted = cell.offer(message)
        except HoldfastError:
            await asyncio.sleep(0)  # Who sends again and again leaves the loop to those for whom it waits.
            raise
        if accepted is not None:
            await accepted

    def ask(
        self, message: Message[R], timeout: float = DEFAULT_TIMEOUT, *, restarting: Restarting = "wait"
    ) -> asyncio.Future[R]:
        """Send now, and return an awaitable with exactly one outcome.

        Args:
            message: what is asked; its class declares the reply's type.
            timeout: seconds until the deadline, finite and > 0; it travels with the message, and runs on during
                recovery.
            restarting: "fail" sends nothing to an actor that is between two lives, or being recovered: the awaitable
                raises ActorRestarting. (Of actors in another process than the root an actor process knows too little:
                it waits. A recorded actor always waits, for its replay to do the same.)

        Returns:
            A future of the reply. Cancelling it ends the wait, never the turn.

        Raises:
            SpecError: the time-out is no such number. UnknownMessage, BadMessage: as `tell`. WrongThread, WrongLoop:
                the system runs elsewhere.

        Raises (by the awaitable):
            Refusal: the handler's typed "no".
            AskTimeout, ActorStopped, AskFailed, RemoteCrash, MailboxFull, AskDeadlock: see `errors.py`.
        """
        cell = self._cell
        sender = current.get(None)
        if restarting != "wait" and (failed := _restarting(cell, restarting, sender)) is not None:
            return failed
        if sender is not None:
            return sender._ask(cell, message, timeout)
        if type(message) not in cell.table:
            cell.require(message)
        node = cell.node
        node.check_caller(cell.path)
        future: asyncio.Future[R] = node.loop.create_future()
        ask = Ask(message, None, (), timeout, NO_DEADLINE, future, cell)
        node.deadlines.add(ask)
        try:
            cell.take_in(cell, ask)
        except BaseException:
            future.cancel()  # Refused at the call: nobody holds the future.
            raise
        return in_next_pass(future) if future.done() else future

    def stop(self) -> None:
        """Ask the actor to stop after what it has begun; a second stop is no error.

        In a turn of a recorded actor this is an output, which takes effect once, when the turn's outputs leave.

        Raises:
            NotGranted: the actor whose turn this is may not order that one from its process.
        """
        self._order("stop")

    def kill(self) -> None:
        """End this life at once, without its hooks. A supervisor treats it as a crash.

        If the actor is recorded, the message in its turn counts it against `max_deliveries`, as any death.
        In a turn of a recorded actor this is an output, as is `stop`.

        Raises:
            NotGranted: as `stop`.
        """
        self._order("kill")

    def _order(self, order: Order) -> None:
        cell, caller = self._cell, current.get(None)
        if caller is not None:
            caller._order(cell, order)
            return
        cell.node.check_caller(cell.path)
        cell.obey(order, "")

    def __repr__(self) -> str:
        return f"<ActorRef {self.path}>"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ActorRef):
            return NotImplemented
        theirs: Cell = other._cell
        return theirs is self._cell or (theirs.node is self._cell.node and theirs.path == self._cell.path)

    def __hash__(self) -> int:
        found = self._hash
        if found is None:
            found = self._hash = hash_of_address(self._cell.path)
        return found


def cell_of(where: str, ref: object) -> Cell:
    """The cell that a ref leads to.

    Args:
        where: the call that it was given to.
        ref: what was given.

    Raises:
        SpecError: it is no ref, and how to come by one.
    """
    if isinstance(ref, ActorRef):
        cell: Cell = ref._cell
        return cell
    hint = shown(ref) if isinstance(ref, str) and ref.startswith("/") else "'/ADDRESS'"
    find = f"ctx.find({hint}, Class), or system.ref({hint}, Class), makes one of an address"
    raise SpecError(where, f"takes a ref, not {shown(ref)}: {find}")


def _restarting(cell: Cell, restarting: str, sender: ActorContext | None) -> asyncio.Future[Any] | None:
    """The failed ask to an actor that is not up now; None if the ask is to be made."""
    if restarting != "fail":
        raise SpecError("ask", f"restarting must be 'wait' or 'fail', not {restarting!r}")
    if cell.is_dead or cell.host.is_up(cell) or (sender is not None and not sender._may_fail_fast):
        return None
    future: asyncio.Future[Any] = cell.node.loop.create_future()
    future.set_exception(ActorRestarting(cell.path))
    return in_next_pass(future)
