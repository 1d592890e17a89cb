"""An image that becomes durable while its actor goes on: what has happened since is not cut with it (T10)."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

import holdfast as hf
from tests.checkpoint.strikes import NEVER, event


class Aside(hf.Message):
    word: str


class Open(hf.Message): ...


class Stop(hf.Message): ...


class Words(hf.Message[list[str]]): ...


class Door(hf.Actor):
    """Puts words aside until it is open; after `Stop` it cannot be saved."""

    def __init__(self) -> None:
        self.grid = np.ones(200_000)
        self.words: list[str] = []
        self.is_open = False
        self.lock: Any = None

    @hf.on(Aside)
    def aside(self, message: Aside) -> None:
        if not self.is_open:
            self.ctx.stash()
        else:
            self.words.append(message.word)

    @hf.on(Open)
    def open(self, message: Open) -> None:
        self.is_open = True
        self.ctx.unstash()

    @hf.on(Stop)
    def stop(self, message: Stop) -> None:
        self.lock = asyncio.Lock()

    @hf.on(Words, readonly=True)
    def read(self, message: Words) -> list[str]:
        return list(self.words)


class Held:
    """Holds up the writing of packs of a real journal."""

    def __init__(self, journal: Any) -> None:
        self._write = journal.keep_blocks
        self.has_begun, self.may_go = threading.Event(), threading.Event()
        journal.keep_blocks = self._keep

    def _keep(self, *arguments: Any) -> None:
        self.has_begun.set()
        assert self.may_go.wait(20.0)
        self._write(*arguments)


class Slow(hf.Actor):
    """Its second life cannot be saved before there is a file."""

    def __init__(self, path: str) -> None:
        begun = Path(f"{path}.begun")
        self._path, self._is_second = path, begun.exists()
        begun.touch()
        self.count = 0

    @hf.on(Aside)
    def take(self, message: Aside) -> None:
        self.count += 1

    @hf.on(Words, readonly=True)
    def read(self, message: Words) -> list[str]:
        return [str(self.count)]

    def get_state(self) -> int:
        end = time.monotonic() + 60.0
        while self._is_second and not Path(self._path).exists() and time.monotonic() < end:
            time.sleep(0.001)
        return self.count

    def set_state(self, state: int) -> None:
        self.count = state


async def begun(system: hf.ActorSystem) -> hf.ActorRef[Door]:
    return await system.start(hf.child("door", hf.start(Door), recovery=hf.hybrid(interval=NEVER)))


def running(path: Path) -> hf.ActorSystem:
    return hf.ActorSystem("app", store=f"sqlite:{path}", log=False, intensity=100)


async def test_what_was_stashed_in_it_and_handled_since_is_replayed_after_a_restart_of_the_root(tmp_path: Path) -> None:
    async with running(tmp_path / "app.db") as system:
        ref = await begun(system)
        held = Held(system._homes.journal)
        ref.tell(Aside("early"))
        await ref.ask(Words())
        wish = asyncio.ensure_future(system.checkpoint(ref, timeout=20.0))
        await asyncio.to_thread(held.has_begun.wait, 20.0)
        ref.tell(Open())
        assert await ref.ask(Words()) == ["early"]
        held.may_go.set()
        await wish
        ref.tell(Stop())
    async with running(tmp_path / "app.db") as system:
        ref = await begun(system)
        assert await ref.ask(Words(), timeout=20.0) == ["early"]


async def test_one_that_is_late_for_a_crash_does_not_count(tmp_path: Path) -> None:
    async with running(tmp_path / "app.db") as system:
        ref = await begun(system)
        held = Held(system._homes.journal)
        ref.tell(Open())
        ref.tell(Aside("one"))
        await ref.ask(Words())
        wish = asyncio.ensure_future(system.checkpoint(ref, timeout=20.0))
        await asyncio.to_thread(held.has_begun.wait, 20.0)
        with system.events() as stream:
            ref.kill()
            recovered = await event(stream, hf.events.Recovered)
            assert recovered.replayed >= 3
        held.may_go.set()
        await wish
        assert await ref.ask(Words()) == ["one"]


async def test_an_actor_is_released_before_the_snapshot_of_what_was_replayed(tmp_path: Path) -> None:
    file = tmp_path / "go on"
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        recovery = hf.hybrid(interval=NEVER)
        ref = await system.start(hf.child("slow", hf.start(Slow, str(file)), isolation="process", recovery=recovery))
        ref.tell(Aside("a"))
        assert await ref.ask(Words()) == ["1"]
        with system.events() as events:
            os.kill(system.pid_of(ref), 9)
            assert (await event(events, hf.events.Recovered)).replayed
            assert not file.exists()
            file.touch()
            assert await ref.ask(Words(), timeout=60.0) == ["1"]
