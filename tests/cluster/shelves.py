"""A system with a large and a small recorded actor, to be copied from store to store by the command."""

from __future__ import annotations

import subprocess
import sys

import holdfast as hf


class Put(hf.Message[int]):
    text: str


class Grow(hf.Message[int]):
    megabytes: int


class Shelf(hf.Actor):
    def __init__(self) -> None:
        self.lines: list[str] = []
        self.bulk = b""

    @hf.on(Put)
    def put(self, message: Put) -> int:
        self.lines.append(message.text)
        return len(self.lines)

    @hf.on(Grow)
    def grow(self, message: Grow) -> int:
        self.bulk += bytes(range(256)) * 4096 * message.megabytes
        return len(self.bulk)


async def fill(store: str) -> None:
    async with hf.ActorSystem("app", store=store, log=False) as system:
        large = await system.start(hf.child("large", hf.start(Shelf), recovery=hf.hybrid(every=2)))
        small = await system.start(hf.child("small", hf.start(Shelf), recovery=hf.replay_only()))
        for n in range(5):
            await large.ask(Grow(1))
            await small.ask(Put(f"line {n}"))


async def found_in(store: str, key: bytes | None = None) -> tuple[int, int]:
    async with hf.ActorSystem("app", store=store, store_key=key, log=False) as system:
        large = await system.start(hf.child("large", hf.start(Shelf), recovery=hf.hybrid(every=2)))
        small = await system.start(hf.child("small", hf.start(Shelf), recovery=hf.replay_only()))
        return await large.ask(Grow(0)), await small.ask(Put("one more"))


def copied(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command; the systems are named after tests' places on servers, and not as the copied one."""
    command = [sys.executable, "-m", "holdfast.console.cli", "store", "copy", "--other-name", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
