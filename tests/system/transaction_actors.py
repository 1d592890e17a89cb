"""The actors of the machine for transactions, and the steps that go wrong."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import holdfast as hf
from tests.system.transaction_model import Node
from tests.system.trees import Add, Counter

PER_ACTOR = 10**7
"""Who an actor is stands in its count: it begins at its number times this."""
PER_STATE = 10**5
"""What a replaced state adds: no run adds so many ones."""
LATE = 0.05
"""Seconds that the start of some actors takes."""


class Nap(hf.Message):
    seconds: float


class Count(hf.Message[int]): ...


class Look(hf.Message[tuple[str, int]]):
    """What is to be seen of an actor: its class, its count."""


class Through(hf.Message[int]):
    """The count of whoever it is bound to; -1 if there is no answer."""


class Tally(Counter):
    peer: hf.Binding[Counter]

    def __init__(self, start: int = 0, is_late: bool = False) -> None:
        super().__init__(start)
        self.is_late = is_late

    async def on_start(self, restored: bool) -> None:
        if self.is_late:
            await asyncio.sleep(LATE)

    @hf.on(Nap)
    async def nap(self, message: Nap) -> None:
        await asyncio.sleep(message.seconds)

    @hf.on(Count, readonly=True)
    def counted(self, message: Count) -> int:
        return self.count

    @hf.on(Look, readonly=True)
    def look(self, message: Look) -> tuple[str, int]:
        return type(self).__name__, self.count

    @hf.on(Through, readonly=True)
    async def through(self, message: Through) -> int:
        try:
            return await self.peer.ask(Count())
        except hf.HoldfastError:
            return -1


class Twice(Tally):
    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.count += 2 * message.n
        return self.count


KINDS: dict[str, type[Tally]] = {"Tally": Tally, "Twice": Twice}


def one_more(state: dict[str, Any]) -> dict[str, Any]:
    """The state that replaces another one."""
    return {**state, "count": state["count"] + PER_STATE}


def spec_of(node: Node, peer: str | None) -> hf.ChildSpec[Any]:
    """The child spec of a newcomer."""
    if node.kind == "supervisor":
        return hf.supervisor(node.name, strategy=node.strategy, intensity=node.intensity, period=node.period)  # type: ignore[arg-type]
    return hf.child(
        node.name,
        hf.start(KINDS[node.kind], node.who * PER_ACTOR, node.is_late),
        isolation=node.isolation,
        recovery=hf.hybrid(on_escalate="restore") if node.is_recorded else None,
        bindings={} if peer is None else {"peer": peer},
    )


class Act(hf.system.Operation):
    """A step of the tests: it does `work` where others prepare, and is told of the commit.

    Its methods have the names of both ways to carry out a transaction: as steps that are done and undone (`do`, `undo`,
    `seal`), and as steps that are prepared and committed (`prepare`, `release`, `commit`).
    """

    verb = "act"

    def __init__(
        self, what: str, work: Callable[[], Awaitable[object]] | None = None, told: Callable[[], None] | None = None
    ) -> None:
        super().__init__(what)
        self._work, self._told = work, told

    async def check(self, system: hf.ActorSystem, draft: Any) -> None:
        """Nothing is in the way."""

    async def prepare(self, system: hf.ActorSystem) -> None:
        if self._work is not None:
            await self._work()

    def commit(self, system: hf.ActorSystem) -> None:
        if self._told is not None:
            self._told()

    async def release(self, system: hf.ActorSystem) -> None:
        """Nothing was made."""

    do, undo, seal = prepare, release, commit


async def fail() -> None:
    raise hf.HoldfastError("there was a stone")


async def hang() -> None:
    await asyncio.get_running_loop().create_future()
