"""Turns that wait for each other are found by that alone: nothing has run out, and no usual turn is known."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import State

pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

IN_TIME = 20.0
"""Seconds on a machine that is as busy as it may be; a circle is found within two on one that is not."""
LONG = 120.0
KINDS: dict[str, dict[str, Any]] = {
    "task": {},
    "recorded": {"recovery": hf.hybrid()},
    "process": {"isolation": "process"},
}


class Begin(hf.Message): ...


class Leave(hf.Message): ...


class Question(hf.Message[int]): ...


class Peer(hf.Actor):
    other: hf.Binding["Peer"]

    @hf.on(Begin)
    async def begin(self, message: Begin) -> None:
        await asyncio.sleep(0.2)
        async with asyncio.timeout(LONG):  # Not refused at once: it may end before.
            await self.other.ask(Question(), timeout=LONG)

    @hf.on(Leave)
    async def leave(self, message: Leave) -> None:
        """Ask, and do something else that takes long: nobody waits for it to no end."""
        await asyncio.sleep(0.1)
        self.other.ask(Question(), timeout=LONG).add_done_callback(lambda reply: reply.exception())
        await asyncio.sleep(4.0)

    @hf.on(Question)
    def question(self, message: Question) -> int:
        return 1


async def pair(system: hf.ActorSystem, kind: str) -> tuple[hf.ActorRef[Peer], hf.ActorRef[Peer]]:
    children = [hf.child(name, hf.start(Peer), **KINDS[kind]) for name in ("one", "two")]
    await system.start(hf.supervisor("all", children=children))
    one, two = system.ref("/t/all/one", Peer), system.ref("/t/all/two", Peer)
    async with system.transaction() as change:
        change.bind(one, "other", two)
        change.bind(two, "other", one)
    return one, two


@pytest.mark.parametrize("kind", KINDS)
async def test_all_in_a_circle_are_certain(kind: str) -> None:
    async with hf.ActorSystem("t", log=False) as system:
        one, two = await pair(system, kind)
        watching = await diagnosis.watch(system, seconds=0.1, repair="off")
        one.tell(Begin())
        two.tell(Begin())
        async with asyncio.timeout(IN_TIME):
            while (found := await watching.diagnosis()).state is not State.FAULTY:
                await asyncio.sleep(0.05)
        assert set(found.certain) == {"all/one", "all/two"}
        one.kill()
        two.kill()


@pytest.mark.parametrize("kind", KINDS)
async def test_who_has_asked_and_does_something_else_is_in_no_circle(kind: str) -> None:
    async with hf.ActorSystem("t", log=False) as system:
        one, two = await pair(system, kind)
        watching = await diagnosis.watch(system, seconds=0.1, repair="off")
        one.tell(Leave())
        two.tell(Begin())
        for _ in range(35):
            await asyncio.sleep(0.1)
            assert (await watching.diagnosis()).state is State.HEALTHY
            assert (await watching.observed()).negative == frozenset()
