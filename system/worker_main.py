"""The entry point of actor processes: gives a guest what only the composition root knows."""

from __future__ import annotations

import asyncio
import functools
import socket
from typing import Any, cast

from ..actors.kernel.address_host import AddressHost
from ..actors.kernel.cell import Cell
from ..actors.kernel.lifecycle import NEAR
from ..actors.migration.worker_moves import Attempt
from ..actors.process import worker_node
from ..actors.process.wire import frames
from ..checkpoint.life.worker_lives import GuestKeeper, RecordedGuest
from ..checkpoint.recovery_file import RecoveryFile
from ..supervision.respec import respec


def main(sock: socket.socket, page_fd: int) -> int:
    """Called by the fork server in each child."""
    return worker_node.main(sock, page_fd, launch, prepare)


def prepare(host: worker_node.Guest) -> None:
    """Before the root's first frame: a recorded life may get its state before it is launched."""
    host.recovery = RecordedGuest(host)
    host.node.respec = respec
    host.moves.of_child = functools.partial(child_attempt, host)
    host.node.host_for = functools.partial(host_for, host)


def host_for(host: worker_node.Guest, spec: Any) -> AddressHost:
    """Where a child below this process's supervisor is lived."""
    if spec.mechanism is None and spec.isolation == "task":
        return cast("AddressHost", host.recovery.host_for(spec))
    from ..ftm.migration.protected_stand_ins import child_at_root  # Most processes have no such child.

    place = child_at_root(host, spec)
    return AddressHost(place.home, place, NEAR)


def child_attempt(host: worker_node.Guest, path: str, number: int) -> Attempt:
    """An attempt to give a live child of this process's supervisor a mechanism, or to take it away."""
    from ..ftm.migration.protected_stand_ins import RecordedChild
    from ..ftm.migration.unrecorded_in_worker import PlainChild

    cell = host.node.find(path)
    recovery = None if cell is None or cell.spec is None else cell.spec.recovery
    kind = PlainChild if recovery is None or not recovery.records else RecordedChild
    return kind(host, path, number)


def launch(host: worker_node.Guest, cell: Cell, frame: frames.Launch) -> asyncio.Future[None] | None:
    """Begin the life that the root asks for."""
    options = frame.options
    host.node.keeper = GuestKeeper(host, options.get("kept", {}), options.get("known", []))
    if "recovery_file" in options:
        host.node.complete = RecoveryFile(**options["recovery_file"]).complete
    recorded = options.get("recorded")
    if recorded is None:
        return cell.host.start(cell)
    host.recovery.start(cell, recorded)
    return None
