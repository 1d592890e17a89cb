"""Two systems whose programs are stopped in good order, or killed, while recorded actors tell each other: all is once.

HOLDFAST_ORDERLY_STOPS says for how many seeds.
"""

from __future__ import annotations

import asyncio
import os
import random
from collections import Counter
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing.fleet.sim_fleet import SimFleet, SimProgram
from tests.cluster.fleets import simulate

SEEDS = int(os.environ.get("HOLDFAST_ORDERLY_STOPS", "10"))
AWAY = 20.0
"""Seconds in which the servers of a system take nothing: longer than a takeover."""


class Charge(hf.Message[None]):
    order: str


class Charged(hf.Message[None]):
    order: str


class Sell(hf.Message[int]):
    order: str


class Books(hf.Message[list[list[str]]]): ...


class Route(hf.Message[None]):
    ledger: hf.ActorRef[Ledger]


class Event(hf.Actor):
    """Sells, and has the cashier charge for it."""

    cashier: hf.Binding[Cashier]

    def __init__(self) -> None:
        self.sold: list[str] = []

    @hf.on(Sell)
    def sell(self, message: Sell) -> int:
        self.sold.append(message.order)
        self.cashier.tell(Charge(message.order))
        return len(self.sold)

    @hf.on(Books)
    def books(self, message: Books) -> list[list[str]]:
        return [self.sold]


class Cashier(hf.Actor):
    """Tells the ledger of the other system what to charge."""

    def __init__(self) -> None:
        self.ledger: hf.ActorRef[Ledger] | None = None
        self.waiting: list[Charge] = []
        self.asked: list[str] = []
        self.confirmed: list[str] = []

    @hf.on(Route)
    def route(self, message: Route) -> None:
        self.ledger = message.ledger
        for charge in self.waiting:
            self.ledger.tell(charge)
        self.waiting = []

    @hf.on(Charge)
    def charge(self, message: Charge) -> None:
        self.asked.append(message.order)
        if self.ledger is None:
            self.waiting.append(message)
        else:
            self.ledger.tell(message)

    @hf.on(Charged)
    def charged(self, message: Charged) -> None:
        self.confirmed.append(message.order)

    @hf.on(Books)
    def books(self, message: Books) -> list[list[str]]:
        return [self.asked, self.confirmed]


class Ledger(hf.Actor):
    """Books each charge, and says so."""

    def __init__(self) -> None:
        self.booked: list[str] = []

    @hf.on(Charge)
    def charge(self, message: Charge) -> None:
        self.booked.append(message.order)
        assert self.ctx.sender is not None
        self.ctx.sender.tell(Charged(message.order))

    @hf.on(Books)
    def books(self, message: Books) -> list[list[str]]:
        return [self.booked]


async def bank(program: SimProgram) -> None:
    async with program.open() as system:
        await system.start(hf.child("ledger", hf.start(Ledger), recovery=hf.hybrid()))
        await asyncio.Event().wait()


def shop_on(fleet: SimFleet) -> Callable[[SimProgram], Coroutine[Any, Any, None]]:
    """A program of the shop: its cashier uses the ledger of the bank."""

    async def shop(program: SimProgram) -> None:
        async with program.open() as system:
            cashier = await system.start(hf.child("cashier", hf.start(Cashier), recovery=hf.hybrid()))
            spec = hf.child("event", hf.start(Event), recovery=hf.hybrid(), bindings={"cashier": "/shop/cashier"})
            await system.start(spec)
            async with hf.connect(fleet.servers("bank"), within=system, timeout=60.0) as there:
                await cashier.ask(Route(there.ref("/bank/ledger", Ledger)), timeout=60.0)
                await asyncio.Event().wait()

    return shop


async def orders_are_charged_once(seed: int) -> None:
    draw = random.Random(f"stops {seed}")
    async with SimFleet(seed) as fleet:
        for name in ("shop", "bank"):
            slowest = draw.choice((0.003, 0.02, 0.06))
            fleet.broker(name).latency = slowest / 4, slowest
        bodies = {"shop": shop_on(fleet), "bank": bank}
        there = {name: [fleet.start(body, name) for _ in range(2)] for name, body in bodies.items()}
        acknowledged: list[str] = []
        done = asyncio.Event()
        async with (
            hf.connect(fleet.servers("shop"), timeout=60.0) as to_shop,
            hf.connect(fleet.servers("bank"), timeout=60.0) as to_bank,
        ):
            event = to_shop.ref("/shop/event", Event)

            async def sell(client: int) -> None:
                number = 0
                while not done.is_set():
                    number += 1
                    await event.ask(Sell(f"{client}-{number}"), timeout=600.0)
                    acknowledged.append(f"{client}-{number}")
                    await asyncio.sleep(pauses.uniform(0.0, 0.05))

            pauses = random.Random(f"pauses {seed}")
            clients = [asyncio.ensure_future(sell(client)) for client in range(4)]
            await asyncio.sleep(2.0)
            for _ in range(3):
                await asyncio.sleep(draw.uniform(0.5, 1.5))
                name = draw.choice(("shop", "shop", "bank"))
                program = next((one for one in there[name] if one.leads), there[name][0])
                there[name].remove(program)
                if draw.random() < 0.8:
                    program.stop()
                else:
                    fleet.kill(program)
                there[name].append(fleet.start(bodies[name], name))
                await asyncio.sleep(draw.uniform(0.5, 6.0))
            await asyncio.sleep(5.0)
            done.set()
            await asyncio.gather(*clients)
            await asyncio.sleep(20.0)
            (sold,) = await event.ask(Books(), timeout=60.0)
            asked, confirmed = await to_shop.ref("/shop/cashier", Cashier).ask(Books(), timeout=60.0)
            (booked,) = await to_bank.ref("/bank/ledger", Ledger).ask(Books(), timeout=60.0)
        for orders in (sold, asked, booked, confirmed):
            assert Counter(orders) == Counter(acknowledged)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_each_order_is_charged_once_whichever_programs_are_stopped(seed: int) -> None:
    simulate(lambda: orders_are_charged_once(seed), seed)
