"""The asks of a node that have no answer yet: who waits for whom, wherever the asker and the asked live."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ..kernel.envelope import Ask
from .process_host import Outlet

if TYPE_CHECKING:
    from ..kernel.cell import Cell
    from ..kernel.node import Node


def open_asks(node: Node, most: int) -> list[tuple[Cell, Ask]]:
    """The asks without an outcome, each with the cell that is asked.

    Args:
        node: the root's; asks between two processes of actors pass it, too.
        most: cells and mailbox items that are looked at; asks that were made in this process are always found.
    """
    found: dict[int, tuple[Cell, Ask]] = {id(ask): (ask.to, ask) for ask in node.deadlines.waiting()}
    found.update((id(ask), (cell, ask)) for cell, ask in _in_mailboxes(node, most))
    return list(found.values())


def _in_mailboxes(node: Node, most: int) -> Iterator[tuple[Cell, Ask]]:
    """The asks that actors have in hand or in their mailboxes, also those that go from one process to another."""
    left, cells = most, [] if node.root is None else [node.root]
    while cells and left > 0:
        cell = cells.pop()
        cells.extend((cell.children or {}).values())
        items = [cell.item, *items_at(cell, left)]
        left -= len(items)
        yield from ((cell, item) for item in items if isinstance(item, Ask) and not item.is_done)


def items_at(cell: Cell, most: int) -> list[Any]:
    """What waits at an actor in this process, or was handed to its own and has no answer yet; at most so many."""
    outlet = outlet_of(cell)
    sent = [item for _, item in outlet.flight] if outlet is not None else []
    return list(itertools.islice(itertools.chain(sent, cell.queue or ()), most))


def outlet_of(cell: Cell) -> Outlet | None:
    """The way to the process that an actor lives in; None if it lives here."""
    outlet = cell.more.outlet if cell.more is not None else None
    return outlet if isinstance(outlet, Outlet) else None
