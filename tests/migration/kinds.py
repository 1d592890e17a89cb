"""Supervisors of every kind, each with recorded actors below it, and what must be true of them after any move."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import holdfast as hf
from tests.migration.far_places import IN_TIME, Pump
from tests.migration.travellers import KINDS, Add, Seen, Traveller
from tests.migration.ways import below, isolation_for, plant, team_of


def leaf(name: str | None, **options: Any) -> hf.ChildSpec:
    return hf.child(name, hf.start(Traveller), recovery=KINDS["recorded"], **options)


class Visits(hf.Message[int]):
    """How often it was asked."""


class Own(hf.Supervisor):
    """Says itself with which children it begins, and has a state of its own."""

    def __init__(self, first: int) -> None:
        self.visits = first
        self.children: list[hf.ActorRef[Any]] = []

    def init(self) -> hf.Plan:
        return hf.Plan([leaf("one"), leaf("two", isolation="process")], intensity=99)

    @hf.on(Visits)
    def visit(self, message: Visits) -> int:
        self.visits += 1
        self.children = [self.ctx.find(f"{self.ctx.path}/one", Traveller)]
        return self.visits


SPECS: dict[str, Any] = {
    "own": lambda isolation: hf.child("team", hf.start(Own, 10), isolation=isolation),
    "pool": lambda isolation: over(hf.supervision.pool("below", leaf(None), 2, intensity=99), isolation),
    "partitions": lambda isolation: hf.supervision.partitions("team", leaf(None), 3, intensity=99, isolation=isolation),
    "template": lambda isolation: hf.dynamic(
        "team", template=leaf(None), journal=True, intensity=99, isolation=isolation
    ),
    "journal": lambda isolation: over(hf.dynamic("below", journal=True, intensity=99), isolation),
    "jobs": lambda isolation: hf.supervision.tasks("team", isolation=isolation, intensity=99),
    "stopped": lambda isolation: over(
        hf.supervisor("below", children=[leaf("one"), leaf("no", autostart=False), leaf("two")], intensity=99),
        isolation,
    ),
}
"""Each as `team`, by where it lives."""


def over(spec: hf.ChildSpec, isolation: Any) -> hf.ChildSpec:
    """It is below another one, which begins anew too."""
    no = hf.child("off", hf.start(Traveller), autostart=False)
    return hf.supervisor("team", children=[no, spec], isolation=isolation, intensity=99)


async def plant_kind(system: hf.ActorSystem, kind: str, way: str, old: str, new: str) -> None:
    """Have it be there, with the children that are started by request."""
    await plant(system, old, SPECS[kind](isolation_for(way)), old, new)
    if kind == "template":
        for _ in range(2):
            await team_of(system).ask(hf.StartChild(), IN_TIME)
    elif kind in ("journal", "jobs"):
        above = f"{team_of(system).path}/below" if kind == "journal" else team_of(system).path
        await system.ref(above, hf.Supervisor).ask(hf.StartChild(leaf("one")), IN_TIME)


def leaves(system: hf.ActorSystem) -> list[str]:
    """The addresses of the recorded actors below it, from it on."""
    top = f"{team_of(system).path}/"
    found = [path.removeprefix(top) for path in system.tree() if path.startswith(top)]
    return [name for name in found if name not in ("below", "below/router")]


async def shape(system: hf.ActorSystem, at: str, homes: tuple[str, ...]) -> dict[str, Any]:
    """Who is below whom, and what each is in."""
    told = {name: await below(system, f"/app/{name}") for name in homes}
    told = {name: children for name, children in told.items() if children}
    assert list(told) == [at]
    found: dict[str, Any] = {"team": await below(system, f"/app/{at}/team")}
    if any(name == "below" for name, _ in found["team"]):
        found["below"] = await below(system, f"/app/{at}/team/below")
    return found


async def is_as_before(system: hf.ActorSystem, at: str, homes: tuple[str, ...], before: dict[str, Any]) -> None:
    """All of it is there and nothing of it elsewhere, in the end."""
    last: Any = None
    try:
        async with asyncio.timeout(IN_TIME):
            while last != before:
                with contextlib.suppress(hf.errors.NoSuchActor, hf.ActorStopped, hf.AskFailed, AssertionError):
                    last = await shape(system, at, homes)
                await asyncio.sleep(0.005)
    except TimeoutError:
        raise AssertionError(f"{last} is not {before}") from None


class Clients:
    """Whoever sends to it: to each actor below it, or to the pool."""

    def __init__(self, system: hf.ActorSystem, kind: str) -> None:
        self._system, self._kind = system, kind
        self.refs = {name: system.ref(f"{team_of(system).path}/{name}", Traveller) for name in leaves(system)}
        self._pumps = [] if kind == "pool" else [Pump(ref) for ref in self.refs.values()]
        self._spread: set[int] = set()  # what the pool has answered
        self._sent, self._is_over = 0, False
        self._pool = (
            hf.supervision.pool_of(system, f"{team_of(system).path}/below", Traveller) if kind == "pool" else None
        )
        self._task = asyncio.create_task(self._spread_all())

    async def _spread_all(self) -> None:
        while self._pool is not None and not self._is_over:
            self._sent += 1
            number = self._sent
            with contextlib.suppress(hf.AskFailed, hf.ActorStopped):  # The router is not recorded.
                await self._pool.ask(Add(number), IN_TIME)
                self._spread.add(number)
            await asyncio.sleep(0)

    async def reached(self, more: int) -> None:
        for pump in self._pumps:
            await pump.reached(more)
        wanted = len(self._spread) + more
        async with asyncio.timeout(IN_TIME):
            while self._pool is not None and len(self._spread) < wanted and not self._task.done():
                await asyncio.sleep(0)

    async def judge(self) -> None:
        """Nothing that was answered is lost, or was done twice."""
        self._is_over = True
        await self._task
        for pump in self._pumps:
            await pump.judge()
        if self._pool is None:
            return
        added: list[int] = []
        for ref in self.refs.values():
            added += (await ref.ask(Seen(), IN_TIME))["added"]
        assert self._spread <= set(added)
        assert len(added) == len(set(added))
