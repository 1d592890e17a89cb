"""An actor with a process of its own is moved to a supervisor in another process, and away from one."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import random
import signal
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.migration.travellers import KINDS, TOLD, Add, Luggage, Seen, Stream, Traveller
from tests.system.test_transaction_commit import Die

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


class Pump:
    """Tells, and asks one after another. There may be thousands: each answer must be the sum of what stands before it."""

    def __init__(self, ref: Any) -> None:
        self._ref, self._is_over = ref, False
        self.answers: list[int] = []
        self._task = asyncio.create_task(self._send())

    async def _send(self) -> None:
        while not self._is_over:
            self._ref.tell(Add(TOLD + len(self.answers)))
            self.answers.append(await self._ref.ask(Add(1 + len(self.answers)), IN_TIME))

    async def reached(self, more: int) -> None:
        wanted = len(self.answers) + more
        while len(self.answers) < wanted and not self._task.done():
            await asyncio.sleep(0)

    async def judge(self) -> None:
        self._is_over = True
        await self._task
        added, count = (await self._ref.ask(Seen(), IN_TIME))["added"], len(self.answers)
        assert added == [n for number in range(count) for n in (TOLD + number, 1 + number)]
        assert self.answers == list(itertools.accumulate(added))[1::2]


async def is_at_one_place(system: hf.ActorSystem, ref: Any) -> None:
    """Its address, and what the supervisors say in the end, agree."""
    async with asyncio.timeout(IN_TIME):
        while True:
            told = [
                f"/app/{name}/{one.id}"
                for name in ("near", "far", "other")
                for one in await system.ref(f"/app/{name}", hf.Supervisor).ask(hf.WhichChildren(), IN_TIME)
                if one.state == "running"
            ]
            if told == [ref.path]:
                return


@pytest.mark.pairs
@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("victim", ["old", "new", "own"])
@pytest.mark.parametrize("seed", range(6))
async def test_a_process_that_is_killed_at_any_instant_loses_nothing(
    system: hf.ActorSystem, seed: int, victim: str, isolation: str, way: str
) -> None:
    old, new = WAYS[way]
    for spec in supervisors("recorded", old, isolation):
        await system.start(spec)
    ref = system.ref(f"/app/{old}/one", Traveller)
    pump = Pump(ref)
    await pump.reached(10)
    moving = asyncio.ensure_future(move(system, ref, new))
    struck = system.node.loop.time() + random.Random(seed).random() * 0.3
    while not moving.done() and system.node.loop.time() < struck:
        await asyncio.sleep(0)
    with contextlib.suppress(hf.NoSuchActor, ProcessLookupError):  # It lives nowhere just now.
        pid = system.pid_of(ref) if victim == "own" else pid_of(system, {"old": old, "new": new}[victim])
        if pid != os.getpid():
            os.kill(pid, signal.SIGKILL)
    try:
        await moving
    except (hf.TransactionFailed, hf.TransactionRefused):
        await pump.reached(5)
        await move(system, ref, new)
    await pump.reached(10)
    await pump.judge()
    assert ref.path == f"/app/{new}/one"
    await is_at_one_place(system, ref)


@asynccontextmanager
async def program(store: str, old: str, isolation: str) -> AsyncGenerator[hf.ActorSystem]:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", durability="os", log=False, intensity=99) as system:
        for spec in supervisors("recorded", old, isolation):
            await system.start(spec)
        yield system


async def killed(store: str, when: str, old: str, new: str, isolation: str) -> None:
    """The root is killed by a step in the middle of the move."""
    async with program(store, old, isolation) as system:
        ref = system.ref(f"/app/{old}/one", Traveller)
        await ref.ask(Add(7))
        async with system.transaction(timeout=IN_TIME) as change:
            if when == "finish":
                change.step(Die(when))
            change.move(ref, f"/app/{new}")
            change.step(Die("finish" if when == "settled" else when))


PROGRAM = """
import asyncio, sys
from tests.migration.test_far_moves import killed

if __name__ == "__main__":
    asyncio.run(killed(*sys.argv[1:]))
"""


@pytest.mark.pairs
@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("when", ["prepare", "commit", "finish", "settled"])
async def test_a_root_that_is_killed_has_it_at_one_of_the_two(
    tmp_path: Path, when: str, isolation: str, way: str
) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    old, new = WAYS[way]
    here = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))}
    arguments = (str(tmp_path / "program.py"), str(tmp_path / "store"), when, old, new, isolation)
    process = await asyncio.create_subprocess_exec(sys.executable, *arguments, env=environment)
    assert await asyncio.wait_for(process.wait(), IN_TIME) == -signal.SIGKILL
    async with program(str(tmp_path / "store"), old, isolation) as system:
        at = new if when in ("finish", "settled") else old
        ref = system.ref(f"/app/{at}/one", Traveller)
        assert await ref.ask(Add(1), IN_TIME) == 8
        await is_at_one_place(system, ref)
        assert (system.pid_of(ref) == pid_of(system, at)) == (isolation == "task")
        if at != old:  # Who knows only the address of before reaches it.
            assert await system.ref(f"/app/{old}/one", Traveller).ask(Add(1), IN_TIME) == 9
