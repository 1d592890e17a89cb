"""A protected actor with a large state ends itself in the middle of a batch: its last snapshot comes home in pieces."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

LARGE = 80_000_000
"""More than one frame may have."""


class Fill(hf.Message[int]):
    size: int


class Leave(hf.Message[None]): ...


class Store(hf.Actor):
    def __init__(self) -> None:
        self.parts: list[bytes] = []

    @hf.on(Fill)
    def fill(self, message: Fill) -> int:
        self.parts.append(bytes(message.size))
        return sum(map(len, self.parts))

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.stop(hf.Shutdown("for a moment"))


@pytest.mark.parametrize("mechanism", [hf.ftm.PBR, hf.ftm.TR])
async def test_a_large_state_comes_home_when_its_actor_ends_itself(system: hf.ActorSystem, mechanism: Any) -> None:
    spec = hf.child("store", hf.start(Store), mechanism=mechanism(), recovery=hf.hybrid(interval=3600.0))
    ref = await system.start(spec)
    with system.events() as stream:
        asks: list[asyncio.Future[Any]] = [
            asyncio.ensure_future(ref.ask(Fill(LARGE // 2), timeout=25.0)) for _ in range(2)
        ]
        asks.append(asyncio.ensure_future(ref.ask(Leave(), timeout=25.0)))
        await asyncio.gather(*asks)
        assert await ref.ask(Fill(1), timeout=25.0) == LARGE + 1
        told = stream.take()
    assert any(isinstance(one, hf.events.SnapshotTaken) and one.size_bytes > LARGE for one in told)
