"""Erasing in a store that no system has open, such as a copy: what `system.erase` does in its own."""

from __future__ import annotations

import asyncio
import contextlib
from functools import partial

from ..actors.errors import SpecError
from ..actors.kernel.node import Node
from ..checkpoint.home.disposal import Erased
from ..checkpoint.home.homes import Homes
from ..checkpoint.journal import StoreEngine
from ..checkpoint.store_opening import check_system
from ..checkpoint.store_tools.kept_lives import apart
from .history.forgetting import telling_of
from .history.writer import HistoryWriter
from .mechanism_notes import MechanismNotes
from .specification import Specifications


async def erase_stored(engine: StoreEngine, address: str, *, dry_run: bool = False) -> Erased:
    """Forget everything that a store has of an address and of those below it; see `ActorSystem.erase`.

    Args:
        engine: the store, which is closed at the end.
        address: `/app/tenants/acme`; `app` is the name of the system.
        dry_run: only count what would be forgotten.

    Raises:
        SpecError: it is no address, or the store is another system's. StoreError: the store refused.
    """
    with contextlib.closing(engine):
        names = address.split("/")
        if len(names) < 3 or names[0] or not all(names[1:]):
            raise SpecError("erase", f"takes an address such as /app/tenants/acme, not {address!r}")
        check_system(engine, names[1])
        node = Node(names[1], asyncio.get_running_loop())
        homes = apart(node, engine)
        try:
            notes = MechanismNotes(homes), Specifications(homes, is_kept=True)
            homes.erasures.notes += [one.forget_below for one in notes]
            homes.erasures.history = partial(_forget_history, node, homes)
            if dry_run:
                return homes.erasures.counted(address)
            erased = await homes.erasures.erase(address, everything=True)
            await homes.settled()
            return erased
        finally:
            homes.close()


def _forget_history(node: Node, homes: Homes, top: str, dry_run: bool) -> int:
    writer = HistoryWriter(node, homes)
    numbers = telling_of(writer.stored(), top)
    if not dry_run:
        writer.forget(lambda event: event.number in numbers)
    return len(numbers)
