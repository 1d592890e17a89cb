"""Two actors of one tree that are bound to each other: a gate to its sessions, and each session to the gate."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf

NAMES = [f"s{number}" for number in range(20)]


class Login(hf.Message[None]):
    user: str


class Touch(hf.Message[int]): ...


class Seen(hf.Message[int]):
    user: str


class Session(hf.Actor):
    gate: hf.Binding[Gate]

    @hf.on(Touch)
    async def touch(self, message: Touch) -> int:
        return await self.gate.ask(Seen(self.ctx.path.rpartition("/")[2]))


class Gate(hf.Actor):
    sessions: hf.Binding[hf.supervision.DynamicSupervisor]

    def __init__(self) -> None:
        self.seen: dict[str, int] = {}

    @hf.on(Login)
    async def login(self, message: Login) -> None:
        await self.sessions.ask(hf.StartChild(id=message.user))

    @hf.on(Seen)
    def see(self, message: Seen) -> int:
        self.seen[message.user] = self.seen.get(message.user, 0) + 1
        return self.seen[message.user]


def specs(above: str, isolation: Any) -> list[hf.ChildSpec]:
    template = hf.child(None, hf.start(Session), bindings={"gate": f"{above}/gate"}, recovery=hf.hybrid())
    bindings = {"sessions": f"{above}/sessions"}
    gate = hf.child("gate", hf.start(Gate), bindings=bindings, recovery=hf.hybrid(), isolation=isolation)
    return [hf.dynamic("sessions", template=template, journal=True), gate]


async def begin(system: hf.ActorSystem, way: Any, isolation: Any) -> str:
    """Start them by calls, or as the children of one supervisor; returns the address above them."""
    above = "/app" if way == "calls" else "/app/house"
    if way == "calls":
        for spec in specs(above, isolation):
            await system.start(spec)
    else:
        await system.start(hf.supervisor("house", strategy=way, children=specs(above, isolation), isolation="task"))
    return above


async def touched(system: hf.ActorSystem, above: str) -> list[int]:
    """Each session speaks to the gate; one that is not there yet is asked again."""

    async def touch(path: str) -> int:
        while True:
            try:
                return await system.ref(path, Session).ask(Touch(), timeout=20.0)
            except (hf.errors.NoSuchActor, hf.errors.ActorStopped, hf.AskFailed):
                await asyncio.sleep(0.02)

    async with asyncio.timeout(30.0):
        return await asyncio.gather(*(touch(f"{above}/sessions/{name}") for name in NAMES))


WAYS = ["calls", "one_for_one", "rest_for_one"]


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("way", WAYS)
async def test_both_come_up_and_come_back(way: str, isolation: str, tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path}/store"
    async with hf.ActorSystem("app", store=store, log=False) as system:
        above = await begin(system, way, isolation)
        gate = system.ref(f"{above}/gate", Gate)
        for name in NAMES:
            await gate.ask(Login(name), timeout=20.0)
        assert set(await touched(system, above)) == {1}
        gate.kill()
        assert set(await touched(system, above)) == {2}
        system.ref(f"{above}/sessions", hf.Supervisor).kill()
        before = await touched(system, above)
    async with hf.ActorSystem("app", store=store, log=False) as system:
        above = await begin(system, way, isolation)
        after = await touched(system, above)
        assert min(before) >= 3
        assert [new - old for new, old in zip(after, before, strict=True)] == [1] * len(NAMES)
        await system.ref(f"{above}/gate", Gate).ask(Login("new"), timeout=20.0)


async def test_the_gate_goes_behind_a_mechanism_and_orders_by_its_binding() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        above = await begin(system, "calls", "task")
        gate = system.ref(f"{above}/gate", Gate)
        await gate.ask(Login("before"))
        async with system.transaction(timeout=30.0) as change:
            change.protect(gate, "pbr")
        for name in NAMES:
            await gate.ask(Login(name), timeout=20.0)
        assert set(await touched(system, above)) == {1}


async def test_whoever_begins_first_may_not_be_bound_to_whoever_begins_later() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        first, then = reversed(specs("/app/house", "task"))
        with pytest.raises(hf.StartFailed, match="put it, or its supervisor, first in the list"):
            await system.start(hf.supervisor("house", children=[first, then]))
