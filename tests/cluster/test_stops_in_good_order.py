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
from holdfast.checkpoint.home import ask_recovery
from holdfast.testing.fleet.sim_fleet import SimFleet, SimProgram
from tests.cluster.fleets import simulate

SEEDS = int(os.environ.get("HOLDFAST_ORDERLY_STOPS", "3"))
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
        await system.start(hf.child("ledger", hf.start(Ledger), recovery=hf.hybrid(), restart="temporary"))
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


async def booked_at(connection: hf.system.SystemConnection) -> list[str]:
    """What the ledger has booked."""
    (booked,) = await connection.ref("/bank/ledger", Ledger).ask(Books(), timeout=600.0)
    return booked


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
            booked = await booked_at(to_bank)
        for orders in (sold, asked, booked, confirmed):
            assert Counter(orders) == Counter(acknowledged)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_each_order_is_charged_once_whichever_programs_are_stopped(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ask_recovery, "MOST_ENTRIES", 30)  # What is kept for others is written anew often.
    simulate(lambda: orders_are_charged_once(seed), seed)


@pytest.mark.parametrize("how", ["stop", "kill"])
def test_what_comes_again_before_the_receiver_has_it_safely_is_handled_once(how: str) -> None:
    """The log of the bank takes nothing while one program of the shop after the other tells it the same."""

    async def run() -> None:
        async with SimFleet() as fleet:
            fleet.start(bank, "bank")
            first = fleet.start(shop_on(fleet), "shop")
            async with (
                hf.connect(fleet.servers("shop"), timeout=60.0) as to_shop,
                hf.connect(fleet.servers("bank"), timeout=60.0) as to_bank,
            ):
                event = to_shop.ref("/shop/event", Event)
                await event.ask(Sell("before"), timeout=60.0)
                fleet.start(shop_on(fleet), "shop")
                await asyncio.sleep(3.0)
                assert await booked_at(to_bank) == ["before"]
                fleet.broker("bank").go_away(AWAY)
                await event.ask(Sell("once"), timeout=60.0)
                await asyncio.sleep(1.0)
                if how == "stop":
                    first.stop()
                else:
                    fleet.kill(first)
                await asyncio.sleep(AWAY + 5.0)
                assert await booked_at(to_bank) == ["before", "once"]

    simulate(run, 0)


def test_what_a_turn_tells_another_system_leaves_when_the_turn_is_safe() -> None:
    """Also if the connection is opened just before."""

    async def run() -> None:
        async with SimFleet() as fleet:
            fleet.start(bank, "bank")
            fleet.broker("shop").latency = (0.5, 0.5)
            opens = asyncio.Event()

            async def shop(program: SimProgram) -> None:
                async with program.open() as system:
                    cashier = await system.start(hf.child("cashier", hf.start(Cashier), recovery=hf.hybrid()))
                    async with hf.connect(fleet.servers("bank"), within=system, timeout=60.0) as there:
                        await cashier.ask(Route(there.ref("/bank/ledger", Ledger)), timeout=60.0)
                    await opens.wait()
                    async with hf.connect(fleet.servers("bank"), within=system, timeout=60.0):
                        await asyncio.Event().wait()

            program = fleet.start(shop, "shop")
            async with (
                hf.connect(fleet.servers("shop"), timeout=60.0) as to_shop,
                hf.connect(fleet.servers("bank"), timeout=60.0) as to_bank,
            ):
                cashier = to_shop.ref("/shop/cashier", Cashier)
                assert await cashier.ask(Books(), timeout=60.0) == [[], []]
                await asyncio.sleep(10.0)
                cashier.tell(Charge("a"))
                assert program.system is not None
                while not any(one.kept for one in program.system.connected()):
                    await asyncio.sleep(0.05)
                opens.set()
                await asyncio.sleep(0.3)
                assert await booked_at(to_bank) == []
                await asyncio.sleep(10.0)
                assert await booked_at(to_bank) == ["a"]

    simulate(run, 0)


def test_who_has_accepted_a_message_forgets_it_when_that_stands_in_the_log_of_its_sender() -> None:
    """Also if that has started no actor yet."""

    async def run() -> None:
        async with SimFleet() as fleet:
            starts = asyncio.Event()
            starts.set()

            async def shop(program: SimProgram) -> None:
                async with program.open() as system:
                    await starts.wait()
                    await system.start(hf.child("cashier", hf.start(Cashier), recovery=hf.hybrid()))
                    await asyncio.Event().wait()

            async def calling_bank(program: SimProgram) -> None:
                async with program.open() as system:
                    ledger = await system.start(hf.child("ledger", hf.start(Ledger), recovery=hf.hybrid()))
                    async with hf.connect(fleet.servers("shop"), within=system, timeout=60.0) as there:
                        await there.ref("/shop/cashier", Cashier).ask(Route(ledger), timeout=60.0)
                        await asyncio.Event().wait()

            first = fleet.start(shop, "shop")
            calling = fleet.start(calling_bank, "bank")
            async with (
                hf.connect(fleet.servers("shop"), timeout=60.0) as to_shop,
                hf.connect(fleet.servers("bank"), timeout=60.0) as to_bank,
            ):
                cashier = to_shop.ref("/shop/cashier", Cashier)
                assert await cashier.ask(Books(), timeout=60.0) == [[], []]
                assert await booked_at(to_bank) == []
                await asyncio.sleep(3.0)
                calling.servers.cut(log=False)
                await cashier.send(Charge("a"))
                assert (await cashier.ask(Books(), timeout=60.0))[0] == ["a"]
                starts.clear()
                fleet.kill(first)
                second = fleet.start(shop, "shop")
                while not second.leads:
                    await asyncio.sleep(0.1)
                fleet.broker("shop").go_away(AWAY)
                calling.servers.heal()
                while await booked_at(to_bank) != ["a"]:
                    await asyncio.sleep(0.1)
                await asyncio.sleep(3.0)
                fleet.kill(second)
                starts.set()
                fleet.start(shop, "shop")
                await asyncio.sleep(2 * AWAY)
                assert await booked_at(to_bank) == ["a"]

    simulate(run, 0)


class Watch(hf.Message[None]):
    whom: hf.ActorRef[Ledger]
    how: str


class Watcher(hf.Actor):
    """Watches an actor of another system in one way, and notes what it is told."""

    def __init__(self) -> None:
        self.told: list[str] = []

    @hf.on(Watch)
    def begin(self, message: Watch) -> None:
        self.ctx.trap_exits = True
        match message.how:
            case "monitor":
                self.ctx.monitor(message.whom)
            case "watch":
                self.ctx.watch(message.whom)
            case _:
                self.ctx.link(message.whom)

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.told.append(f"down {reason}")

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.told.append(f"exit {reason}")

    @hf.on(Books)
    def books(self, message: Books) -> list[list[str]]:
        return [self.told]


TOLD = {"monitor": ["down no connection to bank"], "link": ["exit no connection to bank"], "watch": []}
"""What those who watch an actor in each way hear when another program comes to lead its system."""


@pytest.mark.parametrize("how", TOLD)
@pytest.mark.parametrize("end", ["stop", "kill"])
def test_the_end_of_a_program_is_no_end_of_its_actors_to_other_systems(end: str, how: str) -> None:
    async def run() -> None:
        async with SimFleet() as fleet, hf.ActorSystem("office", log=False) as office:
            first = fleet.start(bank, "bank")
            watcher = await office.start(hf.child("watcher", hf.start(Watcher)))
            async with hf.connect(fleet.servers("bank"), within=office, timeout=60.0) as there:
                ledger = there.ref("/bank/ledger", Ledger)
                assert await ledger.ask(Books(), timeout=60.0) == [[]]
                await watcher.ask(Watch(ledger, how))
                second = fleet.start(bank, "bank")
                await asyncio.sleep(3.0)
                if end == "stop":
                    first.stop()
                else:
                    fleet.kill(first)
                await asyncio.sleep(15.0)
                assert await ledger.ask(Books(), timeout=60.0) == [[]]
                assert await watcher.ask(Books()) == [TOLD[how]]
                if how == "watch":
                    assert second.system is not None
                    await second.system.terminate("/bank/ledger")
                    await asyncio.sleep(1.0)
                    assert await watcher.ask(Books()) == [["down shutdown"]]

    simulate(run, 0)
