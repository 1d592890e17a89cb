"""A line: whatever the post does, all arrives once and in order, and nothing of an earlier run arrives at all."""

from __future__ import annotations

import asyncio
import random
from functools import partial

import msgspec
import pytest

from holdfast.cluster.lines import line as lines_of
from holdfast.cluster.lines.line import NOBODY, Boot, Line, LineBatch, Note
from holdfast.testing.fleet.post import PostFaults, SimPost, SimTransport
from tests.cluster.fleets import simulate

FAULTS = PostFaults(lost=0.2, doubled=0.2, late=0.2)


class End:
    """One end of a line over a simulated post."""

    def __init__(self, transport: SimTransport, own: str, other: str) -> None:
        self.transport, self.own, self.other = transport, own, other
        self.came: list[bytes] = []
        self.batches = 0
        self.line = Line(asyncio.get_running_loop(), self.post, self.came.append)

    def post(self, first: int, items: tuple[bytes, ...], note: Note) -> None:
        self.batches += 1
        batch = LineBatch(self.own, NOBODY, NOBODY, self.line.got, first, items, note)
        self.transport.post(self.other, msgspec.msgpack.encode(batch), "")

    def hear(self, data: bytes, back: str) -> None:
        self.line.hear(msgspec.msgpack.decode(data, type=LineBatch))


async def two_ends(seed: int, faults: PostFaults) -> tuple[End, End]:
    post = SimPost(seed, faults)
    one, two = End(post.transport(), "one", "two"), End(post.transport(), "two", "one")
    await one.transport.hear("one", one.hear)
    await two.transport.hear("two", two.hear)
    return one, two


async def all_arrives(seed: int) -> None:
    draw = random.Random(seed)
    one, two = await two_ends(seed, FAULTS)
    sent: dict[End, list[bytes]] = {one: [], two: []}
    arrived = 0

    def count() -> None:
        nonlocal arrived
        arrived += 1

    for number in range(300):
        end = draw.choice((one, two))
        sent[end].append(b"%d" % number)
        end.line.put(sent[end][-1], count)
        if draw.random() < 0.3:
            await asyncio.sleep(draw.random())
    async with asyncio.timeout(600.0):
        while arrived < 300:
            await asyncio.sleep(0.5)
    assert two.came == sent[one]
    assert one.came == sent[two]


@pytest.mark.parametrize("seed", range(20))
def test_all_arrives_once_and_in_order(seed: int) -> None:
    simulate(partial(all_arrives, seed), seed)


def test_what_arrives_is_acknowledged_once_and_then_nothing_is_said() -> None:
    async def run() -> None:
        one, two = await two_ends(0, PostFaults())
        for number in range(1000):
            one.line.put(b"%d" % number)
        await asyncio.sleep(10.0)
        assert len(two.came) == 1000
        assert (one.batches, two.batches) == (1, 1)  # one batch a tick, and one word that it has come

    simulate(run, 0)


def test_a_sender_that_can_wait_does_while_the_other_end_is_away() -> None:
    async def run() -> None:
        one, two = await two_ends(0, PostFaults())
        two.transport.is_cut = True
        large = bytes(1024 * 1024)
        while one.line.has_room:
            one.line.put(large)
        room = one.line.room()
        assert room is not None
        await asyncio.sleep(5.0)
        assert not room.done()
        two.transport.is_cut = False
        async with asyncio.timeout(5.0):
            await room
        await asyncio.sleep(1.0)
        assert len(two.came) == lines_of.WINDOW_BYTES // len(large)

    simulate(run, 0)


def test_an_end_that_is_closed_sends_and_takes_nothing() -> None:
    async def run() -> None:
        one, two = await two_ends(0, PostFaults())
        one.line.put(b"first")
        one.line.close()
        one.line.put(b"second")
        two.line.put(b"third")
        await asyncio.sleep(5.0)
        assert one.came == two.came == []

    simulate(run, 0)


def test_runs_of_a_program_are_in_order() -> None:
    assert Boot(1, "ff") < Boot(2, "00")
