"""Who is linked with an actor that is moved to another supervisor, or watches it, hears of its end: once."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf

IN_TIME = 30.0


class Tie(hf.Message[bool]):
    verb: str
    path: str


class Heard(hf.Message[list[str]]): ...


class Party(hf.Actor):
    """Is tied to others, and notes what it hears."""

    def __init__(self) -> None:
        self.heard: list[str] = []

    def on_start(self, restored: bool) -> None:
        self.ctx.trap_exits = True

    @hf.on(Tie)
    def tie(self, message: Tie) -> bool:
        getattr(self.ctx, message.verb)(self.ctx.find(message.path, Party))
        return True

    @hf.on(Heard, readonly=True)
    def told(self, message: Heard) -> list[str]:
        return self.heard

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        if not recovering:
            self.heard.append("down")

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.heard.append("exit")


async def hears_once(one: hf.ActorRef[Party], notice: str) -> None:
    async with asyncio.timeout(IN_TIME):
        while not await one.ask(Heard(), IN_TIME):
            await asyncio.sleep(0.005)
    for _ in range(3):
        assert await one.ask(Heard(), IN_TIME) == [notice]


PLACES: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "recorded": {"recovery": hf.hybrid()},
    "recorded process": {"recovery": hf.hybrid(), "isolation": "process"},
}


@pytest.mark.parametrize("verb", ["monitor", "watch", "link"])
@pytest.mark.parametrize("when", ["before", "after", "its own move", "the move of both"])
@pytest.mark.parametrize("target", list(PLACES))
@pytest.mark.parametrize("watcher", list(PLACES))
async def test_it_hears_of_the_end_once(watcher: str, target: str, when: str, verb: str) -> None:
    """`when`: the tie is made before the move, or behind it by the address that the target had.

    If both are moved, each goes into a process, or out of its own, behind that.
    """
    children = [
        hf.child("watcher", hf.start(Party), **PLACES[watcher]),
        hf.child("target", hf.start(Party), **PLACES[target]),
    ]
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.supervisor("here", children=children, intensity=100))
        await system.start(hf.supervisor("there"))
        one, other = system.ref("/app/here/watcher", Party), system.ref("/app/here/target", Party)
        path = other.path
        if when != "after":
            assert await one.ask(Tie(verb, path), IN_TIME)
        async with system.transaction(timeout=IN_TIME) as change:
            if when != "its own move":
                change.move(other, "/app/there")
            if when in ("its own move", "the move of both"):
                change.move(one, "/app/there")
        if when == "after":
            assert await one.ask(Tie(verb, path), IN_TIME)
        if when == "the move of both":
            for ref, place in ((one, watcher), (other, target)):
                await system.set_isolation(ref, "task" if "process" in place else "process", timeout=IN_TIME)
        assert await other.ask(Heard(), IN_TIME) == []
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove(other)
        await hears_once(one, "exit" if verb == "link" else "down")


@pytest.mark.parametrize("verb", ["monitor", "watch", "link"])
@pytest.mark.parametrize("target", list(PLACES))
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_who_lives_with_its_supervisor_hears_of_the_end_once(
    recovery: hf.Method | None, target: str, verb: str
) -> None:
    """It goes into a process of its own, and back, behind the move of the target."""
    team = [hf.child("watcher", hf.start(Party), recovery=recovery)]
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.supervisor("here", children=[hf.child("target", hf.start(Party), **PLACES[target])]))
        await system.start(hf.supervisor("there"))
        await system.start(hf.supervisor("team", children=team, isolation="process", intensity=100))
        one, other = system.ref("/app/team/watcher", Party), system.ref("/app/here/target", Party)
        assert await one.ask(Tie(verb, other.path), IN_TIME)
        async with system.transaction(timeout=IN_TIME) as change:
            change.move(other, "/app/there")
        for isolation in ("process", "task"):
            await system.set_isolation(one, isolation, timeout=IN_TIME)
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove(other)
        await hears_once(one, "exit" if verb == "link" else "down")


class Who(hf.Message[str]): ...


class AskBound(hf.Message[str]): ...


class Named(hf.Actor):
    def __init__(self, name: str) -> None:
        self.name = name

    @hf.on(Who, readonly=True)
    def who(self, message: Who) -> str:
        return self.name


class Client(hf.Actor):
    other: hf.Binding[Named]

    @hf.on(AskBound)
    async def ask_it(self, message: AskBound) -> str:
        return await self.other.ask(Who(), IN_TIME)


@pytest.mark.parametrize("place", [*PLACES, "below", "replicas", "recorded replicas"])
async def test_who_is_bound_to_it_reaches_it_also_when_somebody_else_has_its_address(place: str) -> None:
    options: dict[str, Any] = PLACES.get(place, {})
    if "replicas" in place:
        options = {"mechanism": hf.PBR(), "recovery": hf.hybrid() if "recorded" in place else None}
    client = hf.child("client", hf.start(Client), bindings={"other": "/app/here/named"}, **options)
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.supervisor("here", children=[hf.child("named", hf.start(Named, "first"))]))
        await system.start(hf.supervisor("there"))
        isolation: Any = "process" if place == "below" else "task"
        await system.start(hf.supervisor("team", children=[client], intensity=100, isolation=isolation))
        ref = system.ref("/app/team/client", Client)
        assert await ref.ask(AskBound(), IN_TIME) == "first"
        async with system.transaction(timeout=IN_TIME) as change:
            change.move("/app/here/named", "/app/there")
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app/here", hf.child("named", hf.start(Named, "second")))
        assert await ref.ask(AskBound(), IN_TIME) == "first"
        ref._cell.kill()
        assert await ref.ask(AskBound(), IN_TIME) == "first"
