"""Operations on fault-tolerance mechanisms: attach one to a live actor, or detach it."""

from __future__ import annotations

import asyncio
import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.cell import Cell
from .draft import Draft, Target, is_elsewhere
from .living import OnLiving
from .operation import wrong

if TYPE_CHECKING:
    from ..system import ActorSystem

PROTECT_TIMEOUT = 60.0
"""Seconds that a life may take to move into a group or out of it; the transaction's own time limit is shorter."""


class OnProtection(OnLiving):
    """Base: the way in and the way out, each of which undoes the other."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self._under_way: asyncio.Task[None] | None = None
        self._before: Any = None  # the mechanism there was
        self._has_begun = False

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        assert place is not None
        if place.spec is None:
            raise wrong(self.target, "nobody supervises it, so nobody would start it again")
        above = place.parent
        if above is not None and above.cell is not None and is_elsewhere(above.cell):
            raise wrong(self.target, "its supervisor lives in another process, which cannot have processes of its own")

    async def _run(self, system: ActorSystem, cell: Cell, mechanism: Any) -> None:
        """Change it; whoever is cancelled gives up waiting, the change comes to its end."""
        moves = system._moves
        change = (
            moves.unprotect(cell, PROTECT_TIMEOUT)
            if mechanism is None
            else moves.protect(cell, system.homes, mechanism, PROTECT_TIMEOUT)
        )
        self._under_way = system.node.loop.create_task(change, name=f"mechanism of {cell.path}")
        await asyncio.shield(self._under_way)

    async def undo(self, system: ActorSystem) -> None:
        if not self._has_begun:
            return
        if self._under_way is not None:
            await asyncio.wait((self._under_way,))
            if not self._under_way.cancelled():
                self._under_way.exception()
        cell = self.cell(system)
        if cell.spec.mechanism != self._before:  # Else it stayed as it was.
            await self._run(system, cell, self._before)


class Attach(OnProtection):
    """Have an actor's life lived by a group of replicas, as a mechanism says."""

    verb: ClassVar[str] = "attach"

    def __init__(self, target: Target, mechanism: Any) -> None:
        super().__init__(target)
        self._mechanism = mechanism

    @property
    def text(self) -> str:
        return f"attach {mechanism_text(self._mechanism)} to {self.target}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        assert place is not None
        assert place.spec is not None
        if place.spec.mechanism is not None:
            raise wrong(self.target, f"it has {mechanism_text(place.spec.mechanism)} already: detach that first")
        place.spec = dataclasses.replace(place.spec, mechanism=self._mechanism)

    async def do(self, system: ActorSystem) -> None:
        cell = self.cell(system)
        self._before, self._has_begun = cell.spec.mechanism, True
        await self._run(system, cell, self._mechanism)


class Detach(OnProtection):
    """Have a protected actor live without a mechanism."""

    verb: ClassVar[str] = "detach"

    @property
    def text(self) -> str:
        return f"detach the mechanism of {self.target}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        assert place is not None
        assert place.spec is not None
        if place.spec.mechanism is None:
            raise wrong(self.target, "it has no mechanism")
        place.spec = dataclasses.replace(place.spec, mechanism=None)

    async def do(self, system: ActorSystem) -> None:
        cell = self.cell(system)
        self._before, self._has_begun = cell.spec.mechanism, True
        await self._run(system, cell, None)


def mechanism_text(mechanism: Any) -> str:
    """A mechanism, or several, in words."""
    layers = mechanism if isinstance(mechanism, tuple) else (mechanism,)
    return " + ".join(type(layer).__name__ for layer in layers)
