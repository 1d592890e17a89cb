"""The supervisor: an actor that starts its children in order, restarts them by its strategy, and stops them.

It decides in pure functions (`decisions.py`, `intensity.py`) and acts here. The rules are those of Erlang/OTP's
`supervisor`; `docs/supervision.md` has them as tables.
"""

from __future__ import annotations

import asyncio
import functools
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any, ClassVar

from ..actors import lives
from ..actors.actor import on
from ..actors.cell import DOWN, GONE, Cell
from ..actors.errors import HoldfastError, SpecError, StartFailed, StartIgnored
from ..actors.events import AutoShutdown, ChildRestarted, ChildStartFailed, ChildTerminated, SupervisorGaveUp
from ..actors.exits import SHUTDOWN, ExitReason, unpack_exit
from ..actors.mail import Item, ReplyHandle
from .admin import (
    AlreadyPresent,
    AlreadyStarted,
    ChangeSupervisor,
    ChildBusy,
    DeleteChild,
    RestartChild,
    StartChild,
    TerminateChild,
    opened,
)
from .change import check_place, new_plan, succession
from .children import RECOVERING, RESTARTING, STOPPED, UP, Asked, Child, Retry, Row, StartOver, complete, new_cell
from .decisions import affected, decide, is_reported
from .inquiries import Inquiries
from .intensity import admit_restart
from .spec import ChildSpec, Flags, Plan, check_spec


class Supervisor(Inquiries):
    """Keeps its children alive. Built by `supervisor(...)`, or derived from, with an `init` that returns a `Plan`."""

    _supervises: ClassVar[bool] = True
    _is_dynamic: ClassVar[bool] = False

    _flags: Flags
    _restarts: tuple[float, ...]

    def __init__(self, flags: Flags | None = None, children: tuple[ChildSpec, ...] = ()) -> None:
        self._given = Plan.of(flags or Flags(), children)

    def init(self) -> Plan:
        """Flags and children, asked for at each start and at a `ChangeSupervisor()`. May raise `Ignore`."""
        return self._given

    # -- start ------------------------------------------------------------------------------------------------------

    async def on_start(self, restored: bool) -> None:
        """Start the children left to right; if one fails, the others are stopped in reverse and so do we."""
        self.ctx.trap_exits = True  # Only our own parent can end us: the end of a stranger that is linked is no order.
        self._begin(new_plan(self))
        for one in list(self._children.values()):
            try:
                await self._start(one)
            except HoldfastError:
                self._blame(one)
                raise

    def _begin(self, plan: Plan) -> None:
        """Take up the plan of this start."""
        self._flags = plan.flags
        self._children = {spec.id: Child(spec) for spec in plan.children}
        self._restarts = ()

    async def _start(self, one: Child) -> bool:
        """Start a child and wait until it is up. False: it did not want to be.

        Raises:
            StartFailed, or another HoldfastError: naming the child and why.
        """
        try:
            up = self._launch(one)
            if up is not None:
                await self._wait(one, up)
        except StartIgnored:
            self._ignored(one)
            return False
        except HoldfastError as error:
            self._start_failed(one, error)
            raise
        self._is_up(one)
        return True

    async def _wait(self, one: Child, up: asyncio.Future[None]) -> None:
        try:
            await up
        except asyncio.CancelledError as error:
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                raise  # It is our own turn that is killed.
            raise StartFailed(self._path_of(one), "it was killed while it started") from error

    def _launch(self, one: Child) -> asyncio.Future[None] | None:
        """Begin a life of the child; a future if it takes longer than this turn.

        Raises:
            StartFailed, StartIgnored: at once. NameTaken: somebody else lives at its address.
        """
        cell = one.cell
        if cell is None or cell.state is GONE:
            cell = one.cell = new_cell(self.ctx.cell, one)
            one.ignored_life = 0  # A new address counts its lives anew.
        return cell.host.start(cell)

    def _is_up(self, one: Child) -> None:
        one.state = UP
        one.row = None
        one.up_since = self.ctx.cell.node.loop.time()

    def _start_failed(self, one: Child, error: HoldfastError) -> None:
        one.state, one.row = STOPPED, None
        if one.cell is not None:
            one.ignored_life = one.cell.life
        node = self.ctx.cell.node
        if node.watched:
            reason = error.reason if isinstance(error, StartFailed) else str(error)
            node.emit(ChildStartFailed(self._path_of(one), reason))

    def _ignored(self, one: Child) -> None:
        """It did not want to be started, which is no failure: the spec stays, that of a temporary child does not."""
        one.row = None
        if one.cell is not None:
            one.ignored_life = one.cell.life
        self._give_up_address(one, "it did not want to be started")

    # -- a child has ended ------------------------------------------------------------------------------------------

    def child_exited(self, cell: Cell, life: int, reason: ExitReason) -> Coroutine[Any, Any, None] | None:
        """Decide what follows from the end of a child's life (called by the loop, in a turn of ours)."""
        one = self._children.get(cell.name)
        if cell.parent is not self.ctx.cell and cell.parent is not None:
            cell.parent.push(lives.ChildExit(cell, life, reason))  # It was moved since: another one decides.
            return None
        if one is None or one.cell is not cell:
            lives.retire(cell, reason)
            return None
        if life <= one.ignored_life or one.state != UP:
            return None  # We stopped it, or it ended while it started: that is told by who waits for the start.
        spec, node = one.spec, self.ctx.cell.node
        if node.watched and is_reported(spec.restart, reason):
            node.emit(ChildTerminated(cell.path, reason))
        action = decide(spec.restart, spec.rules, reason)
        if action == "escalate":
            self._give_up(one, reason, reason)
        elif action == "stop":
            self._give_up_address(one, reason)
            self._end_with_significant(one, reason)
        elif spec.backoff is not None:
            self._later(one, reason)
        else:
            return self._restart(one, reason)
        return None

    def _give_up_address(self, one: Child, reason: object) -> None:
        """The child is not restarted: its address goes, its spec too if it is temporary."""
        one.state = STOPPED
        if one.cell is not None:
            lives.retire(one.cell, reason)
        if one.spec.restart == "temporary":
            self._forget(one)

    def _forget(self, one: Child) -> None:
        """The spec goes: the one way out of the list of children."""
        self._children.pop(one.spec.id, None)

    def _end_with_significant(self, one: Child, reason: ExitReason) -> None:
        """A child has ended by itself for good: if it was significant, that may be the end of us."""
        flags = self._flags
        if not one.spec.significant or flags.auto_shutdown == "never":
            return
        left = (other.spec.significant and other.state != STOPPED for other in self._children.values())
        if flags.auto_shutdown == "all_significant" and any(left):
            return
        self.ctx.cell.node.emit(AutoShutdown(self.ctx.path, one.spec.id, reason))
        self.ctx.stop(SHUTDOWN)

    def _later(self, one: Child, reason: ExitReason) -> None:
        """Restart after the back-off; meanwhile everybody else is served."""
        backoff = one.spec.backoff
        assert backoff is not None
        loop = self.ctx.cell.node.loop
        if one.state == UP and loop.time() - one.up_since >= backoff.reset_after:
            one.attempts = 0
        delay = backoff.delay(one.attempts, self.ctx.random)
        one.attempts += 1
        one.state = RESTARTING
        one.retry += 1
        loop.call_later(delay, self._post, Retry(one, one.retry, reason))

    def _post(self, item: Item) -> None:
        if not self.ctx.closed:
            self.ctx.cell.push(item)

    def _retry(self, one: Child, number: int, reason: ExitReason) -> Coroutine[Any, Any, None] | None:
        """A restart is due, unless the child was stopped or started meanwhile."""
        if number != one.retry or one.state != RESTARTING:
            return None
        return self._restart(one, reason)

    def _restart(self, one: Child, reason: ExitReason) -> Coroutine[Any, Any, None] | None:
        """One attempt by the strategy, counted; gives up when there were too many."""
        node, flags = self.ctx.cell.node, self._flags
        window = admit_restart(self._restarts, node.loop.time(), intensity=flags.intensity, period=flags.period)
        if window is None:
            self._give_up(one, reason, SHUTDOWN)
            return None
        self._restarts = window
        if one.spec.is_supervisor:  # Perhaps it has ended because of somebody below it: that one comes back as it says.
            node.keeper.returned(self._path_of(one), flags.period)
        if node.watched:
            node.emit(ChildRestarted(self._path_of(one), reason, len(window)))
        if flags.strategy == "one_for_one":
            self._start_row(Row(deque([one]), reason))
            return None
        return self._restart_group(one, reason)

    def _give_up(self, one: Child, reason: ExitReason, told: ExitReason) -> None:
        """We end: too many restarts, or a rule says that this end is one for whoever is above us."""
        one.state = STOPPED
        self._blame(one)
        node = self.ctx.cell.node
        node.gave_up = SupervisorGaveUp(self.ctx.path, one.spec.id, reason)
        node.emit(node.gave_up)
        self.ctx.stop(told)

    def _blame(self, one: Child) -> None:
        """We end because of this child."""
        self.ctx.cell.node.keeper.blame(self._path_of(one))

    def _path_of(self, one: Child) -> str:
        return f"{self.ctx.path}/{one.spec.id}"

    def _erase(self, one: Child) -> None:
        """Forget what was recorded of a child that does not run. Raises HoldfastError if the store refuses."""
        if one.cell is not None:
            lives.retire(one.cell, "it begins afresh")
        one.spec = complete(self.ctx.cell, one.spec)
        if one.spec.is_supervisor or one.spec.has_home:
            self.ctx.cell.node.keeper.erase(self._path_of(one), below=one.spec.is_supervisor)

    async def _restart_group(self, failed: Child, reason: ExitReason) -> None:
        """one_for_all and rest_for_one: stop the others newest first, then start all of them in order."""
        order = list(self._children.values())
        group = affected(self._flags.strategy, order, order.index(failed))
        for one in reversed(group):
            if one is not failed and one.state != STOPPED:
                await self._stop(one)
                if one.spec.restart == "temporary":
                    self._give_up_address(one, SHUTDOWN)
        self._start_row(Row(deque(one for one in group if one.spec.id in self._children), reason))

    def _start_row(self, row: Row) -> None:
        """Start the children of a row; if one takes longer, its siblings wait for it, and we do not (`_start_over`)."""
        for one in row.waiting:
            one.state, one.row = RESTARTING, row
        self._go_on(row)

    def _go_on(self, row: Row) -> None:
        while row.waiting:
            one = row.waiting.popleft()
            if one.row is not row:
                continue  # Stopped by hand meanwhile.
            try:
                up = self._launch(one)
            except StartIgnored:
                self._ignored(one)
            except HoldfastError as error:
                self._attempt_failed(one, error, row)
                return
            else:
                if up is not None:
                    if one.spec.has_home:
                        one.state = RECOVERING
                    one.up = up
                    up.add_done_callback(functools.partial(self._started, one))
                    return
                self._is_up(one)
            if row.asked is not None:
                row.asked.handle.reply(one.cell.ref if one.state == UP and one.cell is not None else None)

    def _started(self, one: Child, up: asyncio.Future[None]) -> None:
        self._post(StartOver(one, up))

    def _attempt_failed(self, one: Child, error: HoldfastError, row: Row) -> None:
        """A child of the row did not start: the others are stopped, or stay up, until it is tried again."""
        if row.asked is not None:
            self._start_failed(one, error)
            row.asked.failed(error)
            return
        for other in row.waiting:
            if other.row is row:
                other.state, other.row = STOPPED, None
        self._start_failed(one, error)
        self._again(one, row.reason)

    def _again(self, one: Child, reason: ExitReason) -> None:
        """A start has failed: try once more, which counts."""
        one.state = RESTARTING
        if one.spec.backoff is not None:
            self._later(one, reason)
            return
        one.retry += 1
        self.ctx.cell.push(Retry(one, one.retry, reason))  # Through our own mailbox: we answer in between.

    def _start_over(self, one: Child, up: asyncio.Future[None]) -> Coroutine[Any, Any, None] | None:
        """A restart has come to its end, unless the child was stopped meanwhile."""
        cell, row = one.cell, one.row
        if one.up is not up or cell is None or row is None:
            return None
        one.up = None
        error = StartFailed(cell.path, "it was killed while it started") if up.cancelled() else up.exception()
        if isinstance(error, StartIgnored):
            self._ignored(one)
        elif error is not None:
            failure = error if isinstance(error, HoldfastError) else StartFailed(cell.path, str(error))
            self._attempt_failed(one, failure, row)
            return None
        else:
            self._is_up(one)
        if row.asked is not None:
            row.asked.handle.reply(cell.ref if one.state == UP else None)
        self._go_on(row)
        if one.state != UP or cell.state is not DOWN:
            return None
        life = cell.life  # It ended before we heard that it was up: its end in our queue is passed over.
        more = self.child_exited(cell, life, cell.extra().reason)
        one.ignored_life = life
        return more

    # -- stopping ---------------------------------------------------------------------------------------------------

    async def _stop(self, one: Child, reason: ExitReason = SHUTDOWN) -> None:
        """Stop a child as its spec says; its address and queue stay."""
        cell = one.cell
        one.retry += 1
        self._no_answer(one)
        one.state, one.row = STOPPED, None
        starting, one.up = one.up, None
        if cell is None or cell.state is GONE:
            return
        one.ignored_life = cell.life  # Also if it has ended just now: its end is in our queue, and is known here.
        if cell.state is not DOWN:
            await one.spec.stop(cell, reason)
        elif starting is not None:
            cell.kill()

    def _no_answer(self, one: Child) -> None:
        """The child is stopped while somebody waits for its first start."""
        if one.row is not None and one.row.asked is not None:
            one.row.asked.handle.fail(StartFailed(self._path_of(one), "it was stopped while it started"))

    async def _stop_children(self) -> None:
        """We end: the children go in reverse start order, which need not be the order in which their addresses came."""
        below = list((self.ctx.cell.children or {}).values())
        children: dict[str, Child] = self.__dict__.get("_children", {})
        for one in children.values():
            self._no_answer(one)
        living = set(below)
        ours = [one.cell for one in children.values() if one.cell is not None and one.cell in living]
        places = set(ours)
        for cell in reversed(below):  # Others may live below us too: each keeps its place.
            child = ours.pop() if cell in places else cell
            await child.node.stop_child(child)

    # -- administration ---------------------------------------------------------------------------------------------

    @on(StartChild)
    async def _start_child(self, message: StartChild) -> Any:
        """Add and start a child."""
        try:
            spec = self._spec_in(message)
        except HoldfastError as error:
            return self._fail(error)
        self._check_free(spec)
        one = Child(spec)
        try:
            if message.fresh:
                self._erase(one)
            self._enlist(one)
            if spec.has_home:
                return self._start_meanwhile(one, lambda: self._unlist(one))
            return one.cell.ref if await self._start(one) and one.cell is not None else None
        except HoldfastError as error:
            self._unlist(one)
            return self._fail(error)

    def _unlist(self, one: Child) -> None:
        """A child could not be started for the first time."""
        self._forget(one)
        if one.cell is not None:
            lives.retire(one.cell, "it could not be started")

    def _start_meanwhile(self, one: Child, undo: Callable[[], None]) -> ReplyHandle[Any]:
        """Start a child that may have much to replay: others are answered meanwhile, the caller when it is up."""
        handle = self.ctx.reply_handle()
        self._start_row(Row(deque([one]), SHUTDOWN, Asked(handle, undo)))
        return handle

    def _enlist(self, one: Child) -> None:
        """A child is to be started for the first time. Raises HoldfastError if that cannot be."""
        self._children[one.spec.id] = one

    def _check_free(self, spec: ChildSpec) -> None:
        """Refuse a child whose id is known."""
        known = self._children.get(spec.id)
        if known is not None:
            if known.is_running and known.cell is not None:
                raise AlreadyStarted(spec.id, known.cell.ref)
            raise AlreadyPresent(spec.id)

    def _spec_in(self, message: StartChild) -> ChildSpec:
        """The spec that a StartChild means, if we can take it."""
        own = self.ctx.cell
        spec = opened(message.spec, own.node)
        if not isinstance(spec, ChildSpec):
            raise SpecError("StartChild", f"takes child(...) or supervisor(...), not {spec!r}")
        check_spec("StartChild", spec, self._flags.auto_shutdown)
        check_place("StartChild", (spec,), own.node)
        return spec

    @on(TerminateChild)
    async def _terminate_child(self, message: TerminateChild) -> None:
        """Stop a child; a pending restart is void."""
        one = self._child(message.id)
        row = one.row if one.up is not None else None
        reason = SHUTDOWN if message.reason is None else unpack_exit(message.reason)
        await self._stop(one, reason)
        self._give_up_address(one, reason)
        if row is not None:  # Its later siblings have waited for it.
            self._go_on(row)

    @on(RestartChild)
    async def _restart_child(self, message: RestartChild) -> Any:
        """Start a stopped child again."""
        one = self._child(message.id)
        if one.state != STOPPED:
            raise ChildBusy(message.id, one.state)
        try:
            if message.fresh:
                self._erase(one)
            if one.spec.has_home:
                return self._start_meanwhile(one, lambda: self._give_up_address(one, "it could not be started"))
            return one.cell.ref if await self._start(one) and one.cell is not None else None
        except HoldfastError as error:
            self._give_up_address(one, "it could not be started")
            return self._fail(error)

    @on(DeleteChild)
    def _delete_child(self, message: DeleteChild) -> Any:
        """Forget a stopped child's spec, and what was recorded of it."""
        one = self._child(message.id)
        if one.state != STOPPED:
            raise ChildBusy(message.id, one.state)
        if one.cell is not None:
            lives.retire(one.cell, "it was deleted")
        if message.erase:
            try:
                self._erase(one)
            except HoldfastError as error:  # It can be deleted again.
                return self._fail(error)
        self._forget(one)
        return None

    @on(ChangeSupervisor)
    def _change(self, message: ChangeSupervisor) -> Any:
        """Take new flags and specs; nothing is started or stopped, and nothing changes if they are not valid."""
        try:
            plan = new_plan(self, message)
            self._take(plan)
        except StartIgnored:
            return None
        except HoldfastError as error:
            return self._fail(error)
        return None

    def _take(self, plan: Plan) -> None:
        """Follow another plan from now on; raises SpecError if that cannot be."""
        children = succession(self, self._children, plan)
        self._flags, self._children = plan.flags, children

    def _specs(self) -> tuple[ChildSpec, ...]:
        """The specs as they are now."""
        return tuple(one.spec for one in self._children.values())
