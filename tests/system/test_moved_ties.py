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


@pytest.mark.pairs
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


@pytest.mark.pairs
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
        options = {"mechanism": hf.ftm.PBR(), "recovery": hf.hybrid() if "recorded" in place else None}
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


def among_processes(target: dict[str, Any], at: str) -> list[hf.ChildSpec]:
    """A watcher below each of three supervisors, two of which have processes; the target is below `at`."""
    isolations: dict[str, Any] = {"near": "task", "far": "process", "other": "process"}
    return [
        hf.supervisor(
            name,
            children=[
                hf.child("watcher", hf.start(Party)),
                *([hf.child("target", hf.start(Party), **target)] if name == at else []),
            ],
            isolation=isolation,
            intensity=100,
        )
        for name, isolation in isolations.items()
    ]


@pytest.mark.pairs
@pytest.mark.parametrize("verb", ["monitor", "watch", "link"])
@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("target", list(PLACES))
@pytest.mark.parametrize("way", ["near far", "far near", "far other", "far near far"])
@pytest.mark.parametrize("watcher", ["near", "far", "other"])
async def test_it_hears_of_the_end_of_who_goes_from_process_to_process(
    watcher: str, way: str, target: str, when: str, verb: str
) -> None:
    first, *others = way.split()
    async with hf.ActorSystem("app", log=False) as system:
        for spec in among_processes(PLACES[target], first):
            await system.start(spec)
        one, other = system.ref(f"/app/{watcher}/watcher", Party), system.ref(f"/app/{first}/target", Party)
        old = other.path
        if when == "before":
            assert await one.ask(Tie(verb, old), IN_TIME)
            assert await other.ask(Tie(verb, one.path), IN_TIME)
        for to in others:
            async with system.transaction(timeout=IN_TIME) as change:
                change.move(other, f"/app/{to}")
        if when == "after":
            assert await one.ask(Tie(verb, old), IN_TIME)
        assert (await one.ask(Heard(), IN_TIME), await other.ask(Heard(), IN_TIME)) == ([], [])
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove(other)
        await hears_once(one, "exit" if verb == "link" else "down")


@pytest.mark.parametrize("verb", ["monitor", "watch", "link"])
@pytest.mark.parametrize("target", list(PLACES))
async def test_it_hears_of_the_end_though_somebody_else_has_the_address(target: str, verb: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        for spec in among_processes(PLACES[target], "far"):
            await system.start(spec)
        one, other = system.ref("/app/far/watcher", Party), system.ref("/app/far/target", Party)
        assert await one.ask(Tie(verb, other.path), IN_TIME)
        async with system.transaction(timeout=IN_TIME) as change:
            change.move(other, "/app/near")
            change.add("/app/far", hf.child("target", hf.start(Party)))
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove("/app/far/target")
        assert await one.ask(Heard(), IN_TIME) == []
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app/far", hf.child("target", hf.start(Party)))
            change.remove(other)
        await hears_once(one, "exit" if verb == "link" else "down")


@pytest.mark.pairs
@pytest.mark.parametrize("verb", ["monitor", "watch", "link"])
@pytest.mark.parametrize("target", list(PLACES))
@pytest.mark.parametrize("way", ["near far", "far near", "far other"])
@pytest.mark.parametrize("watched", ["near", "far", "other"])
async def test_who_goes_from_process_to_process_hears_of_ends_behind_it(
    watched: str, way: str, target: str, verb: str
) -> None:
    first, to = way.split()
    async with hf.ActorSystem("app", log=False) as system:
        for spec in among_processes(PLACES[target], first):
            await system.start(spec)
        one, other = system.ref(f"/app/{first}/target", Party), system.ref(f"/app/{watched}/watcher", Party)
        assert await one.ask(Tie(verb, other.path), IN_TIME)
        async with system.transaction(timeout=IN_TIME) as change:
            change.move(one, f"/app/{to}")
        assert await one.ask(Heard(), IN_TIME) == []
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove(other)
        await hears_once(one, "exit" if verb == "link" else "down")


@pytest.mark.pairs
@pytest.mark.parametrize("target", list(PLACES))
@pytest.mark.parametrize("client", ["near", "far", "other"])
@pytest.mark.parametrize("way", ["near far", "far near", "far other"])
async def test_who_is_bound_to_one_that_goes_from_process_to_process_reaches_it(
    way: str, client: str, target: str
) -> None:
    """Also when somebody else has its address, and behind a restart of either process."""
    first, to = way.split()
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        for spec in among_processes({}, ""):
            await system.start(spec)
        async with system.transaction(timeout=IN_TIME) as change:
            change.add(f"/app/{first}", hf.child("named", hf.start(Named, "first"), **PLACES[target]))
            change.add(
                f"/app/{client}", hf.child("client", hf.start(Client), bindings={"other": f"/app/{first}/named"})
            )
        ref, named = system.ref(f"/app/{client}/client", Client), system.ref(f"/app/{first}/named", Named)
        assert await ref.ask(AskBound(), IN_TIME) == "first"
        if client == to:
            with pytest.raises(hf.TransactionRefused, match="it is started before the one to which its spec binds"):
                async with system.transaction(timeout=IN_TIME) as change:
                    change.move(named, f"/app/{to}")
            return
        async with system.transaction(timeout=IN_TIME) as change:
            change.move(named, f"/app/{to}")
            change.add(f"/app/{first}", hf.child("named", hf.start(Named, "second")))
        assert await ref.ask(AskBound(), IN_TIME) == "first"
        assert await named.ask(Who(), IN_TIME) == "first"
        assert await system.ref(f"/app/{first}/named", Named).ask(Who(), IN_TIME) == "second"
        for name, who in ((first, "second"), (to, "first")):
            system.ref(f"/app/{name}", hf.Supervisor)._cell.kill()
            assert await answered(system, f"/app/{name}/named", Who()) == who
        assert await answered(system, f"/app/{client}/client", AskBound()) == "first"


async def answered(system: hf.ActorSystem, path: str, message: hf.Message[str]) -> str:
    """The answer of whoever lives at an address when its supervisor has been started again."""
    async with asyncio.timeout(IN_TIME):
        while True:
            try:
                return await system.ref(path, hf.Actor).ask(message, IN_TIME)
            except (hf.errors.NoSuchActor, hf.ActorStopped, hf.AskFailed):
                await asyncio.sleep(0.005)
