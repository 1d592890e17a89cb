"""Turns that rest (for days, perhaps), in the way of what has to wait until nothing is inside: they are run again."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

from ...actors.errors import HoldfastError
from ..bricks.replica_orders import Withdraw

if TYPE_CHECKING:
    from .group import Group

LOOK_AGAIN: Final = 0.05
"""Seconds between two looks at whether the turn that is inside only rests."""
LEFT_WITHIN: Final = 5.0
"""Seconds in which a replica has to leave it."""


async def past_resting_turns(group: Group, future: asyncio.Future[Any]) -> None:
    """Wait for a future that ends when nothing is inside: whatever turn rests meanwhile is left, and sent again."""
    while not (await asyncio.wait((future,), timeout=LOOK_AGAIN))[0]:
        if group.switch.calls.rests.is_busy:
            await _withdraw(group)


async def _withdraw(group: Group) -> None:
    """Have the replicas leave it, the one that leads first: it knows whether more than that is out."""
    known, replicas = group.membership, group.replicas
    primary, members = known.primary, replicas.well()
    order = Withdraw(known.epoch, group.adaptation.config)
    if primary is None or not await _has_left(group, primary, order):
        return
    await asyncio.gather(*(_has_left(group, name, order) for name in members if name != primary))
    if known.primary == primary and known.epoch == order.epoch:  # Else whoever leads next is sent all of it anyway.
        group.withdraw()


async def _has_left(group: Group, name: str, order: Withdraw) -> bool:
    replicas = group.replicas
    life = replicas.life_of(name)
    try:
        return bool(await replicas.ask(name, order, LEFT_WITHIN))
    except HoldfastError as error:  # It may have left it, and nobody knows.
        if replicas.is_well(name):
            replicas.suspect(name, life, f"it could not leave a turn that rests: {error}")
        return False
