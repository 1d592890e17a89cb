"""An image that becomes durable while its actor goes on: what has happened since is not cut with it (T10)."""

from __future__ import annotations

import asyncio
import threading
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
        return self.words


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


async def begun(system: hf.ActorSystem) -> hf.ActorRef[Door]:
    return await system.start(hf.child("door", hf.start(Door), recovery=hf.hybrid(interval=NEVER)))


def running(path: Path) -> hf.ActorSystem:
    return hf.ActorSystem("app", store=f"sqlite:{path}", log=False, intensity=100)


async def test_what_was_stashed_in_it_and_handled_since_is_replayed_after_a_restart_of_the_root(tmp_path: Path) -> None:
    async with running(tmp_path / "app.db") as system:
        ref = await begun(system)
        held = Held(system.homes.journal)
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
        held = Held(system.homes.journal)
        ref.tell(Open())
        ref.tell(Aside("one"))
        await ref.ask(Words())
        wish = asyncio.ensure_future(system.checkpoint(ref, timeout=20.0))
        await asyncio.to_thread(held.has_begun.wait, 20.0)
        with system.events() as stream:
            ref.kill()
            recovered = await event(stream, hf.Recovered)
            assert recovered.replayed >= 3
        held.may_go.set()
        await wish
        assert await ref.ask(Words()) == ["one"]
