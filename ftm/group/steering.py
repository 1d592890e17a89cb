"""Steers a protected actor besides its messages: orders go to the leader, bindings to every replica."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...actors.control.orders import Conclude, Prepare, Ready, ReplaceCode, ReplaceState, Resume, Suspend
from ...actors.control.orders_lane import QueuedOrder, send_call
from ...actors.errors import ControlFailed
from ...actors.kernel import mailbox
from ...actors.kernel.cell import Cell
from ...actors.process.wire import frames

if TYPE_CHECKING:
    from .group import Group
    from .replicas import Replicas

AGAIN_AFTER = 0.01
"""Seconds after which an order is given again that nobody could take."""


def give_order(group: Group | None, cell: Cell, call: QueuedOrder) -> None:
    """Give an order to the actor of the replica that leads; what would change one replica alone is refused.

    `group`: None if the actor is not up.
    """
    ask = call.ask
    if isinstance(call.order, (ReplaceState, ReplaceCode, Prepare, Conclude)):
        why = "it is protected, and all replicas have to be alike: `protect` it by None, and again after"
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
