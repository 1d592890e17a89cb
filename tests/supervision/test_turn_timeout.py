"""A class says how long its turns may take, and whoever waits for too long crashes, wherever it lives."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any, ClassVar

import pytest
import pytest_asyncio

import holdfast as hf


class Wait(hf.Message[int]):
    """Wait for so many seconds; 0: for ever."""

    seconds: float = 0.0


class Swallow(hf.Message[int]):
    """Wait for ever, and go on waiting for long when that is cancelled."""


class Rest(hf.Message[int]):
    """Rest for so many seconds, as a turn that outlives its process does."""

    seconds: float


class Count(hf.Message[int]):
    """Count one more."""


@pytest_asyncio.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("app", log=False) as system:
        yield system


class Waiter(hf.Actor):
    turn_timeout: ClassVar[float | None] = 1.0

    def __init__(self) -> None:
        self.count = 0

    @hf.on(Count)
    def counted(self, message: Count) -> int:
        self.count += 1
        return self.count

    @hf.on(Wait)
    async def wait(self, message: Wait) -> int:
        if message.seconds:
            await asyncio.sleep(message.seconds)
        else:
            await asyncio.get_running_loop().create_future()
        return self.count

    @hf.on(Swallow)
    async def swallow(self, message: Swallow) -> int:
        try:
            await asyncio.get_running_loop().create_future()
        except asyncio.CancelledError:
            await asyncio.sleep(60)
        return -1

    @hf.on(Rest)
    async def rest(self, message: Rest) -> int:
        await self.ctx.sleep(message.seconds)
        return self.count


class Quick(Waiter):
    turn_timeout = 0.2


def spec(kind: type[Waiter], **options: Any) -> hf.ChildSpec[Waiter]:
    return hf.child("waiter", hf.start(kind), **options)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_turn_that_waits_for_too_long_crashes_its_actor_to_the_instant() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        with system.events() as events:
            ref = await system.start(spec(Waiter))
            await asyncio.sleep(0.7)  # The turn begins between two looks.
            begun = asyncio.get_running_loop().time()
            with pytest.raises(hf.errors.RemoteCrash, match=r"in the turn of .*Wait for 1 s") as failed:
                await ref.ask(Wait(), timeout=30)
            assert failed.value.type_name == "holdfast.actors.errors.TurnTimeout"
            assert asyncio.get_running_loop().time() - begun == pytest.approx(1.0)
            (crash,) = (one.reason for one in events.take() if isinstance(one, hf.events.ActorCrashed))
            assert isinstance(crash, hf.Crash)
            assert "create_future()" in crash.traceback  # It says where the turn has waited.
            assert await ref.ask(Wait(0.9)) == 0  # the next life, and it is as patient


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_turn_that_swallows_its_cancellation_is_abandoned() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        with system.events() as events:
            ref = await system.start(spec(Waiter))
            with pytest.raises(hf.errors.RemoteCrash, match="turn_timeout"):
                await ref.ask(Swallow(), timeout=30)
            assert await ref.ask(Count()) == 1
            await asyncio.sleep(60)
            assert [one.address for one in events.take() if isinstance(one, hf.events.LifeAbandoned)] == ["/app/waiter"]


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_starts_and_ends_have_limits_of_their_own() -> None:
    class Slow(Waiter):
        ended: ClassVar[list[float]] = []

        async def on_start(self, restored: bool) -> None:
            await asyncio.sleep(3)

        async def on_stop(self, reason: hf.ExitReason) -> None:
            await asyncio.sleep(3)
            self.ended.append(asyncio.get_running_loop().time())

    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(spec(Slow))
        assert await ref.ask(Count()) == 1
    assert len(Slow.ended) == 1


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_turn_that_rests_is_not_at_work() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(spec(Waiter, recovery=hf.hybrid()))
        assert await ref.ask(Rest(1000.0), timeout=2000) == 0


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_life_that_has_ended_is_not_watched_any_more() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(spec(Waiter))
        await system.ref("/app").ask(hf.RestartChild("waiter", running=True))
        assert await ref.ask(Wait(0.9)) == 0
        assert await ref.ask(Count()) == 1


class Patient(Waiter):
    turn_timeout = None


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("before", [Patient, Waiter])
async def test_other_code_says_its_own(before: type[Waiter]) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(spec(before))
        for kind, seconds in ((Quick, 0.2), (Waiter, 1.0), (Patient, 0.0)):
            async with system.transaction() as change:
                change.replace_code(ref, kind)
            begun = asyncio.get_running_loop().time()
            if seconds:
                with pytest.raises(hf.errors.RemoteCrash, match="turn_timeout"):
                    await ref.ask(Wait(), timeout=30)
                assert asyncio.get_running_loop().time() - begun == pytest.approx(seconds, abs=0.01)
            else:
                assert await ref.ask(Wait(100.0), timeout=200) == 0


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_wherever_it_lives(system: hf.ActorSystem, isolation: Any, recovery: Any) -> None:
    ref = await system.start(spec(Quick, isolation=isolation, recovery=recovery))
    assert await ref.ask(Count()) == 1
    with pytest.raises(hf.errors.RemoteCrash, match="turn_timeout"):
        await ref.ask(Wait(), timeout=30)
    assert await ref.ask(Count()) == (1 if recovery is None else 2)


async def test_below_a_supervisor_in_a_process(system: hf.ActorSystem) -> None:
    await system.start(hf.supervisor("branch", children=[spec(Quick)], isolation="process"))
    ref = system.ref("/app/branch/waiter", Quick)
    with pytest.raises(hf.errors.RemoteCrash, match="turn_timeout"):
        await ref.ask(Wait(), timeout=30)
    assert await ref.ask(Count(), timeout=30) == 1


async def test_behind_a_mechanism_another_replica_takes_the_turn(system: hf.ActorSystem) -> None:
    with system.events() as events:
        ref = await system.start(spec(Quick, mechanism=hf.ftm.PBR(detection=hf.ftm.Detection(interval=0.02))))
        assert await ref.ask(Count()) == 1
        with pytest.raises(hf.errors.Quarantined):
            await ref.ask(Wait(), timeout=60)
        assert await ref.ask(Count(), timeout=60) == 2
        assert any(isinstance(one, hf.events.TurnHung) for one in events.take())


def test_what_is_no_time_limit_is_refused() -> None:
    for wrong in (0, -1.0, True, "5"):
        with pytest.raises(TypeError, match="turn_timeout must be seconds > 0 or None"):
            type("Wrong", (hf.Actor,), {"turn_timeout": wrong})
    with pytest.raises(TypeError, match="a supervisor has none"):
        type("Boss", (hf.Supervisor,), {"turn_timeout": 1.0})
