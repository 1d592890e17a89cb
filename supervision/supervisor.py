"""The supervisor: an actor that starts its children in order, restarts them by its strategy, and stops them.

It decides in pure functions (`decisions.py`, `intensity.py`) and acts here. The rules are those of Erlang/OTP's
`supervisor`; `docs/supervision.md` has them as tables.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, ClassVar

from ..actors.errors import HoldfastError, SpecError, StartFailed, StartIgnored
from ..actors.events import AutoShutdown, ChildRestarted, ChildStartFailed, ChildTerminated, SupervisorGaveUp
from ..actors.exit_reasons import SHUTDOWN, Crash, ExitReason, Shutdown, crash
from ..actors.kernel import lifecycle
from ..actors.kernel.actor import Start, on
from ..actors.kernel.cell import DOWN, GONE, Cell, GivenName
from ..actors.kernel.envelope import Item, ReplyHandle
from ..actors.persistence import UNFIT, ends_in_vain, is_in_vain
from .admin import (
    AlreadyPresent,
    AlreadyStarted,
    ChangeSupervisor,
    ChildBusy,
    ChildParked,
    DeleteChild,
    NoSuchChild,
    RemoveChild,
    RestartChild,
    StartChild,
    TerminateChild,
    opened,
    reason_in,
)
from .awaited import LOOK_AGAIN, Prospects, tell_wait
from .children import (
    RECOVERING,
    RESTARTING,
    STARTING,
    STOPPED,
    STOPPING,
    UP,
    WITH_SUPERVISOR,
    Child,
    RestartAgain,
    StartLimit,
    StartNow,
    StartRow,
    begin_start,
    bind_expected,
    complete,
    new_cell,
    tell_stopped,
)
from .decisions import affected, decide, is_reported
from .errands import Errand, answered
from .inquiries import Inquiries
from .intensity import CountedCauses, admit_restart, recent_restarts
from .spec import ChildSpec, Flags, Plan, check_spec
from .supervisor_changes import (
    Bequest,
    TakeOver,
    account_of,
    check_place,
    new_plan,
    succession,
    take_over,
    told,
    why_occupied,
)

IN_VAIN = (
    "nothing that is recorded of it is lost: start it with the code that has recorded it, with an older snapshot, or "
    "afresh"
)
"""What is to be done about a child whose code does not fit what is recorded of it."""
ENDED = 100
"""Of the children that have ended and were not started again, so many are told of, the newest."""
DISMISSED = 1000
"""Of the children that were stopped by order and whose specs are gone, so many are remembered, the newest."""


class Supervisor(Inquiries):
    """Keeps its children alive. Built by `supervisor(...)`, or derived from, with an `init` that returns a `Plan`."""

    _supervises: ClassVar[bool] = True
    _is_asked_again = True
    _is_dynamic: ClassVar[bool] = False
    _with_successor = "anew"

    _template: ChildSpec | None = None  # of children that are started by their arguments
    _flags: Flags
    _restarts: tuple[float, ...]
    _causes: CountedCauses
    _planned: frozenset[str]
    _parked: set[str]
    _dismissed: dict[str, None]
    _is_in_place: bool = True  # one that is to take the place of another one is not, before it does
    _first: Errand | None = None  # the errand of our own start
    _errands: Sequence[Errand] = ()  # those that wait; some that are over may be among them

    def __init__(self, flags: Flags | None = None, children: tuple[ChildSpec, ...] = ()) -> None:
        self._given = Plan.of(flags or Flags(), children)

    @classmethod
    def _may_order(cls, start: Start[Any], path: str) -> tuple[str, ...]:
        """What the bindings of those below it lead to, as far as its recipe names them."""
        found: list[str] = []
        for given in (*start.args, *start.kwargs.values()):
            for spec in given if isinstance(given, (tuple, list)) else (given,):
                if isinstance(spec, ChildSpec):
                    found += (*spec.bindings.values(), *spec.start.kind._may_order(spec.start, f"{path}/{spec.id}"))
        return tuple(found)

    def init(self) -> Plan:
        """Flags and children, asked for at each start and at a `ChangeSupervisor()`. May raise `Ignore`."""
        return self._given

    # -- errands ----------------------------------------------------------------------------------------------------

    def _errand(self, work: Coroutine[Any, Any, None], first: lifecycle.FirstTurn | None = None) -> Errand:
        """Begin what has to wait for others; what comes behind its first wait is done in turns of its own."""
        errand = Errand(self.ctx, work, first)
        errand.step()
        if not errand.is_over:
            self._errands = [*(one for one in self._errands if not one.is_over), errand]
        return errand

    def _outside(self) -> list[Coroutine[Any, Any, Any]]:
        return [one.work for one in self._errands if not one.is_over]

    def _answered(self, work: Coroutine[Any, Any, Any]) -> ReplyHandle[Any]:
        """Do what was asked for as an errand, and answer at its end."""
        handle = self.ctx.reply_handle()
        self._errand(answered(self.ctx, handle, work))
        return handle

    # -- start ------------------------------------------------------------------------------------------------------

    async def on_start(self, restored: bool) -> None:
        """Begin to start the children, left to right; if one fails, the others are stopped in reverse and so do we.

        The start is over when all of them are up, which can be after this has returned: a child may take its time, and
        we answer meanwhile.
        """
        self.ctx.trap_exits = True  # Only our own parent can end us: the end of a stranger that is linked is no order.
        start = self.ctx._cell.extra().start
        if start is None or start.begins_with is None:
            self._begin(new_plan(self))
            work = self._start_all()
        else:
            flags, children = start.begins_with
            self._is_in_place = False
            Supervisor._begin(self, Plan.of(flags, children))
            self._inherit({})
            work = self._start_listed()
        self._first = self._errand(self._come_all_up(work), self.ctx._item)

    def _begin(self, plan: Plan) -> None:
        """Take up the plan of this start."""
        self._flags = plan.flags
        self._children = {spec.id: Child(spec) for spec in plan.children}
        self._planned, self._parked = frozenset(self._children), set[str]()
        self._dismissed, self._ended = {}, {}
        self._restarts, self._causes = (), CountedCauses()
        self._early: list[lifecycle.ChildExit] = []

    def _is_starting(self) -> bool:
        return self._first is not None and not self._first.is_over

    async def _come_all_up(self, work: Coroutine[Any, Any, None]) -> None:
        """The errand of our own start."""
        await work
        for early in self._early:
            self.ctx._cell.push(early)
        self._early.clear()

    async def _start_all(self) -> None:
        """Start the children of the plan, or those that there were before."""
        self._tell_begun()
        await self._start_listed()

    def _tell_begun(self) -> None:
        """Say which children there are or come back: whoever waits for another one hears that it does not."""
        self.ctx._cell.node.ports.keeper.began(self.ctx.path, list(self._children))

    async def _start_listed(self) -> None:
        """Start the children that are listed."""
        row = StartRow((one for one in self._children.values() if one.spec.autostart), STARTING)
        while (one := row.next()) is not None:
            try:
                await self._come_up_in(row, one)
            except HoldfastError as error:
                self._blame(one, str(error))
                raise

    async def _start(self, one: Child) -> bool:
        """Start a child and wait until it is up. False: it did not want to be.

        Raises:
            StartFailed, or another HoldfastError: naming the child and why.
        """
        row = StartRow((one,), STARTING)
        is_up = await self._come_up_in(row, one)
        if is_up is None:
            raise StartFailed(self._path_of(one), "it was stopped while it started")
        return is_up

    async def _come_up_in(self, row: StartRow, one: Child) -> bool | None:
        """Start a child of a row and wait until it is up. False: it did not want to be; None: it is not ours any more.

        Raises:
            StartFailed, or another HoldfastError: naming the child and why.
        """
        row.current = one
        try:
            await self._await_bound(row, one)
            if one.row is row and one.spec.register is not None:
                await self._take_name(one, one.spec.register)
            await self._await_erased(row, one)
            if one.row is not row:
                return None
            await self._come_up(one)
        except StartIgnored:
            if one.row is not row:
                return None
            self._ignored(one)
            return False
        except HoldfastError as error:
            if one.row is not row:
                return None
            self._start_failed(one, error)
            raise
        if one.row is not row:
            return None
        self._is_up(one)
        cell = one.cell
        if cell is not None and cell.state is DOWN:
            # It ended before we heard that it was up: its end in our queue may be passed over already.
            self.ctx._cell.push(lifecycle.ChildExit(cell, cell.life, cell.extra().reason))
        return True

    async def _await_erased(self, row: StartRow, one: Child) -> None:
        """Wait until nothing is being erased that was recorded at the child's address, or below it.

        Raises:
            StartFailed: the store refuses to erase it.
        """
        path, keeper = self._path_of(one), self.ctx._cell.node.ports.keeper
        try:
            while one.row is row and (erased := keeper.erasing(path)) is not None:
                await erased
        except HoldfastError as error:
            raise StartFailed(path, f"what was recorded there is not erased: {error}") from error

    async def _await_bound(self, row: StartRow, one: Child) -> None:
        """Wait until those are there that the child's spec binds it to, if they are being started.

        Raises:
            StartFailed: they cannot come, or have not come within the time that the start may take.
        """
        if one.cell is not None and one.cell.state is not GONE and not one.comes:
            return  # It has been bound: the address is there since.
        loop, who, seconds = self.ctx._cell.node.loop, self._path_of(one), one.spec.start_timeout or "infinity"
        prospects, since, told = Prospects(self.ctx._cell.node, listed_at), loop.time(), False
        try:
            while one.row is row and (missing := prospects.missing(who, one)):
                if not told:
                    tell_wait(self.ctx._cell)
                    told = True
                if not isinstance(seconds, str) and loop.time() - since >= seconds:
                    raise StartFailed(who, f"{missing}, to which it is bound, was not there within {seconds:g} s")
                await asyncio.sleep(LOOK_AGAIN)
        finally:
            one.awaited = ""

    async def _come_up(self, one: Child) -> None:
        """Launch a child and wait for it. Raises what `_launch` does, or how the start ended."""
        up = self._launch(one)
        if up is None:
            return
        if one.spec.has_home:
            one.state = RECOVERING
        one.up = up
        limit = StartLimit(one)
        try:
            await up
        except asyncio.CancelledError as error:
            turn = self.ctx._cell.extra().turn
            if turn is not None and turn.killed:
                raise  # It is our own turn that is killed.
            why = limit.told if limit.is_over else "it was killed while it started"
            raise StartFailed(self._path_of(one), why) from error
        except StartFailed as error:
            if limit.is_over:
                raise StartFailed(self._path_of(one), limit.told) from error
            raise
        except HoldfastError:
            raise
        except Exception as error:
            raise StartFailed(self._path_of(one), str(error)) from error
        finally:
            limit.close()
            if one.up is up:
                one.up = None

    def _launch(self, one: Child) -> asyncio.Future[None] | None:
        """Begin a life of the child; a future if it takes longer than this turn.

        Raises:
            StartFailed, StartIgnored: at once. NameTaken: somebody else lives at its address.
        """
        cell = self._address_of(one)
        seconds = one.spec.start_timeout or "infinity"
        if isinstance(seconds, str):
            return cell.host.start(cell)
        void = begin_start(cell, seconds)
        try:
            return cell.host.start(cell)  # `__init__` may block already.
        finally:
            void()

    def _address_of(self, one: Child) -> Cell:
        """The cell of a child, made now if it has none. Raises StartFailed, NameTaken: see `new_cell`."""
        cell = one.cell
        if cell is None or cell.state is GONE:
            cell = one.cell = new_cell(self.ctx._cell, one)
            one.ignored_life = 0  # A new address counts its lives anew.
            one.comes = False
        elif one.comes:
            bind_expected(self.ctx._cell, one, cell)
        return cell

    async def _take_name(self, one: Child, name: GivenName) -> None:
        """Have a child that is about to start found by the name that its spec says.

        If it is stopped meanwhile, the name is free again when its address is, or when its next life ends.

        Raises:
            StartFailed: another one has the name. Else what `_address_of` raises.
        """
        cell = self._address_of(one)
        claimed = cell.host.place.name(cell, name)
        if claimed is not None:
            await claimed

    def _is_up(self, one: Child) -> None:
        one.state = UP
        self._parked.discard(one.spec.id)
        self._dismissed.pop(one.spec.id, None)
        self._ended.pop(one.spec.id, None)
        one.row = None
        one.up_since = self.ctx._cell.node.loop.time()

    def _start_failed(self, one: Child, error: HoldfastError) -> None:
        one.state, one.row = STOPPED, None
        if one.cell is not None:
            if one.cell.life > one.ignored_life and isinstance(error, StartFailed):  # A life was begun, and has ended.
                error.struck_by = error.struck_by or one.cell.extra().reason.common_cause
            one.ignored_life = one.cell.life
        node = self.ctx._cell.node
        if node.events.has_listeners:
            reason = error.reason if isinstance(error, StartFailed) else str(error)
            node.emit(ChildStartFailed(self._path_of(one), reason))

    def _ignored(self, one: Child) -> None:
        """It did not want to be started, which is no failure: the spec stays, that of a temporary child does not."""
        one.row = None
        if one.cell is not None:
            one.ignored_life = one.cell.life
        self._give_up_address(one, "it did not want to be started")

    # -- a child has ended ------------------------------------------------------------------------------------------

    def child_exited(self, cell: Cell, life: int, reason: ExitReason) -> None:
        """Decide what follows from the end of a child's life (called by the loop, in a turn of ours)."""
        one = self._children.get(cell.name)
        if cell.parent is not self.ctx._cell and cell.parent is not None:
            cell.parent.push(lifecycle.ChildExit(cell, life, reason))  # It was moved since: another one decides.
            return
        if one is None or one.cell is not cell:
            lifecycle.retire(cell, reason)
            return
        if life <= one.ignored_life:
            return  # We stopped it, or its start has failed.
        if one.state != UP:
            if cell.life == life and one.up is None:
                self._report_end(one, life, reason)  # It is one of those that we are about to stop.
            return  # Or it ended while it started: that is told by who waits for the start.
        spec = one.spec
        if self._is_starting() and self._flags.strategy != "one_for_one":
            self._early.append(lifecycle.ChildExit(cell, life, reason))  # First the others come up.
            return
        self._report_end(one, life, reason)
        action = decide(spec.restart, spec.rules, reason)
        if action == "escalate":
            self._give_up(one, reason, reason)
        elif action == "stop":
            self._give_up_address(one, reason)
            self._end_with_significant(one, reason)
        elif spec.backoff is not None:
            self._later(one, reason)
        elif ends_in_vain(reason):
            self._give_up_in_vain(one, reason)
        else:
            self._restart(one, reason)

    def _child_lost(self, cell: Cell) -> None:
        one = self._listed().get(cell.name)
        if one is None or one.cell is not cell:
            return
        self._give_away(one.spec.id)
        one.row, one.state = None, STOPPED
        one.retry += 1

    def _has_lost(self, one: Child) -> bool:
        """Whether another supervisor has this child now, and its life goes on."""
        return one.cell is not None and one.cell.parent is not self.ctx._cell

    def _report_end(self, one: Child, life: int, reason: ExitReason) -> None:
        """Tell that a child has ended without having been told to."""
        one.ignored_life = life
        node = self.ctx._cell.node
        if not is_reported(one.spec.restart, reason):
            if one.spec.restart == "transient" and one.cell is not None:
                because = f"it has ended with {reason}" if one.spec.is_supervisor else "its work is done"
                tell_stopped(one.cell, one.cell.path, because)
        elif node.events.has_listeners:
            allowed, period = self._flags.intensity, self._flags.period
            restarts = len(recent_restarts(self._restarts, node.loop.time(), period))
            node.emit(ChildTerminated(self._path_of(one), reason, restarts, allowed))

    def _give_up_address(self, one: Child, reason: object) -> None:
        """The child is not restarted: its address goes, its spec too if it is temporary."""
        one.state = STOPPED
        self._note_end(one, reason)
        if one.cell is not None:
            lifecycle.retire(one.cell, reason)
        if one.spec.restart == "temporary":
            self._forget(one)
            self._dismiss(one)

    def _dismiss(self, one: Child) -> None:
        """Its address is free and its spec forgotten: nothing that comes waits for next lives of those below it."""
        spec = one.spec
        is_over = self._is_dynamic or spec.id not in self._planned  # Else our next life has it again.
        is_known = spec.mechanism is not None or not spec.made_up  # Else nobody will have this name again.
        if spec.is_supervisor or (is_over and is_known):
            self.ctx._cell.node.ports.keeper.dismissed(self._path_of(one), below=spec.is_supervisor, for_good=is_over)

    def _note_end(self, one: Child, reason: object) -> None:
        self._ended.pop(one.spec.id, None)
        self._ended[one.spec.id] = reason
        if len(self._ended) > ENDED:
            del self._ended[next(iter(self._ended))]

    def _forget(self, one: Child) -> None:
        """The spec goes: the one way out of the list of children."""
        if self._children.get(one.spec.id) is one:
            del self._children[one.spec.id]
            if one.spec.id in self._parked and one.spec.id not in self._planned:
                self._parked.discard(one.spec.id)  # Nobody brings it back: not our next life, either.
                self._dismissed[one.spec.id] = None
                if len(self._dismissed) > DISMISSED:
                    del self._dismissed[next(iter(self._dismissed))]

    def _end_with_significant(self, one: Child, reason: ExitReason) -> None:
        """A child has ended by itself for good: if it was significant, that may be the end of us."""
        flags = self._flags
        if not one.spec.significant or flags.auto_shutdown == "never":
            return
        left = (other.spec.significant and other.state != STOPPED for other in self._children.values())
        if flags.auto_shutdown == "all_significant" and any(left):
            return
        self.ctx._cell.node.emit(AutoShutdown(self.ctx.path, one.spec.id, reason))
        self.ctx.stop(SHUTDOWN)

    def _later(self, one: Child, reason: ExitReason) -> None:
        """Restart after the back-off; meanwhile everybody else is served."""
        backoff = one.spec.backoff
        assert backoff is not None
        loop = self.ctx._cell.node.loop
        if one.state == UP and loop.time() - one.up_since >= backoff.reset_after:
            one.attempts = 0
        delay = backoff.delay(one.attempts, self.ctx.random)
        one.attempts += 1
        one.state, one.due = RESTARTING, reason
        one.retry += 1
        loop.call_later(delay, self._post, RestartAgain(one, one.retry, reason))

    def _post(self, item: Item) -> None:
        if not self.ctx._closed:
            self.ctx._cell.push(item)

    def _retry(self, one: Child, number: int, reason: ExitReason) -> None:
        """A restart is due, unless the child was stopped or started meanwhile."""
        if number == one.retry and one.state == RESTARTING:
            one.due = None
            self._restart(one, reason)

    def _start_now(self, one: Child, number: int) -> None:
        """Try at once, by order, to start a child that is in a back-off."""
        if number == one.retry and one.state == RESTARTING:
            one.due = None
            self._errand(self._bring_back(one, [one]))

    def _restart(self, one: Child, reason: ExitReason) -> None:
        """One attempt by the strategy, counted; gives up when there were too many."""
        node, flags = self.ctx._cell.node, self._flags
        now, intensity, period = node.loop.time(), flags.intensity, flags.period
        window: tuple[float, ...] | None = recent_restarts(self._restarts, now, period)
        if not self._causes.is_counted(reason.common_cause, one.spec.id, now, period):
            window = admit_restart(self._restarts, now, intensity=intensity, period=period)
        own = admit_restart(one.restarts, now - one.away, intensity=intensity, period=period)
        if window is None or own is None:
            slow = "" if window is None else f", not counting the {one.away:.0f} s that restarts have taken"
            why = f"restart intensity reached{slow}; the last to end was {self._path_of(one)}: {reason}"
            self._give_up(one, reason, Shutdown(why, reason.common_cause))
            return
        self._restarts, one.restarts = window, own
        if one.spec.is_supervisor:  # Perhaps it has ended because of somebody below it: that one comes back as it says.
            node.ports.keeper.returned(self._path_of(one))
        if node.events.has_listeners:
            node.emit(ChildRestarted(self._path_of(one), reason, len(window), flags.intensity))
        order = list(self._children.values())
        group = affected(flags.strategy, order, order.index(self._first_struck(one, reason)))
        wanted = [
            other
            for other in group
            if other is one or (other.state != STARTING and (other.spec.autostart or other.is_running))
        ]
        self._errand(self._restart_group(one, wanted, now))

    def _first_struck(self, one: Child, reason: ExitReason) -> Child:
        """The first of the children that are restarted because of what has ended this one: one restart is for all."""
        cause = reason.common_cause
        if not cause or self._flags.strategy == "one_for_one":
            return one
        return next(other for other in self._children.values() if other is one or _has_ended_by(other, cause))

    def _give_up(self, one: Child, reason: ExitReason, told: ExitReason) -> None:
        """We end: too many restarts, or a rule says that this end is one for whoever is above us."""
        one.state = STOPPED
        if not reason.common_cause:
            self._blame(one, str(reason))
        node = self.ctx._cell.node
        node.supervised.gave_up = SupervisorGaveUp(self.ctx.path, one.spec.id, reason)
        if isinstance(reason, Crash):
            node.supervised.crashed = node.supervised.gave_up
        node.emit(node.supervised.gave_up)
        self.ctx.stop(told)

    def _blame(self, one: Child, why: str) -> None:
        """We end because of this child: it may begin with an older state than that from which it has failed.

        Not if what is recorded does not fit its class: an older state would only lose what was acknowledged.
        """
        if UNFIT not in why:
            self.ctx._cell.node.ports.keeper.blame(self._path_of(one))

    def _path_of(self, one: Child) -> str:
        return f"{self.ctx.path}/{one.spec.id}"

    async def _erase(self, one: Child) -> None:
        """Forget what was recorded of a child that does not run. Raises HoldfastError if the store refuses."""
        if one.cell is not None:
            lifecycle.retire(one.cell, "it begins afresh")
        one.spec = complete(self.ctx._cell, one.spec)
        if one.spec.is_supervisor or one.spec.has_home:
            keeper = self.ctx._cell.node.ports.keeper
            erased = keeper.erase(self._path_of(one), below=one.spec.is_supervisor)
            if erased is not None:
                await erased

    async def _restart_group(self, failed: Child, group: list[Child], since: float) -> None:
        """Restart these children because one has ended: how long that takes does not make its next end a rarer one."""
        try:
            await self._bring_back(failed, group)
        finally:
            failed.away += self.ctx._cell.node.loop.time() - since

    async def _bring_back(self, failed: Child, group: list[Child]) -> None:
        """Stop the others newest first, then start all of them in order; siblings wait for one that takes its time."""
        running = [one for one in group if one is not failed and one.state != STOPPED]
        row = StartRow(group, RESTARTING)
        because = f"{self._path_of(failed)} has ended, and they are restarted together ({self._flags.strategy})"
        for one in reversed(running):
            if one.row is not row:
                continue
            await self._stop(one, row=row, because=because)
            if one.row is row and one.spec.restart == "temporary":
                self._give_up_address(one, SHUTDOWN)
        while (other := row.next()) is not None:
            if self._children.get(other.spec.id) is not other:
                continue
            try:
                await self._come_up_in(row, other)
            except HoldfastError as error:
                row.leave()
                self._again(other, crash(error))  # The others stay up, or are stopped, until it is tried again.

    def _again(self, one: Child, reason: ExitReason) -> None:
        """A start has failed: try once more, which counts, unless only other code can help."""
        one.state = RESTARTING
        if one.spec.backoff is not None:
            self._later(one, reason)
            return
        if is_in_vain(str(reason)):
            if one.cell is not None:
                one.cell.extra().reason = reason  # Whoever waits there is told this, and not how its last life ended.
            self._give_up_in_vain(one, reason)
            return
        one.retry += 1
        self.ctx._cell.push(RestartAgain(one, one.retry, reason))  # Through our own mailbox: we answer in between.

    def _give_up_in_vain(self, one: Child, reason: ExitReason) -> None:
        """We end, for each further life of this child would end as the last one did."""
        why = Shutdown(f"{self._path_of(one)} cannot be started again: {reason}; {IN_VAIN}")
        self._give_up(one, why, why)

    # -- stopping ---------------------------------------------------------------------------------------------------

    async def _stop(
        self,
        one: Child,
        reason: ExitReason = SHUTDOWN,
        *,
        row: StartRow | None = None,
        by: str | None = None,
        because: str = "its supervisor has stopped it",
    ) -> None:
        """Stop a child as its spec says, and wait for its end; its address and queue stay.

        `row` is that with which it will be started again; without one, whoever waits for its start hears that it was
        stopped. `by` and `because` are told with its end: who has called for it (None: we), and why.
        """
        cell = one.cell
        one.retry += 1
        one.row = row
        starting, one.up = one.up, None
        state = STOPPED if row is None else RESTARTING
        if cell is None or cell.state is GONE:
            one.state = state
            return
        one.ignored_life = cell.life  # Also if it has ended just now: its end is in our queue, and is known here.
        if cell.state is not DOWN:
            one.state = STOPPING
            await one.spec.stop(cell, reason)
            if cell.parent is self.ctx._cell:  # Else it was moved meanwhile, and is another's to tell of.
                tell_stopped(cell, self.ctx.path if by is None else by, because)
        elif starting is not None:
            cell.kill()
        if one.row is row:
            one.state = state

    async def _stop_children(self) -> None:
        """We end: the children go in reverse start order, which need not be the order in which their addresses came."""
        below = list((self.ctx._cell.children or {}).values())
        children = self._listed()
        living = set(below)
        ours = [one for one in children.values() if one.cell is not None and one.cell in living]
        places = {one.cell for one in ours}
        for cell in reversed(below):  # Others may live below us too: each keeps its place.
            one = ours.pop() if cell in places else None
            child = cell if one is None or one.cell is None else one.cell
            if one is not None:
                self._has_ended(one)
            if child.parent is self.ctx._cell:  # Else it was given to another supervisor while we stopped others.
                is_living = child.state not in (DOWN, GONE)
                await child.node.stop_child(child)
                if is_living and child.parent is self.ctx._cell:
                    tell_stopped(child, self.ctx.path, WITH_SUPERVISOR)

    def _is_parked(self, name: str) -> bool:
        """Whether this child was stopped by order, and not started since; also if it is forgotten by now."""
        dismissed: dict[str, None] = self.__dict__.get("_dismissed", {})
        return name in self._all_parked() or name in dismissed

    def _all_parked(self) -> set[str]:
        """The children that were stopped by order, and not started since, but would be with our next life."""
        parked: set[str] = self.__dict__.get("_parked", set[str]())
        return parked

    def _listed(self) -> dict[str, Child]:
        """The children; none before our start has come so far."""
        children: dict[str, Child] = self.__dict__.get("_children", {})
        return children

    def _has_ended(self, one: Child) -> None:
        """We end: if this child has done so by itself, nobody will come to the notice of it in our queue."""
        cell = one.cell
        if cell is not None and cell.state is DOWN and one.state == UP and one.ignored_life < cell.life:
            self._report_end(one, cell.life, cell.extra().reason)

    # -- administration ---------------------------------------------------------------------------------------------

    def _asker(self) -> str:
        """The address of the actor whose request we handle in this turn; "" if no actor has asked."""
        item = self.ctx._item
        return item.sender.path if isinstance(item, Item) and item.sender is not None else ""

    @on(StartChild)
    def _start_child(self, message: StartChild) -> ReplyHandle[Any]:
        """Add and start a child."""
        return self._answered(self._add(message))

    async def _add(self, message: StartChild) -> Any:
        spec = self._spec_in(message)
        known = self._candidate(spec.id, message.candidate)
        if known is not None and known.state != STOPPED:
            return known.cell.ref if known.cell is not None else None
        if known is None:
            await self._check_free(spec)
        one = known or Child(spec, candidate=message.candidate)
        if message.unless_stopped and not spec.autostart:
            self._enlist(one)
            return None
        return await self._start_by_hand(one, self._enlist, self._unlist, fresh=message.fresh)

    async def _start_by_hand(
        self, one: Child, enlist: Callable[[Child], None], undo: Callable[[Child, HoldfastError], None], *, fresh: bool
    ) -> Any:
        """Start a child that somebody waits for; its ref, or None if it did not want to be started."""
        row = StartRow((one,), STARTING)
        try:
            enlist(one)
            if fresh:
                await self._erase(one)
            is_up = await self._come_up_in(row, one) if one.row is row else None
        except HoldfastError as error:
            undo(one, error)
            raise
        if is_up is None:  # Whoever has stopped it says what becomes of it.
            raise StartFailed(self._path_of(one), "it was stopped while it started")
        return one.cell.ref if is_up and one.cell is not None else None

    def _unlist(self, one: Child, error: HoldfastError) -> None:
        """A child could not be started for the first time."""
        if one.cell is not None:
            lifecycle.retire(one.cell, "it could not be started")
        self._forget(one)

    def _enlist(self, one: Child) -> None:
        """A child is to be started for the first time. Raises HoldfastError if that cannot be."""
        self._children[one.spec.id] = one

    def _give_away(self, name: str) -> Child:
        """Another supervisor has this child from now on, and its life goes on."""
        return self._children.pop(name)

    def _respecified(self, one: Child, before: ChildSpec) -> None:
        """The next lives of a child begin otherwise, or elsewhere, than its spec said `before`."""

    def _welcome(self, one: Child, declared: ChildSpec) -> None:
        """A child that another supervisor has had is ours from now on; `declared`: with the mechanism it began with."""
        self._children[one.spec.id] = one

    async def _check_free(self, spec: ChildSpec) -> None:
        """Refuse a child whose id is known."""
        known = self._children.get(spec.id)
        if known is not None:
            if known.is_running and known.cell is not None:
                raise AlreadyStarted(spec.id, known.cell.ref)
            raise AlreadyPresent(spec.id)

    def _spec_in(self, message: StartChild) -> ChildSpec:
        """The spec that a StartChild means, if we can take it."""
        own = self.ctx._cell
        spec = opened(message.spec, own.node)
        if not isinstance(spec, ChildSpec):
            raise SpecError("StartChild", f"takes child(...) or supervisor(...), not {spec!r}")
        check_spec("StartChild", spec, self._flags.auto_shutdown)
        check_place("StartChild", (spec,), own.node)
        return spec

    def _candidate(self, name: str, candidate: int) -> Child | None:
        """The child that was started as this candidate."""
        one = self._children.get(name)
        return one if one is not None and candidate and one.candidate == candidate else None

    @on(RemoveChild)
    def _remove_child(self, message: RemoveChild) -> ReplyHandle[Any]:
        """Stop and forget a child."""
        return self._answered(self._remove(message))

    async def _remove(self, message: RemoveChild) -> None:
        by, reason = self._asker(), reason_in(message)
        if message.candidate:
            one = self._candidate(message.id, message.candidate)
            if one is None:
                return
            if one.up is not None and one.cell is not None:
                one.cell.kill()  # Its start would hold up who gives it up for as long as it likes.
        else:
            one = self._child(message.id)
            self._parked.add(message.id)
        self._forget(one)  # From here on nobody starts it again, with others or by itself.
        await self._stop(one, reason, by=by, because="it was removed by order")
        if self._has_lost(one):
            raise NoSuchChild(message.id)
        self._note_end(one, reason)
        if one.cell is not None:
            lifecycle.retire(one.cell, reason)
        self._dismiss(one)
        if message.erase:
            await self._erase(one)

    @on(TerminateChild)
    def _terminate_child(self, message: TerminateChild) -> ReplyHandle[Any]:
        """Stop a child; a pending restart is void, and a start that is under way fails."""
        return self._answered(self._terminate(message))

    async def _terminate(self, message: TerminateChild) -> None:
        by, one, reason = self._asker(), self._child(message.id), reason_in(message)
        if message.parks:
            self._parked.add(one.spec.id)
        await self._stop(one, reason, by=by, because="it was stopped by order")
        if self._has_lost(one):
            raise NoSuchChild(message.id)
        if one.row is None:  # Else it is started again with others meanwhile.
            self._give_up_address(one, reason)

    @on(RestartChild)
    def _restart_child(self, message: RestartChild) -> ReplyHandle[Any]:
        """Start a stopped child again, or, if that is wanted, one that runs."""
        return self._answered(self._begin_again(message))

    async def _begin_again(self, message: RestartChild) -> Any:
        by, one = self._asker(), self._child(message.id)
        if message.unless_parked and message.id in self._parked:
            raise ChildParked(message.id)
        self._parked.discard(message.id)
        has_run = message.running and one.state == UP
        if has_run:
            row = StartRow((one,), RESTARTING)
            if message.blames_turn and one.cell is not None:
                one.cell.host.home.hangs(one.cell)
            if message.at_once and one.cell is not None:
                one.cell.kill()
            await self._stop(one, row=row, by=by, because="it was restarted by order")
            if one.row is not row:  # Whoever has it now says what becomes of it.
                raise StartFailed(self._path_of(one), "it was stopped, or started by somebody else, meanwhile")
            one.state = STOPPED
        if one.state != STOPPED:
            raise ChildBusy(message.id, one.state)
        problem: HoldfastError | None = None
        if message.older:
            try:
                rolled_back = self.ctx._cell.node.ports.keeper.roll_back(self._path_of(one), "it was asked for")
                if rolled_back is not None:
                    await rolled_back
            except HoldfastError as error:
                if not message.running:
                    raise
                problem = error
            if one.state != STOPPED or self._children.get(message.id) is not one:
                raise StartFailed(self._path_of(one), "it was started or deleted by somebody else meanwhile")

        def undo(one: Child, error: HoldfastError) -> None:
            if has_run and one.spec.restart != "temporary":
                self._again(one, crash(error))  # It was to run before and is to run now: as if it had crashed.
            else:
                self._give_up_address(one, "it could not be started")

        started = await self._start_by_hand(one, lambda one: None, undo, fresh=message.fresh)
        if problem is not None:
            raise problem
        return started

    @on(DeleteChild)
    def _delete_child(self, message: DeleteChild) -> Any:
        """Forget a stopped child's spec, and what was recorded of it."""
        return self._answered(self._delete(message))

    async def _delete(self, message: DeleteChild) -> None:
        one = self._child(message.id)
        if one.state != STOPPED:
            raise ChildBusy(message.id, one.state)
        self._ended.pop(message.id, None)
        if one.cell is not None:
            lifecycle.retire(one.cell, "it was deleted")
        if message.erase:
            row = StartRow((one,), STOPPING)  # Nobody starts or deletes it meanwhile.
            try:
                await self._erase(one)
            finally:  # If the store refuses, it can be deleted again.
                row.leave()
            if one.state != STOPPED:
                raise ChildBusy(message.id, one.state)
        self._forget(one)
        self._dismiss(one)

    @on(ChangeSupervisor)
    def _change(self, message: ChangeSupervisor) -> Any:
        """Take new flags and specs; nothing is started or stopped, and nothing changes if they are not valid."""
        try:
            plan = new_plan(self, message)
            self._take(plan)
            self._keep_plan(plan, has_children=message.children is not None or message.flags is None)
        except StartIgnored:
            return None
        except HoldfastError as error:
            return self._fail(error)
        return None

    # -- another one takes its place ----------------------------------------------------------------------------------

    def _told_account(self) -> Any:
        return told(account_of(self))

    def _wind_down(self, attempt: int) -> None:
        """Whoever waits for a restart is restarted now, once: it is moved with its next life."""
        for one in self._listed().values() if attempt else ():
            if one.state == RESTARTING and one.due is not None and one.hurried != attempt:
                one.hurried = attempt
                one.retry += 1
                self.ctx._cell.push(RestartAgain(one, one.retry, one.due))

    def _why_occupied(self) -> str:
        return why_occupied(self)

    @on(TakeOver)
    def _take_over(self, message: TakeOver) -> None:
        """Take the place of another supervisor."""
        take_over(self, message.account)

    def _bequest(self) -> Bequest:
        """What our kind leaves beside its children to the one that takes our place."""
        return {}

    def _inherit(self, left: Bequest) -> None:
        """Go on with what another one of our kind has left; with nothing as long as that has our place still."""

    def _keep_noted(self, one: Child, spec: ChildSpec, changed: tuple[str, ...] | None) -> None:
        """Have our next life know that we have this child, which begins so, as far as our kind notes that.

        `changed`: what of it is not as in the template; None: it may be anything.
        """

    def _changed_of(self, one: Child) -> tuple[str, ...] | None:
        """What of a child is not as in the template; None: nobody knows."""
        return None

    def _take(self, plan: Plan) -> None:
        """Follow another plan from now on; raises SpecError if that cannot be."""
        children = succession(self, self._children, plan)
        self._flags, self._children = plan.flags, children

    def _set_flags(self, flags: Flags) -> None:
        """Have other flags from now on; whoever sets them sees to our next lives."""
        self._flags = flags

    def _keep_plan(self, plan: Plan, *, has_children: bool) -> None:
        """Have our next lives begin with a plan; without children of its own it leaves those as they are."""
        from .respec import keep_plan  # It asks here what a supervisor is.

        keep_plan(self, plan.flags, plan.children if has_children else None)

    def _recipe_with(self, known: Any, given: tuple[ChildSpec, ...]) -> Any:
        """What our next lives begin with if they are given these specs beside those that are known."""
        names = {spec.id for spec in given}
        return (*given, *(spec for spec in known if spec.id not in names))

    def _specs(self) -> tuple[ChildSpec, ...]:
        """The specs as they are now."""
        return tuple(one.spec for one in self._children.values())


def _has_ended_by(one: Child, cause: str) -> bool:
    """Whether a child has ended by a common cause, and is to be restarted at once."""
    if one.state != UP or one.cell is None or one.cell.state is not DOWN:
        return False
    reason, spec = one.cell.extra().reason, one.spec
    return reason.common_cause == cause and spec.backoff is None and spec.restarts(reason)


def listed_at(cell: Cell | None) -> dict[str, Child] | None:
    """The children of a supervisor that lives in this process; None if there is none, or it has not begun."""
    actor = None if cell is None else cell.actor
    return actor._listed() if isinstance(actor, Supervisor) and "_children" in actor.__dict__ else None


def try_again(cell: Cell) -> None:
    """Start a child now that waits for its restart, if its supervisor lives in this process."""
    one = (listed_at(cell.parent) or {}).get(cell.name)
    if cell.parent is not None and one is not None and one.cell is cell and one.due is not None:
        one.retry += 1
        cell.parent.push(StartNow(one, one.retry, one.due))


def kill_starting(top: Cell) -> None:
    """Kill all that are starting below an actor; a supervisor in this process ends by itself, for it answers."""
    for cell in list((top.children or {}).values()):
        above = top.actor
        one = above._listed().get(cell.name) if isinstance(above, Supervisor) else None
        if cell.actor is not None and isinstance(cell.actor, Supervisor):
            kill_starting(cell)
        elif one is not None and one.up is not None and not one.up.done():
            cell.kill()
