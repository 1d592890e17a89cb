"""Whole systems on simulated servers: one leads, the others stand by, and clients see one that never failed."""

from __future__ import annotations

import asyncio
import functools
import os
import random
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.errors import ConnectionLost, NoSuchActor
from holdfast.checkpoint.journal import StaleEpoch
from holdfast.cluster.leadership import MOMENT_SECONDS, LeadershipLost, Standby
from holdfast.cluster.ports import Unanswered
from holdfast.testing import History, Model, linearizable
from holdfast.testing.fleet.broker import BrokerFaults
from holdfast.testing.fleet.post import PostFaults
from holdfast.testing.fleet.sim_engine import SimBlobs
from holdfast.testing.fleet.sim_fleet import SimFleet, SimProgram
from tests.cluster.fleets import simulate

SEEDS = int(os.environ.get("HOLDFAST_SYSTEM_FLEETS", "6"))


class Put(hf.Message[int]):
    key: str
    value: int


class Get(hf.Message[int]):
    key: str


class Ledger(hf.Actor):
    """Keeps a number for each key, and says which one was there before."""

    def __init__(self) -> None:
        self.values: dict[str, int] = {}

    @hf.on(Put)
    def put(self, message: Put) -> int:
        before = self.values.get(message.key, 0)
        self.values[message.key] = message.value
        return before

    @hf.on(Get)
    def get(self, message: Get) -> int:
        return self.values.get(message.key, 0)


async def bank(program: SimProgram, standby: Standby | None = "warm") -> None:
    """A program of the bank: it leads, or stands by until it does."""
    async with program.open(standby=standby) as system:
        spec = hf.child("ledger", hf.start(Ledger), recovery=hf.hybrid(interval=3.0), register="ledger", scope="fleet")
        await system.start(spec)
        await asyncio.Event().wait()


def step(values: tuple[tuple[str, int], ...], message: Put | Get) -> tuple[tuple[tuple[str, int], ...], int]:
    """What a ledger that never fails does."""
    known = dict(values)
    before = known.get(message.key, 0)
    if isinstance(message, Put):
        known[message.key] = message.value
    return tuple(sorted(known.items())), before


MODEL: Model[tuple[tuple[str, int], ...]] = Model((), step, key=lambda operation: operation.message.key)


async def use(fleet: SimFleet, history: History, number: int, done: asyncio.Event) -> None:
    """A client asks one thing after another, of whoever leads."""
    name = f"client {number}"
    draw = random.Random(f"{fleet.seed} {name}")
    async with hf.connect(fleet.servers("bank"), timeout=600.0) as connection:
        ledger = connection.ref("/bank/ledger", Ledger)
        value = 0
        while not done.is_set():
            value += 1
            key = draw.choice("ab")
            message = Put(key, 10 * value + number) if draw.random() < 0.6 else Get(key)
            try:
                await history.ask(ledger, message, draw.choice([0.5, 5.0, 60.0]), client=name)
            except (hf.AskTimeout, hf.AskFailed, hf.SendError):
                pass  # The history has it as unknown, or as surely not done.
            await asyncio.sleep(draw.choice([0.0, 0.05, 0.5]))


FAULTS = ("kill leader", "kill", "stop", "cut", "cut log", "cut lines", "freeze", "election", "expire", "faults")


def weather(fleet: SimFleet) -> None:
    """One thing happens to a program, to the servers, or between them."""
    draw, broker, loop = fleet.draw, fleet.broker("bank"), asyncio.get_running_loop()
    what = draw.choice(FAULTS)
    program = fleet.leader() if draw.random() < 0.7 else None
    program = program or draw.choice(fleet.programs)
    servers = program.servers
    if what in ("kill", "kill leader"):
        fleet.kill(fleet.leader() or program if what == "kill leader" else program)
        fleet.start(bank, "bank")
    elif what == "stop":
        program.stop()
        fleet.programs.remove(program)
        fleet._ending.append(program)
        fleet.start(bank, "bank")
    elif what.startswith("cut"):
        servers.cut(log=what != "cut lines", lines=what != "cut log")
        loop.call_later(draw.uniform(0.3, 12.0), servers.heal)
    elif what == "freeze":
        servers.link.freeze()
        loop.call_later(draw.uniform(0.5, 10.0), servers.link.thaw)
    elif what == "election":
        broker.go_away(draw.choice([0.5, 2.0, 4.0]))
    elif what == "expire":
        broker.expire_lease()
    else:
        share = draw.choice([0.0, 0.01, 0.05])
        drawn = [share * draw.random() for _ in range(8)]
        lost, unheard, late, doubled, refused, stale, silent, skipped = drawn
        skew = 0.2 * draw.random()
        broker.faults = BrokerFaults(lost, unheard, late, doubled, refused, stale, silent / 4, skipped, skew)
        fleet.post.faults = PostFaults(*(share * draw.random() for _ in range(3)))


@pytest.mark.parametrize("seed", range(SEEDS))
def test_clients_see_one_ledger_whatever_happens(seed: int) -> None:
    async def run() -> None:
        history, done = History(), asyncio.Event()
        async with SimFleet(seed) as fleet:
            for _ in range(fleet.draw.choice([2, 3])):
                fleet.start(bank, "bank")
            clients = [asyncio.ensure_future(use(fleet, history, n, done)) for n in range(3)]
            for _ in range(10):
                await asyncio.sleep(fleet.draw.uniform(0.5, 6.0))
                weather(fleet)
                fleet.check()
            fleet.broker("bank").faults, fleet.post.faults = BrokerFaults(), PostFaults()
            for program in fleet.programs:
                program.servers.heal()
                program.servers.link.thaw()
            known = len(history.operations)
            async with asyncio.timeout(120.0):
                while len(history.operations) < known + 20:  # With all well again it goes on.
                    await asyncio.sleep(0.5)
                    fleet.check()
            done.set()
            await asyncio.gather(*clients)
        linearizable(history.operations, MODEL).verify()

    simulate(run, seed)


@pytest.mark.parametrize("how", ["kill", "stop", "cut"])
def test_another_program_goes_on_where_the_leader_was(how: str) -> None:
    async def run() -> None:
        async with SimFleet() as fleet:
            first = fleet.start(bank, "bank")
            async with hf.connect(fleet.servers("bank"), timeout=60.0) as connection:
                ledger = connection.ref("/bank/ledger", Ledger)
                assert await ledger.ask(Put("a", 1), timeout=60.0) == 0
                fleet.start(bank, "bank")
                await asyncio.sleep(1.0)
                if how == "cut":
                    first.servers.cut()
                elif how == "kill":
                    fleet.kill(first)
                else:
                    first.stop()
                assert await ledger.ask(Put("a", 2), timeout=60.0) == 1
                assert (await connection.whereis("ledger", Ledger)).path == "/bank/ledger"
                if how == "cut":
                    first.servers.heal()
                    await asyncio.sleep(10.0)
                assert await ledger.ask(Get("a"), timeout=60.0) == 2

    simulate(run, 0)


@pytest.mark.parametrize("standby", ["warm", None])
def test_who_begins_to_lead_waits_for_servers_that_are_silent_just_then(standby: Standby | None) -> None:
    """They have answered for the log, and not yet for lines: who is not to wait bears that for a moment."""

    async def run() -> None:
        async with SimFleet() as fleet:
            program = fleet.start(lambda program: bank(program, standby), "bank")
            program.servers.cut(log=False)
            await asyncio.sleep(60.0 if standby else MOMENT_SECONDS / 2)
            fleet.check()
            program.servers.heal()
            async with hf.connect(fleet.servers("bank"), timeout=60.0) as connection:
                assert await connection.ref("/bank/ledger", Ledger).ask(Put("a", 1), timeout=60.0) == 0

    simulate(run, 0)


def test_a_leader_that_was_deposed_says_nothing_of_names() -> None:
    """It is cut off from the log alone, and another program leads: it still hears clients, and does not know."""

    async def run() -> None:
        async with SimFleet() as fleet:
            first = fleet.start(bank, "bank")
            async with hf.connect(fleet.servers("bank"), timeout=60.0) as connection:
                assert (await connection.whereis("ledger")).path == "/bank/ledger"
                fleet.start(bank, "bank")
                await asyncio.sleep(1.0)
                first.servers.cut(lines=False)
                asked = asyncio.ensure_future(connection.whereis("ledger", timeout=100.0))
                await asyncio.sleep(2.5)
                assert first.leads
                assert not asked.done()
                try:
                    await asked
                except ConnectionLost:
                    pass  # The one that was asked leads no more.
                async with asyncio.timeout(60.0):
                    while True:
                        try:
                            await connection.whereis("ledger", timeout=5.0)
                            break
                        except (NoSuchActor, ConnectionLost, hf.AskTimeout):
                            await asyncio.sleep(0.1)
                first.servers.heal()

    simulate(run, 0)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_the_fixture_has_a_fleet(sim_fleet: SimFleet) -> None:
    sim_fleet.start(bank, "bank")
    async with hf.connect(sim_fleet.servers("bank"), timeout=60.0) as connection:
        assert await connection.ref("/bank/ledger", Ledger).ask(Put("a", 1), timeout=60.0) == 0


def test_a_seed_decides_when_whatever_happens() -> None:
    """Also what programs draw by themselves: how soon one that stands by looks again."""

    async def moments(told: list[float]) -> None:
        random.seed(len(runs))  # Whatever was drawn before.
        async with SimFleet(seed=1) as fleet:
            fleet.start(bank)
            fleet.start(bank)
            async with hf.connect(fleet.servers("app"), timeout=60.0) as connection:
                ledger = connection.ref("/app/ledger", Ledger)
                for number in range(6):
                    leader = fleet.leader()
                    if number in (2, 4) and leader is not None:
                        fleet.kill(leader)
                        fleet.start(bank)
                    await ledger.ask(Put("a", number), timeout=60.0)
                    told.append(asyncio.get_running_loop().time())

    runs: list[list[float]] = []
    for _ in range(2):
        runs.append([])
        simulate(functools.partial(moments, runs[-1]), seed=1)
    assert runs[0] == runs[1]


def test_what_a_program_raises_is_told() -> None:
    async def broken(program: SimProgram) -> None:
        async with program.open():
            raise ValueError("broken")

    async def run() -> None:
        fleet = SimFleet()
        fleet.start(broken)
        await asyncio.sleep(10.0)
        with pytest.raises(ValueError, match="broken"):
            fleet.check()
        with pytest.raises(ValueError, match="broken"):
            await fleet.close()

    simulate(run, 0)


@pytest.mark.parametrize("moment", ["check_system", "Specifications", "serve", "its body"])
def test_who_is_deposed_while_it_starts_has_lost_the_leadership(moment: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that it may be started again, and stands by: at whatever moment of its start, or later, it hears of that."""

    def refused(*_: object, **__: object) -> Any:
        raise StaleEpoch("sim:broker", epoch=1, current=2)

    async def lead(fleet: SimFleet) -> None:
        async with hf.ActorSystem("app", store=fleet.servers(), log=False):
            if moment == "its body":
                refused()
            raise AssertionError("it runs")

    async def run() -> None:
        async with SimFleet() as fleet:
            if moment != "its body":
                monkeypatch.setattr(f"holdfast.system.system.{moment}", refused)
            with pytest.raises(LeadershipLost, match="in epoch 2"):
                await lead(fleet)

    simulate(run, 0)


class Bulk(hf.Message[int]):
    size: int


class Warehouse(hf.Actor):
    def __init__(self) -> None:
        self.bulk = b""

    @hf.on(Bulk)
    def grow(self, message: Bulk) -> int:
        self.bulk += random.Random(message.size).randbytes(message.size)
        return len(self.bulk)


async def warehouse(program: SimProgram) -> None:
    async with program.open() as system:
        await system.start(hf.child("warehouse", hf.start(Warehouse), recovery=hf.hybrid(every=1)))
        await asyncio.Event().wait()


def test_a_program_that_begins_to_lead_waits_for_its_large_snapshots(monkeypatch: pytest.MonkeyPatch) -> None:
    """The servers do not answer for longer than any read waits, when it wants what stands beside the log."""
    get, asked = SimBlobs.get, list[float]()

    async def away(blobs: SimBlobs, name: str) -> bytes | None:
        asked.append(asyncio.get_running_loop().time())
        if asked[-1] < asked[0] + 45.0:
            raise Unanswered("sim:broker", "it is away")
        return await get(blobs, name)

    async def run() -> None:
        async with SimFleet() as fleet:
            first = fleet.start(warehouse)
            async with hf.connect(fleet.servers(), timeout=60.0) as connection:
                actor = connection.ref("/app/warehouse", Warehouse)
                assert await actor.ask(Bulk(1 << 18), timeout=60.0) == 1 << 18
                async with asyncio.timeout(60.0):
                    while not fleet.broker().blobs:
                        await asyncio.sleep(0.1)
                monkeypatch.setattr(SimBlobs, "get", away)
                fleet.start(warehouse)
                await asyncio.sleep(1.0)
                fleet.kill(first)
                assert await actor.ask(Bulk(0), timeout=200.0) == 1 << 18
                fleet.check()
        assert len(asked) > 1

    simulate(run, 0)


async def idle(program: SimProgram) -> None:
    """Do nothing until the end."""
    await asyncio.Event().wait()


def test_who_does_not_run_is_not_killed() -> None:
    async def run() -> None:
        async with SimFleet() as fleet:
            with pytest.raises(hf.HoldfastError, match="nobody leads; wait until"):
                fleet.kill(fleet.leader())
            program = fleet.start(idle)
            fleet.kill(program)
            with pytest.raises(hf.HoldfastError, match="this one does not"):
                fleet.kill(program)

    simulate(run, 0)
