"""Programs that take over from each other lose nothing that was safe, whatever happens to them and to the servers."""

from __future__ import annotations

import asyncio
import os
from functools import partial

import pytest

from holdfast.cluster.log_records import BASE, read_part
from holdfast.testing.fleet.broker import BrokerFaults, SimBroker
from tests.cluster.fleets import Fleet, simulate, small_sizes

SEEDS = int(os.environ.get("HOLDFAST_FLEETS", "24"))


def weather(fleet: Fleet) -> None:
    """One thing happens."""
    draw, broker = fleet.draw, fleet.broker
    program = draw.choice(fleet.programs)
    link, loop = program.engine.link, asyncio.get_running_loop()
    what = draw.choice(
        ["kill", "kill leader", "freeze", "cut", "one way", "stale", "flap", "election", "expire", "close", "faults"]
    )
    if what == "kill leader":
        program = next((one for one in fleet.programs if one.journal is not None), program)
    if what.startswith("kill"):
        program.kill()
        fleet.start(draw.choice(["warm", "cold"]))
    elif what == "freeze":
        link.freeze()
        loop.call_later(draw.uniform(0.5, 10.0), link.thaw)
    elif what in ("cut", "one way", "stale", "flap"):
        if what == "one way":
            link.cut(sends=draw.random() < 0.5, hears=draw.random() < 0.5)
        else:
            link.cut(stale_since=loop.time() if what == "stale" else None)
        loop.call_later(draw.uniform(0.5, 8.0) if what != "flap" else 0.3, link.heal)
    elif what == "election":
        broker.go_away(draw.choice([0.5, 2.0, 4.0, 60.0] if draw.random() < 0.1 else [0.5, 2.0]))
    elif what == "expire":
        broker.expire_lease()
    elif what == "close":
        program.is_to_close.set()
    else:
        broker.faults = drawn_faults(fleet)


def drawn_faults(fleet: Fleet) -> BrokerFaults:
    draw = fleet.draw
    share = draw.choice([0.0, 0.01, 0.05, 0.2])

    def drawn() -> float:
        return share * draw.random()

    return BrokerFaults(drawn(), drawn(), drawn(), drawn(), drawn(), drawn(), drawn() / 4, drawn(), drawn() * 3)


STRIKES = ("kill", "freeze", "cut", "deaf", "election", "expire", "close", "kill and election")
CROSSED = "HOLDFAST_CROSSED" in os.environ
"""Whether each of them comes at each step, not only one."""


def strike(fleet: Fleet, what: str) -> None:
    """Something happens to whoever leads, or to the first program if nobody does, or to the servers."""
    program = next((one for one in fleet.programs if one.journal is not None), fleet.programs[0])
    link, loop = program.engine.link, asyncio.get_running_loop()
    if what.startswith("kill"):
        program.kill()
        fleet.start("cold")
    elif what == "freeze":
        link.freeze()
        loop.call_later(5.0, link.thaw)
    elif what == "close":
        program.is_to_close.set()
    elif what == "expire":
        fleet.broker.expire_lease()
    elif what in ("cut", "deaf"):
        link.cut(sends=what == "deaf")
        loop.call_later(5.0, link.heal)
    if what.endswith("election"):
        fleet.broker.go_away(2.5)


@pytest.mark.parametrize("step", range(1, 150, 1 if CROSSED else 3))
def test_whatever_happens_at_whatever_step(step: int) -> None:
    """At one request after another of a leader that begins, writes, writes a base, and is taken over from."""

    async def run(what: str) -> None:
        fleet = Fleet(SimBroker(step), step)
        for _ in range(2):
            fleet.start("warm")
        done = 0

        def on_request(number: int) -> None:
            nonlocal done
            if number in (step, step + 9):  # The second one often comes in the midst of what the first has begun.
                asyncio.get_running_loop().call_soon(strike, fleet, what)
                done += 1

        fleet.broker.on_request = on_request
        await asyncio.sleep(12.0)
        fleet.check()
        assert done == 2
        await fleet.settle()

    for what in STRIKES if CROSSED else [STRIKES[step % len(STRIKES)]]:
        with small_sizes(1000):
            simulate(partial(run, what), step)


@pytest.mark.parametrize("seed", range(8))
def test_a_leader_that_dies_between_the_parts_of_a_base_leaves_none(seed: int) -> None:
    async def run() -> None:
        fleet = Fleet(SimBroker(seed), seed)
        fleet.start("warm")
        fleet.start("warm")
        kills = 0

        def on_request(number: int) -> None:
            nonlocal kills
            records = fleet.broker.records
            part = read_part(records[-1]) if records else None
            if kills < 2 and part is not None and part.kind == BASE and not part.is_last and part.part == 1 + kills:
                kills += 1
                asyncio.get_running_loop().call_soon(strike, fleet, "kill")

        fleet.broker.on_request = on_request
        while kills < 2:
            await asyncio.sleep(1.0)
            fleet.check()
        await fleet.settle()

    with small_sizes(1000):
        simulate(run, seed)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_what_was_safe_is_there_once_and_in_order(seed: int) -> None:
    async def run() -> None:
        fleet = Fleet(SimBroker(seed), seed)
        for _ in range(fleet.draw.choice([2, 3])):
            fleet.start(fleet.draw.choice(["warm", "cold"]))
        for _ in range(15):
            await asyncio.sleep(fleet.draw.uniform(0.05, 4.0))
            weather(fleet)
            fleet.check()
        fleet.broker.faults = BrokerFaults()
        await asyncio.sleep(10.0)
        await fleet.settle()
        assert len(fleet.epochs) > 1

    with small_sizes():
        simulate(run, seed)
