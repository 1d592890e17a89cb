"""Moves live actors between tasks and OS processes: finds the sides, one move at a time for each actor."""

from __future__ import annotations

import asyncio
import dataclasses
import weakref
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from ..actors.control.orders import Order, Prepare, Ready, ReplaceCode, ReplaceState, Resume, Suspend
from ..actors.control.orders_lane import order
from ..actors.errors import AskTimeout, CannotMove, HoldfastError, SpecError
from ..actors.events import Moved
from ..actors.kernel.actor import Actor
from ..actors.kernel.cell import Cell
from ..actors.kernel.node import cell_kind
from ..actors.kernel.ref import current
from ..actors.migration.here import ToHere
from ..actors.migration.move import UNWANTED, CommitGate, Entering, Move, Pause
from ..actors.migration.worker import ToWorker
from ..actors.ordered import Ordered
from ..actors.process.process_host import WorkerPlace
from ..actors.process.resource_limits import Limits
from ..actors.process.wire.peer import OutsideHost
from ..actors.seconds import check_seconds
from ..checkpoint.home.journal_home import JournalHome
from ..checkpoint.home.recorded_home import switch_of
from ..checkpoint.places.far_parent import FarParent
from ..checkpoint.places.life_here import LifeHere
from ..checkpoint.places.recorded_moves import ToRecordedHere, ToRecordedWorker, leaving
from ..checkpoint.places.subtree_place import SubtreePlace
from ..supervision.respec import NO_RECIPE, recipe_spec, replace_mechanism, replace_place
from ..supervision.spec import ChildSpec, Isolation
from ..supervision.supervisor import Supervisor

if TYPE_CHECKING:
    from ..actors.kernel.address_host import AddressHost
    from ..actors.kernel.node import Node
    from ..checkpoint.home.homes import Homes


T = TypeVar("T")

BETWEEN_TURNS = (Suspend, ReplaceState, ReplaceCode, Prepare)
"""The orders after which an actor is not what it was in the middle of a turn."""
LOOK_AGAIN = 0.02
"""Seconds between two looks at whether a turn that an order waits for rests."""
LAST_LOOK = 0.05
"""Seconds for which a next life is waited for at least, also when the time of a change is nearly over."""

Begun = Callable[[Any], None]
"""Is told of the `Probation` of a stack of mechanisms, which may be over before anybody else could ask for it."""


class Moves:
    """The moves of one system."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._turns: weakref.WeakKeyDictionary[Cell, asyncio.Lock] = weakref.WeakKeyDictionary()
        self._tasks = Ordered[asyncio.Task[Any]]()
        self._under_way: dict[Cell, Move] = {}  # of mechanisms

    async def move(
        self,
        cell: Cell,
        isolation: Isolation,
        limits: Limits | None,
        timeout: float,
        gate: CommitGate | None = None,
        known: ChildSpec | None = None,
    ) -> bool:
        """Move an actor; if whoever wants it does not wait any more, the move comes to its end all the same.

        With a gate it waits there when all is ready. `known`: its spec, if it is lent a process
        for the time of another move; no recipe at the root need have that.
        Returns whether it has been moved: not if it lived there.

        Raises:
            CannotMove, ActorStopped, AskTimeout, ProcessUnavailable.
        """
        caller = current.get(None)
        if caller is not None and caller._cell is cell and caller._in_turn():
            raise CannotMove(cell.path, "a turn of its own waits for it; call this from outside, or from a task")
        settled = self._moved_there(cell, isolation, limits, timeout, gate, known)
        return await self._alone(cell, settled, f"move of {cell.path}", timeout, gate)

    def _over(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled():
            task.exception()  # Seen: whoever wanted it may not wait any more.

    async def close(self) -> None:
        """Undo what is under way."""
        for task in list(self._tasks):
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks)

    def lock(self, cell: Cell) -> asyncio.Lock:
        """Whoever has it is the only one who changes where an actor lives."""
        return self._turns.setdefault(cell, asyncio.Lock())

    async def _moved_there(
        self,
        cell: Cell,
        isolation: Isolation,
        limits: Limits | None,
        timeout: float,
        gate: CommitGate | None,
        known: ChildSpec | None,
    ) -> bool:
        origin, place, is_lent = place_of(cell), cell.host.place, known is not None
        if isinstance(cell.spec, ChildSpec) or recipe_spec(cell) is not None:
            known = _spec_of(cell)
        if origin == isolation and (known is None or known.mechanism is None):
            return False
        spec = _spec_there(cell, _spec_of(cell) if known is None else known, isolation, limits)
        if spec.mechanism is not None:  # Its replicas have processes: it lives there when nobody protects it.
            replace_place(cell, spec)
            cell.host.parent.respecified(cell, place.spec_data(cell))
            return False
        move = await self._moved(
            cell,
            timeout,
            lambda: self._made(cell, spec, timeout),
            lambda: replace_place(cell, spec, is_lent=is_lent),
            gate,
        )
        if self._node.events.has_listeners:
            self._node.emit(Moved(cell.path, origin, isolation, move.gone_on_at - move.rest_at))
        return True

    async def protect(
        self,
        cell: Cell,
        homes: Homes,
        mechanism: Any,
        timeout: float,
        gate: CommitGate | None = None,
        begun: Begun = lambda probation: None,
    ) -> None:
        """Have a group of replicas live an actor's life. With a gate it waits there when all is ready.

        `begun` is called with the probation of the mechanism, as soon as that begins.

        Raises:
            CannotMove, ActorStopped, AskTimeout, ProcessUnavailable: it goes on as it was.
        """
        protected = self._protected(cell, homes, mechanism, timeout, gate, begun)
        await self._alone(cell, protected, f"attach to {cell.path}", timeout, gate)

    async def _protected(
        self, cell: Cell, homes: Homes, mechanism: Any, timeout: float, gate: CommitGate | None, begun: Begun
    ) -> None:
        from ..ftm.events import MechanismAttached
        from ..ftm.group.group_place import GroupPlace
        from ..ftm.migration.protection import into_group

        before = _spec_of(cell)

        def moved() -> None:
            replace_mechanism(cell, dataclasses.replace(_spec_of(cell), mechanism=mechanism))
            assert isinstance(cell.host.place, GroupPlace)
            cell.host.parent.respecified(cell, cell.host.place.spec_data(cell))
            probation = cell.host.place.probation
            if probation is not None:
                probation.detach = lambda: self.unprotect(cell, timeout)
                begun(probation)

        # Without recovery, only what lives in this process has what a group needs of its state.
        is_by_way_of_a_task = place_of(cell) == "process" and not isinstance(cell.host.home, JournalHome)
        if is_by_way_of_a_task:
            way = None if gate is None else gate.passage()
            await self._settle_in(cell, "task", before.limits, timeout, way)
        try:
            move = await self._moved(
                cell,
                timeout,
                lambda: into_group(cell, homes, mechanism, timeout),
                moved,
                gate,
            )
        except BaseException:
            if is_by_way_of_a_task:
                await self._settle_in(cell, "process", before.limits, timeout)
            raise
        if self._node.events.has_listeners:
            names = tuple(layer.name for layer in move.entering.host.place.layers)
            self._node.emit(MechanismAttached(cell.path, names, move.gone_on_at - move.rest_at))

    async def unprotect(self, cell: Cell, timeout: float, gate: CommitGate | None = None) -> None:
        """Have a protected actor live as its spec says without the mechanism. With a gate it waits there when ready.

        Raises:
            CannotMove, ActorStopped, AskTimeout, ProcessUnavailable: it stays protected.
        """
        unprotected = self._unprotected(cell, timeout, gate)
        await self._alone(cell, unprotected, f"detach from {cell.path}", timeout, gate)

    async def _unprotected(self, cell: Cell, timeout: float, gate: CommitGate | None) -> None:
        from ..ftm.events import MechanismDetached
        from ..ftm.group.group_place import GroupPlace
        from ..ftm.migration.protection import is_plain, out_of_group
        from ..ftm.model.mechanism import compose

        if not isinstance(cell.host.place, GroupPlace):
            return  # It was on probation, and has given way by itself meanwhile; or this is the one that comes late.
        before: ChildSpec = cell.spec
        is_by_way_of_a_task = before.isolation == "process" and is_plain(cell)
        wanted = dataclasses.replace(
            before,
            mechanism=None,
            isolation="task" if is_by_way_of_a_task else before.isolation,
            limits=None if is_by_way_of_a_task else before.limits,
        )

        def moved() -> None:
            replace_mechanism(cell, wanted)
            if isinstance(cell.host.place, WorkerPlace):
                cell.host.parent.respecified(cell, cell.host.place.spec_data(cell))

        move = await self._moved(
            cell,
            timeout,
            lambda: out_of_group(cell, self._entering(self._node.ports.host_for(wanted), wanted.limits), timeout),
            moved,
            gate,
        )
        if self._node.events.has_listeners:
            names = tuple(layer.name for layer in compose(before.mechanism))
            self._node.emit(MechanismDetached(cell.path, names, move.gone_on_at - move.rest_at))
        if is_by_way_of_a_task:
            await self._settle_in(cell, "process", before.limits, timeout)

    async def adapt(
        self,
        cell: Cell,
        mechanism: Any,
        timeout: float,
        gate: CommitGate | None = None,
        begun: Begun = lambda probation: None,
    ) -> None:
        """Have a protected actor go on with another stack of mechanisms, all of it given. With a gate it waits there.

        `begun` is called with the probation of the new stack, as soon as that begins.

        Raises:
            CannotAdapt, ActorStopped, AskTimeout: it stays as it was.
        """
        adapted = self._adapted(cell, mechanism, timeout, gate, begun)
        await self._alone(cell, adapted, f"adaptation of {cell.path}", timeout, gate)

    async def _adapted(self, cell: Cell, mechanism: Any, timeout: float, gate: CommitGate | None, begun: Begun) -> None:
        from ..ftm.events import MechanismChanged
        from ..ftm.group.group_place import GroupPlace
        from ..ftm.group.reconfiguration import CannotAdapt

        attempts = _Attempts(cell, timeout, gate)
        while True:
            await attempts.until_up()  # It may be being recovered: its next life is changed.
            host, place = cell.host, cell.host.place
            if not isinstance(place, GroupPlace):
                raise CannotAdapt(cell.path, "it has no mechanism")
            old, life = place.layers, cell.life

            def switched(place: GroupPlace = place) -> None:
                replace_mechanism(cell, dataclasses.replace(cell.spec, mechanism=mechanism))
                begun(place.probation)

            try:
                change = await place.adapt(cell, mechanism, switched, gate=gate)
                break
            except CannotAdapt as error:
                if (cell.life == life and host.is_up(cell)) or cell.is_dead:
                    raise
                attempts.life_ended(error)
        if self._node.events.has_listeners:
            was, names = (tuple(layer.name for layer in layers) for layers in (old, change.layers))
            seconds = change.gone_on_at - change.rest_at
            self._node.emit(MechanismChanged(cell.path, was, names, change.config, seconds))

    async def given(self, cell: Cell, wanted: Order, timeout: float, *, is_alone: bool = False) -> Any:
        """What comes of an order. A turn that rests does not keep it waiting: it is run again, behind it.

        `is_alone`: whoever gives it has the actor's `lock`.
        """
        future, cell = order(cell, wanted, timeout), cell.living
        if not isinstance(wanted, (Resume, *BETWEEN_TURNS)) or switch_of(cell) is None:
            return await future
        gate = CommitGate(self._node.loop)
        gate.open()
        future.add_done_callback(lambda done: gate.close())  # Who has obeyed goes on.
        try:
            while not future.done():
                if rests(cell):
                    if isinstance(wanted, Resume):
                        return None  # It is in the middle of a turn, and so it is not suspended.
                    life, renewed = cell.life, self._renewed(cell, timeout, gate)
                    try:
                        if is_alone:
                            await renewed
                        else:
                            await self._alone(cell, renewed, f"end of the turn of {cell.path}", timeout, gate)
                    except (
                        HoldfastError
                    ):  # Then it waits for the turn, or the next life; or says that its time is over.
                        while not future.done() and cell.life == life:
                            await asyncio.wait((future,), timeout=LOOK_AGAIN)
                await asyncio.wait((future,), timeout=LOOK_AGAIN)
        finally:
            future.cancel()
        return future.result()

    async def _renewed(self, cell: Cell, timeout: float, gate: CommitGate) -> None:
        """Have the life at an address, a turn of which rests, begin anew where it is, before that turn.

        Not if the gate is closed meanwhile: its turn has ended by itself. And not where the change before, for which
        this one has waited, has left the turn, or has given the actor a place in which it is not left so.
        """
        if not rests(cell):
            return
        spec = _spec_of(cell)
        await self._moved(cell, timeout, lambda: self._made(cell, spec, timeout), lambda: None, gate)

    async def pause(self, cell: Cell, timeout: float, gate: CommitGate) -> None:
        """Bring a recorded or protected actor to rest where it lives; it goes on when the gate opens.

        Who replays turns takes a snapshot.

        Raises:
            CannotMove, ActorStopped, AskTimeout: it was not at rest in time, or the gate was closed; it goes on.
        """

        def made() -> Move:
            known = cell.spec if isinstance(cell.spec, ChildSpec) else recipe_spec(cell)
            if known is None or known.mechanism is None:
                return Pause(cell, leaving(cell), timeout)
            from ..ftm.migration.protection import rest_of_group

            return rest_of_group(cell, timeout)

        pausing = self._moved(cell, timeout, made, lambda: None, gate)
        await self._alone(cell, pausing, f"pause of {cell.path}", timeout, gate)

    async def _alone(
        self, cell: Cell, change: Coroutine[Any, Any, T], name: str, timeout: float, gate: CommitGate | None
    ) -> T:
        """Carry out a change of where an actor lives while no other is; it comes to its end in any case.

        If it is not its turn within the time, or the gate is closed before, it is not begun.

        Raises:
            CannotMove: it was not its turn in time.
        """
        is_begun = False

        async def in_turn() -> T:
            nonlocal is_begun
            lock = self.lock(cell)
            try:
                async with asyncio.timeout(timeout):
                    await lock.acquire()
            except TimeoutError as error:
                raise CannotMove(cell.path, f"another change of it is not over within {timeout:g} s") from error
            try:
                is_begun = True
                return await change
            finally:
                lock.release()

        def give_up(why: str) -> None:
            if not is_begun:
                task.cancel()

        task = self._node.loop.create_task(in_turn(), name=name, context=self._node.base_context.copy())
        self._tasks.add(task)
        task.add_done_callback(self._over)
        task.add_done_callback(lambda done: change.close())  # It may never have begun.
        if gate is not None:
            gate.on_closed(give_up)
        return await to_its_end(cell.path, task)

    async def _settle_in(
        self, cell: Cell, isolation: Isolation, limits: Limits | None, timeout: float, gate: CommitGate | None = None
    ) -> None:
        spec = _spec_there(cell, _spec_of(cell), isolation, limits)
        await self._moved(
            cell, timeout, lambda: self._made(cell, spec, timeout), lambda: replace_place(cell, spec), gate
        )

    def is_moving(self, cell: Cell) -> bool:
        """Whether an actor is on its way to live elsewhere."""
        move = self._under_way.get(cell)
        return move is not None and not move.stays

    async def _moved(
        self,
        cell: Cell,
        timeout: float,
        made: Callable[[], Move],
        moved: Callable[[], None],
        gate: CommitGate | None = None,
    ) -> Any:
        """Carry out a move; if the life ends before it is at rest, its next life is moved."""
        attempts = _Attempts(cell, timeout, gate)
        while True:
            await attempts.until_up()
            move = self._under_way[cell] = made()
            move.moved, move.gate = moved, gate
            try:
                await move.run()
            except CannotMove as error:
                if not move.is_late or cell.is_dead:
                    raise
                attempts.life_ended(error)
            else:
                return move
            finally:
                del self._under_way[cell]
                if move.ending is not None:  # The processes of replicas that are not needed.
                    await move.ending

    def _made(self, cell: Cell, spec: ChildSpec, timeout: float) -> Move:
        """The move that brings the actor to where its spec says."""
        if isinstance(cell.host, OutsideHost) or isinstance(cell.host.parent, FarParent):
            from ..ftm.migration.subtree_moves import move_below

            return move_below(cell, spec, timeout)
        return Move(cell, leaving(cell), self._entering(self._node.ports.host_for(spec), spec.limits), timeout)

    @staticmethod
    def _entering(host: AddressHost, limits: Limits | None) -> Entering:
        is_recorded = isinstance(host.home, JournalHome)
        if isinstance(host.place, WorkerPlace):
            return ToRecordedWorker(host, limits) if is_recorded else ToWorker(host, limits)
        return ToRecordedHere(host) if is_recorded else ToHere(host)


class _Attempts:
    """The lives of one actor that a change is begun with: if one ends before it is at rest, the next one."""

    def __init__(self, cell: Cell, timeout: float, gate: CommitGate | None) -> None:
        self._cell, self._timeout = cell, timeout
        self._gate = CommitGate(cell.node.loop) if gate is None else gate
        self._end = cell.node.loop.time() + timeout

    async def until_up(self) -> None:
        """Wait until a life is up.

        Raises:
            CannotMove: the change is not wanted any more, or lives have ended again and again and none is up in time.
            ActorStopped, AskTimeout.
        """
        cell, closed = self._cell, self._gate.closed
        is_known = not (self._gate.lives_ended and isinstance(cell.host, OutsideHost))  # Else its process knows that.
        if is_known and cell.host.is_up(cell):
            return
        up = order(cell, Ready(), max(self._end - cell.node.loop.time(), LAST_LOOK))
        try:
            await asyncio.wait((up, closed), return_when=asyncio.FIRST_COMPLETED)
            if not up.done():
                raise CannotMove(cell.path, UNWANTED)
            up.result()
        except AskTimeout as error:
            if self._gate.lives_ended:
                raise self._too_often() from error
            raise
        finally:
            up.cancel()

    def life_ended(self, error: HoldfastError) -> None:
        """A life has ended before it was at rest; raises the error if the next one is not tried."""
        self._gate.lives_ended += 1
        if self._gate.is_closed:
            raise error
        if self._cell.node.loop.time() > self._end:
            raise self._too_often() from error

    def _too_often(self) -> CannotMove:
        return CannotMove(self._cell.path, f"not within {self._timeout:g} s: {ended_too_often(self._gate.lives_ended)}")


def rests(cell: Cell) -> bool:
    """Whether a turn of an actor waits for a moment or a message, perhaps for days, and can be left."""
    switch, host = switch_of(cell), cell.host
    if switch is None or not switch.method.replays:
        return False
    is_here = isinstance(host.place, (LifeHere, WorkerPlace)) and not isinstance(host.parent, FarParent)
    return is_here and switch.calls.rests.is_busy


def why_not_left(cell: Cell) -> str:
    """Why an order waits for the turn of an actor that rests, and what helps, in words; "" if it does not."""
    switch, above = switch_of(cell), cell.host.parent
    if switch is None or not isinstance(above, FarParent) or not switch.calls.rests.is_busy:
        return ""
    team: Cell | None = cell.parent
    while team is not None and not isinstance(team.host.place, SubtreePlace):
        team = team.parent
    if team is None:
        return ""
    return (
        f"{team.path} has a process, below which a turn that waits is not left: have it live as a task, repeat this, "
        "and have it live in a process again"
    )


def ended_too_often(lives: int) -> str:
    """Say what keeps a change from an actor whose lives end too soon for it."""
    times = "once" if lives == 1 else f"{lives} times"
    return f"its life has ended {times} meanwhile, before it was at rest; mend what ends it, and try again"


def check_isolation(isolation: object, limits: object, timeout: object) -> None:
    """Raises SpecError: what a move is told is not valid."""
    if isolation not in get_args(Isolation):
        raise SpecError("set_isolation", f"isolation must be 'task' or 'process', not {isolation!r}")
    if limits is not None and (not isinstance(limits, Limits) or isolation != "process"):
        raise SpecError("set_isolation", f"limits must be Limits(...), of a process, or left out, not {limits!r}")
    check_seconds("set_isolation", "timeout", timeout)


async def to_its_end(actor: str, change: asyncio.Future[T]) -> T:
    """Wait for a change of where an actor lives, which goes on if whoever waits is cancelled.

    Raises:
        CannotMove: it was cancelled, for the system ends; nobody has cancelled whoever waits.
        CancelledError: whoever waits was.
    """
    try:
        return await asyncio.shield(change)
    except asyncio.CancelledError:
        if change.cancelled():
            raise CannotMove(actor, "the system ends") from None
        raise


def _spec_of(cell: Cell) -> ChildSpec:
    """The spec of a child, also if its supervisor lives in another process. Raises CannotMove: it is not known."""
    spec = cell.spec if isinstance(cell.spec, ChildSpec) else recipe_spec(cell)
    if spec is None:
        above = cell.parent
        if above is not None and above.actor is None and issubclass(cell_kind(above) or Actor, Supervisor):
            raise CannotMove(cell.path, NO_RECIPE)
        raise CannotMove(cell.path, "nobody restarts it, so nobody knows how; start it as a child of a supervisor")
    return spec


def place_of(cell: Cell) -> Isolation:
    """Where an actor lives: in a process of its own, or as a task of whatever process."""
    return "process" if isinstance(cell.host.place, WorkerPlace) else "task"


def _spec_there(cell: Cell, spec: ChildSpec, isolation: Isolation, limits: Limits | None) -> ChildSpec:
    """The spec of an actor that lives there.

    Raises:
        CannotMove: it cannot.
    """
    try:
        return dataclasses.replace(spec, isolation=isolation, limits=limits if limits is not None else spec.limits)
    except SpecError as error:
        raise CannotMove(cell.path, str(error)) from error
