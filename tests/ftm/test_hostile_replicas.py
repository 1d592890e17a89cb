"""A replica whose process has been broken into may order no more than any other process: the root looks at it."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.process.worker_node import Guest
from holdfast.ftm.group.proxy import Proxy
from tests.actors.process.waiting import next_event
from tests.ftm.accounts import Add, Counter, Tags
from tests.ftm.test_failover import group_of, pid_of, two_again

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

IN_TIME = 30.0


class Order(hf.Message[int]):
    """Order somebody, once; how often this process has come to it."""

    how: str
    whom: str
    note: str


class Turned(Counter):
    """Does what somebody would who has come to run code in its process."""

    @hf.on(Order)
    def order(self, message: Order) -> int:
        note = Path(message.note)
        if note.exists():
            return 0
        note.write_text(str(os.getpid()))
        Guest.require_granted = lambda *args: None  # type: ignore[method-assign]
        victim: hf.ActorRef[Any] = self.ctx.find(message.whom, hf.Actor)
        if message.how == "kill":
            victim.kill()
        elif message.how == "stop":
            victim.stop()
        else:
            victim.tell(hf.TerminateChild("victim"))
        return 1


MECHANISMS = {"pbr": hf.ftm.PBR(), "lfr": hf.ftm.LFR()}


@pytest.mark.parametrize("name", sorted(MECHANISMS))
@pytest.mark.parametrize(("how", "whom"), [("kill", "/app/victim"), ("stop", "/app/victim"), ("stop child", "/app")])
async def test_the_order_of_a_leader_that_was_broken_into_is_not_carried_out(
    tmp_path: Path, name: str, how: str, whom: str
) -> None:
    note = tmp_path / "note"
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        victim = await system.start(hf.child("victim", hf.start(Counter)))
        for number in range(3):
            await victim.ask(Add(number), timeout=IN_TIME)
        ref = await system.start(
            hf.child("turned", hf.start(Turned), mechanism=MECHANISMS[name], recovery=hf.hybrid(interval=3600.0))
        )
        await two_again(ref)
        primary = group_of(ref).membership.primary
        assert primary is not None
        leader = pid_of(system, ref, primary)
        with system.events() as events:
            assert await ref.ask(Order(how, whom, str(note)), timeout=IN_TIME) == 0
            breach = await next_event(events, hf.events.TrustBreached)
        assert breach.pid == leader
        assert await victim.ask(Tags(), timeout=IN_TIME) == [0, 1, 2]
        assert await ref.ask(Add(1), timeout=IN_TIME) == 1


async def test_what_a_leader_that_is_gone_has_ordered_is_not_carried_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody can say any more what its process may: whoever leads next is asked again."""
    note = tmp_path / "note"
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        victim = await system.start(hf.child("victim", hf.start(Counter)))
        ref = await system.start(hf.child("turned", hf.start(Turned), mechanism=hf.ftm.PBR()))
        await two_again(ref)
        group = group_of(ref)
        primary = group.membership.primary
        assert primary is not None
        leader = pid_of(system, ref, primary)
        with monkeypatch.context() as patch:
            heard = asyncio.get_running_loop().create_future()
            may_leave = Proxy._may_leave

            def hear(proxy: Proxy, message: Any) -> bool:
                may = may_leave(proxy, message)
                if not may and not heard.done():
                    heard.set_result(None)
                return may

            patch.setattr(Proxy, "_may_leave", hear)
            patch.setattr(type(group.replicas), "worker_of", lambda replicas, name: None)
            asked = asyncio.ensure_future(ref.ask(Order("kill", "/app/victim", str(note)), timeout=IN_TIME))
            await asyncio.wait((heard, asked), timeout=IN_TIME, return_when=asyncio.FIRST_COMPLETED)
        assert heard.done()
        os.kill(leader, signal.SIGKILL)
        assert await asked == 0
        assert await victim.ask(Add(1), timeout=IN_TIME) == 1
        assert victim._cell.life == 1
