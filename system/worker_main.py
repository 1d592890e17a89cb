"""The entry point of actor processes: gives the guest what only the composition root knows."""

from __future__ import annotations

import asyncio
import socket
from typing import Any

from ..actors.kernel.actor import Start
from ..actors.kernel.address_host import AddressHost
from ..actors.kernel.cell import Cell
from ..actors.kernel.lifecycle import NEAR
from ..actors.migration.worker_moves import Attempt
from ..actors.process import worker_node
from ..actors.process.wire import frames
from ..checkpoint.life.worker_lives import RecordedGuest
from ..checkpoint.recovery_file import RecoveryFile
from ..supervision.respec import respec


def main(sock: socket.socket, page_fd: int) -> int:
    """Called by the fork server in each child."""
    return worker_node.main(sock, page_fd, WorkerComposition)


class WorkerComposition:
    """What a guest has of recovery, supervision and mechanisms."""

    def __init__(self, guest: worker_node.Guest) -> None:
        self._guest = guest
        self.recovery = RecordedGuest(guest)  # Made first: a recorded life may get its state before it is launched.
        self.keeper = self.recovery.keeper
        self._file: RecoveryFile | None = None

    def launch(self, cell: Cell, frame: frames.Launch) -> asyncio.Future[None] | None:
        """Begin the life that the root asks for."""
        options = frame.options
        self.keeper.learn(options.get("kept", {}), options.get("known", []))
        if "recovery_file" in options:
            self._file = RecoveryFile(**options["recovery_file"])
        recorded = options.get("recorded")
        if recorded is None:
            return cell.host.start(cell)
        self.recovery.start(cell, recorded)
        return None

    def host_for(self, spec: Any) -> AddressHost:
        """Where a child below this process's supervisor is lived."""
        if spec.mechanism is None and spec.isolation == "task":
            return self.recovery.host_for(spec)
        from ..ftm.migration.protected_stand_ins import child_at_root  # Most processes have no such child.

        place = child_at_root(self._guest, spec)
        return AddressHost(place.home, place, NEAR)

    def complete(self, spec: Any, path: str) -> Any:
        """A child spec with what the recovery file says of its address."""
        return spec if self._file is None else self._file.complete(spec, path)

    def respec(self, cell: Cell, start: Start[Any]) -> None:
        """Have an actor's next lives begin with this, as its supervisor knows."""
        respec(cell, start)

    def child_attempt(self, path: str, number: int) -> Attempt:
        """An attempt to give a live child of this process's supervisor a mechanism, or to take it away."""
        from ..ftm.migration.protected_stand_ins import RecordedChild
        from ..ftm.migration.unrecorded_in_worker import PlainChild

        cell = self._guest.node.find(path)
        recovery = None if cell is None or cell.spec is None else cell.spec.recovery
        kind = PlainChild if recovery is None or not recovery.records else RecordedChild
        return kind(self._guest, path, number)
