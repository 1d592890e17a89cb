"""Pools: several workers of one class under a supervisor, and a router in front that spreads messages over them."""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
from collections.abc import Iterable
from typing import Any, Protocol, TypeVar, get_args

import msgspec

from ...actors.control.drain import drain
from ...actors.errors import HoldfastError, SpecError, StartIgnored, WrongActor, type_name
from ...actors.events import StoreRefused
from ...actors.exit_reasons import SHUTDOWN
from ...actors.kernel import lifecycle
from ...actors.kernel.actor import Actor, Start, on, start
from ...actors.kernel.context import ActorContext
from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.mailbox import Bounded
from ...actors.kernel.message import Message, RuntimeOrder
from ...actors.kernel.node import Node
from ...actors.kernel.ref import ActorRef
from ...actors.persistence import child_key
from ..children import Child
from ..rules import Rule
from ..spec import ChildSpec, Isolation, Plan, Restart, Shutdown, check_spec, child
from ..supervisor_changes import Bequest
from ..tree import supervisor
from .partition import UniformSupervisor
from .readiness import by_name
from .router import Key, Restarting, Router, Routing

A = TypeVar("A", bound=Actor)

ROUTER = "router"
"""The id of the router; the workers' ids are numbers."""
DRAIN_SECONDS = 5.0
"""How long a worker that goes may take for what it has, if nothing else is said."""


MOST_WORKERS = 100_000
"""Workers that a pool can be told to have."""


class PoolStatus(msgspec.Struct, frozen=True):
    """The state of a pool: its workers, how many are up, how many on their way out, what waits at the router."""

    size: int
    up: int
    leaving: int
    waiting: int


class PoolInfo(Message[PoolStatus]):
    """Asks a pool how it is."""


class ResizePool(RuntimeOrder[int]):
    """Have this many workers; the reply is how many there were, and comes when it is done.

    New ones are started. Those that go get nothing new, handle what they have for up to `deadline` seconds, and are
    then stopped as their spec says: give the ask a longer time-out than that.
    """

    size: int
    deadline: float = DRAIN_SECONDS


class PoolSupervisor(UniformSupervisor):
    """Keeps a pool's workers and its router alive. Built by `pool(...)`.

    When it is itself restarted the pool has its first size again. What was sent to recorded workers waits for them in
    their journals, so those that were added come back too.
    """

    instead = "the children of a pool are its workers: use ResizePool"

    _crew: list[Child]  # who gets messages, in the router's order; not those that are on their way out

    def _begin(self, plan: Plan) -> None:
        self._check(plan)
        self._open()
        self._template = plan.children[0]
        *workers, router = plan.children
        ids = {spec.id for spec in workers}
        added = [dataclasses.replace(self._worker, id=name) for name in self._added() if name not in ids]
        super()._begin(Plan.of(plan.flags, (*workers, *added, router)))
        self._crew = [one for one in self._children.values() if one.spec.id != ROUTER]

    @property
    def _worker(self) -> ChildSpec:
        """As which workers that are added begin."""
        assert self._template is not None
        return self._template

    def _open(self) -> None:
        self._leaving: set[str] = set()
        self._growing = asyncio.Lock()

    def _bequest(self) -> Bequest:
        return {"crew": [one.spec.id for one in self._crew]}

    def _inherit(self, left: Bequest) -> None:
        self._open()
        self._template = self._template or self._given.children[0]
        crew = left.get("crew", [])
        self._crew = [self._children[name] for name in crew if name in self._children] if isinstance(crew, list) else []
        self._wake_router()

    def _keep_noted(self, one: Child, spec: ChildSpec, changed: tuple[str, ...] | None) -> None:
        if one.spec.id not in {first.id for first in self._given.children}:
            self._try_to_note(one, b"")

    def _added(self) -> list[str]:
        """The recorded workers that an earlier life of ours has added, the lowest number first."""
        above = child_key(self.ctx.path, "")
        names = (key.removeprefix(above) for key in self.ctx._cell.node.ports.keeper.notes(above))
        return sorted((name for name in names if name.isdecimal()), key=int)

    def _note(self, name: str, value: bytes | None) -> None:
        """Keep in mind that there is a recorded worker more than at the start. Raises HoldfastError."""
        if self._worker.has_home:
            self.ctx._cell.node.ports.keeper.note(child_key(self.ctx.path, name), value)

    def _try_to_note(self, one: Child, value: bytes | None) -> None:
        try:
            self._note(one.spec.id, value)
        except HoldfastError as error:
            self.ctx._cell.node.emit(StoreRefused(f"{self.ctx.path}/{one.spec.id}", str(error)))

    def _check(self, plan: Plan) -> None:
        *workers, router = (spec.id for spec in plan.children) if plan.children else ("",)
        if router != ROUTER or not workers:
            raise SpecError(self.ctx.path, "a pool's children are its workers and its router: make it with pool(...)")

    def _take(self, plan: Plan) -> None:
        if {spec.id for spec in plan.children} != set(self._children):
            raise SpecError(self.ctx.path, "a pool's children are its workers and its router: use ResizePool")
        super()._take(plan)
        self._template = next((spec for spec in plan.children if spec.id != ROUTER), self._template)

    def _is_up(self, one: Child) -> None:
        super()._is_up(one)
        self._wake_router()

    def _wake_router(self) -> None:
        """Have it look for a worker again."""
        router = self._children.get(ROUTER)
        if router is not None and router.cell is not None and isinstance(router.cell.actor, Router):
            router.cell.actor.look_again()

    def _forget(self, one: Child) -> None:
        super()._forget(one)
        if self._is_in_place:
            self._try_to_note(one, None)  # If the store refuses, it is over all the same, but will come back with us.
        if one in self._crew:  # A temporary one that has ended is none any more.
            self._crew.remove(one)

    # -- its size ---------------------------------------------------------------------------------------------------

    @on(PoolInfo, readonly=True)
    def _info(self, message: PoolInfo) -> PoolStatus:
        """Tell how many workers there are, are up and leave, and how many messages wait."""
        up = sum(one.is_running and one.cell is not None and one.cell.host.is_up(one.cell) for one in self._crew)
        router = self._children.get(ROUTER)
        cell = None if router is None else router.cell
        return PoolStatus(len(self._crew), up, len(self._leaving), 0 if cell is None else cell.host.backlog(cell))

    @on(ResizePool)
    def _resize(self, message: ResizePool) -> ReplyHandle[Any]:
        """Start new workers, or let the uppermost ones go."""
        return self._answered(self._resized(message))

    async def _resized(self, message: ResizePool) -> int:
        if not 0 <= message.size <= MOST_WORKERS or not message.deadline >= 0:
            problem = f"size and deadline must be >= 0, and size at most {MOST_WORKERS}, not {message!r}"
            raise SpecError("ResizePool", problem)
        async with self._growing:  # One after another; who goes is not waited for by who comes.
            before = len(self._crew)
            going = self._crew[message.size :]
            del self._crew[message.size :]  # From here on the router passes them over.
            while len(self._crew) < message.size:
                await self._grow()
        self._leaving.update(one.spec.id for one in going)
        gone = [self.ctx._cell.node.loop.create_future() for _ in going]
        for one, future in zip(going, gone, strict=True):
            self._errand(self._let_go(one, message.deadline, future))
        for future in gone:
            await future
        return before

    async def _grow(self) -> None:
        """Start one more worker.

        Raises:
            HoldfastError: it could not be started, or did not want to be.
        """
        number = next(number for number in itertools.count() if str(number) not in self._children)
        self._note(str(number), b"")  # First: what it accepts is not lost, also if we die in the middle of its start.
        one = self._children[str(number)] = Child(dataclasses.replace(self._worker, id=str(number)))
        self._children[ROUTER] = self._children.pop(ROUTER)  # It stays the last: the first to be stopped.
        try:
            if not await self._start(one):
                raise StartIgnored(f"{self.ctx.path}/{number}")
        except HoldfastError:
            self._forget(one)
            if one.cell is not None:
                lifecycle.retire(one.cell, "it could not be started")
            raise
        self._crew.append(one)

    async def _let_go(self, one: Child, seconds: float, gone: asyncio.Future[None]) -> None:
        """Have a worker handle what it has, and end. If it crashes meanwhile, it is restarted and goes on with that."""
        if one.cell is not None:
            await self.ctx.create_task(drain(one.cell, seconds))
        await self._stop(one)
        self._give_up_address(one, SHUTDOWN)
        self._forget(one)
        self._leaving.discard(one.spec.id)
        gone.set_result(None)


def pool(
    name: str,
    worker: ChildSpec | Start[Any],
    size: int = 4,
    *,
    routing: Routing = "round_robin",
    key: Key | None = None,
    restarting: Restarting | None = None,
    isolation: Isolation | None = None,
    mailbox: Bounded | None = None,
    intensity: int | None = None,
    period: float = 5.0,
    restart: Restart = "permanent",
    shutdown: Shutdown = "infinity",
    rules: Iterable[Rule] = (),
) -> ChildSpec:
    """Describe several workers of one class and a router in front of them. `pool_of` gives a ref to it.

    The router takes what the workers' class handles, tells, sends and asks, and forwards it: sender, deadline and chain
    stay. While no worker can take a message (none is up, or all are full: a bounded mailbox with the policy "block"),
    messages wait at the router in their order.

    Args:
        name: the last part of the address; the workers are `name/0`, `name/1`, ..., the router is `name/router`.
        worker: `start(Class, ...)`, or `child(None, start(Class, ...), ...)` for its options.
        size: how many workers at the start; `ResizePool` changes it.
        routing: "round_robin"; "least_loaded" by messages that wait or are handled; "random"; "hash" of `key`, as
            `partition_of`; or "broadcast" to all workers, for tells only.
        key: for "hash": the name of a field of the messages, or a function of a message.
        restarting: "skip" workers between two lives, or "wait" for them: their messages wait at their address. If left
            out "skip", and "wait" with "hash", where a key's messages stay with its worker.
        isolation: "process" gives each worker a process of its own.
        mailbox: `bounded(...)` for what waits at the router; unbounded if left out.
        intensity, period: how many restarts of workers and router within how many seconds are too many for the pool,
            which then ends with all that waits in it. If `intensity` is left out, `size`: one death of each worker.
        restart, shutdown, rules: as a child of its own supervisor; see `supervisor`.

    Raises:
        SpecError: naming the option and what it may be.
    """
    where = f"pool {name!r}"
    if not isinstance(size, int) or isinstance(size, bool) or size < 1:
        raise SpecError(where, f"size must be a whole number >= 1, not {size!r}")
    for option, value, choices in (("routing", routing, Routing), ("restarting", restarting, Restarting)):
        if value not in get_args(choices) and not (option == "restarting" and value is None):
            raise SpecError(where, f"{option} must be one of {', '.join(get_args(choices))}, not {value!r}")
    if (key is None) == (routing == "hash"):
        raise SpecError(where, "routing='hash' takes a key, and nothing else does")
    if key is not None and not callable(key) and not (isinstance(key, str) and key.isidentifier()):
        raise SpecError(where, f"key must be the name of a field or a function of a message, not {key!r}")
    one = _worker_in(where, worker, isolation)
    waits = restarting or ("wait" if routing == "hash" else "skip")
    router = start(Router, start(one.start.kind), routing, by_name(key) if callable(key) else key, waits)
    copies = [dataclasses.replace(one, id=str(number)) for number in range(size)]
    return supervisor(
        name,
        intensity=size if intensity is None else intensity,
        period=period,
        children=[*copies, child(ROUTER, router, mailbox=mailbox)],
        restart=restart,
        shutdown=shutdown,
        rules=rules,
        kind=PoolSupervisor,
    )


def _worker_in(where: str, worker: Any, isolation: Isolation | None) -> ChildSpec:
    one = child(None, worker) if isinstance(worker, Start) else worker
    if not isinstance(one, ChildSpec):
        raise SpecError(where, f"the worker must come from start(...) or child(None, start(...)), not be {worker!r}")
    check_spec(where, one, "never", nameless=True)
    if one.is_supervisor:
        raise SpecError(where, "a worker takes messages: a supervisor is none")
    return one if isolation is None else dataclasses.replace(one, isolation=isolation)


class HasNode(Protocol):
    """What has a node: an actor system."""

    @property
    def _node(self) -> Node: ...


def pool_of(system: HasNode | ActorContext, path: str, kind: type[A]) -> ActorRef[A]:
    """Return a ref to a pool, typed as one to a worker: what is sent there goes to one of them.

    Args:
        system: the actor system; in an actor, `self.ctx`.
        path: the pool's address.
        kind: the class of the workers.

    Raises:
        NoSuchActor: nobody lives there. WrongActor: it is no pool, or one of other workers.
    """
    node = system._cell.node if isinstance(system, ActorContext) else system._node
    node.find_ref(path, PoolSupervisor)
    cell = node.find_ref(f"{path}/{ROUTER}", Router)._cell
    made = cell.more.start if cell.more is not None else None
    if cell.actor is not None and made is not None:
        found: type[Actor] = made.args[0].kind
        if not issubclass(found, kind):
            raise WrongActor(path, f"pool of {type_name(kind)}", f"pool of {type_name(found)}")
    return ActorRef(cell)
