"""Hands a child to or from a supervisor in another process; the root exchanges who decides about it.

The new supervisor, in its process, has the child started as a candidate; the root does not begin the life that is so
wanted, for it has one. At the commit that life is the one, and the old supervisor is told that it has lost the child.
If there is no commit the candidate is withdrawn. A child without a process of its own has one while it is given away.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
from typing import TYPE_CHECKING, Any

from ...actors.errors import ActorStopped, HoldfastError
from ...actors.kernel.cell import RUNNING, Cell
from ...actors.kernel.lifecycle import NEAR
from ...actors.kernel.ref import ActorRef
from ...actors.process.process_host import WorkerPlace
from ...checkpoint.places.far_parent import FarParent
from ...checkpoint.places.subtree_place import SubtreePlace
from ...supervision.admin import Boxed, RemoveChild, StartChild
from ...supervision.supervisor_changes import check_subtree
from ..live_moves import place_of
from .arrangement import planned_spec
from .draft import START_TIMEOUT, DraftPlace, is_elsewhere
from .lasting import recipe_specs
from .operation import wrong
from .relocation import MOVED_WITHIN, Gated, seen
from .structure import CANDIDATES

if TYPE_CHECKING:
    from ...supervision.spec import ChildSpec
    from ...supervision.supervisor import Supervisor
    from ..system import ActorSystem


UNKNOWN = (
    "no recipe at the root has its spec, and its supervisor, in another process, cannot tell one that has bindings, a "
    "mechanism, or a class that is not loaded here"
)
"""Why a child cannot be given away."""


def check_handing(place: DraftPlace, old: DraftPlace, new: DraftPlace) -> None:
    """Whether a child can be given by one supervisor to another, one of which lives in another process.

    Raises:
        SpecError: why not.
    """
    check_handed(place, old, new)
    if place.cell is None or place.is_stopped:
        raise wrong(place.path, "it does not run, and a supervisor lives in another process: start it first")
    if new.is_far:
        for one in (recipe_specs(new.cell) or ()) if new.cell is not None else ():
            early = one.bindings.keys() - one.late
            if port := next((port for port in early if is_at(place, one.bindings[port])), ""):
                why = f"it is started before the one to which its spec binds {port!r}"
                raise wrong(f"{new.path}/{one.id}", f"{why}: a restart of its supervisor would fail")
        if place.name in new.was.children:
            raise wrong(new.path, f"it has a child {place.name!r} until this transaction is in force: use the next one")


def is_at(place: DraftPlace, path: str) -> bool:
    """Whether the actor of a place is found at an address now."""
    return place.cell is not None and place.cell.node.find(path) is place.cell


def check_handed(place: DraftPlace, old: DraftPlace, new: DraftPlace) -> None:
    """Whether an actor can be given away, with its life, where its supervisor lives in another process, or will.

    Raises:
        SpecError: why not.
    """
    spec = place.spec
    if spec is None:
        raise wrong(place.path, UNKNOWN)
    if new.is_far:
        check_subtree(new.path, (spec,))
        Boxed(spec).packed()


class Handing:
    """One child that is given to another supervisor."""

    def __init__(self, place: DraftPlace, timeout: float) -> None:
        self._place, self._timeout = place, timeout
        self._candidate = next(CANDIDATES)
        self._start: asyncio.Task[Any] | None = None  # by the new supervisor, in its process; over behind the commit
        self._asked: Cell | None = None  # that supervisor
        self._life = 0  # of it
        self._parent: FarParent | None = None  # at the new address
        self._is_lodged = False  # it has a process for this only
        self._lodging = Gated(place, f"a process for {place.path}")

    @property
    def _above(self) -> DraftPlace:
        above = self._place.parent
        assert above is not None
        return above

    @property
    def _is_early(self) -> bool:
        """Whether its new supervisor is to be started by a step behind this one."""
        return self._above.is_planned and self._above.cell is None

    @property
    def waits_for(self) -> str:
        """Why it has no process of its own yet, in words; "" if nothing is known."""
        return self._lodging.waits_for

    def check(self) -> None:
        """Whether it can be given away with all else that the transaction wants of it.

        Raises:
            SpecError: why not.
        """
        place, moves = self._place, self._place.relocation
        is_changed = place.rework is not None or (moves is not None and not moves.is_of_place_alone)
        if place.is_given_away and is_changed:
            raise wrong(
                place.path,
                "it goes to or from another process's supervisor: its state, code and mechanisms, and whether it is "
                "suspended, are changed in a transaction of its own",
            )

    async def prepare(self, system: ActorSystem) -> None:
        """Have the new supervisor make room, if it lives in another process."""
        place = self._place
        if not place.is_given_away:
            return
        cell = place.living(system._node)
        if not place.is_protected and place_of(cell) != "process":
            within = max(MOVED_WITHIN, self._timeout)
            limits = place.spec.limits if place.spec is not None and place.spec.isolation == "process" else None
            work = functools.partial(system._moves.move, cell, "process", limits, within, known=place.spec)
            self._is_lodged |= await self._lodging.done(system, work)
        if self._is_early:
            return
        above = self._above.living(system._node)
        if not is_elsewhere(above) or (
            self._asked is above and self._life == above.coming_life and not self._has_failed()
        ):
            return
        await self._withdraw()
        self._asked, self._life = above, above.coming_life
        self._parent = far_parent(above, place.path)
        self._parent.expect()
        supervisor: ActorRef[Supervisor] = ActorRef(above)
        spec = self.spec_on_the_way(planned_spec(place, in_force=True))
        asked = supervisor.ask(StartChild(spec, candidate=self._candidate), START_TIMEOUT)
        self._start = system._node.loop.create_task(_reply(asked), name=f"room for {place.path}")
        self._start.add_done_callback(seen)

    def _has_failed(self) -> bool:
        """Whether the supervisor has ended before it had answered. Raises what it has answered: a refusal."""
        start = self._start
        if start is None or not start.done():
            return False
        error = start.exception()
        if error is not None and not isinstance(error, ActorStopped):
            raise error
        return True

    def ready(self, system: ActorSystem) -> str:
        """What is in the way of giving it away at this instant; "" if nothing is."""
        if not self._place.is_given_away:
            return ""
        if self._is_early:
            return f"{self._above.path} is being started"
        cell = self._place.living(system._node)
        old, at = cell.host.parent, cell.host.place
        if not (self._place.is_protected or isinstance(at, WorkerPlace)):
            return f"{cell.path} has no process of its own"
        if cell.state is not RUNNING or not cell.host.is_up(cell) or at.is_ending:
            return f"{cell.path} is being restarted"
        if system._moves.is_moving(cell):  # Its processes speak of it by the address at which that began.
            return f"{cell.path} is on its way to live elsewhere"
        if isinstance(old, FarParent) and (why := old.why_busy(cell)):
            return why
        if is_elsewhere(self._above.living(system._node)) and (
            self._parent is None or self._has_failed() or not self._parent.is_expected
        ):
            return f"{self._above.path} has not made room for {self._place.name!r} yet"
        return ""

    def commit(self, cell: Cell) -> None:
        """From here on the other supervisor decides what follows from its ends."""
        if not self._place.is_given_away:
            return
        old, new = cell.host.parent, self._parent
        if isinstance(old, FarParent):
            old.give_away(NEAR if new is None else new)
        if new is not None:
            new.take(cell)

    def spec(self, spec: ChildSpec) -> ChildSpec:
        """Its spec from the commit on: as the transaction has it, and not as it had a process for this."""
        known = self._place.spec
        assert known is not None
        is_other = self._is_lodged or self._place.relocation is not None
        return dataclasses.replace(spec, isolation=known.isolation, limits=known.limits) if is_other else spec

    def spec_on_the_way(self, spec: ChildSpec) -> ChildSpec:
        """Its spec as a supervisor in another process has it until it lives where that says."""
        return spec if self._place.is_protected else dataclasses.replace(spec, isolation="process")

    async def finish(self, system: ActorSystem) -> None:
        """Have it live where its spec says, when the new supervisor knows of it."""
        if self._start is not None:
            with contextlib.suppress(HoldfastError):  # It has ended: the next life has it in its recipe.
                await asyncio.shield(self._start)
        spec, moves = self._place.spec, self._place.relocation
        if spec is not None and spec.isolation == "task" and (self._is_lodged or moves is not None):
            await self._settle(system)

    async def _settle(self, system: ActorSystem) -> None:
        cell = self._place.now(system._node)
        if cell is not None:
            await system._moves.move(cell, "task", None, self._timeout)

    async def release(self, system: ActorSystem) -> None:
        """The new supervisor forgets it, and it lives where it did."""
        try:
            self._is_lodged |= await self._lodging.give_up()
        finally:  # The other one goes in any case.
            try:
                await self._withdraw()
            finally:
                if self._is_lodged:
                    await self._settle(system)

    async def _withdraw(self) -> None:
        start, parent, asked = self._start, self._parent, self._asked
        if start is None or parent is None or asked is None:
            return
        supervisor: ActorRef[Supervisor] = ActorRef(asked)
        try:
            with contextlib.suppress(ActorStopped):  # What it had made is gone with it.
                await supervisor.ask(RemoveChild(self._place.name, candidate=self._candidate), START_TIMEOUT)
        finally:
            parent.expect_nobody()
        with contextlib.suppress(HoldfastError):
            await start
        self._start = self._parent = self._asked = None


async def _reply(asked: Any) -> Any:
    return await asked


def far_parent(supervisor: Cell, path: str) -> FarParent:
    """Where a supervisor in another process is heard about an address below it."""
    top: Cell | None = supervisor
    while top is not None:
        if isinstance(top.host.place, SubtreePlace):
            return top.host.place.at(path)
        top = top.parent
    raise wrong(path, f"{supervisor.path} has no process, nor has anybody above it")
