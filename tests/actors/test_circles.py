"""Turns that have begun by themselves and ask each other (errors.md, `AskDeadlock`)."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import pytest

import holdfast as hf


class Begin(hf.Message[str]): ...


class Question(hf.Message[int]): ...


class Glance(hf.Message[int]): ...


class Peer(hf.Actor):
    """Asks its neighbour in a turn that somebody outside has begun."""

    other: hf.Binding["Peer"]

    def __init__(self, limit: float = 10.0) -> None:
        self.limit = limit
        self.heard = 0

    @hf.on(Begin)
    async def begin(self, message: Begin) -> str:
        await asyncio.sleep(0.1)
        try:
            return str(await self.wait(self.other.ask(Question(), timeout=self.limit)))
        except hf.errors.AskDeadlock as error:
            return f"refused: {error}"

    async def wait(self, reply: asyncio.Future[int]) -> int:
        return await reply

    @hf.on(Question)
    def question(self, message: Question) -> int:
        self.heard += 1
        return self.heard


async def ring(system: hf.ActorSystem, *peers: hf.Start[Any]) -> list[hf.ActorRef[Peer]]:
    refs = [await system.start(hf.child(f"p{n}", peer)) for n, peer in enumerate(peers)]
    async with system.transaction() as change:
        for ref, other in zip(refs, (*refs[1:], refs[0]), strict=True):
            change.bind(ref, "other", other)
    return refs


@pytest.mark.parametrize("length", [2, 3, 5])
async def test_turns_that_wait_for_each_other_are_found_at_once(system: hf.ActorSystem, length: int) -> None:
    """One ask is refused and not run, and so all others are answered."""
    loop = asyncio.get_running_loop()
    refs = await ring(system, *(hf.start(Peer) for _ in range(length)))
    begun = loop.time()
    told = await asyncio.gather(*(ref.ask(Begin(), timeout=20.0) for ref in refs))
    assert loop.time() - begun < 1.0
    refused = next(n for n, answer in enumerate(told) if answer != "1")
    to = refs[(refused + 1) % length]
    way = " -> ".join(f"/t/p{n % length}" for n in range(refused + 1, refused + length + 2))
    assert (
        told[refused]
        == f"refused: ask to {to.path} would wait for itself ({way}); use tell, or ask from outside the turn"
    )
    assert told.count("1") == length - 1
    assert await to.ask(Question()) == 1


async def test_of_a_circle_the_ask_that_runs_out_first_is_refused(system: hf.ActorSystem) -> None:
    refs = await ring(system, hf.start(Peer, 10.0), hf.start(Peer, 3.0))
    told = await asyncio.gather(*(ref.ask(Begin(), timeout=20.0) for ref in refs))
    assert told[0] == "1"
    assert told[1].startswith("refused")


async def only(reply: Awaitable[int]) -> int:
    return await reply


async def not_at_all(reply: Awaitable[int]) -> int:
    await asyncio.sleep(0.5)
    return -1


async def one_of_two(reply: asyncio.Future[int]) -> int:
    late: asyncio.Future[Any] = asyncio.create_task(asyncio.sleep(0.5))
    await asyncio.wait([reply, late], return_when=asyncio.FIRST_COMPLETED)
    return -1


async def within(reply: Awaitable[int]) -> int:
    try:
        async with asyncio.timeout(0.5):
            return await reply
    except TimeoutError:
        return -1


async def wait_for(reply: Awaitable[int]) -> int:
    try:
        return await asyncio.wait_for(reply, 0.5)
    except TimeoutError:
        return -1


async def in_a_scope(reply: Awaitable[int]) -> int:
    with anyio.move_on_after(0.5):
        return await only(reply)
    return -1


async def behind_a_scope(reply: Awaitable[int]) -> int:
    return await in_a_scope(reply)


async def shielded(reply: asyncio.Future[int]) -> int:
    shield = asyncio.shield(reply)
    asyncio.get_running_loop().call_later(0.5, shield.cancel)
    try:
        return await shield
    except asyncio.CancelledError:
        return -1


class Free(Peer):
    """Waits for its reply in a way of its own."""

    def __init__(self, way: Callable[[Any], Awaitable[int]]) -> None:
        super().__init__()
        self._way = way

    async def wait(self, reply: asyncio.Future[int]) -> int:
        return await self._way(reply)


WAYS = [not_at_all, one_of_two, within, wait_for, in_a_scope, behind_a_scope, shielded]


@pytest.mark.parametrize("first", [True, False], ids=["first", "second"])
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.some(14)
async def test_nobody_is_refused_who_may_get_on(system: hf.ActorSystem, way: Any, first: bool) -> None:
    """Its turn need not wait for the reply to its end, so the other one gets its own."""
    free, peer = hf.start(Free, way), hf.start(Peer)
    refs = await ring(system, *((free, peer) if first else (peer, free)))
    told = await asyncio.gather(*(ref.ask(Begin(), timeout=20.0) for ref in refs))
    assert told == (["-1", "1"] if first else ["1", "-1"])


async def test_who_rests_is_no_part_of_a_circle(system: hf.ActorSystem) -> None:
    class Rests(Peer):
        async def wait(self, reply: asyncio.Future[int]) -> int:
            await self.ctx.sleep(0.5)
            return -1

        @hf.on(Glance, readonly=True)
        async def glance(self, message: Glance) -> int:
            return -2

    class Looks(Peer):
        async def wait(self, reply: asyncio.Future[int]) -> int:
            return await self.other.ask(Glance())

    told = await asyncio.gather(*(ref.ask(Begin()) for ref in await ring(system, hf.start(Rests), hf.start(Looks))))
    assert told == ["-1", "-2"]


async def test_who_is_in_a_thread_is_no_part_of_a_circle(system: hf.ActorSystem) -> None:
    class Blocks(Peer):
        @hf.on(Glance, to_thread=True)
        def glance(self, message: Glance) -> int:
            self.other.tell(Question())
            time.sleep(0.2)
            return -2

    blocks, peer = await ring(system, hf.start(Blocks), hf.start(Peer))
    assert list(await asyncio.gather(peer.ask(Begin()), blocks.ask(Glance()))) == ["1", -2]
