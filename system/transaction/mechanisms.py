"""Operations on fault-tolerance mechanisms: attach, detach, compose, exchange one for another, update a brick."""

from __future__ import annotations

import asyncio
import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.kernel.cell import Cell
from ...supervision.arbiter import Grant, Hand, arbiter_of
from ...supervision.respec import recipe_spec
from ..live_moves import to_its_end
from .draft import Draft, Place, Target, is_elsewhere, rules
from .living import OnLiving
from .operation import wrong

if TYPE_CHECKING:
    from ...ftm.group.probation import Probation
    from ..system import ActorSystem

PROTECT_TIMEOUT = 60.0
"""Seconds that a life may take to move into a group or out of it; the transaction's own time limit is shorter."""


class OnProtection(OnLiving):
    """Base: the way in and the way out, each of which undoes the other."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self._under_way: asyncio.Task[None] | None = None
        self._before: Any = None  # the mechanism there was
        self._after: Any = None  # and that there is to be
        self._has_begun = False
        self._grant: Grant | None = None
        self.probation: Probation | None = None
        """Whether it stays is known when this is over; None: at once."""

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        if (busy := arbiter_of(system.node).in_the_way(self.target, Hand.ADAPTATION)) is not None:
            raise busy
        place = self._place
        assert place is not None
        above = place.parent
        if above is not None and above.cell is not None and is_elsewhere(above.cell):
            self._check_below(place)
        if place.spec is None:
            raise wrong(self.target, "nobody supervises it, so nobody would start it again")

    def _check_below(self, place: Place) -> None:
        """Whether it can be done below a supervisor that lives in another process. Raises SpecError."""
        cell = place.cell
        if place.spec is None and cell is not None:
            place.spec = recipe_spec(cell)
        if place.spec is None:
            why = "its supervisor lives in another process, and no recipe here has its spec: add it by a transaction"
            raise wrong(self.target, why)

    async def _run(self, system: ActorSystem, cell: Cell, mechanism: Any) -> None:
        """Change it; whoever is cancelled gives up waiting, the change comes to its end."""
        moves = system._moves
        change = (
            moves.unprotect(cell, PROTECT_TIMEOUT)
            if mechanism is None
            else moves.protect(cell, system.homes, mechanism, PROTECT_TIMEOUT)
        )
        self._under_way = system.node.loop.create_task(change, name=f"mechanism of {cell.path}")
        await to_its_end(self.target, self._under_way)
        self.probation = getattr(cell.host, "probation", None)  # None: there is no mechanism.

    async def undo(self, system: ActorSystem) -> None:
        if not self._has_begun:
            return
        try:
            if self._under_way is not None:
                self._give_up(system)
                await asyncio.wait((self._under_way,))
                if not self._under_way.cancelled():
                    self._under_way.exception()
            cell = self.cell(system)
            if described(mechanism_of(cell)) != described(self._before):  # Else it stayed as it was.
                await self._run(system, cell, self._before)
            system.mechanism_notes.over(self.target)
        finally:
            self._give_back(system)

    def _give_up(self, system: ActorSystem) -> None:
        """Have what is under way end soon, if it can."""
        system._moves.give_up(self.cell(system), "it is not wanted any more")

    def _give_back(self, system: ActorSystem) -> None:
        grant, self._grant = self._grant, None
        if grant is not None:
            arbiter_of(system.node).release(grant)

    async def do(self, system: ActorSystem) -> None:
        cell = self.cell(system)
        self._grant = arbiter_of(system.node).claim(self.target, Hand.ADAPTATION, self.text)
        self._before, self._has_begun = mechanism_of(cell), True
        system.mechanism_notes.begun(self.target, self.text)
        await self._run(system, cell, self._after)

    def verify(self, system: ActorSystem) -> None:
        place = self._place  # With what all steps have made of it.
        assert place is not None
        assert place.spec is not None
        if described(mechanism_of(self.cell(system))) != described(place.spec.mechanism):
            raise wrong(self.target, "its mechanism is another one again")

    def seal(self, system: ActorSystem) -> None:
        notes, target, before, after = system.mechanism_notes, self.target, self._before, self._after
        probation = self.probation
        is_open = probation is not None and not probation.is_over
        notes.put(target, before, after, is_trusted=not is_open)
        notes.over(target)

        def over(is_kept: bool) -> None:
            if is_kept:
                notes.settled(target, after)
            else:
                notes.put(target, after, before, is_trusted=False)
            notes.flush()

        if probation is not None:
            probation.when_over(over)
        self._give_back(system)

    async def finish(self, system: ActorSystem) -> None:
        system.mechanism_notes.flush()


class Attach(OnProtection):
    """Have an actor's life lived by a group of replicas, as a mechanism says."""

    verb: ClassVar[str] = "attach"

    def __init__(self, target: Target, mechanism: Any) -> None:
        super().__init__(target)
        self._mechanism = mechanism

    def _layers(self) -> Any:
        """As the spec has it: one alone stands there as it is."""
        layers = rules().layers_of(self._mechanism)
        return layers[0] if len(layers) == 1 else layers

    @property
    def text(self) -> str:
        return f"attach {mechanism_text(self._after or self._mechanism)} to {self.target}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        assert place is not None
        assert place.spec is not None
        if place.spec.mechanism is not None:
            raise wrong(self.target, f"it has {mechanism_text(place.spec.mechanism)} already: detach that first")
        self._after = self._layers()
        check_layers(place, self._after)
        if not place.is_planned and not getattr(place.kind, "state_access", True):
            why = "its class says state_access = False, so its state cannot go along"
            raise wrong(self.target, f"{why}: name the mechanism in its spec, and it begins with it")
        place.spec = dataclasses.replace(place.spec, mechanism=self._after)


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


class Adapt(OnProtection):
    """Base: a protected actor goes on with another stack of mechanisms; its replicas live on."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self._was: Any = None

    def _wanted(self, before: Any) -> tuple[Any, ...]:
        """The whole new stack.

        Raises:
            MechanismRefused: there is none.
        """
        raise NotImplementedError

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        assert place is not None
        assert place.spec is not None
        self._was = place.spec.mechanism
        if self._was is None:
            raise wrong(self.target, "it has no mechanism yet: attach one")
        layers = self._wanted(self._was)
        self._after = layers[0] if len(layers) == 1 else layers
        check_layers(place, self._after)
        if described(self._after) == described(self._was):
            raise wrong(self.target, f"it has just that already: {mechanism_text(self._was)}")
        place.spec = dataclasses.replace(place.spec, mechanism=self._after)

    async def _run(self, system: ActorSystem, cell: Cell, mechanism: Any) -> None:
        change = system._moves.adapt(cell, mechanism, PROTECT_TIMEOUT)
        self._under_way = system.node.loop.create_task(change, name=f"adaptation of {cell.path}")
        await to_its_end(self.target, self._under_way)
        self.probation = getattr(cell.host, "probation", None)  # None: it has been detached since.

    def _give_up(self, system: ActorSystem) -> None:
        if self._under_way is not None and not self._under_way.done():
            group = getattr(self.cell(system).host, "group", None)
            change = None if group is None else group.change
            if change is not None:
                change.give_up("it is not wanted any more")

    @property
    def _from_to(self) -> str:
        if self._was is None:
            return ""
        return f" (from {mechanism_text(self._was)} to {mechanism_text(self._after)})"


class Compose(Adapt):
    """Nest one more mechanism: inside of those that are there, or outside."""

    verb: ClassVar[str] = "compose"

    def __init__(self, target: Target, mechanism: Any, *, outside: bool) -> None:
        super().__init__(target)
        self._mechanism, self._outside = mechanism, outside

    @property
    def text(self) -> str:
        where = "outside" if self._outside else "inside"
        return f"compose {self.target} with {mechanism_text(self._mechanism)} {where}{self._from_to}"

    def _wanted(self, before: Any) -> tuple[Any, ...]:
        layers: tuple[Any, ...] = rules().composed(before, self._mechanism, outside=self._outside)
        return layers


class Transition(Adapt):
    """Another mechanism in the place of the one of its sort; several in the place of all."""

    verb: ClassVar[str] = "transition"

    def __init__(self, target: Target, mechanism: Any, *, whole: bool = False) -> None:
        super().__init__(target)
        self._mechanism, self._whole = mechanism, whole

    @property
    def text(self) -> str:
        return f"transition of {self.target} to {mechanism_text(self._mechanism)}{self._from_to}"

    def _wanted(self, before: Any) -> tuple[Any, ...]:
        layers: tuple[Any, ...] = rules().replaced(before, self._mechanism, whole=self._whole)
        return layers


class DetachLayer(Adapt):
    """Take one mechanism out of several."""

    verb: ClassVar[str] = "detach"

    def __init__(self, target: Target, name: str) -> None:
        super().__init__(target)
        self._name = name

    @property
    def text(self) -> str:
        return f"detach {self._name} from {self.target}{self._from_to}"

    def _wanted(self, before: Any) -> tuple[Any, ...]:
        layers: tuple[Any, ...] = rules().without(before, self._name)
        return layers


class Update(Adapt):
    """New code for one brick."""

    verb: ClassVar[str] = "update"

    def __init__(self, target: Target, brick: str, new: Any, *, mechanism: str, role: str) -> None:
        super().__init__(target)
        self._brick, self._new, self._of, self._role = brick, new, mechanism, role

    @property
    def text(self) -> str:
        new = self._new.__name__ if isinstance(self._new, type) else str(self._new)
        which = " ".join(one for one in (self._of, self._role, self._brick) if one)
        return f"update {which} of {self.target} to {new}"

    def _wanted(self, before: Any) -> tuple[Any, ...]:
        layers: tuple[Any, ...] = rules().updated(before, self._brick, self._new, mechanism=self._of, role=self._role)
        return layers


def mechanism_of(cell: Cell) -> Any:
    """The mechanism that a live child has; None if it has none."""
    return getattr(cell.spec, "mechanism", None)  # One that lives elsewhere has no spec here.


def described(mechanism: Any) -> Any:
    """A mechanism, or several, as it can be compared."""
    return None if mechanism is None else rules().describe(mechanism)


def check_layers(place: Place, mechanism: Any) -> None:
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
