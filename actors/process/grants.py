"""To whom an actor may give orders from a process, and whom it has ordered so far that it may not order there.

In the root's process an actor orders whom it likes; in another one only those below it, and those to whom it is bound.
"""

from __future__ import annotations

from collections.abc import Iterable

from ..errors import CannotMove, NotGranted
from ..kernel.bindings import ordered_by, unclaimed
from ..kernel.cell import Cell
from .wire.worker_gate import is_at_or_below

MOST_NAMED = 8
"""Addresses that a sentence names."""


def check_orders(cell: Cell) -> None:
    """Raises CannotMove: an actor that is to live in a process has given orders that it may not give there."""
    if cell.host.place.is_here and (why := why_not_granted([cell], cell.path, _bound(cell))):
        raise CannotMove(cell.path, why)


def said_of_grants(path: str, home: str, granted: list[str]) -> str:
    """To whom an actor may give orders in a process, in a sentence.

    >>> said_of_grants("/a/gate", "/a/gate", [])
    'in a process /a/gate may give orders to nobody but those below /a/gate; all other orders are refused (NotGranted)'
    """
    others = _listed(granted)
    whom = f"{others} and those below these, and to those" if others else "nobody but those"
    return f"in a process {path} may give orders to {whom} below {home}; all other orders are refused (NotGranted)"


def why_not_granted(cells: Iterable[Cell], home: str, granted: Iterable[str]) -> str:
    """Why actors that go into the process of `home` would fail there by orders that they give; "" if none is known."""
    may = (home, *granted)
    given = dict.fromkeys(to for cell in cells for to in ordered_by(cell))
    refused = [to for to in given if not any(is_at_or_below(to, one) for one in may)]
    if not refused:
        return ""
    remedy = "bind it to them (bindings= in its spec, or change.bind), and use the bindings"
    return f"it has given orders to {_listed(refused)}, which a process may not ({NotGranted.__name__}): {remedy}"


def _bound(cell: Cell) -> list[str]:
    start = None if cell.more is None else cell.more.start
    recipe = () if start is None else start.kind._may_order(start, cell.path)
    return [*(to.path for to in unclaimed(cell).values()), *recipe]


def _listed(addresses: list[str]) -> str:
    more = len(addresses) - MOST_NAMED
    return ", ".join(addresses[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
