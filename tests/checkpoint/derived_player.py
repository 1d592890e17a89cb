"""A root whose ledger is told what derives from what it handles: python derived_player.py STORE ISOLATION END."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from typing import Any

import holdfast as hf


class Order(hf.Message[int]):
    number: int


class Express(Order):
    by: str


class Overnight(Express):
    before: int


class Show(hf.Message[list[str]]): ...


class Ledger(hf.Actor):
    """Handles orders, whatever they are called."""

    def __init__(self) -> None:
        self.orders: list[str] = []

    @hf.on(Order)
    async def order(self, message: Order) -> int:
        self.orders.append(repr(message))
        return len(self.orders)

    @hf.on(Show, readonly=True)
    async def show(self, message: Show) -> list[str]:
        return self.orders


class Notice(hf.Message):
    text: str


class Urgent(Notice):
    level: int


class Alarm(Urgent):
    siren: bool


class Gather(hf.Message[list[str]]):
    count: int


class Clerk(hf.Actor):
    """Waits for notices, whatever they are called."""

    @hf.on(Gather)
    async def gather(self, message: Gather) -> list[str]:
        return [repr(await self.ctx.wait_for(Notice, timeout=20.0)) for _ in range(message.count)]

    @hf.on(Notice)
    def late(self, message: Notice) -> None: ...

    @hf.on(Urgent)
    def late_and_urgent(self, message: Urgent) -> None: ...


NOTICES = (Urgent("rain", 2), Notice("sun"), Alarm("flood", 9, True))
ORDERS = (Order(1), Express(2, "air"), Overnight(3, "road", 8))


async def main(store: str, isolation: Any, end: str) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        spec = hf.child("ledger", hf.start(Ledger), isolation=isolation, recovery=hf.replay_only())
        ledger = await system.start(spec)
        if end == "killed":
            for order in ORDERS:
                await ledger.ask(order)
            os.kill(os.getpid(), signal.SIGKILL)
        print(json.dumps(await ledger.ask(Show())))


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
