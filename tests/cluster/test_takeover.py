"""Programs that take over from each other lose nothing that was safe, whatever happens to them and to the servers."""

from __future__ import annotations

import asyncio
import os

import pytest

from holdfast.testing.fleet.broker import BrokerFaults, SimBroker
from tests.cluster.fleets import Fleet, simulate, small_sizes

SEEDS = int(os.environ.get("HOLDFAST_FLEETS", "100"))


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
