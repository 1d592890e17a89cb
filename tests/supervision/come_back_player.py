"""Children of journaled dynamic supervisors, bound to a desk: a plain one, a recorded one, and one in a subtree."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import holdfast as hf

NAMES = {"plain": "plain", "recorded": "recorded", "subtree": "subtree/one"}
"""The address of each below its supervisor, by its id there."""


class Note(hf.Message[int]):
    """To be counted at the desk; the answer is how many it has counted."""


class Count(hf.Message[int]): ...


class Desk(hf.Actor):
    def __init__(self) -> None:
        self.notes = 0

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.notes += 1
        return self.notes


class Clerk(hf.Actor):
    desk: hf.Binding[Desk]

    @hf.on(Count)
    async def count(self, message: Count) -> int:
        return await self.desk.ask(Note())


def children(desk: str) -> list[hf.ChildSpec[hf.Actor]]:
    clerk, bound = hf.start(Clerk), {"desk": desk}
    return [
        hf.child("plain", clerk, bindings=bound),
        hf.child("recorded", clerk, bindings=bound, recovery=hf.hybrid()),
        hf.supervisor("subtree", children=[hf.child("one", clerk, bindings=bound)]),
    ]


def desk_at(where: str) -> str:
    return "/app/house/desk" if where in ("earlier", "later") else "/app/desk"


def clerks_at(where: str) -> str:
    return "/app/house/clerks" if where in ("earlier", "later") else "/app/clerks"


@asynccontextmanager
async def program(store: str | None, where: str, *, has_desk: bool = True) -> AsyncGenerator[hf.ActorSystem]:
    """The desk is a sibling that starts `earlier` or `later` than the clerks' supervisor, or by itself: `other`."""
    desk = hf.child("desk", hf.start(Desk), recovery=hf.hybrid(), autostart=has_desk)
    clerks = hf.dynamic("clerks", journal=True, intensity=0)
    async with hf.ActorSystem("app", store=store, log=False) as system:
        match where:
            case "earlier":
                await system.start(hf.supervisor("house", children=[desk, clerks], intensity=0))
            case "later":
                await system.start(hf.supervisor("house", children=[clerks, desk], intensity=0))
            case _:
                await system.start(clerks)
                if has_desk:
                    await asyncio.sleep(0.1)  # As if much was started in between.
                    await system.start(desk)
        yield system


async def add(system: hf.ActorSystem, where: str) -> None:
    for spec in children(desk_at(where)):
        await system.ref(clerks_at(where), hf.supervision.DynamicSupervisor).ask(hf.StartChild(spec))


async def counted(system: hf.ActorSystem, where: str) -> list[int]:
    """What the clerks answer as soon as they are there."""
    found = list[int]()
    for name in NAMES.values():
        async with asyncio.timeout(20.0):
            while system._node.find(f"{clerks_at(where)}/{name}") is None:
                await asyncio.sleep(0.01)
        found.append(await system.ref(f"{clerks_at(where)}/{name}", Clerk).ask(Count(), 20.0))
    return found


async def killed(store: str, where: str) -> None:
    async with program(store, where) as system:
        await add(system, where)
        assert await counted(system, where) == [1, 2, 3]
        os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    from tests.supervision import come_back_player

    asyncio.run(come_back_player.killed(*sys.argv[1:]))
