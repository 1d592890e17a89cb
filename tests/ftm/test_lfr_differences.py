"""What leader and follower do about a difference: states are compared too, and what has differed is computed again."""

from __future__ import annotations

import asyncio
import math
import os
from typing import Any, ClassVar

import pytest

import holdfast as hf
from holdfast.ftm.alarms import Diverged, NondeterminismFound, StatesDiffer
from holdfast.ftm.bricks.brick_messages import Strayed
from holdfast.ftm.mechanisms.lfr import LFR, RUNS_AGAIN
from tests.ftm.replicated import Add, Guess, Read, Total, pair


class Watched(Total):
    """Has something in its state that no reply shows; counts its runs on each replica."""

    runs: ClassVar[dict[str, int]] = {}
    flips: ClassVar[dict[str, str]] = {}
    """What the next run on a replica does wrong: in its "reply", or in its "state"."""

    def __init__(self) -> None:
        super().__init__()
        self.hidden = 0

    def wrong(self) -> str:
        replica = self.ctx._cell.path.split("/")[4]
        self.runs[replica] = self.runs.get(replica, 0) + 1
        return self.flips.pop(replica, "")

    @hf.on(Add)
    def add(self, message: Add) -> int:
        wrong = self.wrong()
        self.hidden += 1 if wrong != "state" else 256
        self.seen.append(message.n)
        return sum(self.seen) ^ (1024 if wrong == "reply" else 0)


class Secret(Watched):
    """Is not deterministic, and no reply shows it."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.hidden = int.from_bytes(os.urandom(6), "big")
        self.seen.append(message.n)
        return sum(self.seen)


@pytest.fixture(autouse=True)
def _afresh() -> None:
    Watched.runs.clear()
    Watched.flips.clear()


async def heard(events: Any, *kinds: type[Any]) -> list[Any]:
    """Events, until there is one of each of these kinds."""
    seen: list[Any] = []
    async with asyncio.timeout(30):
        while not all(any(isinstance(one, kind) for one in seen) for kind in kinds):
            seen += events.take()
            await asyncio.sleep(0)
    return seen


async def until_run_again(driver: Any) -> None:
    """Wait until the follower has computed again what has differed."""
    async with asyncio.timeout(30):
        while Watched.runs.get("r2", 0) < Watched.runs["r1"] + RUNS_AGAIN or driver.standing("r2").server.shadows:
            await asyncio.sleep(0)


@pytest.mark.parametrize(("what", "kind"), [("reply", Diverged), ("state", StatesDiffer)])
async def test_one_wrong_value_is_told_and_is_not_the_application_s_fault(
    system: hf.ActorSystem, what: str, kind: type[Any]
) -> None:
    driver = await pair(system, Watched, LFR(compare_every=0))
    with system.events() as events:
        assert await driver.ask(Add(1)) == 1
        Watched.flips["r2"] = what
        assert await driver.ask(Add(2)) == 3
        (told,) = [one for one in await heard(events, kind) if isinstance(one, kind)]
        assert told.replica == driver.path("r2")
        await until_run_again(driver)
        assert [one.path for one in driver.more if isinstance(one, Strayed)] == [driver.path("r2")]
        async with asyncio.timeout(30):
            while driver.standing("r1").other.state != "live":
                await asyncio.sleep(0)
        assert await driver.ask(Add(3)) == 6
        for _ in range(200):
            await asyncio.sleep(0)
        assert not [one for one in events.take() if isinstance(one, (Diverged, StatesDiffer, NondeterminismFound))]
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert driver.server("r2").hidden == 3
    assert await driver.ask(Read()) == [1, 2, 3]


async def test_an_actor_that_is_not_deterministic_is_found_out_by_its_replies(system: hf.ActorSystem) -> None:
    driver = await pair(system, Total, LFR(compare_every=math.inf))
    with system.events() as events:
        (key,) = driver.send(Guess())
        await driver.reply(key)
        told = await heard(events, Diverged, NondeterminismFound)
    (found,) = [one for one in told if isinstance(one, NondeterminismFound)]
    assert (found.request, found.name.rpartition(":")[2]) == (key, "Guess")


async def test_an_actor_that_is_not_deterministic_is_found_out_by_its_state(system: hf.ActorSystem) -> None:
    driver = await pair(system, Secret, LFR(compare_every=0))
    driver.holds_strays = True
    with system.events() as events:
        assert await driver.ask(Add(1)) == 1
        await heard(events, StatesDiffer, NondeterminismFound)


async def test_states_are_compared_only_now_and_then(system: hf.ActorSystem) -> None:
    """At the first batch, and then when the time has come: here never again."""
    driver = await pair(system, Watched, LFR(compare_every=1e6))
    with system.events() as events:
        Watched.flips["r2"] = "state"
        for n in range(20):
            await driver.ask(Add(n))
        assert not [one for one in events.take() if isinstance(one, StatesDiffer)]


def test_settings_that_mean_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match="compare_every must be seconds >= 0, not -1"):
        LFR(compare_every=-1)
    with pytest.raises(ValueError, match="compare_every"):
        LFR(compare_every=math.nan)
