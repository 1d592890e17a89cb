"""A message whose turn never ends: repair restarts its actor, and the second end in a row puts the message aside."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.repair import Policy, Repaired

IN_TIME = 60.0
POLICY = Policy(verify=5.0, settle=0.2, cool_down=0.2)


class Count(hf.Message[int]): ...


class Hang(hf.Message): ...


class Spin(hf.Message): ...


class Node(hf.Actor):
    def __init__(self) -> None:
        self.counted = 0

    @hf.on(Count)
    def count(self, message: Count) -> int:
        self.counted += 1
        return self.counted

    @hf.on(Hang)
    async def hang(self, message: Hang) -> None:
        await asyncio.Event().wait()

    @hf.on(Spin)
    def spin(self, message: Spin) -> None:
        while True:
            pass


class Listener(hf.Actor):
    def __init__(self, repaired: "asyncio.Future[None]") -> None:
        self._repaired = repaired

    @hf.subscribe(diagnosis.REPAIR)
    @hf.on(Repaired)
    def hear(self, message: Repaired) -> None:
        self._repaired.set_result(None)


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize(("isolation", "bad"), [("task", Hang()), ("process", Spin())], ids=str)
@pytest.mark.parametrize("by", ["send", "ask"])
async def test_an_actor_whose_turn_hangs_again_is_healed_by_repair(isolation: Any, bad: hf.Message, by: str) -> None:
    spec = hf.child("node", hf.start(Node), isolation=isolation, recovery=hf.hybrid(), shutdown=0.2)
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(hf.supervisor("all", children=[spec], intensity=20))
        node = system.ref("/t/all/node", Node)
        repaired = asyncio.get_running_loop().create_future()
        system.spawn(hf.start(Listener, repaired))
        await node.ask(Count(), timeout=IN_TIME)
        watching = await diagnosis.watch(system, seconds=0.1, hung_after=0.5, repair="on", policy=POLICY)
        asked: list[asyncio.Future[Any]] = []
        if by == "ask":  # That asks of it run out is one more symptom, which has to go.
            asked = [node.ask(bad, timeout=IN_TIME), *(node.ask(Count(), timeout=1.0) for _ in range(2))]
        else:
            await node.send(bad)
        last = 1
        async with asyncio.timeout(IN_TIME):
            while not repaired.done():
                last = await node.ask(Count(), timeout=IN_TIME)
                await asyncio.wait([repaired], timeout=0.05)
        await asyncio.gather(*asked, return_exceptions=True)
        (aside,) = system.quarantined(node)
        assert (type(aside.message), aside.attempts) == (type(bad), 2)
        assert await node.ask(Count(), timeout=IN_TIME) == last + 1
        assert (await watching.diagnosis()).state is State.HEALTHY
