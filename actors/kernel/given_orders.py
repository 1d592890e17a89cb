"""To whom an actor has given orders: noted where an order is carried out, or a life is ended, in the same process."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from .envelope import Item

if TYPE_CHECKING:
    from .actor import Actor
    from .cell import Cell
    from .message import Message

MOST: int = 64
"""Addresses that are noted of one actor; further ones are not."""


def note_order(giver: Cell, to: Cell) -> None:
    """Note that an actor has given an order to another one."""
    known = giver.extra().ordered
    if len(known) < MOST:
        known[to.path] = None


def ordered_by(giver: Cell) -> list[str]:
    """The addresses to which an actor has given orders since the system has begun, as far as this process knows."""
    return [] if giver.more is None or not giver.more.has_more else list(giver.more.ordered)


def noting(handler: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """The handler of an order, which notes who has given it."""

    @functools.wraps(handler)
    def turn(actor: Actor, message: Message[Any]) -> Any:
        item = actor.ctx._item
        if isinstance(item, Item) and item.sender is not None:
            note_order(item.sender, actor.ctx._cell)
        return handler(actor, message)

    return turn
