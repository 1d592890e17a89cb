"""An observer of whether actors run: `running(n)` (D20)."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Mapping
from typing import Final

from ...actors.control.orders import Status, known_at_home, status_of
from ...actors.control.orders_lane import ask_status
from ...actors.errors import HoldfastError, SpecError
from ...actors.kernel.actor import Actor
from ...actors.kernel.cell import RUNNING, Cell
from ...actors.process.process_host import WorkerPlace
from ...actors.process.wire.peer import OutsideHost, Peer
from ...supervision.intensity import admit_restart
from ..literals import Literal, running
from ..messages import STARTS, ComponentsStarted
from .observer import Manner, Observer

FREE: Final = 3
"""Starts within `WITHIN` seconds after which time is given: who is started more often has a fault that a start does not
mend."""
WITHIN: Final = 10.0
PATIENCE: Final = 1.0
"""Seconds an actor's process gets to answer."""


class NodeObserver(Observer):
    """Looks whether actors live; they need not know of it. One that is suspended is unknown.

    Args:
        actors: component to address; it may change.
        hung_after: seconds; an actor whose turn takes longer without a rest that it has told of, or whose process does
            not answer so long, counts as not running. None: nothing takes too long.
        settling: seconds after somebody has started an actor again in which nothing that is seen of it, or of what
            depends on it, is held against it. One that is started more than three times in ten seconds gets none.
        manner: see `Observer`.
    """

    def __init__(
        self,
        actors: Mapping[str, str],
        *,
        hung_after: float | None = None,
        settling: float = 1.0,
        manner: Manner | None = None,
    ) -> None:
        super().__init__(manner=manner)
        self._actors = actors
        self._hung_after, self._settling = hung_after, settling
        self._lives: dict[Literal, tuple[Cell, int]] = {}
        self._starts: dict[Literal, tuple[float, ...]] = {}
        self._rested: dict[str, float] = {}  # when an address was seen for the last time to rest in its turn

    def on_start(self, restored: bool) -> None:
        """Begin. Raises SpecError in a process of its own."""
        at_root(self)
        super().on_start(restored)

    async def look(self) -> None:
        """Look them all up; those that have to be asked are asked at the same time."""
        actors = {running(component): path for component, path in self._actors.items()}
        if started := [atom.args[0] for atom, path in actors.items() if self._is_new(atom, path)]:
            await self.ctx.publish(STARTS, ComponentsStarted(tuple(started), self._settling))
        asked: list[Literal] = []
        answers: list[Awaitable[bool | None]] = []
        for atom, path in actors.items():
            seen = self._runs(self.ctx._cell.node.find(path))
            if seen is None or isinstance(seen, bool):
                self.verdict(atom, seen)
            else:
                asked.append(atom)
                answers.append(seen)
        if asked:
            for atom, answer in zip(asked, await asyncio.gather(*answers), strict=True):
                self.verdict(atom, answer)

    def _is_new(self, atom: Literal, path: str) -> bool:
        """Whether it has begun another life since the last look, and is to be given time."""
        cell = self.ctx._cell.node.find(path)
        if cell is None or not cell.life:
            return False
        before, now = self._lives.get(atom), (cell, cell.life)
        self._lives[atom] = now
        if before is None or before == now or not self._settling:
            return False
        window = admit_restart(self._starts.get(atom, ()), self.now, intensity=FREE, period=WITHIN)
        if window is not None:
            self._starts[atom] = window
        return window is not None

    def _runs(self, cell: Cell | None) -> bool | Awaitable[bool | None] | None:
        if cell is None:
            return False
        host = cell.host
        if isinstance(host, OutsideHost):
            return self._answers(host.peer, cell, PATIENCE if self._hung_after is None else self._hung_after)
        if cell.state is not RUNNING or not host.is_up(cell):
            return False
        worker = host.place.process(cell) if isinstance(host.place, WorkerPlace) else None
        if worker is None or self._hung_after is None:
            return self._judged(status_of(cell), cell)
        return self._answers(worker, cell, self._hung_after)

    async def _answers(self, peer: Peer, cell: Cell, timeout: float) -> bool | None:
        try:
            return self._judged(await ask_status(peer, cell, timeout), cell)
        except HoldfastError:  # It has ended, or its process does not answer.
            return False

    def _judged(self, told: Status, cell: Cell) -> bool | None:
        status = known_at_home(told, cell)
        if status.state == "suspended":
            return None
        if status.turn_rests:
            self._rested[cell.path] = self.now
        elif status.turn is None:
            self._rested.pop(cell.path, None)
        at_work = min(status.turn_seconds, self.now - self._rested.get(cell.path, -math.inf))
        return status.state == "running" and (self._hung_after is None or at_work <= self._hung_after)


def at_root(observer: Actor) -> None:
    """Refuse an actor that looks at others and sees only its own process. Raises SpecError."""
    if observer.ctx._cell.node.ports.uplink is not None:
        raise SpecError(observer.ctx.path, f"{type(observer).__name__} must be in the system's own process: a task")
