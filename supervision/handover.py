"""One supervisor takes the place of another: it begins without children, and goes on with those of the other one.

Of the old one it has the children, in their order, the flags, and the restarts that still count.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from ..actors.kernel.message import RuntimeOrder
from .children import STOPPED, UP

if TYPE_CHECKING:
    from .supervisor import Supervisor


class Account(msgspec.Struct, frozen=True):
    """What a supervisor leaves to the one that takes its place."""

    children: tuple[str, ...]
    """The ids of its children, in start order."""
    restarts: tuple[float, ...]
    """How many seconds ago each restart was that may still count, the oldest first."""


class TakeOver(RuntimeOrder[None]):
    """Go on in the place of another supervisor, whose children are yours by now."""

    account: Account


def why_occupied(supervisor: Supervisor) -> str:
    """What keeps a supervisor from giving its children away between two turns; "" if nothing does."""
    if any(not errand.is_over for errand in supervisor._errands):
        return "it is starting or stopping children"
    busy = next((one for one in supervisor._listed().values() if one.state not in (UP, STOPPED)), None)
    return "" if busy is None else f"its child {busy.spec.id!r} is {busy.state}"


def account_of(supervisor: Supervisor) -> Account:
    """What a supervisor leaves to the one that takes its place."""
    now = supervisor.ctx.cell.node.loop.time()
    return Account(tuple(supervisor._listed()), tuple(now - at for at in supervisor._restarts))


def take_over(supervisor: Supervisor, account: Account) -> None:
    """Have a supervisor go on with the children that it has got, in the order of the one that had them."""
    now, known = supervisor.ctx.cell.node.loop.time(), supervisor._children
    supervisor._restarts = tuple(sorted((*supervisor._restarts, *(now - ago for ago in account.restarts))))
    first = {name: known[name] for name in account.children if name in known}
    supervisor._children = {**first, **known}
