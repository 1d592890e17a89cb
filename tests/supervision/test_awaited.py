"""Children that are bound to somebody below another supervisor, who is being started too: they wait."""

from __future__ import annotations

import asyncio
import os
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.supervision.admin import WhichChildren
from holdfast.supervision.respec import respec as respecify

IN_TIME = 20.0


class Where(hf.Message[str]):
    """Whom it is bound to."""


class Gate:
    """Where starts wait from the second one on, until it is opened."""

    def __init__(self) -> None:
        self.came = 0
        self.opened = asyncio.Event()

    async def passed(self) -> None:
        self.came += 1
        if self.came > 1:
            await self.opened.wait()


class Idle(hf.Actor):
    port: hf.Binding[hf.Actor]

    def __init__(self, gate: Gate | None = None) -> None:
        self._gate = gate

    async def on_start(self, restored: bool) -> None:
        if self._gate is not None:
            await self._gate.passed()

    @hf.on(Where)
    def where(self, message: Where) -> str:
        return self.port.path


def kid(name: str, to: str = "", **more: Any) -> hf.ChildSpec[Idle]:
    start = hf.start(Idle, more.pop("gate")) if "gate" in more else hf.start(Idle)
    return hf.child(name, start, bindings={"port": to} if to else {}, **more)


async def tree(system: hf.ActorSystem, isolation: Any = "task", gate: Gate | None = None) -> None:
    """`here/one` is bound to `there/two`, which comes up behind somebody who waits at the gate."""
    first = kid("first") if gate is None else kid("first", gate=gate)
    await system.start(hf.supervisor("there", children=[first, kid("two")], isolation=isolation))
    await system.start(hf.supervisor("here", children=[kid("one", "/app/there/two")]))


async def asked(system: hf.ActorSystem, path: str, before: Any) -> str:
    """Whom the actor there is bound to, when another one lives there than `before`."""
    async with asyncio.timeout(IN_TIME):
        while (cell := system._node.find(path)) in (None, before) or cell.state != "running":
            await asyncio.sleep(0)
        return await hf.ActorRef[Idle](cell).ask(Where(), IN_TIME)


def respec(supervisor: hf.ActorRef[hf.Supervisor], children: list[hf.ChildSpec[Any]]) -> None:
    """The next life of a supervisor has other specs."""
    start = supervisor._cell.extra().start
    assert start is not None
    respecify(supervisor._cell, hf.start(start.kind, start.args[0], tuple(children)))


def told(events: Any, kind: type[Any]) -> list[Any]:
    return [event for event in events.take() if isinstance(event, kind)]


@pytest.mark.parametrize("first", ["here", "there"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_two_that_are_killed_at_once_come_back_with_one_restart_each(isolation: Any, first: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=2, period=60.0) as system:
        await tree(system, isolation)
        before = system._node.find("/app/here/one")
        with system.events() as events:
            system.ref("/app/here" if first == "here" else "/app/there", hf.Actor).kill()
            system.ref("/app/there" if first == "here" else "/app/here", hf.Actor).kill()
            assert await asked(system, "/app/here/one", before) == "/app/there/two"
            seen = list[Any]()
            async with asyncio.timeout(IN_TIME):
                while len([event for event in seen if isinstance(event, hf.events.ChildRestarted)]) < 2:
                    seen += events.take()
                    await asyncio.sleep(0)
        assert {event.address for event in seen if isinstance(event, hf.events.ChildRestarted)} == {
            "/app/here",
            "/app/there",
        }
        assert not [event for event in seen if isinstance(event, hf.events.ChildStartFailed)]


async def test_it_waits_for_somebody_in_a_process_that_begins() -> None:
    async with hf.ActorSystem("app", log=False, intensity=2, period=60.0) as system:
        await tree(system, "process")
        before, there = system._node.find("/app/here/one"), system.ref("/app/there", hf.Supervisor)
        with system.events() as events:
            os.kill(system.pid_of(there), signal.SIGKILL)
            async with asyncio.timeout(IN_TIME):
                while system._node.find("/app/there/two") is not None:
                    await asyncio.sleep(0)
            system.ref("/app/here", hf.Actor).kill()
            assert await asked(system, "/app/here/one", before) == "/app/there/two"
            assert not told(events, hf.events.ChildStartFailed)


async def waiting_here(system: hf.ActorSystem, gate: Gate) -> hf.ActorRef[hf.Supervisor]:
    """Have `one` wait for `two`, which does not come up before the gate is opened; returns its supervisor."""
    here, there = system.ref("/app/here", hf.Supervisor), system.ref("/app/there", hf.Supervisor)
    there.kill()
    async with asyncio.timeout(IN_TIME):
        while gate.came < 2:
            await asyncio.sleep(0)
        here.kill()
        while system._node.find("/app/here/one") is not None or here._cell.actor is None:
            await asyncio.sleep(0)
        (info,) = await here.ask(WhichChildren(), IN_TIME)
    assert (info.id, info.state) == ("one", "starting")
    return here


async def test_whoever_waits_holds_up_nobody_and_answers() -> None:
    gate = Gate()
    async with hf.ActorSystem("app", log=False, intensity=2, period=60.0) as system:
        await tree(system, gate=gate)
        before = system._node.find("/app/here/one")
        await waiting_here(system, gate)
        gate.opened.set()
        assert await asked(system, "/app/here/one", before) == "/app/there/two"


async def test_one_that_waits_can_be_stopped_and_its_supervisor_too() -> None:
    gate = Gate()
    async with hf.ActorSystem("app", log=False, intensity=2, period=60.0) as system:
        await tree(system, gate=gate)
        here = await waiting_here(system, gate)
        async with asyncio.timeout(IN_TIME):
            await here.ask(hf.TerminateChild("one"), IN_TIME)
            await system.stop(here)
        gate.opened.set()
        async with asyncio.timeout(IN_TIME):
            while (cell := system._node.find("/app/there/two")) is None or cell.state != "running":
                await asyncio.sleep(0)
        assert system._node.find("/app/here") is None


async def test_it_waits_no_longer_than_its_start_may_take() -> None:
    gate = Gate()
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        await system.start(hf.supervisor("there", children=[kid("first", gate=gate), kid("two")]))
        one = kid("one", "/app/there/two", start_timeout=0.1)
        await system.start(hf.supervisor("here", children=[one], intensity=0))
        with system.events() as events:
            system.ref("/app/there", hf.Actor).kill()
            failed = list[Any]()
            async with asyncio.timeout(IN_TIME):
                while gate.came < 2:
                    await asyncio.sleep(0)
                system.ref("/app/here", hf.Actor).kill()
                while not failed:
                    failed += told(events, hf.events.ChildStartFailed)
                    await asyncio.sleep(0)
            assert failed[0].address == "/app/here/one"
            assert "/app/there/two, to which it is bound, was not there within 0.1 s" in failed[0].reason
        gate.opened.set()


# -- who waits for each other -----------------------------------------------------------------------------------------


async def test_two_that_wait_for_each_other_are_told_and_counted() -> None:
    """Their specs were changed while they ran: none of them can begin before the other one."""
    async with hf.ActorSystem("app", log=False) as system:
        top = hf.supervisor("top", intensity=2, period=60.0, children=[])
        await system.start(top)
        above = system.ref("/app/top", hf.Supervisor)
        for name, kids in (("here", [kid("one"), kid("a")]), ("there", [kid("two"), kid("b")])):
            await above.ask(hf.StartChild(hf.supervisor(name, children=kids)), IN_TIME)
        here, there = system.ref("/app/top/here", hf.Supervisor), system.ref("/app/top/there", hf.Supervisor)
        respec(here, [kid("one", "/app/top/there/b"), kid("a")])
        respec(there, [kid("two", "/app/top/here/a"), kid("b")])
        with system.events() as events:
            here.kill()
            there.kill()
            seen = list[Any]()
            async with asyncio.timeout(IN_TIME):
                while not [event for event in seen if isinstance(event, hf.events.SupervisorGaveUp)]:
                    seen += events.take()
                    await asyncio.sleep(0)
        reasons = [event.reason for event in seen if isinstance(event, hf.events.ChildStartFailed)]
        circles = [reason for reason in reasons if "before another one" in str(reason)]
        assert circles
        for said in ("/app/top/here/one waits for /app/top/there/b", "/app/top/there/two waits for /app/top/here/a"):
            assert all(said in str(circle) for circle in circles)


async def test_who_is_bound_to_one_that_is_started_behind_it_is_told_at_once() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        children = [kid("one", "/app/top/two"), kid("two")]
        with pytest.raises(
            hf.StartFailed, match=r"top/one.*no actor at /app/top/two yet, because it is started after this child"
        ):
            await system.start(hf.supervisor("top", children=children))
        nested = hf.supervisor("inner", children=[kid("one", "/app/top/two")])
        with pytest.raises(hf.StartFailed, match=r"binding 'port': there is no actor at /app/top/two"):
            await system.start(hf.supervisor("top", children=[nested, kid("two")]))


async def test_nobody_waits_for_one_that_was_stopped_or_never_was() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.supervisor("there", children=[kid("two"), kid("later", autostart=False)]))
        there = system.ref("/app/there", hf.Supervisor)
        await there.ask(hf.TerminateChild("two"), IN_TIME)
        for missing in ("/app/there/two", "/app/there/later", "/app/there/nobody", "/app/nowhere/two", "/other/two"):
            with pytest.raises(hf.StartFailed, match=f"there is no actor at {missing}"):
                await system.start(kid("one", missing))


async def test_two_that_are_started_at_once_wait_for_each_other() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        gate = Gate()
        gate.came = 1
        there = asyncio.ensure_future(
            system.start(hf.supervisor("there", children=[kid("first", gate=gate), kid("two")]))
        )
        async with asyncio.timeout(IN_TIME):
            while gate.came < 2:
                await asyncio.sleep(0)
        here = asyncio.ensure_future(system.start(kid("one", "/app/there/two")))
        await asyncio.sleep(0)
        gate.opened.set()
        await asyncio.gather(there, here)
        assert await system.ref("/app/one", Idle).ask(Where(), IN_TIME) == "/app/there/two"
