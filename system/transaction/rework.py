"""Holds one live actor while a transaction changes its state, its code, or whether it is suspended.

The actor is held between two of its turns and tries what is wanted of it. At the commit it goes on with what it has
tried, or, if the transaction is given up, as before: it has handled nothing in between.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import msgspec

from ...actors.control.orders import Conclude, Order, Prepare, ReplaceCode, ReplaceState, Resume, Suspend, next_start
from ...actors.control.orders_lane import order
from ...actors.errors import ActorStopped, AskFailed, ControlFailed, HoldfastError, NotSuspended
from ...actors.events import ActorResumed, ActorSuspended
from ...actors.kernel import mailbox
from ...actors.kernel.actor import Start
from ...actors.kernel.cell import Cell, Host
from ...actors.migration.quiesce import ATTEMPTS
from ...actors.process.wire.start_codec import unpack_recipe
from ...checkpoint.home.recorded_home import give_other_code, switch_of, why_in_vain
from ...checkpoint.protocol import Snapshot
from ...supervision.respec import respec
from ...supervision.supervisor import listed_at, try_again
from ..history.authors import author
from ..live_moves import ended_too_often
from .arrangement import busy
from .operation import PROTECTED, StagedWork, wrong
from .relocation import seen

if TYPE_CHECKING:
    from ...checkpoint.home.switch import Switch
    from ..system import ActorSystem
    from .draft import DraftPlace

SNAPSHOT: msgspec.msgpack.Decoder[Snapshot] = msgspec.msgpack.Decoder(Snapshot)
PREPARED_WITHIN = 3600.0
"""Seconds that an actor may take to come to it; the transaction's own time limit is shorter."""
AGAIN_AFTER = 0.02
"""Seconds after which the next life of an actor is looked for."""
CONCLUDED_WITHIN = 60.0
"""Seconds that an actor in another process may take to hear that the transaction is over."""
OTHER_CODE = (
    "have its supervisor know code that fits (ChangeSupervisor), then TerminateChild, and StartChild or RestartChild"
)
"""What is to be done about an actor that cannot be recovered, if it is not by a change of its code alone."""


class Rework(StagedWork):
    """One actor that is held, all that is wanted of it, and what it has prepared."""

    def __init__(self, place: DraftPlace) -> None:
        self._place = place
        self._wanted: list[ReplaceState | ReplaceCode] = []
        self.suspended: bool | None = None
        """Whether it is to be suspended; None: as it is."""
        self._attempt = next(ATTEMPTS)
        self._held: LifeThere | None = None  # the life that has prepared
        self._recipe: bytes | None = None  # of the next lives, from another process
        self._saved: list[bytes] = []  # and the new state, as its home is to keep it
        self._concluded: asyncio.Future[Any] | None = None  # there
        self._lock: asyncio.Lock | None = None  # nobody moves it meanwhile
        self._lives_ended = 0  # before they were held
        self._trouble = ""
        self._begun_with: Start[Any] | None = None  # before it was to come back as the new class

    def add(self, wanted: ReplaceState | ReplaceCode) -> None:
        """One more thing.

        Raises:
            SpecError: that cannot be done to this actor, or not where it lives.
        """
        place = self._place
        if place.is_supervisor:
            raise wrong(place.path, "a supervisor is changed by its own operations: add, remove, strategy ...")
        if place.is_protected:
            raise wrong(
                place.path,
                PROTECTED,
            )
        if place.cell is not None and not lives_here(place.cell) and not place.cell.is_dead:
            wanted.pack(place.path)
        self._wanted.append(wanted)

    @property
    def _is_ordered(self) -> bool:
        """Whether it is only told, and not held: a supervisor has to answer meanwhile, and replicas are of the root."""
        return self._place.is_supervisor or self._place.is_protected

    async def prepare(self, system: ActorSystem) -> None:
        """Hold it, and have it try."""
        if self._is_ordered:
            return
        while True:
            cell = self._place.living(system._node)
            await self._claim(system, cell)
            life, self._held = cell.life, None
            try:
                self._recipe, self._saved = await self._prepared(system, cell)
            except (AskFailed, ActorStopped):
                if cell.life == life and cell.host.is_up(cell):
                    raise
                self._lives_ended += 1
                self._trouble = f"{cell.path}: {ended_too_often(self._lives_ended)}"
                await asyncio.sleep(AGAIN_AFTER)  # Its life has ended: the next one is prepared, if there is one.
                continue
            self._held = life_at(cell)
            return

    async def _prepared(self, system: ActorSystem, cell: Cell) -> tuple[bytes | None, list[bytes]]:
        """What an actor has prepared; one that cannot be recovered by its code comes back as the class that it becomes.

        Raises:
            ControlFailed: it cannot be recovered, or not by that class either.
        """
        wanted = Prepare(self._attempt, tuple(self._wanted))
        work = asyncio.ensure_future(system._moves.given(cell, wanted, PREPARED_WITHIN, is_alone=True))
        try:
            while not work.done():
                if why := why_in_vain(cell):
                    self._try_other_code(cell, why)
                await asyncio.wait((work,), timeout=AGAIN_AFTER)
        finally:
            work.cancel()
        return cast("tuple[bytes | None, list[bytes]]", work.result())

    def _try_other_code(self, cell: Cell, why: str) -> None:
        own, wanted = cell.extra().start, self._wanted[0] if len(self._wanted) == 1 else None
        is_told = isinstance(wanted, ReplaceCode) and wanted.change is None
        if own is None or self._begun_with is not None or not is_told or listed_at(cell.parent) is None:
            raise ControlFailed(cell.path, "prepare", f"it cannot be recovered: {why}; {OTHER_CODE}")
        assert isinstance(wanted, ReplaceCode)
        self._begun_with = own
        respec(cell, next_start(cell, wanted.start, keeps_arguments=wanted.keeps_arguments), is_lent=True)
        give_other_code(cell)
        try_again(cell)

    async def _claim(self, system: ActorSystem, cell: Cell) -> None:
        """Have nobody else move it."""
        lock = system._moves.lock(cell)
        if self._lock is not lock:
            self._let_go()
            await lock.acquire()
            self._lock = lock

    def _let_go(self) -> None:
        lock, self._lock = self._lock, None
        if lock is not None:
            lock.release()

    @property
    def waits_for(self) -> str:
        return self._trouble

    def ready(self, system: ActorSystem) -> str:
        """Whether the life that was prepared is the one."""
        place = self._place
        cell = place.living(system._node)
        if self._is_ordered:
            return busy(cell) if lives_here(cell) else ""
        if lives_here(cell):
            hold = mailbox.held(cell)
            is_held = hold is not None and hold.attempt == self._attempt
        else:
            switch = switch_of(cell)
            is_held = self._is_there(cell) and (switch is None or switch.life.counts)
        return "" if is_held else f"{cell.path} has begun a new life"

    def _is_there(self, cell: Cell) -> bool:
        """Whether the life that was prepared lives still, as far as is known here."""
        return self._held == life_at(cell) and cell.host.is_up(cell)

    def commit(self, system: ActorSystem) -> None:
        """It goes on with what it has prepared: here at once; elsewhere as soon as it hears so, before all else.

        Raises:
            ControlFailed: what it has prepared could not be kept, and it goes on as before.
        """
        cell = self._place.living(system._node)
        if self._is_ordered:
            if self.suspended is not None:
                self._tell(cell, Suspend() if self.suspended else Resume())
                self._report(cell)
            return
        switch, start = switch_of(cell), self._next_start(cell)
        if switch is not None and start is not None:
            switch.arrival.becomes = start  # Its snapshot is of the new class.
        if not lives_here(cell):
            try:
                self._keep(cell, start)
            except ControlFailed:
                self._tell(cell, Conclude(self._attempt, False, None))
                raise
        self._tell(cell, Conclude(self._attempt, True, self.suspended))
        self._report(cell)

    def _report(self, cell: Cell) -> None:
        if self.suspended is not None:
            cell.node.emit((ActorSuspended if self.suspended else ActorResumed)(cell.path, author()))

    def _next_start(self, cell: Cell) -> Start[Any] | None:
        """The recipe of its next lives; None: it is as before."""
        if not lives_here(cell):
            return None if self._recipe is None else unpack_recipe(self._recipe, imports=False)
        hold = mailbox.held(cell)
        return hold.prepared.start if hold is not None and hold.prepared is not None else None

    def _keep(self, cell: Cell, start: Start[Any] | None) -> None:
        """Have the next lives begin with what a life elsewhere has prepared: it may end before it hears of it.

        Raises:
            ControlFailed: the state could not be kept, and they begin as before.
        """
        switch = switch_of(cell)
        if switch is not None:
            before = len(switch.arrival.unsaved)
            switch.arrival.take_ahead([SNAPSHOT.decode(piece) for piece in self._saved])
            refuse_unsaved(cell, switch, before)
        if start is not None:
            respec(cell, start)

    def _tell(self, cell: Cell, wanted: Order) -> None:
        if not lives_here(cell):
            self._concluded = order(cell, wanted, CONCLUDED_WITHIN)
            self._concluded.add_done_callback(lambda done: self._over(cell))
            return
        actor = cell.actor
        assert actor is not None
        try:
            wanted.run(cell, actor)
        finally:
            self._over(cell)

    def _over(self, cell: Cell) -> None:
        switch = switch_of(cell)
        if switch is not None:
            switch.arrival.becomes = None
        self._let_go()

    async def finish(self, system: ActorSystem) -> None:
        """Wait until an actor in another process has heard it.

        What is in force is what its home keeps and its spec says, and the next life begins with that. So a life that
        cannot go on with it is ended.
        """
        if self._concluded is None:
            return
        cell = self._place.living(system._node)
        switch = switch_of(cell)
        before = 0 if switch is None else len(switch.arrival.unsaved)
        try:
            await asyncio.shield(self._concluded)
        except HoldfastError as error:
            if self._is_there(cell):
                end_life(cell)
                raise
            if not isinstance(error, (AskFailed, ActorStopped, NotSuspended)):
                raise
        if switch is not None:
            refuse_unsaved(cell, switch, before)

    async def let_go(self, system: ActorSystem) -> bool:
        if self._held is None:
            return False
        await self.release(system)
        self._held, self._attempt = None, next(ATTEMPTS)
        return True

    async def release(self, system: ActorSystem) -> None:
        """It goes on as before."""
        if self._is_ordered:
            return
        cell = self._place.now(system._node)
        try:
            if cell is not None and self._lock is not None:
                concluded = order(cell, Conclude(self._attempt, False, None), CONCLUDED_WITHIN)
                if self._begun_with is not None:
                    respec(cell, self._begun_with, is_lent=True)
                    cell.kill()  # If it has come back: as the class that it is not to become.
                    self._held = None
                if self._held is None:  # It has not come to it so far, and obeys this behind it.
                    concluded.add_done_callback(seen)
                else:
                    await concluded
        except (AskFailed, ActorStopped):
            pass  # The life that was held has ended.
        finally:
            if cell is not None:
                self._over(cell)
            self._let_go()


LifeThere: TypeAlias = "tuple[Cell, int, Host]"
"""A life: where, which one there, and in which process or task, for it may be carried over from one to another."""


def life_at(cell: Cell) -> LifeThere:
    """The present life of an actor."""
    return cell, cell.life, cell.host


def end_life(cell: Cell) -> None:
    """Have the next life begin at once: this one is not as it has to be, and nothing that it says counts."""
    switch = switch_of(cell)
    if switch is not None:
        switch.life.is_void = True
    cell.kill()


def refuse_unsaved(cell: Cell, switch: Switch, known: int) -> None:
    """Raises ControlFailed: more states than these could not be saved."""
    if len(switch.arrival.unsaved) > known:
        problem = f"the new state could not be saved ({switch.arrival.unsaved[-1]})"
        raise ControlFailed(cell.path, "replace_state", problem)


def lives_here(cell: Cell) -> bool:
    """Whether an actor's life, if it has one, is lived in this process."""
    return cell.actor is not None
