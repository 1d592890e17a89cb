"""The control methods of a system for live actors: they come ahead of messages and end in time."""

from __future__ import annotations

import asyncio
import dataclasses
from typing import TYPE_CHECKING, Any, TypeVar, cast

from ..actors.control.orders import (
    Change,
    GetState,
    ObserveTurns,
    Order,
    OutlineState,
    ReplaceCode,
    ReplaceState,
    Resume,
    Status,
    Suspend,
    known_at_home,
    next_start,
    status_of,
)
from ..actors.control.orders_lane import ask_status, order
from ..actors.control.tracing import Statistics, tap_of
from ..actors.errors import (
    ActorStopped,
    AskFailed,
    AskTimeout,
    CannotMove,
    ControlFailed,
    HoldfastError,
    SpecError,
    StillEnding,
)
from ..actors.events import ActorResumed, ActorSuspended, EventStream
from ..actors.exit_reasons import KILLED, SHUTDOWN, ExitReason, check_reason
from ..actors.kernel import lifecycle
from ..actors.kernel.actor import Actor, Start
from ..actors.kernel.cell import Cell
from ..actors.kernel.node import cell_kind
from ..actors.kernel.ref import DEFAULT_TIMEOUT, Target
from ..actors.process.grants import check_orders
from ..actors.process.process_host import WorkerPlace
from ..actors.process.resource_limits import Limits
from ..actors.process.wire.peer import OutsideHost
from ..actors.process.wire.start_codec import unpack_recipe
from ..actors.seconds import check_seconds
from ..checkpoint.home.recorded_home import switch_of
from ..checkpoint.home.switch import Switch
from ..checkpoint.places.far_parent import SlotPlace
from ..supervision.respec import respec
from ..supervision.spec import ChildSpec, Isolation
from ..supervision.supervisor import Supervisor
from .history.authors import author
from .history.lives import KILLED_BY_REF
from .history.recorder import HistoryRecorder, expect_end
from .live_moves import BETWEEN_TURNS, Moves, check_isolation, why_not_left
from .transaction.errors import TransactionFailed
from .transaction.mechanisms import Isolate

if TYPE_CHECKING:
    from ..actors.kernel.node import Node
    from ..ftm.group.protected import ProtectionStatus
    from .transaction.transaction import Transaction

A = TypeVar("A", bound=Actor)


STATUS_WITHIN = 1.0
"""Seconds in which an actor says what it is at."""


class Controls:
    """Control of live actors: tasks, processes, actors of a subtree in a process, recorded or not.

    Who is meant is said by a ref or an address. Each call raises ActorStopped if nobody lives there any more, and
    NoSuchActor if nobody is found at an address, AskTimeout if the actor does not come to it within `timeout`
    seconds (it is carried out between two turns, and the error's `turn` says which one is in the way), and
    SpecError if that is no finite number > 0. While an actor is
    restarted, its next life is waited for.
    """

    _moves: Moves
    _history: HistoryRecorder | None

    @property
    def _node(self) -> Node:
        """The node that hosts this process's actors."""
        raise NotImplementedError

    def transaction(self, *, dry_run: bool = False, timeout: float = 10.0) -> Transaction:
        """Several changes of the running tree as one."""
        raise NotImplementedError

    async def suspend(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> None:
        """Have an actor handle no message until `resume`; they wait in order. Twice is once.

        It still obeys its supervisor and all control. A suspension ends with the life.
        """
        cell = self._living(target)
        await self._order(target, Suspend(), timeout)
        cell.node.emit(ActorSuspended(cell.path, author()))

    async def resume(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> None:
        """Have it handle messages again. Twice is once."""
        cell = self._living(target)
        await self._order(target, Resume(), timeout)
        cell.node.emit(ActorResumed(cell.path, author()))

    async def get_state(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> Any:
        """A copy of an actor's state: what its `get_state()` gives, else a dict of its key variables.

        What cannot be copied (a ref, a socket) stands in it as `Opaque`. Of a supervisor it has its flags, its restarts
        within the period, and each child's class, state, restart type and restarts, beside what its class adds.
        """
        return await self._order(target, GetState(), timeout)

    async def outline(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> dict[str, str]:
        """Tell an actor's state in short texts, one for each variable; of a large one how large it is, and its start.

        Nothing is copied, so it also answers for a state that is too large to be sent. A state that is no dict has the
        name "".
        """
        return cast("dict[str, str]", await self._order(target, OutlineState(), timeout))

    async def replace_state(self, target: Target, change: Change, *, timeout: float = DEFAULT_TIMEOUT) -> Any:
        """Put `change(state)` in the place of an actor's state; returns the new one.

        `change` gets a copy and runs where the actor lives; for another process it must be a function of a module, or
        a `functools.partial` of one. A recorded actor saves the new state before it handles anything else.

        Raises:
            ControlFailed: `change` raised, or the state does not fit: a variable is missing that has no default in the
                class's body, or there is one that the body does not declare. The old one stays.
            SpecError: another process cannot import `change`.
        """
        return await self._replace(target, ReplaceState(change), timeout)

    async def replace_code(
        self,
        target: Target,
        new: type[Actor] | Start[Any],
        change: Change | None = None,
        *,
        timeout: float = DEFAULT_TIMEOUT,
    ) -> None:
        """Have a suspended actor go on as another class, now and after restarts.

        A variable that the actor has not yet is what `__init__` of the new class gives it.

        Args:
            target: the actor.
            new: the class, or `start(Class, ...)` if its arguments are to change too.
            change: `change(state)` gives the state as the new class wants it. Left out, the new class's classmethod
                `migrate(state, from_version)` does, as for a saved state, if its `schema_version` is higher.
            timeout: seconds.

        Raises:
            NotSuspended: suspend it first. ControlFailed: `change` or `migrate` raised, or the class needs a `migrate`
                and has none; variables may have been renamed; `__init__` does more than set variables, and there is no
                `change`. The old class stays.
            SpecError: the class does not take the arguments, or cannot be imported by the actor's process.
        """
        cell = self._living(target)
        if not isinstance(new, Start) and not (isinstance(new, type) and issubclass(new, Actor)):
            raise SpecError(cell.path, f"replace_code takes an Actor class or start(Class, ...), not {new!r}")
        start = new if isinstance(new, Start) else Start(new)
        keeps = not isinstance(new, Start)
        switch = switch_of(cell)
        if not isinstance(cell.host, OutsideHost):
            becomes = next_start(
                cell, start, keeps_arguments=keeps
            )  # What cannot be is refused before anything is done.
            if switch is not None and isinstance(cell.spec, ChildSpec):
                switch.arrival.becomes = becomes
        try:
            recipe = await self._replace(target, ReplaceCode(start, keeps, change), timeout)
        finally:
            if switch is not None:
                switch.arrival.becomes = None
        if recipe is not None:
            start = unpack_recipe(recipe, imports=False)
            respec(cell, start)

    async def _turn_in_hand(self, target: Target, *, is_left: bool = False) -> str:
        """The turn that an actor is in, for how long it has been, and where it waits, in words; "" if none is known.

        With `is_left` it is told, too, why a turn that waits was not left, and what helps.
        """
        try:
            said = said_of_turn(await self.get_status(target, timeout=STATUS_WITHIN))
            why = why_not_left(self._living(target)) if said and is_left else ""
        except HoldfastError:
            return ""
        return "; ".join(filter(None, (said, why)))

    async def get_status(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> Status:
        """How an actor is, also while a turn of it waits for something, and between two lives."""
        cell = self._living(target)
        try:
            return await self._status(cell, timeout)
        except (ActorStopped, AskFailed):  # Its process has ended, or is about to.
            return dataclasses.replace(status_of(self._living(target)), state="restarting", pid=0)

    async def _status(self, cell: Cell, timeout: float) -> Status:
        host = cell.host
        if isinstance(host, OutsideHost):
            return known_at_home(cast("Status", await ask_status(host.peer, cell, timeout)), cell)
        if not has_process(cell):
            return await self._of_leader(cell, timeout)
        own, worker = status_of(cell), host.place.process(cell)
        if worker is None:
            return dataclasses.replace(own, pid=0)
        there = known_at_home(cast("Status", await ask_status(worker, cell, timeout)), cell)
        state = there.state if own.state == "running" else own.state
        return dataclasses.replace(
            there,
            state=state,
            parent=own.parent,
            queued=own.queued,
            links=own.links,
            monitors=own.monitors,
        )

    async def _of_leader(self, cell: Cell, timeout: float) -> Status:
        """The status of an actor that no process beside this one has alone; with the turn of the replica that leads."""
        own, place = status_of(cell), cell.host.place
        worker = place.process(cell)
        if worker is None or not cell.host.work(cell).is_in_turn:
            return own
        try:
            told = await ask_status(worker, cell, min(timeout, STATUS_WITHIN), place.known_as(cell))
        except (ActorStopped, AskFailed, AskTimeout):  # Another one leads soon.
            return own
        there, names = known_at_home(told, cell), ("turn", "turn_seconds", "turn_at", "turn_rests")
        return dataclasses.replace(own, **{name: getattr(there, name) for name in names})

    async def protection(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> ProtectionStatus:
        """Whether an actor is protected by mechanisms now, by which, who leads, and whether a replica may die.

        It is what the root knows at this moment. (`timeout` is as for the other questions; nobody is asked.)
        """
        from ..ftm.group.protected import protection_of

        return protection_of(self._living(target))

    async def statistics(
        self, target: Target, on: bool | None = None, *, timeout: float = DEFAULT_TIMEOUT
    ) -> Statistics | None:
        """What an actor has done since its statistics were switched on; None while they are off.

        Args:
            target: the actor.
            on: True switches them on, False off; left out, they stay as they are.
            timeout: seconds.

        Of an actor with a process of its own, what was counted before its last restart is lost (but for `restarts`
        and `messages_in`).
        """
        cell = self._living(target)
        counts = cast("Statistics | None", await self._order(target, ObserveTurns(on, None), timeout))
        if not has_process(cell):
            return counts
        own = tap_of(cell).switch(on, None)
        if own is None or counts is None:
            return None
        return dataclasses.replace(own, **_done(counts))

    async def trace(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> EventStream:
        """Follow an actor: a stream of MessageIn, TurnBegan, TurnEnded and MessageOut. Close it when done.

        It goes on over restarts and ends when the address is given up. Of a turn that is in hand what it sends is
        shown, and not its end.
        """
        cell = self._living(target)
        tap = tap_of(cell)
        await self._order(target, ObserveTurns(None, True), timeout)
        stream = tap.listen()
        if has_process(cell):
            tap.attach()
        if has_process(cell) or isinstance(cell.host, OutsideHost):
            tap.forget = lambda: _no_more(cell)
        return stream

    async def set_isolation(
        self,
        target: Target,
        isolation: Isolation,
        *,
        limits: Limits | None = None,
        timeout: float = DEFAULT_TIMEOUT,
    ) -> None:
        """Move a live actor between a task and an OS process of its own, with its state and all that waits for it.

        Its next lives begin there too. Nothing is lost or doubled, asks are answered, and nobody hears of an end; the
        actor begins with `__init__`, its state, and `on_start(restored=True)`. Where it lives already, nothing is done.
        A supervisor goes with all below it, by a transaction of this one step: see `docs/control.md`.

        Args:
            target: the actor: a child of a supervisor in this process.
            isolation: "task" or "process".
            limits: of the process; left out, those of its spec.
            timeout: seconds within which another change of where it lives must be over, within which it must come to
                the end of its turn and of background work, and within which its new life must be up. (Making the new
                place ready goes on beside its work.)

        Whoever cancels this gives up waiting; the move itself comes to its end, but that of a supervisor is given up.

        Raises:
            CannotMove: why it stays where it was, as it was. ActorStopped: nobody lives there.
            ProcessUnavailable: no process could be had.
        """
        check_isolation(isolation, limits, timeout)
        cell = self._living(target)
        kind = cell_kind(cell)
        if kind is None or not issubclass(kind, Supervisor):
            if isolation == "process":
                check_orders(cell)
            await self._moves.move(cell, isolation, limits, timeout)
            return
        try:
            async with self.transaction(timeout=timeout) as change:
                change.step(Isolate(cell.ref, isolation, limits))
        except TransactionFailed as error:
            raise CannotMove(cell.path, error.cause) from error

    async def terminate(
        self, target: Target, reason: ExitReason = SHUTDOWN, *, timeout: float = DEFAULT_TIMEOUT
    ) -> ExitReason:
        """Have a life end in good order, for `reason`; its supervisor then does as its spec says.

        For the reason `KILLED` it ends at once, also in the middle of a turn that hangs, as by `ref.kill()`.

        Returns:
            The reason with which it ended.

        Raises:
            StillEnding: it has not ended within `timeout` seconds; an end that was asked for is not taken back.
            SpecError: the reason is none of the library's.
        """
        check_reason("terminate", reason)
        cell = self._living(target)
        check_seconds(cell.path, "timeout", timeout)
        gone = cell.ended()
        if reason == KILLED:
            expect_end(self._history, cell.path, KILLED_BY_REF)
            cell.ref.kill()
        else:
            expect_end(self._history, cell.path, "it was terminated")
            cell.request_stop(reason)
        done, _ = await asyncio.wait((gone,), timeout=timeout)
        if not done:
            gone.cancel()
            raise await self._busy(cell, StillEnding(cell.path, timeout))
        return gone.result()

    # -- how --------------------------------------------------------------------------------------------------------

    def _living(self, target: Target) -> Cell:
        living = self._node.meant(target)
        if living.is_dead:
            raise lifecycle.nobody_at(living)
        return living

    async def checkpoint(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> None:
        """Have a recorded actor's state saved; returns when all that it has handled up to now is in a snapshot.

        With a store that lasts, the snapshot is in it then. While the actor is being recovered, its next life is
        waited for; background work (`pipe_to_self`) that is out is waited for too.

        Raises:
            SpecError: its method keeps no snapshots. CheckpointFailed: it could not be saved, or has stopped.
            AskTimeout: it was not within `timeout` seconds.
        """
        cell = self._living(target)
        check_seconds(cell.path, "timeout", timeout)
        switch = switch_of(cell)
        if switch is None or not switch.method.snapshots:
            raise SpecError(cell.path, "keeps no snapshots: give it recovery=hybrid(...)")
        wish = switch.due.wish()
        done, _ = await asyncio.wait([wish], timeout=timeout)
        if not done:
            wish.cancel()
            raise await self._busy(cell, AskTimeout(cell.path, timeout, None))
        wish.result()

    async def _replace(self, target: Target, wanted: Order, timeout: float) -> Any:
        """Carry out an order that gives a recorded actor another state; raises ControlFailed if that is not kept."""
        cell = self._node.meant(target)
        switch = switch_of(cell)
        before = 0 if switch is None else len(switch.arrival.unsaved)
        try:
            result = await self._order(target, wanted, timeout)
        except HoldfastError:
            _check_saved(switch, before, cell.path, wanted.verb)
            raise
        _check_saved(switch, before, cell.path, wanted.verb)
        return result

    async def _order(self, target: Target, wanted: Order, timeout: float) -> Any:
        cell = self._node.meant(target)
        try:
            return await self._moves.given(cell, wanted, timeout)
        except AskTimeout as late:
            raise await self._busy(cell, late, is_left=isinstance(wanted, BETWEEN_TURNS)) from late

    async def _busy(self, cell: Cell, late: AskTimeout, *, is_left: bool = False) -> AskTimeout:
        """The same error; it says which turn is in the way, and since when, if that is known."""
        turn = await self._turn_in_hand(cell.ref, is_left=is_left)
        return type(late)(late.actor, late.seconds, late.handled, late.why, turn)


def said_of_turn(status: Status) -> str:
    """The turn that an actor is in, for how long it has been, and the line at which it waits; "" if it is in none."""
    if not status.turn:
        return ""
    at = f" (at {status.turn_at})" if status.turn_at else ""
    return f"its turn of {status.turn} has run for {status.turn_seconds:.0f} s{at}"


def has_process(cell: Cell) -> bool:
    """Whether the actor's life is lived in one process beside this one, which knows more of it than its home does."""
    return isinstance(cell.host.place, (WorkerPlace, SlotPlace))


def _check_saved(switch: Switch | None, before: int, path: str, verb: str) -> None:
    """Raises ControlFailed if the home could not keep a new state: that life ends, and the old state comes back."""
    if switch is not None and len(switch.arrival.unsaved) > before:
        raise ControlFailed(path, verb, f"the new state could not be saved ({switch.arrival.unsaved[-1]})")


def _done(counts: Statistics) -> dict[str, Any]:
    """What only the process itself has counted."""
    names = ("messages_out", "turns", "turn_seconds", "longest_turn", "turn_times")
    return {name: getattr(counts, name) for name in names}


def _no_more(cell: Cell) -> None:
    """Nobody follows any more: tell the process."""
    if not cell.is_dead:
        done = order(cell, ObserveTurns(None, False), DEFAULT_TIMEOUT)
        done.add_done_callback(lambda future: future.cancelled() or future.exception())
