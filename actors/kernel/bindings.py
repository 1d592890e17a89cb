"""Bindings: named ports of an actor that the runtime can point elsewhere; and whom an actor has given orders."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast, overload

from ..errors import HoldfastError
from .envelope import Item

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from .actor import Actor
    from .cell import Cell
    from .message import Message
    from .ref import ActorRef

A_co = TypeVar("A_co", bound="Actor", covariant=True)


class Unbound(HoldfastError, text="{actor}.{port} is not bound; bind it in the child spec or with system.bind()"):
    """A binding was used before anything was bound to it."""

    actor: str
    port: str


class Binding(Generic[A_co]):
    """A port declared in the class body (`teller: Binding[Account]`); reading it gives the bound `ActorRef`.

    It is re-pointed between turns of its owner, so one turn sees one target.
    """

    __slots__ = ("_name",)

    def __init__(self) -> None:
        self._name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, actor: None, owner: type) -> Binding[A_co]: ...
    @overload
    def __get__(self, actor: Actor, owner: type) -> ActorRef[A_co]: ...
    def __get__(self, actor: Actor | None, owner: type) -> Binding[A_co] | ActorRef[A_co]:
        if actor is None:
            return self
        bound = actor.ctx._bound(self._name)
        if bound is None:
            raise Unbound(actor.ctx.path, self._name)
        return cast("ActorRef[A_co]", bound)

    def __set__(self, actor: Any, target: Any) -> None:
        raise AttributeError(f"binding {self._name!r} is set by the runtime: use system.bind()")


# -- claims: what another process says of its own actors ------------------------------------------------------------
#
# To whoever looks at the structure a claim is a binding like any other. It grants nothing: otherwise a process could
# grant itself any address. `More.claimed` has the ports of which nothing else is known.


def claim(cell: Cell, told: Mapping[str, str]) -> None:
    """Take an actor process's word for where the bindings of one of its actors lead: ports to addresses.

    What was bound here stands: the process has been told, or will be.
    """
    more = cell.more
    if more is None and not told:
        return
    more = cell.extra()
    for port in more.claimed - told.keys():
        more.bindings.pop(port, None)
    more.claimed = frozenset(port for port in told if port in more.claimed or port not in more.bindings)
    for port in more.claimed:
        more.bindings[port] = cell.node.cell_at(told[port])


def doubt(cell: Cell) -> None:
    """What was bound here has ended with an actor process: what the next one says will count."""
    more = cell.more
    if more is not None:
        more.claimed = frozenset(more.bindings)


def settle_claims(cell: Cell, named: Mapping[str, str]) -> None:
    """Have the bindings that a spec of this process names lead where it says, unless they were bound anew here."""
    more = cell.extra()
    for port, path in named.items():
        if port in more.claimed or port not in more.bindings:
            more.bindings[port] = cell.node.cell_at(path)
    more.claimed -= named.keys()


def unclaimed(cell: Cell) -> dict[str, Cell]:
    """The bindings that were made here, which grant what they lead to."""
    more = cell.more
    return {} if more is None else {port: to for port, to in more.bindings.items() if port not in more.claimed}


# -- whom an actor has ordered: from another process it may order those alone whom a binding grants ------------------

MOST_ORDERED: int = 64
"""Addresses that are noted of one actor; further ones are not."""


def note_order(giver: Cell, to: Cell) -> None:
    """Note that an actor has given an order to another one."""
    known = giver.extra().ties.ordered
    if len(known) < MOST_ORDERED:
        known[to.path] = None


def ordered_by(giver: Cell) -> list[str]:
    """The addresses to which an actor has given orders since the system has begun, as far as this process knows."""
    return [] if giver.more is None or not giver.more.has_more else list(giver.more.ties.ordered)


def noting(handler: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """The handler of an order, which notes who has given it."""

    @functools.wraps(handler)
    def turn(actor: Actor, message: Message[Any]) -> Any:
        item = actor.ctx._item
        if isinstance(item, Item) and item.sender is not None:
            note_order(item.sender, actor.ctx._cell)
        return handler(actor, message)

    return turn
