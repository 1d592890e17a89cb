"""Operations on where an actor lives, and on its mechanisms; and to whom it may give orders there."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.errors import SpecError
from ...actors.kernel.ref import Target
from ...actors.process.grants import said_of_grants, why_not_granted
from ...actors.process.wire.worker_gate import is_at_or_below
from ...supervision.arbiter import Hand, arbiter_of
from ...supervision.respec import NO_RECIPE, recipe_spec
from ...supervision.spec import Isolation
from ...supervision.supervisor_changes import check_subtree
from .draft import Draft, DraftPlace, is_elsewhere, rules
from .living import OnSharedWork
from .operation import Operation, wrong
from .relocation import Relocation, described
from .reparenting import Regrouping, Reparent, successors
from .succession import Beside

if TYPE_CHECKING:
    from ...actors.process.resource_limits import Limits
    from ...ftm.group.probation import Probation
    from ..system import ActorSystem


class OnPlace(OnSharedWork):
    """Base of operations on where an actor lives, and behind which mechanisms."""

    unsupervised: ClassVar[str] = "nobody supervises it, so nobody would start it again"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        above = place.parent
        if place.spec is None and above is not None and above.cell is not None and is_elsewhere(above.cell):
            place.spec = recipe_spec(place.cell) if place.cell is not None else None
            if place.spec is None:
                raise wrong(self.target, NO_RECIPE)
        if place.spec is None:
            raise wrong(self.target, self.unsupervised)
        if place.relocation is None:
            place.relocation = self._work = Relocation(place, self.text, draft.timeout)


class Isolate(OnPlace):
    """Have an actor live in a process of its own, or as a task of this one."""

    verb: ClassVar[str] = "isolate"
    unsupervised: ClassVar[str] = "nobody supervises it: it has no isolation to change"

    def __init__(self, target: Target, isolation: Isolation, limits: Limits | None = None) -> None:
        super().__init__(target)
        self._to: Isolation = isolation
        self._limits = limits  # of a supervisor's process; None: those of its spec

    @property
    def text(self) -> str:
        return f"have {self.target} live in a {self._to}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        assert place.spec is not None
        if self._to not in ("task", "process"):
            raise SpecError(self.target, f"isolation must be one of task, process, not {self._to!r}")
        if place.is_supervisor and not place.is_planned and place.spec.isolation != self._to:
            await self._begin_anew(draft, place)
        else:
            place.spec = dataclasses.replace(place.spec, isolation=self._to)

    async def _begin_anew(self, draft: Draft, place: DraftPlace) -> None:
        """Another supervisor takes the place of this one, where it is to live, and gets all below it."""
        above = place.parent
        assert above is not None
        assert place.spec is not None
        place.relocation = self._work = None
        if above.is_far:
            raise wrong(self.target, "its supervisor lives in another process: it lives there, as a task")
        limits = self._limits or place.spec.limits
        spec = dataclasses.replace(place.spec, isolation=self._to, limits=limits if self._to == "process" else None)
        anew = await successors(draft, place, above, is_given=True)
        if self._to == "process":
            check_subtree(place.path, [one.spec for one in place.children.values() if one.spec is not None])
        place.spec = spec
        work = self._work = Regrouping(place, draft)
        work.begin_anew(anew, Beside(place), self)
        draft.arrangement.touch(above, self)


class OnProtection(OnPlace):
    """Base of operations that give an actor another stack of mechanisms, or none."""

    lacks: ClassVar[str] = ""
    """What is wrong with an actor without mechanisms; "" if nothing is."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self._was: Any = None  # the mechanism there was
        self._after: Any = None  # and that there is to be

    def _wanted(self, before: Any) -> tuple[Any, ...] | None:
        """The whole new stack; None: no mechanism.

        Raises:
            SpecError, MechanismRefused: there is none.
        """
        raise NotImplementedError

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        if (busy := arbiter_of(system._node).in_the_way(self.target, Hand.ADAPTATION)) is not None:
            raise busy
        place = self._place
        assert place.spec is not None
        self._was = place.spec.mechanism
        if self._was is None and self.lacks:
            raise wrong(self.target, self.lacks)
        layers = self._wanted(self._was)
        if layers is not None:
            self._after = layers[0] if len(layers) == 1 else layers
            check_layers(place, self._after)
        place.spec = dataclasses.replace(place.spec, mechanism=self._after)

    @property
    def probation(self) -> Probation | None:
        """Whether it stays is known when this is over; None: at once."""
        return self._work.probation if isinstance(self._work, Relocation) else None


class Protect(OnProtection):
    """Have an actor protected by just this stack of mechanisms, whatever it has now; by none if there is none."""

    verb: ClassVar[str] = "protect"

    def __init__(self, target: Target, mechanism: Any) -> None:
        super().__init__(target)
        self._mechanism = mechanism

    @property
    def text(self) -> str:
        if self._is_none:
            return f"protect {self.target} by no mechanism"
        return f"protect {self.target} by {mechanism_text(self._after or self._mechanism)}"

    @property
    def _is_none(self) -> bool:
        return self._mechanism is None or (isinstance(self._mechanism, (tuple, list)) and not self._mechanism)

    def _wanted(self, before: Any) -> tuple[Any, ...] | None:
        if self._is_none:
            return None
        layers: tuple[Any, ...] = rules().layers_of(self._mechanism, before)
        return layers

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        begins = place.is_planned or self._was is not None or self._after is None
        if not begins and place.kind is not None and not place.kind.state_access:
            why = "its class says state_access = False, so its state cannot go along"
            raise wrong(self.target, f"{why}: name the mechanism in its spec, and it begins with it")


class Update(OnProtection):
    """New code for one brick."""

    verb: ClassVar[str] = "update"
    lacks: ClassVar[str] = "it has no mechanism yet: protect it first"

    def __init__(self, target: Target, brick: str, new: Any, *, mechanism: str, role: str) -> None:
        super().__init__(target)
        self._brick, self._new, self._of, self._role = brick, new, mechanism, role

    @property
    def text(self) -> str:
        new = self._new.__name__ if isinstance(self._new, type) else str(self._new)
        which = " ".join(one for one in (self._of, self._role, self._brick) if one)
        return f"update {which} of {self.target} to {new}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        if described(self._after) == described(self._was):
            raise wrong(self.target, f"it has just that already: {mechanism_text(self._was)}")

    def _wanted(self, before: Any) -> tuple[Any, ...]:
        layers: tuple[Any, ...] = rules().updated(before, self._brick, self._new, mechanism=self._of, role=self._role)
        return layers


def check_layers(place: DraftPlace, mechanism: Any) -> None:
    """Whether these go together, and with the actor. Raises MechanismRefused."""
    layers = mechanism if isinstance(mechanism, tuple) else (mechanism,)
    rules().check_stack(layers, place.kind, place.path)


def mechanism_text(mechanism: Any) -> str:
    """A mechanism, or several, in words."""
    layers = mechanism if isinstance(mechanism, (tuple, list)) else (mechanism,)
    return " + ".join(
        layer if isinstance(layer, str) else layer.__name__ if isinstance(layer, type) else type(layer).__name__
        for layer in layers
    )


def look_at_grants(steps: Iterable[Operation]) -> None:
    """Have each step that takes an actor into a process say to whom that one may give orders there.

    Raises:
        SpecError: it has given orders to others so far.
    """
    for step in steps:
        place = step._found if isinstance(step, (OnPlace, Reparent)) else None
        if place is None or place.cell is None or place.is_leaving or not place.cell.host.place.is_here:
            continue
        home = _process_of(place)
        if home is None:
            continue
        granted = list(_granted(home))
        step.note = said_of_grants(place.path, home.path, granted)
        cells = [one.cell for one in place.walk() if one.cell is not None]
        if why := why_not_granted(cells, home.path, granted):
            raise wrong(place.path, why)


def _process_of(place: DraftPlace) -> DraftPlace | None:
    """Whose process a place will be in; None: that of the root."""
    for one in place.upwards():
        if one.spec is not None:
            if one.spec.isolation == "process" or one.spec.mechanism is not None:
                return one
        elif one.cell is not None and not one.cell.host.place.is_here:
            return one
    return None


def _granted(home: DraftPlace) -> Iterator[str]:
    """To whom the bindings of those in a process lead, and what its recipe grants."""
    seen = {home.path}
    for place in home.walk():
        start = None if place.spec is None else place.spec.start
        recipe = () if start is None else start.kind._may_order(start, place.path)
        for to in (*(one.path for one in place.bindings.values()), *recipe):
            if not any(is_at_or_below(to, one) for one in seen):
                seen.add(to)
                yield to
