"""To whom an actor may give orders when it has come to live in a process, and whom it has ordered that it may not then.

In the root's process an actor orders whom it likes; in another one only those below it, and those to whom it is bound.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from ...actors.errors import CannotMove, NotGranted
from ...actors.kernel.bindings import unclaimed
from ...actors.kernel.given_orders import ordered_by
from ...actors.process.wire.worker_gate import is_at_or_below
from .mechanisms import OnPlace
from .operation import Operation, wrong
from .reparenting import Reparent

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from .draft import DraftPlace

MOST_NAMED = 8
"""Addresses that a sentence names."""


def look_at_grants(steps: Iterable[Operation]) -> None:
    """Have each step that takes an actor into a process say to whom that one may give orders there.

    Raises:
        SpecError: it has given orders to others so far.
    """
    for step in steps:
        place = step._found if isinstance(step, (OnPlace, Reparent)) else None
        if place is None or place.cell is None or place.is_leaving or not place.cell.host.place.is_here:
            continue
        home = _process_of(place)
        if home is None:
            continue
        granted = list(_granted(home))
        step.note = said_of_grants(place.path, home.path, granted)
        cells = [one.cell for one in place.walk() if one.cell is not None]
        if why := why_not_granted(cells, home.path, granted):
            raise wrong(place.path, why)


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


def _process_of(place: DraftPlace) -> DraftPlace | None:
    """Whose process a place will be in; None: that of the root."""
    for one in place.upwards():
        if one.spec is not None:
            if one.spec.isolation == "process" or one.spec.mechanism is not None:
                return one
        elif one.cell is not None and not one.cell.host.place.is_here:
            return one
    return None


def _granted(home: DraftPlace) -> Iterator[str]:
    """To whom the bindings of those in a process lead, and what its recipe grants."""
    seen = {home.path}
    for place in home.walk():
        start = None if place.spec is None else place.spec.start
        recipe = () if start is None else start.kind._may_order(start, place.path)
        for to in (*(one.path for one in place.bindings.values()), *recipe):
            if not any(is_at_or_below(to, one) for one in seen):
                seen.add(to)
                yield to


def _bound(cell: Cell) -> list[str]:
    start = None if cell.more is None else cell.more.start
    recipe = () if start is None else start.kind._may_order(start, cell.path)
    return [*(to.path for to in unclaimed(cell).values()), *recipe]


def _listed(addresses: list[str]) -> str:
    more = len(addresses) - MOST_NAMED
    return ", ".join(addresses[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
