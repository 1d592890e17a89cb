"""Failover and what a turn has begun: background work, and asks that come back."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import signal
from pathlib import Path
from typing import Any, ClassVar

import pytest

import holdfast as hf
from holdfast.checkpoint.home.recorded_home import switch_of
from holdfast.ftm.bricks.bricks import Before
from holdfast.ftm.events import FailedOver
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.model.mechanism import Role
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
    primary = group_of(ref).membership.primary
    assert primary is not None
    if how == "kill":
        os.kill(pid_of(system, ref, primary), signal.SIGKILL)
    else:
        with pytest.raises(hf.RemoteCrash):
            await ref.ask(Boom())
    assert await ref.ask(Add(3), timeout=30) == 3
    there.touch()
    lost = [one for one in events.take() if isinstance(one, hf.events.BackgroundWorkLost)]
    if recovery is None:
        assert [one.count for one in lost] == [1]
        assert await ref.ask(Tags()) == [0, 2, 3]
    else:
        async with asyncio.timeout(10):
            while await ref.ask(Tags(), timeout=10) != [0, 2, 3, 1]:
                await asyncio.sleep(0.005)
        assert lost == []
    events.close()


async def test_a_turn_that_fails_has_ended_before_work_is_said_to_be_lost(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """Also if a snapshot waits for that work: the actor begins anew behind that turn, and not before it for ever."""
    ref = await started(system, hf.start(Waiter), recovery=hf.hybrid(interval=0.05))
    there = tmp_path / "there"
    await ref.ask(Add(0))
    await ref.ask(Wait(str(there), 1))
    switch = switch_of(ref._cell)
    assert switch is not None
    async with asyncio.timeout(20):
        while switch.due.asked_at < 0:  # From here on a snapshot is wanted, and waits for the work.
            await asyncio.sleep(0.005)
    with pytest.raises(hf.RemoteCrash):
        await ref.ask(Boom())
    there.touch()
    async with asyncio.timeout(10):
        while await ref.ask(Tags(), timeout=10) != [0, 1]:
            await asyncio.sleep(0.005)


class Break(hf.Message): ...


class Breaking(Before):
    """A brick with a bug."""

    @hf.on(Break)
    def fail(self, message: Break) -> None:
        raise ValueError("a bug")


@dataclasses.dataclass(frozen=True)
class Fragile(PBR):
    roles: ClassVar[dict[str, Role]] = {
        **PBR.roles,
        "primary": dataclasses.replace(PBR.roles["primary"], before=Breaking),
    }


class Stay(hf.Message[int]):
    """Take for ever in the first process, and no time in any other."""

    folder: str


class Stayer(Counter):
    @hf.on(Stay)
    async def stay(self, message: Stay) -> int:
        begun = Path(message.folder, "begun")
        if not begun.exists():
            begun.touch()
            await asyncio.Event().wait()
        self.total += 1
        return self.total


async def test_nobody_waits_for_the_turn_in_hand_of_a_replica_that_is_broken(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """A brick has crashed (A44-A59), and its replica would end with the turn: it is killed, another one leads."""
    ref = await system.start(hf.child("alice", hf.start(Stayer), mechanism=Fragile()))
    primary = group_of(ref).membership.primary
    with system.events() as events:
        answer = ref.ask(Stay(str(tmp_path)), timeout=60)
        await until_there(tmp_path / "begun")
        system._node.cell_at(f"{ref.path}/ftm/{primary}/before").ref.tell(Break())
        assert await answer == 1
        (failover,) = [one for one in events.take() if isinstance(one, FailedOver)]
    assert failover.why == "its before has ended: ValueError: a bug"


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
        except hf.errors.AskDeadlock:
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
