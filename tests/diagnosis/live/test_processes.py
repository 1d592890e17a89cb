"""What actors in processes of their own publish is heard, and who they are is known."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest

import holdfast as hf
from holdfast.diagnosis import DIAGNOSIS, OBSERVATIONS, generate, observer, watch
from holdfast.diagnosis.engine import Diagnosis, State
from holdfast.diagnosis.literals import progress, replies
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.observers import Manner, TimeoutObserver
from holdfast.testing import probe

pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])


class Beat(hf.Message):
    number: int


class Next(hf.Message):
    pass


class Heart(hf.Actor):
    def on_start(self, restored: bool) -> None:
        self.beats = 0
        self.ctx.every(0.05, Next())

    @hf.on(Next)
    async def _beat(self, message: Next) -> None:
        self.beats += 1
        await self.ctx.publish("/beat", Beat(self.beats))


class Other(hf.Actor):
    @hf.subscribe("/beat")
    @hf.on(Beat)
    def _hear(self, message: Beat) -> None:
        pass


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False) as running:
        await running.start(hf.child("heart", hf.start(Heart), isolation="process"))
        yield running


async def test_what_a_process_publishes_is_heard(system: hf.ActorSystem) -> None:
    heard = probe(system)
    heard.subscribe(OBSERVATIONS)
    manner = Manner(every=0.1, time_to_live=1.0)
    await system.start(observer("o", hf.start(TimeoutObserver, "/beat", 10.0, manner=manner)))
    seen = await heard.expect(Observation, timeout=60.0)
    assert str(seen.literal) == "ok(/beat)"


async def test_who_publishes_from_a_process_is_known(system: hf.ActorSystem) -> None:
    await system.start(hf.child("other", hf.start(Other), isolation="process"))
    found = await generate(system, seconds=1.0)
    for _ in range(20):  # on a busy machine a second may be too short to hear anybody
        if not found.wiring["heart"].publishes:
            found = await generate(system, seconds=1.0)
    assert found.wiring["heart"].publishes == ("/beat",)
    assert found.wiring["other"].subscribes == ("/beat",)


class Wanted(hf.Message[int]):
    is_last: bool = False


class WantedLater(hf.Message[int]): ...


class Oracle(hf.Actor):
    @hf.on(WantedLater)
    def _owe(self, message: WantedLater) -> "hf.ReplyHandle[int]":
        return self.ctx.reply_handle()

    @hf.on(Wanted)
    async def _answer(self, message: Wanted) -> int:
        if message.is_last:
            await asyncio.Event().wait()
        return 1


class Client(hf.Actor):
    @hf.on(Wanted)
    async def _ask(self, message: Wanted) -> int:
        return await self.ctx.find("/t/oracle", Oracle).ask(message, timeout=600.0)


async def test_a_frozen_callee_in_a_process_is_certain_behind_who_asks_it_from_another(system: hf.ActorSystem) -> None:
    await system.start(hf.child("oracle", hf.start(Oracle), isolation="process"))
    client = await system.start(hf.child("client", hf.start(Client), isolation="process"))
    heard = probe(system)
    heard.subscribe(DIAGNOSIS)
    watching = await watch(system, seconds=0.5)
    for _ in range(60):  # Until its usual turns are known, only a time-out would accuse it.
        assert await client.ask(Wanted()) == 1
        await asyncio.sleep(0.05)
    asking = asyncio.ensure_future(client.ask(Wanted(is_last=True), timeout=600.0))
    found = await heard.expect(Diagnosis, timeout=60.0)
    while found.state is not State.FAULTY:
        found = await heard.expect(Diagnosis, timeout=60.0)
    assert [one.bad for one in found.candidates] == [("oracle",)]
    asking.cancel()
    await system.stop(watching.tree)


PLAIN, RECORDED = None, hf.hybrid()


@pytest.mark.parametrize(
    ("recovery", "place"),
    [(PLAIN, "task"), (PLAIN, "process"), (RECORDED, "task"), (RECORDED, "process"), (RECORDED, "below")],
    ids=[
        "plain task",
        "plain process",
        "recorded task",
        "recorded process",
        "recorded below a supervisor in a process",
    ],
)
async def test_who_answers_is_seen_to_wherever_it_is(system: hf.ActorSystem, recovery: Any, place: str) -> None:
    """An answer that is owed is none."""
    spec = hf.child(
        "oracle", hf.start(Oracle), recovery=recovery, isolation="process" if place == "process" else "task"
    )
    if place == "below":
        await system.start(hf.supervisor("all", children=[spec], isolation="process"))
    else:
        await system.start(spec)
    path = "all/oracle" if place == "below" else "oracle"
    oracle = system.ref(f"/t/{path}", Oracle)
    watching = await watch(system, seconds=0.5)
    owed = []
    async with asyncio.timeout(60.0):
        while progress(path) not in (await watching.observed()).positive:
            owed.append(oracle.ask(WantedLater(), timeout=600.0))
            await asyncio.sleep(0.05)
        assert replies(path) not in (await watching.observed()).positive
        while replies(path) not in (await watching.observed()).positive:
            assert await oracle.ask(Wanted(), timeout=60.0) == 1
            await asyncio.sleep(0.05)
    await system.stop(watching.tree)
    for one in owed:
        one.cancel()
