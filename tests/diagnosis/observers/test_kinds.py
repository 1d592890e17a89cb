"""Whatever an actor is, wherever it lives, diagnosis sees that it works, and that it hangs."""

import asyncio
import contextlib
import itertools
import os
from collections.abc import AsyncGenerator
from typing import Any

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import Diagnosis, State
from holdfast.testing import advance

pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

IN_TIME = 30.0
"""Seconds on a machine that is as busy as it may be; what is waited for is seen within two on one that is not."""
PATHS = {"task": "/t/all/node", "process": "/t/all/node", "subtree": "/t/all/own/node", "PBR": "/t/all/node"}
KINDS: dict[str, dict[str, Any]] = {
    "plain": {},
    "hybrid": {"recovery": hf.hybrid()},
    "checkpoint_only": {"recovery": hf.checkpoint_only(interval=60.0)},
    **{
        overflow: {"recovery": hf.hybrid(), "mailbox": hf.bounded(2, overflow=overflow)}
        for overflow in ("block", "reject", "drop_newest", "drop_oldest", "latest")
    },
    "plain latest": {"mailbox": hf.bounded(2, overflow="latest")},
    "plain drop_oldest": {"mailbox": hf.bounded(2, overflow="drop_oldest")},
}
IS_CROSSED = bool(os.environ.get("HOLDFAST_CROSSED"))
"""All of them, in the campaign."""
CASES = [
    *[("subtree", "hybrid"), ("PBR", "hybrid")],
    *(itertools.product(("task", "process"), KINDS) if IS_CROSSED else ()),
    *(() if IS_CROSSED else (("task", "latest"), ("process", "plain"), ("process", "hybrid"))),
]


class Count(hf.Message[int]): ...


class Frame(hf.Message): ...


class Slow(hf.Message): ...


class Hang(hf.Message): ...


class Rest(hf.Message): ...


class Node(hf.Actor):
    def __init__(self) -> None:
        self.counted = 0

    @hf.on(Count)
    def count(self, message: Count) -> int:
        self.counted += 1
        return self.counted

    @hf.on(Frame)
    def frame(self, message: Frame) -> None:
        self.counted += 1

    @hf.on(Slow)
    async def slow(self, message: Slow) -> None:
        await asyncio.sleep(1.5)

    @hf.on(Rest)
    async def rest(self, message: Rest) -> None:
        await self.ctx.sleep(5.0)

    @hf.on(Hang)
    async def hang(self, message: Hang) -> None:
        await asyncio.Event().wait()


def tree(place: str, kind: str) -> hf.ChildSpec[Any]:
    more: dict[str, Any] = {"mechanism": hf.ftm.PBR()} if place == "PBR" else {}
    isolation: Any = "process" if place == "process" else "task"
    node = hf.child("node", hf.start(Node), isolation=isolation, shutdown="brutal_kill", **KINDS[kind], **more)
    own = hf.supervisor("own", children=[node], isolation="process")
    return hf.supervisor("all", children=[own if place == "subtree" else node])


async def told(node: hf.ActorRef[Node], kind: type[hf.Message[Any]] = Frame) -> None:
    """Tell it that again and again."""
    while True:
        with contextlib.suppress(hf.SendError):
            node.tell(kind())
        await asyncio.sleep(0.02)


async def asked(node: hf.ActorRef[Node], kind: type[hf.Message[int]]) -> None:
    """Ask it that again and again."""
    while True:
        with contextlib.suppress(hf.SendError, hf.AskTimeout):
            await node.ask(kind(), timeout=IN_TIME)
        await asyncio.sleep(0.02)


@contextlib.asynccontextmanager
async def doing(work: Any) -> AsyncGenerator[None]:
    """Have this going on beside the block."""
    task = asyncio.ensure_future(work)
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def until(watching: diagnosis.Watch, component: str, state: State) -> Diagnosis:
    """Wait until the diagnosis is that; if it is healthy, until something is known of the component's work, too."""
    async with asyncio.timeout(IN_TIME):
        while True:
            found = await watching.diagnosis()
            if found.state is state and (state is State.FAULTY or component not in found.unknown):
                return found
            await asyncio.sleep(0.05)


@pytest.mark.parametrize(("place", "kind"), CASES, ids=lambda case: case)
@pytest.mark.some(3)
async def test_it_is_seen_to_work_and_to_hang(place: str, kind: str) -> None:
    component = PATHS[place].removeprefix("/t/")
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(tree(place, kind))
        node = system.ref(PATHS[place], Node)
        watching = await diagnosis.watch(system, seconds=0.1, repair="off")
        async with doing(asked(node, Count)):
            await until(watching, component, State.HEALTHY)
        async with doing(told(node)):
            await asyncio.sleep(3.0)  # Longer than it may have a full mailbox, and for twenty looks.
            assert (await until(watching, component, State.HEALTHY)).suspects == ()
            node.tell(Hang())
            found = await until(watching, component, State.FAULTY)
        assert found.certain == (component,)


@pytest.mark.parametrize("kind", ["plain", "hybrid"])
async def test_who_rests_in_its_turn_in_a_process_is_not_accused(kind: str) -> None:
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(tree("process", kind))
        node = system.ref(PATHS["process"], Node)
        watching = await diagnosis.watch(system, seconds=0.1, repair="off")
        async with doing(told(node)):
            await asyncio.sleep(3.0)  # For twenty looks and more.
            node.tell(Rest())
            for _ in range(40):
                await asyncio.sleep(0.1)
                assert (await watching.observed()).negative == frozenset()


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("kind", ["drop_oldest", "plain drop_oldest"])
async def test_a_mailbox_that_is_full_by_its_policy_is_no_fault(kind: str) -> None:
    """It is slower than what comes, as a node behind a camera may be: the newest always finds room."""
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(tree("task", kind))
        node = system.ref("/t/all/node", Node)
        watching = await diagnosis.watch(system, seconds=0.1, repair="off")
        async with doing(told(node, Slow)):
            await advance(30.0)
            assert (await watching.diagnosis()).state is State.HEALTHY


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("kind", ["plain", "hybrid"])
async def test_who_was_idle_for_long_is_blamed_as_soon_as_who_was_not(kind: str) -> None:
    """The time in which it had nothing to do is no turn that it needed."""
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(tree("task", kind))
        node = system.ref("/t/all/node", Node)
        watching = await diagnosis.watch(system, seconds=0.1, repair="off")
        async with doing(asked(node, Count)):
            await advance(4.0)
        await advance(100.0)
        async with doing(asked(node, Count)):
            await advance(4.0)
            node.tell(Hang())
            await advance(3.0)
            assert (await watching.diagnosis()).certain == ("all/node",)
