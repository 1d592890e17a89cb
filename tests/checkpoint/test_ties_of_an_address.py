"""Monitors, watches and links of a recorded actor belong to its address: they outlive each end of a life (T14)."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel.cell import DOWN, GONE
from tests.checkpoint.players import start


class Tie(hf.Message):
    """Watch the others, in each way."""


class Told(hf.Message[list[str]]): ...


class Other(hf.Actor):
    def on_start(self, restored: bool) -> None:
        self.ctx.trap_exits = True  # The end of whoever is linked is not its own.


class Watcher(hf.Actor):
    """Is told of the end of others; ties itself to them in the hook that it is given, or when it is asked."""

    def __init__(self, hook: str) -> None:
        self.hook = hook
        self.told: list[str] = []

    def on_start(self, restored: bool) -> None:
        self.ctx.trap_exits = True
        if restored and self.hook == "on_start":
            self._tie()

    def on_recovered(self) -> None:
        if self.hook == "on_recovered":
            self._tie()

    def _tie(self) -> None:
        self.ctx.monitor(self.ctx.find("/app/monitored", Other))
        self.ctx.watch(self.ctx.find("/app/watched", Other))
        self.ctx.link(self.ctx.find("/app/linked", Other))

    @hf.on(Tie)
    def tie(self, message: Tie) -> None:
        self._tie()

    @hf.on(Told, readonly=True)
    def read(self, message: Told) -> list[str]:
        return self.told

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.told.append(f"DOWN {source.path}")

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.told.append(f"EXIT {source.path}")


class Crash(hf.Message): ...


class Life(hf.Message[int]): ...


class Fragile(hf.Actor):
    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise RuntimeError("too hot in here")

    @hf.on(Life, readonly=True)
    def life(self, message: Life) -> int:
        return self.ctx.life


class Link(hf.Message[None]): ...


class LinkedWith(hf.Actor):
    """A plain actor that is linked with another one."""

    def __init__(self, path: str, *, at_once: bool = True) -> None:
        self.path, self.at_once = path, at_once
        self.told: list[str] = []

    def on_start(self, restored: bool) -> None:
        self.ctx.trap_exits = True
        self.other = self.ctx.find(self.path, Fragile)
        if self.at_once:
            self.link(Link())

    @hf.on(Link)
    def link(self, message: Link) -> None:
        self.ctx.link(self.other)

    @hf.on(Told)
    def read(self, message: Told) -> list[str]:
        return self.told

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.told.append(f"EXIT {source.path}")


@pytest.mark.pairs
@pytest.mark.parametrize("hook", ["none", "on_start", "on_recovered"])
@pytest.mark.parametrize("end", ["crash", "terminated and restarted", "its supervisor is restarted"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_they_are_there_once_in_the_next_life(
    system: hf.ActorSystem, isolation: Any, end: str, hook: str
) -> None:
    for name in ("monitored", "watched", "linked"):
        await system.start(hf.child(name, hf.start(Other), restart="temporary"))
    spec = hf.child("watcher", hf.start(Watcher, hook), recovery=hf.hybrid(), isolation=isolation)
    above = await system.start(hf.supervisor("above", children=[spec], intensity=5))
    watcher = system.ref("/app/above/watcher", Watcher)
    await watcher.ask(Tie())
    if end == "crash":
        watcher.kill()
    elif end == "terminated and restarted":
        await above.ask(hf.TerminateChild("watcher"))
        await above.ask(hf.RestartChild("watcher"))
    else:
        with system.events() as events:
            above.kill()
            async for event in events:
                if isinstance(event, hf.events.Recovered):
                    break
    assert await watcher.ask(Told(), timeout=20.0) == []
    for name in ("monitored", "watched", "linked"):
        await system.stop(system.ref(f"/app/{name}", Other))
    async with asyncio.timeout(10.0):
        while len(await watcher.ask(Told())) < 3:
            pass
    assert sorted(await watcher.ask(Told())) == ["DOWN /app/monitored", "DOWN /app/watched", "EXIT /app/linked"]


@pytest.mark.pairs
@pytest.mark.parametrize("above", ["task", "process"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_who_is_linked_with_one_that_recovers_hears_of_no_crash(
    system: hf.ActorSystem, isolation: Any, above: Any
) -> None:
    """Wherever the recovered one lives: its process knows of none of its links, and tells nobody of its end."""
    spec = hf.child("linked", hf.start(Fragile), recovery=hf.hybrid(), isolation=isolation)
    await system.start(hf.supervisor("above", children=[spec], intensity=10, isolation=above))
    fragile = system.ref("/app/above/linked", Fragile)
    ones = []
    for n in range(5):  # Whether a process tells of a link is a race between that and its own end.
        ones.append(await system.start(hf.child(f"one{n}", hf.start(LinkedWith, fragile.path))))
        with pytest.raises(hf.RemoteCrash):
            await fragile.ask(Crash(), timeout=20.0)
        assert await fragile.ask(Life(), timeout=20.0) == n + 2
    assert [await one.ask(Told()) for one in ones] == [[]] * 5
    await system.stop(fragile)
    assert [await one.ask(Told()) for one in ones] == [["EXIT /app/above/linked"]] * 5


@pytest.mark.parametrize("above", ["task", "process"])
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("restart", ["permanent", "temporary"])
async def test_who_links_with_one_between_two_lives_is_linked_with_the_next(
    system: hf.ActorSystem, isolation: Any, above: Any, restart: Any
) -> None:
    """And hears at once that there is nobody if none comes."""
    nothing = hf.child("nothing", hf.start(Fragile))  # It stays, so that the other one's end is not the supervisor's.
    slowly = hf.Backoff(0.3)  # So that there is a time between two lives.
    spec = hf.child(
        "linked", hf.start(Fragile), recovery=hf.hybrid(), isolation=isolation, restart=restart, backoff=slowly
    )
    await system.start(hf.supervisor("above", children=[nothing, spec], intensity=10, isolation=above))
    fragile = system.ref("/app/above/linked", Fragile)
    other = await system.start(hf.child("other", hf.start(LinkedWith, fragile.path, at_once=False)))
    with pytest.raises(hf.RemoteCrash):
        await fragile.ask(Crash(), timeout=20.0)
    while fragile._cell.state not in (DOWN, GONE):
        await asyncio.sleep(0)
    await other.ask(Link())
    if restart == "permanent":
        assert await fragile.ask(Life(), timeout=20.0) == 2
        assert await other.ask(Told()) == []
        await system.stop(fragile)
    async with asyncio.timeout(20.0):
        while await other.ask(Told()) != ["EXIT /app/above/linked"]:
            pass


class Raise(hf.Message):
    """Have a child that ends, and is tied in this way."""

    how: str


class End(hf.Message): ...


class Child(hf.Actor):
    @hf.on(End)
    def end(self, message: End) -> None:
        self.ctx.stop()


class Parent(hf.Actor):
    def __init__(self) -> None:
        self.told: list[str] = []

    @hf.on(Raise)
    def have_child(self, message: Raise) -> None:
        child = self.ctx.spawn(hf.start(Child))
        if message.how == "link":
            self.ctx.trap_exits = True
            self.ctx.link(child)
        else:
            (self.ctx.monitor if message.how == "monitor" else self.ctx.watch)(child)
        child.tell(End())

    @hf.on(Told, readonly=True)
    def read(self, message: Told) -> list[str]:
        return self.told

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.told.append("DOWN")

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.told.append("EXIT")


@pytest.mark.parametrize("how", ["monitor", "watch", "link"])
async def test_the_end_of_a_child_in_the_same_process_is_heard_of_once(
    system: hf.ActorSystem, isolation: str, how: str
) -> None:
    parent = await start(system, isolation, "parent", hf.start(Parent), recovery=hf.hybrid())
    await parent.ask(Raise(how))
    heard = ["EXIT" if how == "link" else "DOWN"]
    async with asyncio.timeout(30.0):
        while await parent.ask(Told()) == []:
            await asyncio.sleep(0)
    await system.checkpoint(parent)
    assert await parent.ask(Told()) == heard
    parent.kill()
    assert await parent.ask(Told(), timeout=30.0) == heard
