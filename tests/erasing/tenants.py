"""Tenants with documents; run as a program, it erases one or two of them and kills itself in the middle."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import holdfast as hf
from holdfast.checkpoint.home.disposal import Erased
from holdfast.supervision import DynamicSupervisor

Place = Literal["task", "process"]
ACME, OTHER = "/app/tenants/acme", "/app/tenants/other"


class Put(hf.Message[int]):
    text: str


class Parse(hf.Message[int]):
    text: str


class Remind(hf.Message):
    text: str


class Get(hf.Message[list[str]]): ...


class Doc(hf.Actor):
    """Keeps what it is given, and is reminded of it much later."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    @hf.on(Put)
    def put(self, message: Put) -> int:
        self.texts.append(message.text)
        self.ctx.tell_after(1e6, Remind(message.text))
        return len(self.texts)

    @hf.on(Parse)
    def parse(self, message: Parse) -> int:
        raise ValueError(f"cannot parse {message.text}")

    @hf.on(Remind)
    def remind(self, message: Remind) -> None: ...

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> list[str]:
        return self.texts


def tenant(name: str, isolation: Place = "task") -> hf.ChildSpec[Any]:
    """A supervisor with a profile, and documents that come back with it."""
    return hf.supervisor(
        name,
        isolation=isolation,
        intensity=100,
        children=[
            hf.child("profile", hf.start(Doc), recovery=hf.hybrid()),
            hf.dynamic("docs", journal=True, template=hf.child(None, hf.start(Doc), recovery=hf.hybrid())),
        ],
    )


async def tenants(system: hf.ActorSystem, *specs: hf.ChildSpec[Any]) -> hf.ActorRef[DynamicSupervisor]:
    """The supervisor of tenants, with these."""
    top = await system.start(hf.dynamic("tenants", intensity=100))
    for spec in specs:
        await top.ask(hf.StartChild(spec))
    return top


async def fill(system: hf.ActorSystem, path: str, documents: int, text: str = "words") -> None:
    """Give a tenant that many documents."""
    await system.ref(f"{path}/profile", Doc).ask(Put(text))
    docs = system.ref(f"{path}/docs", DynamicSupervisor)
    for number in range(documents):
        await docs.ask(hf.StartChild(id=f"d{number}"))
        await system.ref(f"{path}/docs/d{number}", Doc).ask(Put(text))


async def read(system: hf.ActorSystem, path: str) -> list[list[str]]:
    """What a tenant's profile and documents have."""
    docs = await system.ref(f"{path}/docs", DynamicSupervisor).ask(hf.WhichChildren())
    found = [f"{path}/profile", *sorted(one.path for one in docs)]
    return [await system.ref(one, Doc).ask(Get()) for one in found]


def nothing(path: str) -> Erased:
    """What is forgotten where nothing is recorded."""
    return Erased(path)


def kill_at(count: int) -> Callable[..., None]:
    """Kills this process with the call of that number."""
    calls = 0

    def called(*_: object) -> None:
        nonlocal calls
        calls += 1
        if calls == count:
            os.kill(os.getpid(), signal.SIGKILL)

    return called


async def main(store: str, count: int) -> None:
    """Erase both tenants at once, and be killed at the store's write of that number."""
    async with hf.ActorSystem("app", store=store, log=False) as system:
        journal, step = system._homes.journal, kill_at(count)
        erase, note = journal.erase, journal.note

        def erase_or_die(address: str) -> None:
            step()
            erase(address)

        def note_or_die(key: str, value: bytes | None) -> None:
            step()
            note(key, value)

        journal.erase, journal.note = erase_or_die, note_or_die  # type: ignore[method-assign]
        await asyncio.gather(system.erase(ACME), system.erase(OTHER))
        Path(f"{store.removeprefix('sqlite:')}.done").touch()


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], int(sys.argv[2])))
