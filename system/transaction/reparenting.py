"""Moving a child to another supervisor: its life goes on, only its address changes."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, ClassVar

from ...actors.kernel.cell import DOWN, GONE, Cell
from ...actors.kernel.lifecycle import LOCAL
from ...checkpoint.home.homes import Homes
from ...checkpoint.home.switch import Switch
from ...checkpoint.protocol import SnapshotNow
from ...supervision.admin import NotSupported
from ...supervision.children import STOPPED, UP, Child
from ...supervision.spec import ChildSpec
from ...supervision.supervisor import Supervisor
from .addresses import Moved
from .draft import Draft, Place, Target, is_elsewhere
from .lasting import keep, with_child, without
from .operation import Operation, wrong
from .structure import check_child, text_of
from .turns import arrange, between_turns

if TYPE_CHECKING:
    from ..system import ActorSystem

LOOK_AGAIN = 0.02
"""Seconds between two looks at a child that is being restarted, or a supervisor in the middle of something."""


class Move(Operation):
    """Put a child under another supervisor of this process."""

    verb: ClassVar[str] = "move"

    def __init__(self, target: Target, supervisor: Target) -> None:
        super().__init__(text_of(target))
        self._at, self._to = target, supervisor
        self._place: Place | None = None
        self._above: tuple[Place, Place] | None = None  # the supervisors: the old one and the new one
        self._before: tuple[list[str], list[str]] | None = None  # the order there: of children, of addresses
        self._spec: ChildSpec | None = None

    @property
    def text(self) -> str:
        to = self._above[1].path if self._above is not None else text_of(self._to)
        return f"move {self.target} to {to}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = draft.find(self._at)
        new, old = await draft.supervisor(self._to), place.parent
        self.target = place.path
        if old is None or not old.is_supervisor or place.spec is None:
            raise wrong(place.path, "no supervisor looks after it, so it cannot be moved to another")
        if new in place.walk():
            raise wrong(place.path, f"it cannot be moved below itself, to {new.path}")
        if old.is_partitioned:
            raise NotSupported("the children of a partition supervisor are its partitions: use ResizePartitions")
        for above in (old, new):
            if above.cell is not None and is_elsewhere(above.cell):
                raise wrong(above.path, "it lives in another process, which a life cannot enter or leave")
        for one in place.walk():
            check_movable(one)
        check_child(new, place.spec)
        del old.children[place.name]
        new.children[place.name], place.parent = place, new
        self._place, self._above = place, (old, new)
        self.between_turns_of = self._above

    async def do(self, system: ActorSystem) -> None:
        assert self._above is not None
        old, new = (above.living(system.node) for above in self._above)
        await self._moved(system, old, new)

    async def _moved(self, system: ActorSystem, old: Cell, new: Cell) -> None:
        """Move it as soon as nothing is in the way, however often that has to be looked at."""
        assert self._place is not None
        name, homes, moved = self._place.name, system.homes, system.moved_addresses
        asked: dict[Switch, int] = {}
        while True:
            settle_senders(homes, asked)
            self.waiting = await between_turns(
                old, lambda supervisor: self._attempt(supervisor, new, name, homes, moved)
            )
            if not self.waiting:
                return
            await asyncio.sleep(LOOK_AGAIN)

    def _attempt(self, old: Supervisor, new: Cell, name: str, homes: Homes, moved: Moved) -> str:
        """Move it, or say what is in the way. Nothing else happens between its first line and its last."""
        one, to = old._children.get(name), new.actor
        if one is None:
            raise wrong(old.ctx.path, f"it has no child {name!r} any more")
        if not isinstance(to, Supervisor) or "_children" not in to.__dict__ or (new.more and new.more.turn):
            return f"{new.path} is in the middle of something"
        if one.state not in (UP, STOPPED) or one.row is not None or one.up is not None:
            return "it is being restarted"
        if name in to._children or name in (new.children or ()):
            raise wrong(new.path, f"it has a child {name!r} already")
        if unsettled(homes):
            return WAITING
        self._before = self._before or (list(old._children), list(old.ctx.cell.children or ()))
        self._spec = one.spec
        move_child(old, to, one, moved)
        return ""

    async def undo(self, system: ActorSystem) -> None:
        if self._before is None or self._above is None or self._place is None:
            return
        old, new = (above.living(system.node) for above in self._above)
        if not isinstance(new.actor, Supervisor) or self._place.name not in new.actor._children:
            return  # It was not moved, or has ended for good since.
        before, cells = self._before
        await self._moved(system, new, old)

        def back(supervisor: Supervisor) -> None:
            known = supervisor._children
            first = {name: known[name] for name in before if name in known}
            supervisor._children = {**first, **{name: one for name, one in known.items() if name not in first}}
            arrange(supervisor.ctx.cell, cells)

        await between_turns(old, back)
        system.moved_addresses.forget(f"{new.path}/{self._place.name}")

    def seal(self, system: ActorSystem) -> None:
        assert self._above is not None
        assert self._spec is not None
        old, new = self._above
        keep(old.living(system.node), without(self._spec.id))
        if self._spec.restart != "temporary":
            keep(new.living(system.node), with_child(self._spec))

    def verify(self, system: ActorSystem) -> None:
        assert self._above is not None
        for above in self._above:
            above.living(system.node)


def check_movable(place: Place) -> None:
    """Whether an actor can have another address.

    Raises:
        SpecError: something besides its refs knows it by its address.
    """
    cell, spec = place.cell, place.spec
    if (spec is not None and spec.isolation == "process") or (cell is not None and is_elsewhere(cell)):
        raise wrong(place.path, "its process knows it by its address: have it live in a task first")
    if (spec is not None and spec.recovery is not None and spec.recovery.records) or (
        cell is not None and cell.host is not LOCAL
    ):
        raise wrong(place.path, "its journal is kept by its address: a recorded actor cannot be moved")


def move_child(old: Supervisor, new: Supervisor, one: Child, moved: Moved) -> None:
    """Put a child from one supervisor under another, between two turns of both."""
    name, cell = one.spec.id, one.cell
    del old._children[name]
    new._children[name] = one
    if cell is None or cell.state is GONE:
        return
    was, above = cell.path, new.ctx.cell
    (old.ctx.cell.children or {}).pop(name, None)
    above.children = {**(above.children or {}), name: cell}
    cell.parent = above
    moved.leave(was, cell)
    if cell.state is DOWN and one.state == UP:
        return  # Its end waits in the old supervisor's queue, which hands it on.


WAITING = "recorded actors may have to repeat what they sent to it: their snapshots are waited for"


def unsettled(homes: Homes) -> bool:
    """Whether a recorded actor would compare addresses in a replay: then none may change."""
    return any(map(is_unsettled, homes))


def is_unsettled(switch: Switch) -> bool:
    """Whether what it has sent may be sent again, to be compared."""
    return bool(switch.partial) or any(turn.digests for turn in switch.turns.values())


def settle_senders(homes: Homes, asked: dict[Switch, int]) -> None:
    """Have recorded actors take a snapshot, so that no replay sends to an address of before; each turn once."""
    for switch in homes:
        if is_unsettled(switch) and asked.get(switch) != switch.turn and switch.port is not None and switch.is_released:
            asked[switch] = switch.turn
            switch.port.to_life(SnapshotNow())
