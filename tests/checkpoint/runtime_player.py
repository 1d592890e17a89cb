"""A recorded actor that asks supervisors, registries, pools, and a recorded one, each by one of their verbs."""

from __future__ import annotations

from typing import Any

import holdfast as hf
from holdfast.supervision import Registry, RegistryActor, Route
from tests.checkpoint.players import Doer, Note, gate

ASKED = "/app/team/b"
TIME = 60.0


class Kid(hf.Actor):
    def __init__(self, path: str = "") -> None:
        self._path = path

    async def on_start(self, restored: bool) -> None:
        if self._path:
            await gate(self._path)

    @hf.on(Note)
    def note(self, message: Note) -> int:
        return len(message.text)


class Clerk(Doer):
    """Says what it has heard, or the class of the error."""

    async def step(self, verb: str, arg: str, peer: hf.ActorRef[Any] | None) -> Any:
        if verb not in VERBS:
            return await super().step(verb, arg, peer)
        self.seen.append(f"{verb}:{await self._ask(verb)}")
        return None

    async def _ask(self, verb: str) -> Any:
        at: hf.ActorRef[Any] = self.ctx.find(ASKED, hf.Actor)
        match verb:
            case "start":
                try:
                    return (await at.ask(hf.StartChild(id="kid"), timeout=TIME)).path
                except hf.errors.AlreadyStarted as there:
                    return there.ref.path
            case "any":
                started = await at.ask(hf.StartChild(), timeout=TIME)
                return started.path.rpartition("/")[0]
            case "which":
                return len(await at.ask(hf.WhichChildren(), timeout=TIME)) >= 0
            case "lookup" | "register":
                registry: Registry[str, int] = Registry(self.ctx.find(ASKED, RegistryActor), timeout=TIME)
                if verb == "register":
                    return await registry.register("key", 1)
                return await registry.lookup("nobody's")
            case "note":
                return await at.ask(Note("hello"), timeout=TIME)
            case "pool":
                router: hf.ActorRef[Any] = self.ctx.find(f"{ASKED}/router", hf.Actor)
                return await router.ask(Note("four"), timeout=TIME)
            case "size":
                return (await at.ask(hf.supervision.PoolInfo(), timeout=TIME)).size
            case "route":
                return (await at.ask(Route(7), timeout=TIME)).path.rpartition("/")[0]
            case _:
                raise ValueError(verb)


VERBS = {
    "start": ASKED + "/kid",
    "any": ASKED,
    "which": "True",
    "lookup": "[]",
    "register": "None",
    "note": "1",
    "pool": "4",
    "size": "2",
    "route": ASKED,
}
"""What each verb hears."""
