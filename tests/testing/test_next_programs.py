"""Programs in turn on one virtual clock: the next one goes on at the time that it is, and its waits know that."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, Simulation, advance, simulate

Systems = Callable[..., Awaitable[GuardedSystem]]
VIRTUAL = pytest.mark.asyncio(loop_factories=["virtual"])
WAIT, UP = 1000.0, 500.0
CASES = [(how, down) for how in ("sleep", "until", "wait", "timer") for down in (0.0, 400.0, 2000.0)]


class Go(hf.Message):
    how: str


class Fire(hf.Message): ...


class Seen(hf.Message[list[float]]): ...


class Never(hf.Message): ...


class Now(hf.Message[float]): ...


class Sleeper(hf.Actor):
    def __init__(self) -> None:
        self.seen: list[float] = []

    @hf.on(Go)
    async def go(self, message: Go) -> None:
        self.seen.append(self.ctx.now())
        match message.how:
            case "sleep":
                await self.ctx.sleep(WAIT)
            case "until":
                await self.ctx.sleep_until(self.ctx.now() + WAIT)
            case "wait":
                with contextlib.suppress(hf.errors.WaitTimeout):
                    await self.ctx.wait_for(Never, timeout=WAIT)
            case _:
                self.ctx.tell_after(WAIT, Fire())
                return
        self.seen.append(self.ctx.now())

    @hf.on(Fire)
    def fire(self, message: Fire) -> None:
        self.seen.append(self.ctx.now())

    @hf.on(Never)
    def never(self, message: Never) -> None: ...

    @hf.on(Seen, readonly=True)
    def see(self, message: Seen) -> list[float]:
        return self.seen

    @hf.on(Now, readonly=True)
    def now(self, message: Now) -> float:
        return self.ctx.now()


def sleeper(**options: Any) -> hf.ChildSpec[Sleeper]:
    return hf.child("sleeper", hf.start(Sleeper), **options)


RECORDED = sleeper(recovery=hf.hybrid(interval=86_400.0))


async def ends_as_it_should(first: hf.ActorRef[Sleeper], began: float, down: float) -> None:
    """The wait is over when its time is, or at once if that has passed while the program was down."""
    while len(await first.ask(Seen())) == 1:
        await asyncio.sleep(1.0)
    took = asyncio.get_running_loop().time() - began
    assert took == pytest.approx(max(WAIT, UP + down), abs=5.0)
    before, after = await first.ask(Seen())
    assert after - before == pytest.approx(took, abs=5.0)


@pytest.mark.parametrize(("how", "down"), CASES)
@VIRTUAL
async def test_a_wait_goes_on_in_the_next_program(
    actor_systems: Systems, tmp_path: Path, how: str, down: float
) -> None:
    began, store = asyncio.get_running_loop().time(), f"sqlite:{tmp_path}/app.db"
    system = await actor_systems(store=store)
    await (await system.start(RECORDED)).send(Go(how))
    await advance(UP)
    await system.shutdown()
    await asyncio.sleep(down)
    system = await actor_systems(store=store)
    await ends_as_it_should(await system.start(RECORDED), began, down)


@pytest.mark.parametrize(("how", "down"), CASES)
def test_so_it_does_when_its_program_is_killed_in_a_simulation(how: str, down: float) -> None:
    @simulate(seeds=2, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        began = asyncio.get_running_loop().time()
        await (await system.start(RECORDED)).send(Go(how))
        await asyncio.sleep(UP)
        system = await simulation.crash_root()
        await asyncio.sleep(down)
        await ends_as_it_should(await system.start(RECORDED), began, down)

    run()


async def clocks_agree(actor_systems: Systems) -> None:
    """`ctx.now()`, histories and what is known of lives are of one time in all systems of a loop."""
    began, loop = time.time(), asyncio.get_running_loop()
    start = loop.time()
    systems = [await actor_systems("one")]
    for name in ("two", "three"):
        await asyncio.sleep(5_400.0)
        systems.append(await actor_systems(name))
    refs = [await system.start(sleeper()) for system in systems]
    now = [await ref.ask(Now()) for ref in refs]
    assert now == pytest.approx([began + loop.time() - start] * 3, abs=60.0)
    assert now == pytest.approx(now[:1] * 3, abs=1e-3)
    for system, ref in zip(systems, refs, strict=True):
        assert system.history(ref).events[-1].at == pytest.approx(now[0], abs=1.0)


@VIRTUAL
async def test_all_systems_of_a_loop_have_one_time(actor_systems: Systems) -> None:
    await clocks_agree(actor_systems)


@VIRTUAL
async def test_the_loop_of_the_next_test_begins_anew(actor_systems: Systems) -> None:
    assert asyncio.get_running_loop().time() < 60.0
    await clocks_agree(actor_systems)
