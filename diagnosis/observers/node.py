"""Is it running? `running(n)` for actors (D20)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from ...actors.cell import RUNNING, Cell
from ...actors.control.calls import ask_status
from ...actors.control.orders import status_of
from ...actors.errors import HoldfastError, SpecError
from ...actors.process.relay import OutsideHost
from ...actors.process.remote import ProcessHost
from ..literals import running
from .observer import Manner, Observer

PATIENCE: Final = 1.0
"""Seconds an actor's process gets to answer."""


class NodeObserver(Observer):
    """Looks whether actors live; they need not know of it. One that is suspended is unknown.

    Args:
        actors: component to address.
        hung_after: seconds; an actor whose turn takes longer, or whose process does not answer so long, counts as not
            running. None: nothing takes too long.
        manner: see `Observer`.
    """

    def __init__(
        self, actors: Mapping[str, str], *, hung_after: float | None = None, manner: Manner | None = None
    ) -> None:
        super().__init__(manner=manner)
        self._actors = {running(component): path for component, path in actors.items()}
        self._hung_after = hung_after

    def on_start(self, restored: bool) -> None:
        """Begin. Raises SpecError in a process of its own."""
        at_root(self)
        super().on_start(restored)

    async def look(self) -> None:
        """Look them all up."""
        for atom, path in self._actors.items():
            cell = self.ctx.cell.node.find(path)
            self.verdict(atom, False if cell is None else await self._runs(cell))

    async def _runs(self, cell: Cell) -> bool | None:
        host, limit = cell.host, self._hung_after
        peer: Any = host.worker_of(cell) if isinstance(host, ProcessHost) else getattr(host, "peer", None)
        if not isinstance(host, OutsideHost) and (cell.state is not RUNNING or not host.is_up(cell)):
            return False
        if peer is None or (limit is None and isinstance(host, ProcessHost)):
            status = status_of(cell)
        else:
            try:
                status = await ask_status(peer, cell, PATIENCE if limit is None else limit)
            except HoldfastError:  # It has ended, or its process does not answer.
                return False
        if status.state == "suspended":
            return None
        return status.state == "running" and (limit is None or status.turn_seconds <= limit)


def at_root(observer: Observer) -> None:
    """Refuse an observer that sees only its own process. Raises SpecError."""
    if observer.ctx.cell.node.uplink is not None:
        raise SpecError(observer.ctx.path, f"{type(observer).__name__} must be in the system's own process: a task")
