"""Partitions: several copies of one child, and a key that says which of them is meant. Elixir's PartitionSupervisor."""

from __future__ import annotations

import asyncio
import dataclasses
import os
from collections.abc import Callable
from typing import Any, ClassVar

import msgspec

from ...actors.errors import HoldfastError, SpecError
from ...actors.exit_reasons import SHUTDOWN
from ...actors.kernel.actor import Start, on
from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.message import Message, RuntimeCall, RuntimeOrder
from ...actors.kernel.ref import ActorRef
from ...actors.process.resource_limits import Limits
from ...actors.values import state_digest
from ..admin import (
    DeleteChild,
    NoPartitions,
    NotSupported,
    RemoveChild,
    StartChild,
    boxed_argument,
    opened_argument,
)
from ..children import STOPPED, Child
from ..spec import ChildSpec, Isolation, Plan, Restart, Shutdown, Strategy, check_spec, child
from ..supervisor import Supervisor
from ..supervisor_changes import Bequest
from ..tree import supervisor


class Route(RuntimeCall[ActorRef[Any]]):
    """Ask which partition a key belongs to; the reply is a ref to that partition."""

    key: Any

    def __post_init__(self) -> None:  # Another process has to find the same partition.
        msgspec.structs.force_setattr(self, "key", boxed_argument(self.key))


class CountPartitions(Message[int]):
    """Ask how many partitions there are now."""


class ResizePartitions(RuntimeOrder[int]):
    """Have this many partitions, at most as many as at the start; the reply is how many there were."""

    count: int


def partition_of(key: object, count: int) -> int:
    """Return the partition of a key: `abs(key) % count` for an int, else by a stable hash of its type and value.

    The same in every process and at every time, so that a key can be stored with the partition that it belongs to.

    Raises:
        ValueError: there is no partition. UnsavableValue: the key is of a type that cannot be saved.

    >>> partition_of(-7, 4), partition_of("alice", 4) == partition_of("alice", 4)
    (3, True)
    """
    if count < 1:
        raise ValueError("there is no partition to route to")
    if isinstance(key, int) and not isinstance(key, bool):
        return abs(key) % count
    return int.from_bytes(state_digest(key)[:8], "big") % count


class UniformSupervisor(Supervisor):
    """Base of supervisors whose children are all alike: none of them is started or removed alone."""

    instead: ClassVar[str]
    """What to do instead."""

    def _recipe_with(self, known: Any, given: tuple[ChildSpec, ...]) -> Any:
        """As many as there were at first: how many there are now is for this life."""
        specs = {spec.id: spec for spec in given}
        return tuple(specs.get(spec.id, spec) for spec in known)

    @on(StartChild)
    def _start_child(self, message: StartChild) -> Any:
        """Refuse, because all are alike."""
        if self._is_in_place:
            raise NotSupported(self.instead)
        return super()._start_child(message)

    @on(RemoveChild)
    def _remove_child(self, message: RemoveChild) -> ReplyHandle[None] | None:
        """Refuse to remove one alone, if there is such a one."""
        if not self._is_in_place:
            return super()._remove_child(message)
        self._child(message.id)
        raise NotSupported(self.instead)

    @on(DeleteChild)
    def _delete_child(self, message: DeleteChild) -> Any:
        """Refuse to delete the spec of one alone, if there is such a one."""
        self._child(message.id)
        raise NotSupported(self.instead)


class PartitionSupervisor(UniformSupervisor):
    """Keeps several copies of one child alive, each at the address of its number. Built by `partitions(...)`."""

    instead = "the children of a partition supervisor are its partitions: use ResizePartitions"

    _now: int
    _all: tuple[ChildSpec, ...]

    def _begin(self, plan: Plan) -> None:
        if [spec.id for spec in plan.children] != [str(number) for number in range(len(plan.children))]:
            raise SpecError(self.ctx.path, "the ids of partitions are their numbers: make it with partitions(...)")
        self._have(len(plan.children), plan.children)
        super()._begin(plan)

    def _have(self, count: int, every: tuple[ChildSpec, ...]) -> None:
        self._now, self._all = count, every
        self._resizing = asyncio.Lock()

    def _bequest(self) -> Bequest:
        return {"count": self._now}

    def _inherit(self, left: Bequest) -> None:
        count = left.get("count")
        self._have(count if isinstance(count, int) else 0, self._given.children)

    def _take(self, plan: Plan) -> None:
        if len(plan.children) != len(self._all):
            raise SpecError(self.ctx.path, f"there are {len(self._all)} partitions: use ResizePartitions to have fewer")
        super()._take(plan)
        self._all = plan.children

    def _specs(self) -> tuple[ChildSpec, ...]:
        return self._all  # A temporary partition that has ended is still one.

    @on(Route, readonly=True)
    def _route(self, message: Route) -> Any:
        """The partition of a key; while it is restarted, messages wait at its address."""
        if not self._now:
            raise NoPartitions(self.ctx.path)
        try:
            number = partition_of(opened_argument(message.key, self.ctx._cell.node), self._now)
        except HoldfastError as error:
            return self._fail(error)
        return self.ctx._cell.node.cell_at(f"{self.ctx.path}/{number}").ref

    @on(CountPartitions, readonly=True)
    def _count_partitions(self, message: CountPartitions) -> int:
        """How many there are now."""
        return self._now

    @on(ResizePartitions)
    def _resize(self, message: ResizePartitions) -> ReplyHandle[Any]:
        """Stop the uppermost partitions, or start those that were stopped."""
        return self._answered(self._resized(message))

    async def _resized(self, message: ResizePartitions) -> int:
        if not 0 <= message.count <= len(self._all):
            raise SpecError("ResizePartitions", f"count must be from 0 to {len(self._all)}, not {message.count}")
        async with self._resizing:  # One after another.
            before = self._now
            for number in reversed(range(message.count, before)):
                self._now = number  # Nobody is routed to one that is being stopped.
                one = self._partition(number)
                await self._stop(one)
                if one.row is None:  # Else it is started again with others meanwhile.
                    self._give_up_address(one, SHUTDOWN)
            for number in range(before, message.count):
                one = self._partition(number)
                try:
                    if one.state == STOPPED:
                        await self._start(one)
                except HoldfastError:
                    self._give_up_address(one, "it could not be started")
                    raise
                self._now = number + 1
            return before

    def _partition(self, number: int) -> Child:
        """A partition; a temporary one that was stopped is made anew."""
        name = str(number)
        return self._children.setdefault(name, Child(self._all[number]))


def partitions(
    name: str,
    copy: ChildSpec | Start[Any],
    count: int | None = None,
    *,
    arguments: Callable[[int], tuple[Any, ...]] | None = None,
    strategy: Strategy = "one_for_one",
    intensity: int = 1,
    period: float = 5.0,
    restart: Restart = "permanent",
    shutdown: Shutdown = "infinity",
    isolation: Isolation = "task",
    limits: Limits | None = None,
) -> ChildSpec:
    """Describe several copies of one child under a supervisor. `Route(key)` asks it for the copy of a key.

    Args:
        name: the last part of the supervisor's address; the copies are `name/0`, `name/1`, ...
        copy: the child, as `start(Class, ...)` or `child(None, start(Class, ...), ...)`.
        count: how many copies; as many as there are processors if left out.
        arguments: gives each copy, by its number, further arguments; asked once, here.
        strategy, intensity, period: of their supervisor.
        restart, shutdown, isolation, limits: as a child of its own supervisor; see `supervisor`.

    Raises:
        SpecError: naming the option and what it may be.
    """
    where = f"partitions {name!r}"
    count = (os.cpu_count() or 1) if count is None else count
    if not isinstance(count, int) or isinstance(count, bool) or count < 1:
        raise SpecError(where, f"count must be a whole number >= 1, not {count!r}")
    one = child(None, copy) if isinstance(copy, Start) else copy
    check_spec(where, one, "never", nameless=True)
    copies = [_numbered(one, number, () if arguments is None else arguments(number)) for number in range(count)]
    return supervisor(
        name,
        strategy=strategy,
        intensity=intensity,
        period=period,
        children=copies,
        restart=restart,
        shutdown=shutdown,
        isolation=isolation,
        limits=limits,
        kind=PartitionSupervisor,
    )


def _numbered(copy: ChildSpec, number: int, more: tuple[Any, ...]) -> ChildSpec:
    own = copy.start
    return dataclasses.replace(copy, id=str(number), start=Start(own.kind, (*own.args, *more), own.kwargs))
