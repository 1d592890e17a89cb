"""Turns that wait for too long are told of, wherever they run, and nothing is ended."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import pytest

import holdfast as hf

LIMIT = 0.2
PLACES: dict[str, dict[str, Any]] = {
    "task": {},
    "recorded": {"recovery": hf.hybrid()},
    "process": {"isolation": "process"},
    "recorded process": {"isolation": "process", "recovery": hf.hybrid()},
    "protected": {"mechanism": hf.ftm.PBR(), "recovery": hf.hybrid()},
}


class Pay(hf.Message[str]):
    seconds: float
    how: str = "sleep"


async def provider(seconds: float) -> str:
    await asyncio.sleep(seconds)
    return "paid"


class Till(hf.Actor):
    @hf.on(Pay)
    async def pay(self, message: Pay) -> str:
        match message.how:
            case "effect":
                return await self.ctx.effect(provider, message.seconds)
            case "rest":
                await self.ctx.sleep(message.seconds)
            case _:
                await asyncio.sleep(message.seconds)
        return "paid"


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("how", ["sleep", "effect"])
@pytest.mark.some(5)
async def test_a_turn_that_waits_for_too_long_is_told_of(place: str, how: str) -> None:
    async with hf.ActorSystem("app", log=False, watch_waits=LIMIT) as system:
        till = await system.start(hf.child("till", hf.start(Till), **PLACES[place]))
        with system.events() as events:
            asked = till.ask(Pay(1.2, how), timeout=60.0)
            for least in (LIMIT, 2 * LIMIT):
                told = await events.until(hf.events.TurnWaits, timeout=20.0)
                assert told.address.startswith("/app/till"), told
                assert told.message.endswith("test_wait_watch.Pay")
                assert least <= told.seconds
                assert "asyncio.sleep" in told.at or "ctx.effect" in told.at
            assert await asked == "paid"
        assert (await system.get_status(till)).life == 1


@pytest.mark.parametrize("place", PLACES)
async def test_turns_that_end_in_time_are_not(place: str) -> None:
    async with hf.ActorSystem("app", log=False, watch_waits=LIMIT) as system:
        till = await system.start(hf.child("till", hf.start(Till), **PLACES[place]))
        for _ in range(10):
            await till.ask(Pay(0.05), timeout=60.0)
        assert system.history(kinds=["TurnWaits"]).events == []


@pytest.mark.parametrize("place", ["task", "recorded", "process", "recorded process"])
async def test_nor_is_one_that_rests_as_long_as_it_has_said_itself(place: str) -> None:
    async with hf.ActorSystem("app", log=False, watch_waits=LIMIT) as system:
        till = await system.start(hf.child("till", hf.start(Till), **PLACES[place]))
        assert await till.ask(Pay(0.6, "rest"), timeout=60.0) == "paid"
        assert system.history(kinds=["TurnWaits"]).events == []


@pytest.mark.parametrize("wrong", [0.0, -1.0, float("inf")])
def test_limits_are_seconds(wrong: float) -> None:
    with pytest.raises(hf.SpecError, match="watch_waits"):
        hf.ActorSystem("app", watch_waits=wrong)


class Flow(hf.Actor):
    @hf.on(Pay)
    async def pay(self, message: Pay) -> str:
        await asyncio.sleep(message.seconds)
        return "paid"


class Leaving(hf.Actor):
    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    async def on_stop(self, reason: Any) -> None:
        await asyncio.sleep(self.seconds)


@pytest.mark.parametrize("place", ["task", "recorded", "process"])
async def test_a_stop_says_once_for_whom_it_waits(place: str) -> None:
    """The supervisors above wait for that as well, and do not say so."""
    async with hf.ActorSystem("app", log=False, watch_waits=LIMIT) as system:
        flow = hf.child("a", hf.start(Flow), shutdown=10.0, **PLACES[place])
        others = [hf.child(name, hf.start(Flow)) for name in ("b", "c")]
        inner = hf.supervisor("inner", children=[flow, *others], shutdown=20.0)
        top = await system.start(hf.supervisor("top", children=[inner], shutdown=20.0))
        paying = system.ref("/app/top/inner/a", Flow)
        asked = paying.ask(Pay(1.2), timeout=60.0)
        async with asyncio.timeout(20.0):
            while (await system.get_status(paying)).turn is None:
                await asyncio.sleep(0)
        await system.stop(top)
        with contextlib.suppress(hf.AskFailed, hf.ActorStopped):
            await asked
        told = system.history(kinds=["StopWaits"]).events
        assert {(one.address, one.fields["waits_for"]) for one in told} == {("/app/top/inner", "/app/top/inner/a")}
        assert {one.address for one in system.history(kinds=["TurnWaits"]).events} <= {"/app/top/inner/a"}


async def test_a_stop_names_its_own_line() -> None:
    async with hf.ActorSystem("app", log=False, watch_waits=LIMIT) as system:
        leaving = await system.start(hf.child("leaving", hf.start(Leaving, 0.8), shutdown=10.0))
        await system.stop(leaving)
        told = system.history(kinds=["StopWaits"]).events
        assert told
        assert (told[0].address, told[0].fields["waits_for"]) == ("/app/leaving", "")
        assert "asyncio.sleep" in str(told[0].fields["at"])
