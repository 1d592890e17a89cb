"""Takes a live actor elsewhere in a transaction: to a task, a process, or replicas behind mechanisms.

The new place is made ready and the actor comes to rest beside what runs; it waits at a gate that the commit opens. What
its spec says from then on is in force, and what runs follows it: if the life ends on the way, the next one is moved.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any, Protocol

from ...actors.kernel.cell import Cell
from ...actors.migration.move import CommitGate
from ...checkpoint.home.recorded_home import said_of_turn
from ...supervision.arbiter import Grant, Hand, arbiter_of
from ...supervision.respec import recipe_spec, replace_mechanism, replace_place
from ...supervision.spec import ChildSpec
from ..live_moves import ended_too_often, to_its_end
from .draft import rules
from .operation import StagedWork

if TYPE_CHECKING:
    from ...actors.kernel.node import Node
    from ...ftm.group.probation import Probation
    from ..system import ActorSystem
    from .draft import DraftPlace

MOVED_WITHIN = 60.0
"""Seconds that a life may take to move at least; the transaction gives up first, at its own time limit."""


class Inhabited(Protocol):
    """Where an actor lives, whichever life it is in."""

    def living(self, node: Node) -> Cell:
        """The cell that lives there now. Raises NoSuchActor."""
        ...


class Gated:
    """A change of one live actor that waits, when all is ready, for the commit; until then it can be given up."""

    def __init__(self, place: Inhabited, text: str) -> None:
        self._place, self._text = place, text
        self.task: asyncio.Task[Any] | None = None
        self._cell: Cell | None = None  # of the actor, as it is while this is done
        self._gate: CommitGate | None = None

    @property
    def waits_for(self) -> str:
        """Why it takes so long, in words; "" if nothing is known."""
        cell, gate, task = self._cell, self._gate, self.task
        if cell is None or gate is None:
            return ""
        if gate.lives_ended:
            return f"{cell.path}: {ended_too_often(gate.lives_ended)}"
        return "" if gate.is_waiting or task is None or task.done() else said_of_turn(cell.living)

    def begin(self, system: ActorSystem, work: Coroutine[Any, Any, object]) -> None:
        """Have it done; with a gate that `work` was given it waits there."""
        cell = self._cell = self._place.living(system._node)
        self.task = system._node.loop.create_task(
            to_its_end(cell.path, asyncio.ensure_future(work)),
            name=self._text,
            context=system._node.base_context.copy(),
        )
        self.task.add_done_callback(seen)

    async def reach(self, system: ActorSystem, work: Callable[[CommitGate], Coroutine[Any, Any, object]]) -> None:
        """Have it begun, if it is not, and wait until it is ready."""
        self.aim(system, work)
        while not self.is_waiting:
            await asyncio.wait(self.stirs, return_when=asyncio.FIRST_COMPLETED)

    def aim(self, system: ActorSystem, work: Callable[[CommitGate], Coroutine[Any, Any, object]]) -> None:
        """Have it begun, if it is not; it waits at the gate when it is ready."""
        if self.task is None:
            self._gate = CommitGate(system._node.loop)
            self.begin(system, work(self._gate))

    @property
    def stirs(self) -> tuple[asyncio.Future[Any], ...]:
        """What ends when it may be ready, or has failed; nothing if it is not begun."""
        return (self._gate.reached, self.task) if self._gate is not None and self.task is not None else ()

    async def done(self, system: ActorSystem, work: Callable[[CommitGate], Coroutine[Any, Any, bool]]) -> bool:
        """Have it done at once, at an open gate. Whoever waits no more has to give it up."""
        self._gate = CommitGate(system._node.loop)
        self._gate.open()
        self.begin(system, work(self._gate))
        assert self.task is not None
        return bool(await asyncio.shield(self.task))

    @property
    def is_waiting(self) -> bool:
        """Whether it is ready at this instant, or there was nothing to be done. Raises what has ended it."""
        if self.task is not None and self.task.done():
            self.task.result()
            return True
        return self._gate is not None and self._gate.is_waiting

    def open(self) -> None:
        """It is in force."""
        if self._gate is not None:
            self._gate.open()

    async def give_up(self) -> bool:
        """It is not to be, and can be begun anew. Returns whether it had been done already."""
        task, gate = self.task, self._gate
        if gate is not None:
            gate.close()
        if task is not None:
            await asyncio.wait((task,))
        self.task = self._gate = None
        return task is not None and task.exception() is None and bool(task.result())


class Relocation(StagedWork):
    """One actor that is to live elsewhere, or behind other mechanisms: the way from its spec to that of the draft."""

    def __init__(self, place: DraftPlace, text: str, timeout: float) -> None:
        self._place, self._text, self._within = place, text, max(MOVED_WITHIN, timeout)
        assert place.spec is not None
        self.before: ChildSpec = place.spec
        """What its spec says before the transaction."""
        self._move = Gated(place, text)
        self._grant: Grant | None = None
        self.probation: Probation | None = None
        """Whether its mechanisms stay is known when this is over; None: at once."""

    @property
    def _after(self) -> ChildSpec:
        spec = self._place.spec
        assert spec is not None
        return spec

    @property
    def _adapts(self) -> bool:
        """Whether its mechanisms are other ones."""
        return bool(described(self.before.mechanism) != described(self._after.mechanism))

    @property
    def _is_elsewhere(self) -> bool:
        """Whether its spec says that it lives elsewhere, mechanisms aside."""
        return self.before.isolation != self._after.isolation

    @property
    def _moves(self) -> bool:
        """Whether it does so now; who is protected does when nobody protects it any more."""
        return self._is_elsewhere and self._after.mechanism is None

    @property
    def is_of_place_alone(self) -> bool:
        """Whether it is about where an actor lives that nobody protects, before or after."""
        return self.before.mechanism is None and self._after.mechanism is None

    @property
    def _is_by_others(self) -> bool:
        """Whether others carry it out: who starts it, or who gives it to its new supervisor."""
        return self._place.is_planned or self._place.is_given_away

    @property
    def _comes_last(self) -> bool:
        """Its state, its code or its address is changed too: it is where it is until that is done."""
        at: DraftPlace | None = self._place
        while at is not None and not at.is_moved:
            at = at.parent
        return self._place.rework is not None or at is not None

    # -- before the commit --------------------------------------------------------------------------------------------

    async def prepare(self, system: ActorSystem) -> None:
        """Make the new place ready and wait until the life is at rest."""
        if self._is_by_others or not (self._adapts or self._moves):
            return
        if self._adapts and self._grant is None:
            path = self._place.path
            self._grant = arbiter_of(system._node).claim(path, Hand.ADAPTATION, self._text)
            system._mechanism_notes.begun(path, self._text)
        if not self._comes_last:
            await self._move.reach(system, lambda gate: self._work(system, gate))

    def _work(self, system: ActorSystem, gate: CommitGate | None) -> Coroutine[Any, Any, object]:
        cell, moves = self._place.living(system._node), system._moves
        wanted, before = self._after.mechanism, self.before.mechanism
        if not self._adapts:
            return moves.move(cell, self._after.isolation, self._after.limits, self._within, gate)
        if wanted is None:
            return moves.unprotect(cell, self._within, gate)
        if before is None:
            return moves.protect(cell, system._homes, wanted, self._within, gate, self._begun)
        return moves.adapt(cell, wanted, self._within, gate, self._begun)

    def _begun(self, probation: Probation) -> None:
        self.probation = probation

    @property
    def waits_for(self) -> str:
        return self._move.waits_for

    def ready(self, system: ActorSystem) -> str:
        """Whether it is at rest, and everything is ready for it."""
        cell = self._place.living(system._node) if not self._place.is_planned else None
        if cell is None or self._move.task is None or self._move.is_waiting:
            return ""
        return f"{cell.path} is not at rest any more"

    # -- from the commit on -------------------------------------------------------------------------------------------

    def commit(self, system: ActorSystem) -> None:
        """From here on its spec says so."""
        if self._is_by_others or not (self._adapts or self._is_elsewhere):
            return
        cell = self._place.living(system._node)
        now = cell.spec if isinstance(cell.spec, ChildSpec) else recipe_spec(cell)
        if now is not None and self._is_elsewhere and not (self._adapts and self._moves):
            replace_place(cell, dataclasses.replace(now, isolation=self._after.isolation))
        if now is not None and self._adapts and self._move.task is not None:
            isolation = now.isolation if self._moves else self._after.isolation
            replace_mechanism(
                cell, dataclasses.replace(now, mechanism=self._after.mechanism, isolation=isolation)
            )  # fmt: skip
            # A life that begins before the end of the change has it too.
            system._mechanism_notes.put(cell.path, self.before.mechanism, self._after.mechanism, is_trusted=False)
        self._move.open()

    async def finish(self, system: ActorSystem) -> None:
        """Have its life follow."""
        if self._is_by_others or not (self._adapts or self._moves):
            return
        try:
            if self._move.task is None:
                self._move.begin(system, self._work(system, None))
            assert self._move.task is not None
            await asyncio.shield(self._move.task)
            if self._adapts and self._moves:
                cell = self._place.living(system._node)
                await system._moves.move(cell, self._after.isolation, self._after.limits, self._within)
        finally:
            self._settle(system)

    def _settle(self, system: ActorSystem) -> None:
        """Note what its mechanisms are now, for the next root, and whether they are trusted."""
        if not self._adapts:
            return
        self._give_back(system)
        notes, path = system._mechanism_notes, self._place.path
        before, after = self.before.mechanism, self._after.mechanism
        cell = self._place.now(system._node)
        if cell is not None:  # Else its next life begins as its spec says.
            after = mechanism_of(cell)
        probation = self.probation
        notes.put(path, before, after, is_trusted=probation is None or probation.is_over)
        notes.over(path)

        def over(is_kept: bool) -> None:
            at = path if cell is None else cell.path  # It may have moved meanwhile.
            if is_kept:
                notes.settled(at, after)
            else:
                notes.put(at, after, before, is_trusted=False)
            notes.flush()

        if probation is not None:
            probation.when_over(over)
        notes.flush()

    # -- given up -----------------------------------------------------------------------------------------------------

    async def let_go(self, system: ActorSystem) -> bool:
        is_begun = self._move.task is not None
        await self._move.give_up()
        return is_begun

    async def release(self, system: ActorSystem) -> None:
        """It goes on where it is."""
        try:
            await self._move.give_up()
            if self._grant is not None:
                system._mechanism_notes.over(self._place.path)
        finally:
            self._give_back(system)

    def _give_back(self, system: ActorSystem) -> None:
        grant, self._grant = self._grant, None
        if grant is not None:
            arbiter_of(system._node).release(grant)


def seen(done: asyncio.Future[Any]) -> None:
    """Whoever wanted it may not wait any more: its error is no news then."""
    if not done.cancelled():
        done.exception()


def mechanism_of(cell: Cell) -> Any:
    """The mechanism that a live child has; None if it has none."""
    return (
        cell.spec.mechanism if isinstance(cell.spec, ChildSpec) else None
    )  # One that lives elsewhere has no spec here.


def described(mechanism: Any) -> Any:
    """A mechanism, or several, as it can be compared."""
    return None if mechanism is None else rules().describe(mechanism)
