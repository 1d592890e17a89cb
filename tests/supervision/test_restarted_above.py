"""What becomes of what is sent to an actor when a supervisor above it is restarted: its siblings fare better."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import Any

import pytest

import holdfast as hf

IN_TIME = 20.0


class Boom(hf.Message): ...


class Add(hf.Message[int]): ...


class Slow(hf.Message[str]): ...


class Heard(hf.Message[list[str]]): ...


class Fragile(hf.Actor):
    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise RuntimeError("boom")


class Counter(hf.Actor):
    """Its slow turn ends when it is let through, so that it is seen what comes meanwhile."""

    def __init__(self) -> None:
        self.count = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.count += 1
        return self.count

    @hf.on(Slow)
    async def slow(self, message: Slow) -> str:
        await GATES[0].wait()
        return f"slow {self.count}"


GATES: list[asyncio.Event] = []


class Watcher(hf.Actor):
    def __init__(self, whom: str) -> None:
        self.whom = whom
        self.heard: list[str] = []

    def on_start(self, restored: bool) -> None:
        self.ctx.watch(self.ctx.find(self.whom, Counter))

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.heard.append(str(reason))

    @hf.on(Heard)
    def say(self, message: Heard) -> list[str]:
        return list(self.heard)


async def outcome(ask: Awaitable[Any]) -> Any:
    try:
        return await ask
    except hf.HoldfastError as error:
        return type(error).__name__


def told(ref: hf.ActorRef[Counter]) -> str:
    try:
        ref.tell(Add())
    except hf.ActorStopped:
        return "refused"
    return "taken"


FATES = {
    # (restarted, recorded): turn in hand, ask that waits, ask meanwhile, tell meanwhile, dead letters, watch, count
    ("it", False): ["slow 1", 1, 3, "taken", 0, [], 5],
    ("it", True): ["slow 1", 2, 4, "taken", 0, [], 6],
    ("above", False): ["slow 1", "ActorStopped", "ActorStopped", "taken", 2, ["shutdown"], 1],
    ("above", True): ["slow 1", "ActorStopped", "ActorStopped", "taken", 0, ["shutdown"], 4],
}


@pytest.mark.parametrize(("restarted", "is_recorded"), FATES)
async def test_what_is_sent_while_a_siblings_crash_has_it_restarted(restarted: str, is_recorded: bool) -> None:
    """`rest_for_one` restarts all behind the one that crashes: the actor, or a supervisor above it."""
    GATES[:] = [asyncio.Event()]
    spec = hf.child("counter", hf.start(Counter), recovery=hf.hybrid() if is_recorded else None)
    inner: Any = hf.supervisor("inner", children=[spec]) if restarted == "above" else spec
    path = "/app/team/inner/counter" if restarted == "above" else "/app/team/counter"
    first = hf.child("first", hf.start(Fragile))
    async with hf.ActorSystem("app", log=False, intensity=9) as system:
        await system.start(hf.supervisor("team", strategy="rest_for_one", intensity=9, children=[first, inner]))
        watcher = await system.start(hf.child("watcher", hf.start(Watcher, path)))
        ref = system.ref(path, Counter)
        assert await ref.ask(Add()) == 1
        with system.events() as stream:
            asks: list[Awaitable[Any]] = [ref.ask(Slow(), timeout=IN_TIME), ref.ask(Add(), timeout=IN_TIME)]
            ref.tell(Add())
            system.ref("/app/team/first", Fragile).tell(Boom())
            async for event in stream:
                if isinstance(event, hf.events.ActorCrashed):
                    break
            for _ in range(20):  # It is told to stop, and its turn is not over.
                await asyncio.sleep(0)
            asks.append(ref.ask(Add(), timeout=IN_TIME))
            tell = told(ref)
            GATES[0].set()
            fates = [await outcome(ask) for ask in asks]
            while (count := await outcome(ref.ask(Add(), timeout=IN_TIME))) == "ActorStopped":
                await asyncio.sleep(0)
            letters = sum(isinstance(one, hf.events.DeadLetter) for one in stream.take())
        heard = await watcher.ask(Heard())
        assert [*fates, tell, letters, heard, count] == FATES[restarted, is_recorded]
