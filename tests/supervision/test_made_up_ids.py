"""An id that was made up names one actor: a ref to it leads to nobody else, whatever has ended that one."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, Simulation, idle, simulate

SEEDS = 3


class Attach(hf.Message):
    connection: hf.ActorRef[hf.Actor]


class Push(hf.Message): ...


class Line(hf.Message):
    text: str


class Told(hf.Message[list[str]]): ...


class Spawn(hf.Message[hf.ActorRef[hf.Actor]]): ...


class Greet(hf.Message[list[str]]): ...


class Session(hf.Actor):
    def __init__(self) -> None:
        self.connection: hf.ActorRef[hf.Actor] | None = None
        self.told: list[str] = []

    @hf.on(Attach)
    def attach(self, message: Attach) -> None:
        self.connection = message.connection
        self.ctx.monitor(message.connection)
        self.push(Push())

    @hf.on(Push)
    def push(self, message: Push) -> None:
        if self.connection is not None:
            self.connection.tell(Line("for one pair of eyes"))

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.told.append(f"{source.path} {reason}")

    @hf.on(Told, readonly=True)
    def read(self, message: Told) -> list[str]:
        return list(self.told)


class Connection(hf.Actor):
    def __init__(self) -> None:
        self.got: list[str] = []

    @hf.on(Line)
    def line(self, message: Line) -> None:
        self.got.append(message.text)

    @hf.on(Told, readonly=True)
    def read(self, message: Told) -> list[str]:
        return list(self.got)


class Bearer(hf.Actor):
    """Has connections below it that it gives no name."""

    def __init__(self) -> None:
        self.children: list[hf.ActorRef[Connection]] = []

    @hf.on(Spawn)
    def spawn(self, message: Spawn) -> hf.ActorRef[Any]:
        return self.ctx.spawn(hf.start(Connection))

    @hf.on(Greet)
    async def greet(self, message: Greet) -> list[str]:
        self.children = [self.ctx.spawn(hf.start(Connection)) for _ in range(2)]
        for number, child in enumerate(self.children):
            child.tell(Line(f"number {number}"))
        return [line for child in self.children for line in await child.ask(Told())]


async def log_in(system: hf.ActorSystem, recovery: Any) -> list[hf.ActorRef[Session]]:
    specs = [hf.child(name, hf.start(Session), recovery=recovery) for name in ("late", "behind")]
    return [await system.start(spec) for spec in specs]


async def open_door(system: hf.ActorSystem, place: Any) -> None:
    connections = hf.dynamic("connections", template=hf.child(None, hf.start(Connection), restart="temporary"))
    children = [connections, hf.child("bearer", hf.start(Bearer))]
    await system.start(hf.supervisor("door", isolation=place, children=children))


async def connected(system: hf.ActorSystem, kind: str) -> hf.ActorRef[Any]:
    while True:
        try:
            if kind == "spawned":
                return await system.ref("/app/door/bearer", Bearer).ask(Spawn())
            return await system.ref("/app/door/connections", hf.Supervisor).ask(hf.StartChild())
        except hf.HoldfastError:
            await asyncio.sleep(0.01)  # The door is not open again.


@pytest.mark.parametrize("kind", ["made up", "spawned"])
@pytest.mark.parametrize(
    ("end", "session"),
    [*itertools.product(["supervisor", "process"], ["recorded", "plain"]), ("program", "recorded")],
)
def test_a_ref_to_a_made_up_id_leads_to_no_stranger(end: str, session: str, kind: str) -> None:
    """One session is given the ref when the connection has ended, and one has it, and is behind."""
    recovery = hf.hybrid() if session == "recorded" else None
    place = "process" if end == "process" else "task"

    @simulate(seeds=SEEDS, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        await open_door(system, place)
        late, behind = await log_in(system, recovery)
        anns = await connected(system, kind)
        await behind.send(Attach(anns))
        while not await anns.ask(Told()):
            await asyncio.sleep(0.01)
        for one in (late, behind):
            await system.suspend(one)
        await late.send(Attach(anns))
        await behind.send(Push())
        if end == "program":
            system = await simulation.crash_root()
            await open_door(system, place)
        elif end == "process":
            simulation.kill_process(system.ref("/app/door", hf.Supervisor))
        else:
            system.ref(anns.path.rpartition("/")[0], hf.Actor).kill()
        system.expect_crashes()
        system.expect_dead_letters()
        eves = await connected(system, kind)
        if end == "program":
            late, behind = await log_in(system, recovery)
        for one in (late, behind):
            await system.resume(one)
        await idle(system)
        assert await eves.ask(Told()) == []
        assert await late.ask(Told()) == [f"{anns.path} {hf.NOPROC}"]
        (down,) = await behind.ask(Told())
        assert down.startswith(anns.path)

    run()


@pytest.mark.parametrize("method", [hf.hybrid(), hf.replay_only()], ids=["hybrid", "replay_only"])
def test_a_turn_that_is_replayed_makes_up_the_same_names(method: Any) -> None:
    @simulate(seeds=SEEDS, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        bearer = hf.child("bearer", hf.start(Bearer), recovery=method)
        ref = await system.start(bearer)
        assert await ref.ask(Greet()) == ["number 0", "number 1"]
        system.expect_crashes()
        ref.kill()
        assert await ref.ask(Greet()) == ["number 0", "number 1"]
        system = await simulation.crash_root()
        assert await (await system.start(bearer)).ask(Greet()) == ["number 0", "number 1"]

    run()
