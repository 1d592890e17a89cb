"""A program with a registry and a member that registers at its start: `registry_player.py STORE KEYS METHOD RUN`.

The first run kills itself when the member is in; the next one prints how many entries there are, and who was reached.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from typing import Any

import holdfast as hf

METHODS: dict[str, Any] = {
    "plain": None,
    "hybrid": hf.hybrid(interval=3600.0),
    "replay_only": hf.replay_only(),
    "checkpoint_only": hf.checkpoint_only(3600.0),
}
Names = hf.supervision.Registry[str, int]


class Hit(hf.Message): ...


class Hits(hf.Message[int]): ...


class Enter(hf.Message):
    key: str
    value: int


class Leave(hf.Message):
    key: str


class End(hf.Message): ...


class Member(hf.Actor):
    """Has the key "members" from its start on, if it is said to, and others when it is told to."""

    def __init__(self, enters: bool = True) -> None:
        self._enters = enters
        self.hits = 0

    async def on_start(self, restored: bool) -> None:
        if self._enters:
            await self._names().register("members", 7)

    def _names(self) -> Names:
        return Names(self.ctx.find("/app/house/names", hf.supervision.RegistryActor))

    @hf.on(Hit)
    def hit(self, message: Hit) -> None:
        self.hits += 1

    @hf.on(Hits)
    def read(self, message: Hits) -> int:
        return self.hits

    @hf.on(Enter)
    async def enter(self, message: Enter) -> None:
        await self._names().register(message.key, message.value)

    @hf.on(End)
    def end(self, message: End) -> None:
        self.ctx.stop()

    @hf.on(Leave)
    async def leave(self, message: Leave) -> None:
        await self._names().unregister(message.key)


def house(keys: Any, method: str, *, isolation: Any = "task", enters: bool = True) -> hf.ChildSpec:
    member = hf.child("member", hf.start(Member, enters), recovery=METHODS[method], isolation=isolation)
    names = hf.supervision.registry("names", keys=keys, listeners=["/app/listener"])
    return hf.supervisor("house", strategy="rest_for_one", intensity=100, children=[names, member])


async def found(system: hf.ActorSystem, key: str = "members") -> list[tuple[str, int]]:
    """Who has the key, and with which value; each of them is hit, and has been hit as often as it stands there."""
    names = Names(system.ref("/app/house/names", hf.supervision.RegistryActor))
    entries = await names.lookup(key)
    for one in {entry.holder for entry in entries}:
        before = await one.ask(Hits(), timeout=60.0)
        reached = await names.dispatch(key, Hit())
        assert await one.ask(Hits(), timeout=60.0) == before + reached
    return [(entry.holder.path.rpartition("/")[2], entry.value) for entry in entries]


async def main(store: str, keys: str, method: str, run: str) -> None:
    async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
        await system.start(house(keys, method))
        print(await found(system), flush=True)
        if run == "first":
            os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
