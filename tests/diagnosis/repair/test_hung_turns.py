"""A message whose turn never ends: repair restarts its actor, and the second end in a row puts the message aside."""

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncGenerator
from typing import Any

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.repair import Policy, Repaired, RepairTold

IN_TIME = 60.0
RESTS = [
    pytest.param("sleep", None, id="sleep"),
    pytest.param("sleep", hf.hybrid(), id="recorded sleep"),
    pytest.param("wait", hf.hybrid(), id="recorded wait"),
]
POLICY = Policy(verify=5.0, settle=0.2, cool_down=0.2)


class Count(hf.Message[int]): ...


class Hang(hf.Message): ...


class Spin(hf.Message): ...


class Signal(hf.Message): ...


class End(hf.Message): ...


class Rest(hf.Message):
    how: str


class Node(hf.Actor):
    def __init__(self) -> None:
        self.counted = 0

    @hf.on(Rest)
    async def rest(self, message: Rest) -> None:
        """A sleep, or a wait for a signal; a short sleep, behind which the turn hangs."""
        if message.how == "wait":
            await self.ctx.wait_for(Signal)
        await self.ctx.sleep(3.0 if message.how == "hang" else 3600.0)
        await asyncio.Event().wait()

    @hf.on(Signal)
    def take(self, message: Signal) -> None:
        pass

    @hf.on(End)
    def end(self, message: End) -> None:
        self.ctx.stop()

    async def on_stop(self, reason: Any) -> None:
        if reason == hf.NORMAL:
            await asyncio.Event().wait()

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


Tended = tuple[hf.ActorSystem, hf.ActorRef[Node], "asyncio.Future[Any]", diagnosis.Watch]


@contextlib.asynccontextmanager
async def tended(spec: hf.ChildSpec[Node]) -> AsyncGenerator[Tended, None]:
    """A system whose one node is repaired, and a future that ends when it has been."""
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(hf.supervisor("all", children=[spec], intensity=20))
        node = system.ref("/t/all/node", Node)
        repaired = asyncio.get_running_loop().create_future()
        system.spawn(hf.start(Listener, repaired))
        await node.ask(Count(), timeout=IN_TIME)
        watching = await diagnosis.watch(system, seconds=0.1, hung_after=0.5, repair="on", policy=POLICY)
        yield system, node, repaired, watching


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize(
    ("isolation", "bad", "by"), [("task", Hang(), "send"), ("task", Hang(), "ask"), ("process", Spin(), "ask")], ids=str
)
async def test_an_actor_whose_turn_hangs_again_is_healed_by_repair(isolation: Any, bad: hf.Message, by: str) -> None:
    spec = hf.child("node", hf.start(Node), isolation=isolation, recovery=hf.hybrid(), shutdown=0.2)
    async with tended(spec) as (system, node, repaired, watching):
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


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_who_hears_nothing_is_not_given_the_time_to_end(recovery: Any) -> None:
    spec = hf.child("node", hf.start(Node), isolation="process", recovery=recovery, shutdown=30.0)
    async with tended(spec) as (system, node, repaired, _):
        with system.events() as stream:
            os.kill(system.pid_of(node), signal.SIGSTOP)
            async with asyncio.timeout(IN_TIME):
                while not repaired.done():
                    await asyncio.wait([node.ask(Count(), timeout=1.0), repaired], return_when=asyncio.FIRST_COMPLETED)
            said = [event.text for event in stream.take() if isinstance(event, RepairTold)]
        assert not any("did not return" in text for text in said), said
        assert await node.ask(Count(), timeout=IN_TIME) > 0
        assert len(system.lives(node)) == 2


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize(("how", "recovery"), RESTS)
@pytest.mark.some(3)
async def test_a_turn_that_rests_as_it_has_said_does_not_hang(how: str, recovery: Any, isolation: Any) -> None:
    spec = hf.child("node", hf.start(Node), isolation=isolation, recovery=recovery, shutdown="brutal_kill")
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(hf.supervisor("all", children=[spec], intensity=20))
        node = system.ref("/t/all/node", Node)
        await node.ask(Count(), timeout=IN_TIME)
        node.tell(Rest(how))
        watching = await diagnosis.watch(system, seconds=0.1, hung_after=0.3, repair="on", policy=POLICY)
        for _ in range(30):
            await asyncio.sleep(0.1)
            assert (await watching.diagnosis()).state is not State.FAULTY
        assert len(system.lives(node)) == 1


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_turn_that_hangs_behind_its_rest_is_seen() -> None:
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(hf.supervisor("all", children=[hf.child("node", hf.start(Node), recovery=hf.hybrid())]))
        node = system.ref("/t/all/node", Node)
        await node.ask(Count())
        watching = await diagnosis.watch(system, seconds=0.1, hung_after=2.0, repair="off")
        node.tell(Rest("hang"))
        await asyncio.sleep(4.5)
        assert (await watching.diagnosis()).state is State.HEALTHY
        await asyncio.sleep(6.0)
        assert [one.bad for one in (await watching.diagnosis()).candidates] == [("all/node",)]


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_who_ends_by_itself_and_hangs_in_that_is_restarted_once_its_time_to_stop_is_over() -> None:
    spec = hf.child("node", hf.start(Node), shutdown=5.0)
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(hf.supervisor("all", children=[spec]))
        node = system.ref("/t/all/node", Node)
        repaired = asyncio.get_running_loop().create_future()
        system.spawn(hf.start(Listener, repaired))
        await diagnosis.watch(system, seconds=0.1, repair="on", policy=POLICY)
        node.tell(End())
        await asyncio.sleep(4.5)
        assert len(system.lives(node)) == 1
        async with asyncio.timeout(IN_TIME):
            await repaired
        assert await node.ask(Count()) == 1
        assert len(system.lives(node)) == 2
