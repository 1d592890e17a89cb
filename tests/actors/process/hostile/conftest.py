"""One world for all hostile workers: a supervisor with one of them, and with others who must not suffer."""

from __future__ import annotations

import resource
from collections.abc import AsyncIterator

import pytest

import holdfast as hf
from tests.actors.process.hostile.players import Add, Evil, Ping, Senders, Victim, Write
from tests.actors.process.waiting import next_event

MEMORY_BYTES = 600 * 1024 * 1024
"""What the root may take more, at the most, for a frame of 16 MiB, whatever is in it."""


class World:
    """What the tests do with it, and the judge."""

    def __init__(self, system: hf.ActorSystem) -> None:
        self.system = system
        self.evil = system.ref("/app/sup/evil", Evil)
        self.victims = [system.ref(f"/app/sup/{name}", Victim) for name in ("victim", "other", "recorded")]
        self.totals = [0] * len(self.victims)
        self.pids = self._pids()
        self.memory = _peak()

    def _pids(self) -> list[int]:
        return [self.system.pid_of(victim) for victim in self.victims]

    def trying(self, name: str) -> None:
        """What is tried now; shown if it fails."""
        print(f"hostile worker: {name}")

    async def work(self) -> None:
        """All others do what they always do."""
        for at, victim in enumerate(self.victims):
            self.totals[at] += 1
            assert await victim.ask(Add(), timeout=60) == self.totals[at]

    async def write(self, data: bytes) -> None:
        """Have the worker write this."""
        self.evil.tell(Write(data))

    async def breached(self, events: hf.events.EventStream) -> hf.events.TrustBreached:
        """The worker is ended, it is told why, and its supervisor starts it again."""
        breach = await next_event(events, hf.events.TrustBreached)
        assert breach.address == "/app/sup/evil"
        assert breach.problem
        died = await next_event(events, hf.events.ProcessDied)
        assert (died.address, died.pid) == ("/app/sup/evil", breach.pid)
        assert died.reason == hf.TrustBreach(breach.problem)
        await next_event(events, hf.events.ActorStarted, lambda event: event.address == "/app/sup/evil")
        return breach

    async def judge(self) -> None:
        """The root is there, and nobody else has felt anything."""
        await self.work()
        assert await self.evil.ask(Ping(), timeout=60) == 1
        assert self._pids() == self.pids
        tree = {path for path in self.system.tree() if not path.startswith("/app/recovery")}
        assert tree <= {"/app", "/app/sup", "/app/sup/evil", *(victim.path for victim in self.victims)}
        for victim in self.victims:
            assert set(await victim.ask(Senders(), timeout=60)) == {""}
        assert _peak() - self.memory < MEMORY_BYTES


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@pytest.fixture
async def world() -> AsyncIterator[World]:
    children = [
        hf.child("victim", hf.start(Victim)),
        hf.child("other", hf.start(Victim), isolation="process"),
        hf.child("recorded", hf.start(Victim), isolation="process", recovery=hf.hybrid()),
        hf.child("evil", hf.start(Evil), isolation="process"),
    ]
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.supervisor("sup", intensity=10_000, period=1.0, children=children))
        made = World(system)
        await made.work()
        yield made
