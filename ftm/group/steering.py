"""Steers a protected actor besides its messages: orders go to the leader, bindings to every replica.

A turn that rests (for days, perhaps) in the way of what has to wait until nothing is inside is left, and run again.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

from ...actors.control.orders import Conclude, Prepare, Ready, ReplaceCode, ReplaceState, Resume, Suspend
from ...actors.control.orders_lane import QueuedOrder, send_call
from ...actors.errors import ControlFailed, HoldfastError
from ...actors.kernel import mailbox
from ...actors.kernel.cell import Cell
from ...actors.process.wire import frames
from ..bricks.replica_orders import Withdraw

if TYPE_CHECKING:
    from .group import Group
    from .replicas import Replicas

AGAIN_AFTER = 0.01
"""Seconds after which an order is given again that nobody could take."""
LOOK_AGAIN: Final = 0.05
"""Seconds between two looks at whether the turn that is inside only rests."""
LEFT_WITHIN: Final = 5.0
"""Seconds in which a replica has to leave it."""


def give_order(group: Group | None, cell: Cell, call: QueuedOrder) -> None:
    """Give an order to the actor of the replica that leads; what would change one replica alone is refused.

    `group`: None if the actor is not up.
    """
    ask = call.ask
    if isinstance(call.order, (ReplaceState, ReplaceCode, Prepare, Conclude)):
        why = "it is protected, and all replicas have to be alike: `protect` it by None first, and again after that"
        ask.fail(ControlFailed(cell.path, call.order.verb, why))
        return
    primary = None if group is None else group.membership.primary
    if group is None or primary is None:
        cell.node.loop.call_later(AGAIN_AFTER, give_again, cell, call)
        return
    if isinstance(call.order, Ready):
        call.give(None)
        return
    if isinstance(call.order, (Suspend, Resume)):
        is_suspended = group.delivery.is_suspended = isinstance(call.order, Suspend)
        cell.extra().suspended = mailbox.BY_USER if is_suspended else 0
        group.poke()
        call.give(None)
        return
    worker = group.replicas.worker_of(primary)
    if worker is None:
        ask.fail(ControlFailed(cell.path, call.order.verb, "the replica that leads has just ended; try again"))
        return
    send_call(worker, group.replicas.place(f"{primary}/server"), call)


def bind(replicas: Replicas, name: str, data: dict[str, Any]) -> None:
    """Tell a replica of a binding."""
    worker = replicas.worker_of(name)
    if worker is not None and replicas.life_of(name):
        to = worker.connection.names.to_wire(replicas.place(f"{name}/server"))
        worker.connection.send(frames.Command(to, "bind", data))


def bind_again(replicas: Replicas, name: str) -> None:
    """Tell a replica that was started again what was bound since the first start."""
    more = replicas.cell.extra()
    for port, target in more.bindings.items():
        data = {"port": port, "target": target.path, "is_claimed": port in more.claimed}
        bind(replicas, name, data)


def give_again(cell: Cell, call: QueuedOrder) -> None:
    """An order had to wait until somebody leads: give it to whoever lives there now, if it is still waited for."""
    if call.ask.is_done:
        return
    if cell.is_dead:
        call.ask.undelivered(cell, "it has ended")
    else:
        cell.host.control(cell, call)


async def past_resting_turns(group: Group, future: asyncio.Future[Any]) -> None:
    """Wait for a future that ends when nothing is inside: whatever turn rests meanwhile is left, and sent again."""
    while not (await asyncio.wait((future,), timeout=LOOK_AGAIN))[0]:
        await leave_resting(group)


async def leave_resting(group: Group) -> None:
    """Have the turn that is inside left if it only rests: it is sent again when something may go in."""
    if group.switch.calls.rests.is_busy or group.switch.calls.stranded():
        # Whoever waits may give up; what the replicas have left is sent again all the same.
        await asyncio.shield(asyncio.ensure_future(_withdraw(group)))


async def _withdraw(group: Group) -> None:
    """Have the replicas leave it, the one that leads first: it knows whether more than that is out."""
    known, replicas = group.membership, group.replicas
    primary, members = known.primary, replicas.well()
    order = Withdraw(known.epoch, group.adaptation.config, group.switch.ledger.begun, group.switch.calls.stranded())
    if primary is None or not await _has_left(group, primary, order):
        return
    await asyncio.gather(*(_has_left(group, name, order) for name in members if name != primary))
    is_elsewhere = group.switch.life.port is not group  # Meanwhile, and perhaps the turn rests there.
    if known.primary == primary and known.epoch == order.epoch and not is_elsewhere:
        group.withdraw()  # Else whoever goes on is sent all of it anyway.


async def _has_left(group: Group, name: str, order: Withdraw) -> bool:
    replicas = group.replicas
    life = replicas.life_of(name)
    try:
        return bool(await replicas.ask(name, order, LEFT_WITHIN))
    except HoldfastError as error:  # It may have left it, and nobody knows.
        if replicas.is_well(name):
            replicas.suspect(name, life, f"it could not leave a turn that rests: {error}")
        return False
