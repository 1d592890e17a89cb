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
