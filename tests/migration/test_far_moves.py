"""An actor with a process of its own is moved to a supervisor in another process, and away from one."""

from __future__ import annotations

from typing import Any

import pytest

import holdfast as hf
from tests.migration.travellers import KINDS, Luggage, Stream, Traveller

IN_TIME = 60.0
WAYS = {"far to near": ("far", "near"), "near to far": ("near", "far"), "far to far": ("far", "other")}


def traveller(kind: str, isolation: Any) -> hf.ChildSpec:
    recovery = {} if KINDS[kind] is None else {"recovery": KINDS[kind]}
    return hf.child("one", hf.start(Traveller), isolation=isolation, mailbox=hf.bounded(100_000), **recovery)


def supervisors(kind: str, at: str, isolation: Any) -> list[hf.ChildSpec]:
    """`/app/near` in the root's process, `/app/far` and `/app/other` in processes; `one` is below `at`."""
    isolations: dict[str, Any] = {"near": "task", "far": "process", "other": "process"}
    return [
        hf.supervisor(
            name, children=[traveller(kind, isolation)] if name == at else [], isolation=place, intensity=1000
        )
        for name, place in isolations.items()
    ]


async def move(system: hf.ActorSystem, ref: Any, to: str) -> None:
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(ref, f"/app/{to}")


def pid_of(system: hf.ActorSystem, supervisor: str) -> int:
    return system.pid_of(system.ref(f"/app/{supervisor}", hf.Supervisor))


@pytest.fixture
async def system() -> Any:
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_it_goes_with_all_it_has(system: hf.ActorSystem, isolation: str, kind: str, way: str) -> None:
    old, new = WAYS[way]
    for spec in supervisors(kind, old, isolation):
        await system.start(spec)
    ref = system.ref(f"/app/{old}/one", Traveller)
    luggage, stream = Luggage(system, ref), Stream(ref)
    await luggage.pack()
    await stream.reached(20)
    own = system.pid_of(ref)
    for to in (new, old, new):
        await move(system, ref, to)
        assert ref.path == f"/app/{to}/one"
        assert system.pid_of(ref) == (own if isolation == "process" else pid_of(system, to))
        await stream.reached(20)
    await stream.stop()
    seen = await luggage.unpack()
    stream.judge(seen["added"])
    for name in ("near", "far", "other"):
        below = await system.ref(f"/app/{name}", hf.Supervisor).ask(hf.WhichChildren(), IN_TIME)
        assert [(one.id, one.state) for one in below] == ([("one", "running")] if name == new else [])
