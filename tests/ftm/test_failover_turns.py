"""Failover and what a turn has begun: background work, and asks that come back."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.ftm.accounts import Add, Boom, Counter, Tags, Total
from tests.ftm.test_failover import group_of, pid_of, started


class Wait(hf.Message[None]):
    path: str
    tag: int


class Waiter(Counter):
    """Has something done in the background, until a file is there."""

    @hf.on(Wait)
    def wait(self, message: Wait) -> None:
        self.ctx.pipe_to_self(until_there(Path(message.path)), lambda _: Add(message.tag))


async def until_there(path: Path) -> None:
    while not path.exists():
        await asyncio.sleep(0.005)


@pytest.mark.parametrize("recovery", [hf.hybrid(interval=0.05), None])
@pytest.mark.parametrize("how", ["kill", "fail"])
async def test_background_work_is_begun_again_or_said_to_be_lost(
    system: hf.ActorSystem, recovery: Any, how: str, tmp_path: Path
) -> None:
    """The one that leads dies, or a turn of it fails, while the work of an earlier turn is out."""
    ref = await started(system, hf.start(Waiter), recovery=recovery)
    events, there = system.events(), tmp_path / "there"
    await ref.ask(Add(0))
    await ref.ask(Wait(str(there), 1))
    assert await ref.ask(Add(2)) == 2
    primary = group_of(ref).primary
    assert primary is not None
    if how == "kill":
        os.kill(pid_of(system, ref, primary), signal.SIGKILL)
    else:
        with pytest.raises(hf.RemoteCrash):
            await ref.ask(Boom())
    assert await ref.ask(Add(3), timeout=30) == 3
    there.touch()
    lost = [one for one in events.take() if isinstance(one, hf.BackgroundWorkLost)]
    if recovery is None:
        assert [one.count for one in lost] == [1]
        assert await ref.ask(Tags()) == [0, 2, 3]
    else:
        async with asyncio.timeout(10):
            while await ref.ask(Tags(), timeout=10) != [0, 2, 3, 1]:
                await asyncio.sleep(0.005)
        assert lost == []
    events.close()


class Ring(hf.Message[str]): ...


class Caller(Counter):
    """Asks somebody who asks it in turn."""

    friend: hf.Binding[Friend]

    @hf.on(Ring)
    async def ring(self, message: Ring) -> str:
        return await self.friend.ask(Ring())


class Friend(hf.Actor):
    """Asks back."""

    @hf.on(Ring)
    async def ring(self, message: Ring) -> str:
        try:
            await self.ctx.find("/app/alice", Counter).ask(Total())
        except hf.AskDeadlock:
            return "deadlock"
        return "answered"


@pytest.mark.parametrize("recovery", [hf.hybrid(), None])
@pytest.mark.parametrize("recorded", [False, True])
async def test_an_ask_that_comes_back_inside_a_turn_fails_at_once(
    system: hf.ActorSystem, recovery: Any, recorded: bool
) -> None:
    friend = await system.start(hf.child("friend", hf.start(Friend), recovery=hf.hybrid() if recorded else None))
    ref = await started(system, hf.start(Caller), recovery=recovery, bindings={"friend": friend.path})
    assert await ref.ask(Ring(), timeout=3.0) == "deadlock"
    assert await ref.ask(Add(0)) == 1
