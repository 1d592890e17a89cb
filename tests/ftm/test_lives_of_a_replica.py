"""The lives of the protected actor inside a replica: two may want one at the same time, and nobody waits for ever."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel.address_host import AddressHost
from holdfast.actors.kernel.lifecycle import NEAR
from holdfast.actors.kernel.message import message_name
from holdfast.checkpoint.life.recorded_life import FED
from holdfast.checkpoint.protocol import MESSAGE, Feed, TurnEnd
from holdfast.ftm.bricks.brick_messages import Request
from holdfast.ftm.bricks.standing import Standing
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.replica.protected_actor import Server
from tests.ftm.accounts import Add, Counter


class Slow(Counter):
    """Comes back when it may."""

    async def on_start(self, restored: bool) -> None:
        if restored:
            await GATE[0].wait()


GATE: list[asyncio.Event] = []


class Trip(hf.Message[None]):
    """Have the life end outside of any turn, once."""


class Pause(hf.Message[None]):
    """A turn in which that happens: it takes effect behind what the life was given with it."""


class Loose(Counter):
    """Falls between two turns."""

    def on_start(self, restored: bool) -> None: ...

    @hf.on(Trip)
    def trip(self, message: Trip) -> None:
        if not GATE[0].is_set():
            self.ctx.create_task(self._fall())

    async def _fall(self) -> None:
        await GATE[0].wait()
        raise RuntimeError("fell")

    @hf.on(Pause)
    async def pause(self, message: Pause) -> None:
        GATE[0].set()
        for _ in range(10):
            await asyncio.sleep(0)


def request_of(node: Any, number: int, message: hf.Message[Any]) -> Request:
    name, body = message_name(type(message)), node.codec.encode(message, "")
    return Request("", 0, Feed(number, -1, MESSAGE, name, body, 0.0, None, True))


@pytest.fixture(params=[Slow])
async def server(system: hf.ActorSystem, request: pytest.FixtureRequest) -> Any:
    """A server as a replica has it, in this process, with a state to begin from."""
    kind: type[Counter] = request.param
    GATE[:] = [asyncio.Event()]
    node = system._node
    standing = Standing(node.nowhere("/app/x/ftm/r1"), 1, (LFR(),))
    made = standing.server = Server(standing, hf.hybrid())
    cell = node.cell_below(node.root, "x", AddressHost(FED, made, NEAR))
    cell.spec, cell.extra().start = hf.child("x", hf.start(kind)), hf.start(kind)
    made.start(cell)
    await made.ensure()
    made.install(made.capture())
    await made.drop_life()
    yield made
    await made.drop_life()


async def test_a_life_is_begun_once_though_two_want_it(server: Any) -> None:
    node = server.standing.node
    pending = deque([request_of(node, 1, Add(1)), request_of(node, 2, Add(2)), request_of(node, 3, Add(3))])
    ends: list[TurnEnd] = []

    async def handled() -> None:
        while pending:
            ends.extend(await server.run_part(pending))

    first, work = asyncio.ensure_future(server.ensure()), asyncio.ensure_future(handled())
    await asyncio.sleep(0)
    GATE[0].set()
    async with asyncio.timeout(20):
        await first
        await work
    assert [end.status for end in ends] == ["ok", "ok", "ok"]


async def test_whoever_waits_for_a_life_that_is_dropped_is_told(server: Any) -> None:
    waits = asyncio.ensure_future(server.ensure())
    while server.life is None:
        await asyncio.sleep(0)
    async with asyncio.timeout(20):
        await server.drop_life()
        await waits
    assert server.life is None


@pytest.mark.parametrize("server", [Loose], indirect=True)
async def test_what_a_life_has_left_that_ends_between_two_chunks_of_a_part_is_not_lost(
    server: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rest of the part does not go on from where the part began."""
    monkeypatch.setattr("holdfast.ftm.replica.protected_actor.PART", 60.0)  # All of it is one part.
    node, counts = server.standing.node, range(3, 30)
    messages = [Trip(), Pause(), *(Add(1) for _ in counts)]
    requests = [request_of(node, number, message) for number, message in enumerate(messages, 1)]
    assert server.attempts.size < len(requests)
    await server.ensure()
    ends = await server._run_all(requests, even_stopping=True)
    assert GATE[0].is_set()
    assert [node.codec.decode(int, end.answer.body) for end in ends[2:]] == [*range(1, len(counts) + 1)]
    assert server.life.cell.actor.total == len(counts)
