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


def request(node: Any, number: int, message: hf.Message[Any]) -> Request:
    name, body = message_name(type(message)), node.codec.encode(message, "")
    return Request("", 0, Feed(number, -1, MESSAGE, name, body, 0.0, None, True))


@pytest.fixture
async def server(system: hf.ActorSystem) -> Any:
    """A server as a replica has it, in this process, with a state to begin from."""
    GATE[:] = [asyncio.Event()]
    node = system._node
    standing = Standing(node.nowhere("/app/x/ftm/r1"), 1, (LFR(),))
    made = standing.server = Server(standing, hf.hybrid())
    cell = node.cell_below(node.root, "x", AddressHost(FED, made, NEAR))
    cell.spec, cell.extra().start = hf.child("x", hf.start(Slow)), hf.start(Slow)
    made.start(cell)
    await made.ensure()
    made.install(made.capture())
    await made.drop_life()
    yield made
    await made.drop_life()


async def test_a_life_is_begun_once_though_two_want_it(server: Any) -> None:
    node = server.standing.node
    pending = deque([request(node, 1, Add(1)), request(node, 2, Add(2)), request(node, 3, Add(3))])
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
