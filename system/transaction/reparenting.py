"""Moving a child to another supervisor: its life goes on, only its address changes.

So does that of a supervisor, with all below it, if all its supervisors live in the root's process, and stay there. Else
another one takes its place (`succession.py`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from ...supervision.respec import recipe_spec
from .draft import Draft, DraftPlace, Target, is_elsewhere, rules
from .handing import check_handing, is_far
from .living import OnSharedWork
from .operation import text_of, wrong
from .regrouping import Regrouping, addressed, successors
from .structure import check_child, check_not_uniform
from .succession import Elsewhere

if TYPE_CHECKING:
    from ..system import ActorSystem


class Reparent(OnSharedWork):
    """Put a child under another supervisor."""

    verb: ClassVar[str] = "move"

    def __init__(self, target: Target, supervisor: Target) -> None:
        super().__init__(target)
        self._to = supervisor
        self._above: DraftPlace | None = None  # the new supervisor, at this point

    @property
    def text(self) -> str:
        return f"move {self.target} to {self._above.path if self._above is not None else text_of(self._to)}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = draft.find(self._at)
        new, old = await draft.supervisor(self._to), place.parent
        self.target = place.path
        if place.spec is None and place.cell is not None:  # Its supervisor lives in another process.
            place.spec = recipe_spec(place.cell)
        if old is None or not old.is_supervisor or place.spec is None:
            raise wrong(place.path, "no supervisor looks after it, so it cannot be moved to another")
        if new in place.walk():
            raise wrong(place.path, f"it cannot be moved below itself, to {new.path}")
        check_not_uniform(old)
        if any(one.place is place for one in draft.arrangement.successions):
            raise wrong(place.path, "it begins anew there by this very transaction: move it once")
        if is_far(old) or is_far(new):
            await draft.supervisor(old.path)  # It tells whom it has before it has one less in the draft.
            check_handing(place, old, new)
        for above in new.upwards():
            if above.comes_last:
                raise wrong(
                    new.path, "it is started only when this transaction is in force: move to it in the next one"
                )
        if new.is_dynamic and place.is_stopped:
            raise wrong(place.path, f"it is stopped, and {new.path} is dynamic: it keeps nobody who does not run")
        anew: list[DraftPlace] = []
        if begins_anew(place, old, new):
            if place.name in new.was.children:
                why = f"it has a child {place.name!r} until this transaction is in force: use the next one"
                raise wrong(new.path, why)
            anew = await successors(draft, place, new, is_given=is_far(old) or is_far(new))
        for one in addressed(place):
            check_movable(one)
        check_child(new, place.spec)
        del old.children[place.name]
        new.children[place.name], place.parent = place, new
        self._found, self._above = place, new
        if anew:
            work = self._work = Regrouping(place, draft)
            work.begin_anew(anew, Elsewhere(place), self)
        elif not (place.is_moved or place.is_planned):  # Who is added is started where it is to be.
            work = self._work = Regrouping(place, draft)
            work.hand(place)  # By the first step that moves it, to where the last one wants it.
        place.is_moved = True
        self.between_turns_of = (old, new)
        for holder in (old, new):
            draft.arrangement.touch(holder, self)


def check_movable(place: DraftPlace) -> None:
    """Whether an actor can have another address.

    Raises:
        SpecError: something that cannot be told knows it by its address.
    """
    cell, spec = place.cell, place.spec
    if place.is_protected and cell is not None and any(one.secures for one in rules().layers_of(cell.spec.mechanism)):
        raise wrong(place.path, "its replicas are certified under its address: detach the mechanism that secures them")
    method = spec.recovery if spec is not None else None
    if method is not None and method.replays and not method.snapshots:
        why = "it takes no snapshots, so all its turns would be repeated under another address"
        raise wrong(place.path, f"{why}: use hybrid(...)")


def begins_anew(place: DraftPlace, old: DraftPlace, new: DraftPlace) -> bool:
    """Whether another supervisor takes the place of this one, for some of it is in another process, or will be."""
    if not place.is_supervisor or place.is_planned:
        return False
    return is_far(old) or is_far(new) or any(one.is_supervisor and has_process(one) for one in addressed(place))


def has_process(place: DraftPlace) -> bool:
    """Whether a supervisor has a process of its own, or is below one that has."""
    cell, spec = place.cell, place.spec
    return (spec is not None and spec.isolation == "process") or (cell is not None and is_elsewhere(cell))
