"""Whether an actor answers: asked before repair restarts it on suspicion."""

from __future__ import annotations

import asyncio

from ...actors.control.orders import Status, known_at_home, status_of
from ...actors.control.orders_lane import ask_status
from ...actors.errors import HoldfastError
from ...actors.kernel.node import Node
from ...actors.process.process_host import WorkerPlace
from ...actors.process.wire.peer import OutsideHost


async def answers(node: Node, address: str, seconds: float) -> bool | None:
    """Whether an actor lives and gets on with its messages.

    Its mailbox is not used: a ping behind a thousand messages would say how long the queue is. A turn that is as old
    as the wait is one that hangs, unless it rests as it has said.

    Args:
        node: where it is looked up.
        address: of the actor.
        seconds: how long it has to answer, and how long its turn may last while it is looked at.

    Returns:
        None: it was suspended by order, and says nothing.
    """
    first = await looked_at(node, address, seconds)
    if first is None or first.state != "running":
        return None if first is not None and first.state == "suspended" else False
    if first.turn is None:
        return True
    await asyncio.sleep(seconds)
    second = await looked_at(node, address, seconds)
    if second is None or second.state != "running":
        return None if second is not None and second.state == "suspended" else False
    rests = first.turn_rests or second.turn_rests
    return second.life != first.life or second.turn is None or bool(rests) or second.turn_seconds < seconds


async def looked_at(node: Node, address: str, seconds: float) -> Status | None:
    """Its status; None: it is not there, or its process does not answer."""
    cell = node.find(address)
    if cell is None:
        return None
    host = cell.host
    peer = host.peer if isinstance(host, OutsideHost) else None
    if peer is None and host.is_up(cell) and isinstance(host.place, WorkerPlace):
        peer = host.place.process(cell)
    if peer is None:
        return status_of(cell)
    try:
        return known_at_home(await ask_status(peer, cell, seconds), cell)
    except HoldfastError:  # It has ended, or does not answer: both are the answer.
        return None
