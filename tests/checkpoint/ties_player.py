"""A root with a SQLite store for `test_restart_ties.py`: python ties_player.py STORE ORDER SAVED LIFE.

LIFE "first": a watcher monitors, watches, links and traps, and the root ends by SIGKILL. LIFE "second": the tree is
started again, those that are watched end, and what the watcher was told is printed.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from typing import Any

import holdfast as hf


class Tie(hf.Message[int]):
    others: list[hf.ActorRef[Any]]


class Told(hf.Message[list[str]]): ...


class Crash(hf.Message): ...


class Here(hf.Message): ...


class Victim(hf.Actor):
    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise RuntimeError("boom")

    @hf.on(Here, readonly=True)
    def here(self, message: Here) -> None:
        pass


class Watcher(hf.Actor):
    def __init__(self) -> None:
        self.ctx.trap_exits = True
        self.told: list[str] = []

    @hf.on(Tie)
    def tie(self, message: Tie) -> int:
        monitored, watched, linked, untied = message.others
        self.ctx.monitor(monitored)
        self.ctx.monitor(monitored)  # Each has a DOWN of its own.
        self.ctx.monitor(monitored).cancel()
        self.ctx.watch(watched)
        self.ctx.link(linked)
        self.ctx.monitor(untied).cancel()
        self.ctx.link(untied)
        self.ctx.unlink(untied)
        return 1

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.told.append(f"DOWN {source.path} {recovering}")

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.told.append(f"EXIT {source.path}")

    @hf.on(Told, readonly=True)
    def read(self, message: Told) -> list[str]:
        return self.told


NAMES = ("monitored", "watched", "linked", "untied")


async def main(store: str, order: str, saved: str, life: str) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False, intensity=100) as system:
        for name in order.split(","):
            if name == "watcher":
                recovery = hf.hybrid(interval=3600.0)
                await system.start(hf.child(name, hf.start(Watcher), recovery=recovery))
            else:
                await system.start(hf.child(name, hf.start(Victim), restart="temporary"))
        watcher = system.ref("/app/watcher", Watcher)
        others: list[hf.ActorRef[Any]] = [system.ref(f"/app/{name}", Victim) for name in NAMES]
        if life == "first":
            await watcher.ask(Tie(others))
            if saved == "saved":
                await system.checkpoint(watcher)
            await system._homes.settled()
            os.kill(os.getpid(), signal.SIGKILL)
        await system._node.settled()
        for other in others:
            other.tell(Crash())
        told: list[str] = []
        while len(told) < 4:
            told = await watcher.ask(Told())
        await system._node.settled()
        print(json.dumps(await watcher.ask(Told())))


if __name__ == "__main__":
    hf.run(main(*sys.argv[1:]))
