"""Moving a child to another supervisor: its life goes on, only its address changes."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from ...actors.kernel.cell import DOWN, GONE, Cell
from ...actors.kernel.lifecycle import LOCAL
from ...checkpoint.home.homes import Homes
from ...checkpoint.home.switch import Switch
from ...checkpoint.protocol import SnapshotNow
from ...supervision.admin import NotSupported
from ...supervision.children import STOPPED, UP, Child
from ...supervision.supervisor import Supervisor
from .addresses import Moved
from .draft import Draft, Place, Target, is_elsewhere
from .lasting import Renamed, keep, with_child, without
from .operation import Operation, wrong
from .structure import busy, check_child, child_of, text_of

if TYPE_CHECKING:
    from ..system import ActorSystem


class Move(Operation):
    """Put a child under another supervisor of this process."""

    verb: ClassVar[str] = "move"

    def __init__(self, target: Target, supervisor: Target) -> None:
        super().__init__(text_of(target))
        self._at, self._to = target, supervisor
        self._place: Place | None = None
        self._draft: Draft | None = None
        self._above: Place | None = None  # the new supervisor, at this point
        self._leads = False  # it is the first step that moves this actor: it brings it to where the last one wants it
        self._asked: dict[Switch, int] = {}  # who was asked for a snapshot, behind which turn

    @property
    def text(self) -> str:
        return f"move {self.target} to {self._above.path if self._above is not None else text_of(self._to)}"

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
        self._place, self._draft, self._above = place, draft, new
        self._leads = not (place.is_moved or place.is_planned)  # Who is added is started where it is to be.
        place.is_moved = True
        self.between_turns_of = (old, new)

    def _ends(self, system: ActorSystem) -> tuple[Cell, Cell] | None:
        """The supervisors that it leaves and comes to; None if it is to stay, or another step moves it."""
        place = self._place
        assert place is not None
        old, new = place.was[0], place.parent
        assert old is not None
        assert new is not None
        return (old.living(system.node), new.living(system.node)) if self._leads and old is not new else None

    def ready(self, system: ActorSystem) -> str:
        ends = self._ends(system)
        if ends is None:
            return ""
        place = self._place
        assert place is not None
        for holder in ends:
            if why := busy(holder):
                return why
        old, new = ends
        one = child_of(old, place.name)
        if one is None:
            raise wrong(old.path, f"it has no child {place.name!r} any more")
        if one.state not in (UP, STOPPED) or one.row is not None or one.up is not None:
            return f"{self.target} is being restarted"
        self._check_free(new, place.name)
        settle_senders(system.homes, self._asked)
        return WAITING if unsettled(system.homes) else ""

    def _check_free(self, new: Cell, name: str) -> None:
        """Raises SpecError: somebody came to live at the new address meanwhile, and stays there."""
        assert self._draft is not None
        known = child_of(new, name)
        cell = (new.children or {}).get(name) or (known.cell if known is not None else None)
        place = self._draft.by_cell.get(cell) if cell is not None else None
        if (known is not None or cell is not None) and (place is None or not place.is_moved):
            raise wrong(new.path, f"it has a child {name!r} already")

    def commit(self, system: ActorSystem) -> None:
        ends = self._ends(system)
        if ends is None:
            return
        assert self._place is not None
        old, new = (cell.actor for cell in ends)
        assert isinstance(old, Supervisor)
        assert isinstance(new, Supervisor)
        one = old._children[self._place.name]
        keep(ends[0], without(one.spec.id))
        if one.spec.restart != "temporary":
            keep(ends[1], with_child(one.spec))
        was = f"{ends[0].path}/{one.spec.id}"
        move_child(old, new, one, system.moved_addresses)
        root = system.node.root
        assert root is not None
        Renamed(was, f"{ends[1].path}/{one.spec.id}").keep(root)


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
