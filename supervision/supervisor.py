"""The supervisor: an actor that starts its children in order, restarts them by its strategy, and stops them.

It decides in pure functions (`decisions.py`, `intensity.py`) and acts here.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

from ..actors import lives
from ..actors.actor import Actor, Start, on
from ..actors.cell import DOWN, GONE, Cell
from ..actors.errors import HoldfastError, NoSuchActor, SpecError, StartFailed
from ..actors.events import ChildRestarted, SupervisorGaveUp
from ..actors.exits import SHUTDOWN, ExitReason
from ..actors.mail import Item, ReplyHandle
from ..actors.message import Message, Refusal
from ..actors.process.limits import Limits
from .decisions import affected, is_restarted
from .intensity import admit_restart
from .spec import ChildSpec, Flags, Isolation, Restart, Shutdown, Strategy, check_ids

# What a child may be in, as `which_children` tells it.
STOPPED = "stopped"
UP = "running"
RESTARTING = "restarting"
RECOVERING = "recovering"


class AlreadyStarted(Refusal):
    """A child of this id runs already, or is being restarted."""

    id: str


class AlreadyPresent(Refusal):
    """A child of this id is known, but not running: restart or delete it."""

    id: str


class ChildBusy(Refusal):
    """The child runs or is being restarted: terminate it first."""

    id: str


class NoSuchChild(Refusal):
    """The supervisor has no child of this id."""

    id: str


class StartChild(Message[Any]):
    """Start one more child; the reply is its ref."""

    spec: Any


class TerminateChild(Message[None]):
    """Stop a child by its spec; the spec stays, unless it is temporary."""

    id: str


class RestartChild(Message[Any]):
    """Start a stopped child again; the reply is its ref."""

    id: str


class DeleteChild(Message[None]):
    """Forget a stopped child."""

    id: str


class ChildInfo(Message[None]):
    """One child, as `WhichChildren` tells it: id, state, address."""

    id: str
    state: str
    path: str
    is_supervisor: bool


class WhichChildren(Message[list[ChildInfo]]):
    """All children, in start order."""


@dataclasses.dataclass(slots=True)
class Child:
    """A child as its supervisor sees it."""

    spec: ChildSpec
    cell: Cell | None = None
    state: str = STOPPED
    ignored_life: int = 0  # the end of this life is known already: its start failed, or we stopped it
    attempts: int = 0  # restarts in a row without a healthy life
    up_since: float = 0.0
    retry: int = 0  # the number of the retry that counts; stale ones are dropped
    up: asyncio.Future[None] | None = None  # a start that is waited for outside our turn; None once it is known or void


class Retry(Item):
    """A restart that is due: after a failed attempt, or a back-off. Other requests are served before it."""

    __slots__ = ("child", "number", "reason")

    def __init__(self, child: Child, number: int, reason: ExitReason) -> None:
        self.child, self.number, self.reason = child, number, reason

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        return actor.retry(item.child, item.number, item.reason)


class StartOver(Item):
    """A child's start, waited for outside the supervisor's turn, has come to its end."""

    __slots__ = ("child", "up")

    def __init__(self, child: Child, up: asyncio.Future[None]) -> None:
        self.child, self.up = child, up

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        return actor.start_over(item.child, item.up)


class Supervisor(Actor):
    """Keeps its children alive. Built by `supervisor(...)`."""

    def __init__(self, flags: Flags, children: tuple[ChildSpec, ...]) -> None:
        self._flags = flags
        self._children: dict[str, Child] = {spec.id: Child(spec) for spec in children}
        self._restarts: tuple[float, ...] = ()
        self._rng = self.ctx.random  # of the node's seed: a run can be repeated

    # -- start ------------------------------------------------------------------------------------------------------

    async def on_start(self, restored: bool) -> None:
        """Start the children left to right; if one fails, the others are stopped in reverse and so do we."""
        for one in list(self._children.values()):
            await self._start(one)

    async def _start(self, one: Child) -> None:
        """Start a child and wait until it is up.

        Raises:
            StartFailed: naming the child and why.
        """
        up = self._launch(one)
        if up is not None:
            try:
                await up
            except asyncio.CancelledError as error:
                task = asyncio.current_task()
                if task is not None and task.cancelling():
                    raise  # It is our own turn that is killed.
                raise StartFailed(f"{self.ctx.path}/{one.spec.id}", "it was killed while it started") from error
        self._is_up(one)

    def _launch(self, one: Child) -> asyncio.Future[None] | None:
        """Begin a life of the child; a future if it takes longer than this turn."""
        cell = one.cell
        if cell is None or cell.state is GONE:
            cell = one.cell = self._new_cell(one.spec)
            one.ignored_life = 0  # A new address counts its lives anew.
        try:
            up = cell.host.start(cell)
        except StartFailed:
            one.ignored_life = cell.life
            one.state = STOPPED
            raise
        return up

    def _new_cell(self, spec: ChildSpec) -> Cell:
        own = self.ctx.cell
        node = own.node
        targets = {port: node.find(path) for port, path in spec.bindings.items()}
        for port, target in targets.items():  # Before there is a cell: a child that cannot start leaves no name taken.
            if target is None:
                missing = NoSuchActor(spec.bindings[port])
                raise StartFailed(f"{own.path}/{spec.id}", f"binding {port!r}: {missing}") from missing
        cell = node.cell_below(own, spec.id, node.host_for(spec))
        cell.spec = spec
        more = cell.extra()
        more.start = spec.start
        if spec.mailbox is not None:
            node.bound(cell, spec.mailbox)
        for port, target in targets.items():
            assert target is not None
            node.bind(cell, port, target)
        return cell

    def _is_up(self, one: Child) -> None:
        one.state = UP
        one.up_since = self.ctx.cell.node.loop.time()

    # -- a child has ended ------------------------------------------------------------------------------------------

    def child_exited(self, cell: Cell, life: int, reason: ExitReason) -> Coroutine[Any, Any, None] | None:
        """Decide what follows from the end of a child's life (called by the loop, in a turn of ours)."""
        one = self._children.get(cell.name)
        if one is None or one.cell is not cell:
            lives.retire(cell, reason)
            return None
        if life <= one.ignored_life or one.state != UP:
            return None  # We stopped it, or its start failed: that is told by who waits for the start.
        if one.up is not None:
            if not has_succeeded(one.up):
                return None  # It ended while it started: `start_over` hears of that, and it counts once.
            one.up = None
        if not is_restarted(one.spec.restart, reason):
            self._give_up_address(one, reason)
            return None
        if one.spec.backoff is not None:
            self._later(one, reason)
            return None
        return self._restart(one, reason)

    def _give_up_address(self, one: Child, reason: object) -> None:
        """The child is not restarted: its address goes, its spec too if it is temporary."""
        one.state = STOPPED
        if one.cell is not None:
            lives.retire(one.cell, reason)
        if one.spec.restart == "temporary":
            self._children.pop(one.spec.id, None)

    def _later(self, one: Child, reason: ExitReason) -> None:
        """Restart after the back-off; meanwhile everybody else is served."""
        backoff = one.spec.backoff
        assert backoff is not None
        loop = self.ctx.cell.node.loop
        if one.state == UP and loop.time() - one.up_since >= backoff.reset_after:
            one.attempts = 0
        delay = backoff.delay(one.attempts, self._rng)
        one.attempts += 1
        one.state = RESTARTING
        one.retry += 1
        loop.call_later(delay, self._post, Retry(one, one.retry, reason))

    def _post(self, item: Item) -> None:
        if not self.ctx.closed:
            self.ctx.cell.push(item)

    def retry(self, one: Child, number: int, reason: ExitReason) -> Coroutine[Any, Any, None] | None:
        """A restart is due, unless the child was stopped or started meanwhile."""
        if number != one.retry or one.state != RESTARTING:
            return None
        return self._restart(one, reason)

    def _restart(self, one: Child, reason: ExitReason) -> Coroutine[Any, Any, None] | None:
        """One attempt by the strategy, counted; gives up when there were too many."""
        node = self.ctx.cell.node
        window = admit_restart(
            self._restarts, node.loop.time(), intensity=self._flags.intensity, period=self._flags.period
        )
        if window is None:
            self._give_up(one, reason)
            return None
        self._restarts = window
        if node.watched:
            node.emit(ChildRestarted(f"{self.ctx.path}/{one.spec.id}", reason, len(window)))
        if self._flags.strategy == "one_for_one":
            self._restart_one(one, reason)
            return None
        return self._restart_group(one, reason)

    def _give_up(self, one: Child, reason: ExitReason) -> None:
        node = self.ctx.cell.node
        one.state = STOPPED
        node.emit(SupervisorGaveUp(self.ctx.path, one.spec.id, reason))
        self.ctx.stop(SHUTDOWN)

    def _restart_one(self, one: Child, reason: ExitReason) -> None:
        """Start it again; if that takes longer, wait for it outside our turn."""
        one.state = RESTARTING
        try:
            up = self._launch(one)
        except StartFailed:
            self._try_again(one, reason)
            return
        if up is None:
            self._is_up(one)
            return
        if one.spec.recovery is not None:
            one.state = RECOVERING
        one.up = up
        up.add_done_callback(lambda done: self._post(StartOver(one, done)))

    def start_over(self, one: Child, up: asyncio.Future[None]) -> Coroutine[Any, Any, None] | None:
        """A restart has come to its end, unless the child was stopped meanwhile or has ended again."""
        cell = one.cell
        if one.up is not up or cell is None:
            return None
        one.up = None
        if has_succeeded(up):
            self._is_up(one)
            if cell.state is not DOWN:
                return None
            life = cell.life  # It ended before we heard that it was up, and so its end was not heard.
            more = self.child_exited(cell, life, cell.extra().reason)
            one.ignored_life = life
            return more
        one.ignored_life = cell.life
        self._try_again(one, cell.extra().reason)
        return None

    def _try_again(self, one: Child, reason: ExitReason) -> None:
        """A start attempt failed: the next goes through our own mailbox, so that we answer in between."""
        one.state = RESTARTING
        if one.spec.backoff is not None:
            self._later(one, reason)
            return
        one.retry += 1
        self.ctx.cell.push(Retry(one, one.retry, reason))

    async def _restart_group(self, failed: Child, reason: ExitReason) -> None:
        """one_for_all and rest_for_one: stop the others newest first, then start all of them in order."""
        order = list(self._children.values())
        group = affected(self._flags.strategy, order, order.index(failed))
        failed.state = RESTARTING
        for one in reversed(group):
            if one is not failed and one.state != STOPPED:
                await self._stop(one)
                if one.spec.restart == "temporary":
                    self._give_up_address(one, SHUTDOWN)
        for one in group:
            if one.spec.id not in self._children:
                continue
            try:
                await self._start(one)
            except StartFailed:
                if one.cell is not None:
                    one.ignored_life = one.cell.life
                self._try_again(one, reason)  # Of the group, it is the one that does not run.
                return

    async def _stop(self, one: Child) -> None:
        """Stop a child as its spec says; its address and queue stay."""
        cell = one.cell
        one.retry += 1
        one.state = STOPPED
        starting, one.up = one.up, None
        if cell is None or cell.state is GONE:
            return
        one.ignored_life = cell.life  # Also if it has ended just now: its end is in our queue, and is known here.
        if cell.state is not DOWN:
            await one.spec.stop(cell)
        elif starting is not None:
            cell.kill()

    # -- administration ---------------------------------------------------------------------------------------------

    @on(StartChild)
    async def start_child(self, message: StartChild) -> Any:
        """Add and start a child."""
        spec = message.spec
        if not isinstance(spec, ChildSpec):
            return self._fail(SpecError("StartChild", f"takes child(...) or supervisor(...), not {spec!r}"))
        known = self._children.get(spec.id)
        if known is not None:
            raise AlreadyPresent(spec.id) if known.state == STOPPED else AlreadyStarted(spec.id)
        one = self._children[spec.id] = Child(spec)
        try:
            await self._start(one)
        except HoldfastError as error:
            self._children.pop(spec.id, None)
            if one.cell is not None:
                one.ignored_life = one.cell.life
                lives.retire(one.cell, "it could not be started")
            return self._fail(error)
        assert one.cell is not None
        return one.cell.ref

    @on(TerminateChild)
    async def terminate_child(self, message: TerminateChild) -> None:
        """Stop a child; a pending restart is void."""
        one = self._child(message.id)
        await self._stop(one)
        self._give_up_address(one, SHUTDOWN)

    @on(RestartChild)
    async def restart_child(self, message: RestartChild) -> Any:
        """Start a stopped child again."""
        one = self._child(message.id)
        if one.state != STOPPED:
            raise ChildBusy(message.id)
        try:
            await self._start(one)
        except HoldfastError as error:
            self._give_up_address(one, "it could not be started")
            return self._fail(error)
        assert one.cell is not None
        return one.cell.ref

    @on(DeleteChild)
    def delete_child(self, message: DeleteChild) -> None:
        """Forget a stopped child's spec."""
        one = self._child(message.id)
        if one.state != STOPPED:
            raise ChildBusy(message.id)
        del self._children[message.id]
        if one.cell is not None:
            lives.retire(one.cell, "it was deleted")

    @on(WhichChildren, readonly=True)
    def which_children(self, message: WhichChildren) -> list[ChildInfo]:
        """What there is, in start order."""
        own = self.ctx.path
        return [
            ChildInfo(one.spec.id, one.state, f"{own}/{one.spec.id}", one.spec.is_supervisor)
            for one in self._children.values()
        ]

    def _child(self, name: str) -> Child:
        one = self._children.get(name)
        if one is None:
            raise NoSuchChild(name)
        return one

    def _fail(self, error: HoldfastError) -> ReplyHandle[Any]:
        """Answer an admin call with an error: it is the caller's business, not our crash."""
        handle = self.ctx.reply_handle()
        handle.fail(error)
        return handle


def has_succeeded(up: asyncio.Future[None]) -> bool:
    """Whether a start has come to its end, and a good one."""
    return up.done() and not up.cancelled() and up.exception() is None


def holds(specs: Iterable[ChildSpec], wanted: Callable[[ChildSpec], bool]) -> bool:
    """Whether one of the children, or of theirs, is as wanted."""
    return any(wanted(spec) or (spec.is_supervisor and holds(spec.start.args[1], wanted)) for spec in specs)


def supervisor(
    name: str,
    *,
    strategy: Strategy = "one_for_one",
    intensity: int = 1,
    period: float = 5.0,
    children: Iterable[ChildSpec] = (),
    restart: Restart = "permanent",
    shutdown: Shutdown = "infinity",
    isolation: Isolation = "task",
    limits: Limits | None = None,
) -> ChildSpec:
    """A supervisor with its children, as a spec: start it with `system.start`, or nest it in another one.

    Args:
        name: the last part of its address.
        strategy: "one_for_one", "one_for_all" or "rest_for_one".
        intensity: restarts allowed within `period` seconds; one more and it gives up.
        period: seconds, > 0.
        children: specs, in start order.
        restart, shutdown: as a child of its own supervisor.
        isolation: "process" puts the whole subtree into one OS process.
        limits: of that process.

    Raises:
        SpecError: naming the option and what it may be.
    """
    specs = check_ids(f"supervisor {name!r}", children)
    try:
        flags = Flags(strategy, intensity, period)
    except SpecError as error:
        raise SpecError(f"supervisor {name!r}", error.problem) from None
    start = Start(Supervisor, (flags, specs))
    if isolation == "process":
        where = f"supervisor {name!r}"
        if holds(specs, lambda spec: spec.isolation == "process"):
            raise SpecError(where, "a subtree in a process cannot hold process children: its own is theirs")
        if holds(specs, lambda spec: spec.recovery is not None and spec.recovery.records):
            raise SpecError(where, "a subtree in a process cannot hold recorded children yet: give them their own")
    return ChildSpec(name, start, restart, shutdown, isolation, limits=limits, is_supervisor=True)
