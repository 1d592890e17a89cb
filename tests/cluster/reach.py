"""Systems that are reached over a simulated post on the virtual clock, and an account that they ask."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Coroutine
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.cluster.lines.inflow import DEFAULT_LIMITS
from holdfast.system import system_connection
from holdfast.testing.fleet.post import NO_POST_FAULTS, PostFaults, SimPost, SimTransport
from tests.cluster.fleets import simulate


class Add(hf.Message[int]):
    amount: int


class Total(hf.Message[int]): ...


class Wait(hf.Message[int]):
    seconds: float


class No(hf.Refusal):
    why: str


class Refuse(hf.Message[None]): ...


class Crash(hf.Message[None]): ...


class Large(hf.Message[bytes]):
    data: bytes


class News(hf.Message[None]):
    text: str


class Account(hf.Actor):
    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.amount
        return self.total

    @hf.on(Total)
    def say(self, message: Total) -> int:
        return self.total

    @hf.on(Wait)
    async def wait(self, message: Wait) -> int:
        await asyncio.sleep(message.seconds)
        return self.total

    @hf.on(Large)
    def large(self, message: Large) -> bytes:
        return message.data * 3

    @hf.on(Refuse)
    def refuse(self, message: Refuse) -> None:
        raise No("not today")

    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise ValueError("broken")

    @hf.on(News)
    def news(self, message: News) -> None:
        self.total += len(message.text)


class Posted:
    """Servers that carry lines alone; see `holdfast.cluster.servers.Servers`."""

    def __init__(self, reach: Reach, system: str) -> None:
        self._reach, self.system = reach, system

    async def open_lines(self) -> tuple[SimTransport, str]:
        self._reach.transports.append(self._reach.post.transport())
        return self._reach.transports[-1], f"inbox of {self.system}"


class Reach:
    """Systems that are reached over one post."""

    def __init__(self, patch: pytest.MonkeyPatch, seed: int, faults: PostFaults = NO_POST_FAULTS) -> None:
        self.post = SimPost(seed, faults)
        self.transports: list[SimTransport] = []
        patch.setattr(system_connection, "servers_of", lambda at, settings: Posted(self, at))

    @asynccontextmanager
    async def bank_stack(self, store: Path) -> AsyncGenerator[Bank]:
        """A bank that can end and begin anew."""
        made = Bank(self, store)
        await made.begin()
        yield made
        await made.end()

    @asynccontextmanager
    async def bank(
        self, store: Path | None = None, limits: hf.system.ConnectionLimits = DEFAULT_LIMITS
    ) -> AsyncGenerator[hf.ActorSystem]:
        """A system with a plain account and a recorded one."""
        kept = None if store is None else f"sqlite:{store}"
        async with hf.ActorSystem("bank", store=kept, reachable="bank", connection_limits=limits, log=False) as system:
            await system.start(hf.child("plain", hf.start(Account)))
            await system.start(hf.child("kept", hf.start(Account), recovery=hf.hybrid()))
            yield system


class Bank:
    """A system that ends and begins anew, on one store."""

    def __init__(self, reach: Reach, store: Path) -> None:
        self._reach, self._store = reach, store
        self._stack = AsyncExitStack()
        self.transport = reach.post.transport()

    async def begin(self) -> None:
        self.system = await self._stack.enter_async_context(self._reach.bank(self._store))
        self.transport = self._reach.transports[-1]

    async def end(self) -> None:
        await self._stack.aclose()

    async def again(self) -> None:
        await self.end()
        await self.begin()

    async def total(self) -> int:
        return await self.system.ref("/bank/kept", Account).ask(Total())


Work = Callable[[Reach], Coroutine[Any, Any, None]]


def run(work: Work, seed: int = 0, faults: PostFaults = NO_POST_FAULTS) -> None:
    with pytest.MonkeyPatch.context() as patch:

        async def reached() -> None:
            await work(Reach(patch, seed, faults))

        simulate(reached, seed)


class Pay(hf.Message[int]):
    amount: int
    how: str


class Clerk(hf.Actor):
    """Recorded: pays into an account of another system."""

    def __init__(self, account: hf.ActorRef[Account]) -> None:
        self._account = account
        self.paid = 0

    @hf.on(Pay)
    async def pay(self, message: Pay) -> int:
        self.paid += message.amount
        match message.how:
            case "tell":
                self._account.tell(Add(message.amount))
            case "send":
                await self._account.send(Add(message.amount))
            case "ask":
                await self._account.ask(Add(message.amount), timeout=3000.0)
        return self.paid


@asynccontextmanager
async def shop_of(
    store: Path, name: str = "kept", limits: hf.system.ConnectionLimits = DEFAULT_LIMITS
) -> AsyncGenerator[hf.ActorRef[Clerk]]:
    """A system whose recorded clerk pays into an account of the bank."""
    async with (
        hf.ActorSystem("shop", store=f"sqlite:{store}", connection_limits=limits, log=False) as shop,
        hf.connect("bank", within=shop, timeout=600.0) as bank,
    ):
        account = bank.ref(f"/bank/{name}", Account)
        yield await shop.start(hf.child("clerk", hf.start(Clerk, account), recovery=hf.hybrid()))
