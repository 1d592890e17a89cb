"""A program for `test_ties_to_the_gone.py`: STORE WATCHER KIND PLACE ORDER END; END is "killed", "stopped" or "told".

The first ones tie a watcher to one of a KIND that lives in PLACE, and end. "told" begins again in that ORDER, has
somebody come, to the same address if that can be, and crash, and prints what the watcher was told.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from typing import Any

import holdfast as hf
from tests.checkpoint.players import start

IN_TIME = 30.0


class Tie(hf.Message[int]):
    paths: list[str]


class Told(hf.Message[list[str]]): ...


class Crash(hf.Message): ...


class Other(hf.Actor):
    def __init__(self) -> None:
        self.ctx.trap_exits = True  # The end of the watcher is not its own.

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        pass

    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise RuntimeError("boom")


class Bear(hf.Message[str]): ...


class Parent(hf.Actor):
    @hf.on(Bear)
    def bear(self, message: Bear) -> str:
        return self.ctx.spawn(hf.start(Other)).path


class Watcher(hf.Actor):
    def __init__(self, again: bool = False) -> None:
        self.ctx.trap_exits = True
        self.told: list[str] = []
        self.paths: list[str] = []
        self._again = again

    def on_recovered(self) -> None:
        if self._again:
            self._tie()

    @hf.on(Tie)
    def tie(self, message: Tie) -> int:
        self.paths = message.paths
        self._tie()
        return 1

    def _tie(self) -> None:
        for path in self.paths:
            other = self.ctx.find(path, hf.Actor)
            self.ctx.monitor(other)
            self.ctx.watch(other)
            self.ctx.link(other)

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        if not recovering:
            self.told.append(f"DOWN {source.path} {reason}")

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.told.append(f"EXIT {source.path} {reason}")

    @hf.on(Told, readonly=True)
    def read(self, message: Told) -> list[str]:
        return self.told


RECORDED = hf.hybrid(interval=3600.0)


async def house(system: hf.ActorSystem, kind: str, place: Any) -> Any:
    """Below whom the other one lives."""
    if kind == "spawned":
        return await system.start(hf.child("house", hf.start(Parent), isolation=place))
    if kind == "listed":
        children = [hf.child("one", hf.start(Other), autostart=False)]
        return await system.start(hf.supervisor("house", children=children, isolation=place, intensity=99))
    recovery = RECORDED if kind in ("recorded", "keyed") else None
    template = hf.child(None, hf.start(Other), restart="temporary", recovery=recovery)
    spec = hf.dynamic("house", template=template, isolation=place, journal=kind == "journaled", intensity=99)
    return await system.start(spec)


async def other(system: hf.ActorSystem, kind: str) -> hf.ActorRef[Other]:
    """The one that is tied, or whoever comes after it."""
    if kind == "spawned":
        return system.ref(await system.ref("/app/house", Parent).ask(Bear(), IN_TIME), Other)
    top = system.ref("/app/house", hf.Supervisor)
    if kind == "listed":
        return await top.ask(hf.RestartChild("one"), IN_TIME)
    if kind == "journaled" and (there := [path for path in system.tree() if path.startswith("/app/house/")]):
        return system.ref(there[0], Other)
    return await top.ask(hf.StartChild(id="one" if kind in ("given", "keyed") else None), IN_TIME)


async def watcher(system: hf.ActorSystem, isolation: str, again: bool) -> hf.ActorRef[Watcher]:
    return await start(system, isolation, "watcher", hf.start(Watcher, again), recovery=RECORDED)


async def main(store: str, isolation: str, kind: str, place: str, order: str, end: str) -> None:
    again = order == "again"
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False, intensity=100) as system:
        early = await watcher(system, isolation, again) if order == "watcher first" else None
        await house(system, kind, place)
        one = await other(system, kind) if order == "stranger first" or end != "told" else None
        ref = early or await watcher(system, isolation, again)
        if end != "told":
            assert one is not None
            await ref.ask(Tie([one.path]), IN_TIME)
            print(json.dumps(one.path), flush=True)
            if end == "stopped":
                await system.stop(ref)
                return
            await system._homes.settled()
            os.kill(os.getpid(), signal.SIGKILL)
        if kind not in ("listed", "keyed", "journaled"):
            async with asyncio.timeout(IN_TIME):
                while len(await ref.ask(Told(), IN_TIME)) < 3:
                    await asyncio.sleep(0.005)
        await system._node.settled()
        before = await ref.ask(Told(), IN_TIME)
        one = one or await other(system, kind)
        with system.events() as events:
            one.tell(Crash())
            async with asyncio.timeout(IN_TIME):
                async for event in events:
                    if isinstance(event, hf.events.ActorCrashed):
                        break
        await system._node.settled()
        after = await ref.ask(Told(), IN_TIME)
        if len(before) < 3:
            async with asyncio.timeout(IN_TIME):
                while not any("EXIT" in text for text in after):
                    after = await ref.ask(Told(), IN_TIME)
        print(json.dumps([before, after]))


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
