"""Moving a child to another supervisor: its life goes on, only its address changes."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from ...actors.kernel.lifecycle import LOCAL
from ...checkpoint.home.homes import Homes
from ...checkpoint.home.switch import Switch
from ...checkpoint.protocol import SnapshotNow
from ...supervision.admin import NotSupported
from ...supervision.children import STOPPED, UP
from .arrangement import busy, child_of
from .draft import Draft, Place, Target, is_elsewhere
from .operation import Operation, wrong
from .structure import check_child, text_of

if TYPE_CHECKING:
    from ..system import ActorSystem


class Move(Operation):
    """Put a child under another supervisor of this process."""

    verb: ClassVar[str] = "move"

    def __init__(self, target: Target, supervisor: Target) -> None:
        super().__init__(text_of(target))
        self._at, self._to = target, supervisor
        self._place: Place | None = None
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
        for above in new.upwards():
            if above.comes_last:
                raise wrong(
                    new.path, "it is started only when this transaction is in force: move to it in the next one"
                )
        if new.is_dynamic and place.is_stopped:
            raise wrong(place.path, f"it is stopped, and {new.path} is dynamic: it keeps nobody who does not run")
        for one in place.walk():
            check_movable(one)
        check_child(new, place.spec)
        del old.children[place.name]
        new.children[place.name], place.parent = place, new
        self._place, self._above = place, new
        self._leads = not (place.is_moved or place.is_planned)  # Who is added is started where it is to be.
        place.is_moved = True
        self.between_turns_of = (old, new)
        for holder in (old, new):
            draft.arrangement.touch(holder, self)

    def ready(self, system: ActorSystem) -> str:
        place = self._place
        assert place is not None
        if not (self._leads and place.has_moved):
            return ""
        assert place.was.below is not None
        old = place.was.below.living(system.node)
        if why := busy(old):
            return why
        one = child_of(old, place.name)
        if one is None:
            raise wrong(old.path, f"it has no child {place.name!r} any more")
        if one.state not in (UP, STOPPED) or one.row is not None or one.up is not None:
            return f"{self.target} is being restarted"
        settle_senders(system.homes, self._asked)
        return WAITING if unsettled(system.homes) else ""


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


WAITING = "recorded actors may have to repeat what they sent to it: their snapshots are waited for"


def unsettled(homes: Homes) -> bool:
    """Whether a recorded actor would compare addresses in a replay: then none may change."""
    return any(map(is_unsettled, homes))


def is_unsettled(switch: Switch) -> bool:
    """Whether what it has sent may be sent again, to be compared."""
    return switch.ledger.has_sent


def settle_senders(homes: Homes, asked: dict[Switch, int]) -> None:
    """Have recorded actors take a snapshot, so that no replay sends to an address of before; each turn once."""
    for switch in homes:
        life = switch.life
        if is_unsettled(switch) and asked.get(switch) != switch.turn and life.port is not None and life.is_released:
            asked[switch] = switch.turn
            life.port.to_life(SnapshotNow())
