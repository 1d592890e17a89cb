"""Properties of actors and their processes, measured from outside on real loops."""

import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import psutil
import pytest

import holdfast as hf
from holdfast.diagnosis import OBSERVATIONS, observer
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.observers import Bound, Limits, Manner, NodeObserver, Property, PropertyObserver
from holdfast.testing import Probe, Unexpected, probe

LONG = 20.0  # seconds that nothing here takes, unless something is wrong
QUICK = Manner(every=0.05, time_to_live=1.0)


class Grow(hf.Message):
    megabytes: int


class Open(hf.Message):
    files: int


class Burn(hf.Message):
    seconds: float


class Crash(hf.Message):
    pass


class Worker(hf.Actor):
    deterministic = False

    def __init__(self) -> None:
        self._kept: list[Any] = []

    @hf.on(Grow)
    def _grow(self, message: Grow) -> None:
        self._kept.append(b"x" * (message.megabytes << 20))

    @hf.on(Open)
    def _open(self, message: Open) -> None:
        self._kept += [Path("/dev/null").open() for _ in range(message.files)]  # noqa: SIM115

    @hf.on(Burn)
    def _burn(self, message: Burn) -> None:
        end = time.monotonic() + message.seconds
        while time.monotonic() < end:
            pass

    @hf.on(Crash)
    def _crash(self, message: Crash) -> None:
        raise RuntimeError("as told")

    def on_stop(self, reason: hf.ExitReason) -> None:
        for one in self._kept:
            getattr(one, "close", lambda: None)()


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, intensity=100) as running:
        yield running


async def said(heard: Probe, text: str) -> Observation:
    while True:
        found = await heard.fish(Observation, timeout=LONG)
        if str(found.literal) == text:
            return found


async def measured(system: hf.ActorSystem, *bounds: Bound) -> Probe:
    heard = probe(system)
    heard.subscribe(OBSERVATIONS)
    await system.start(observer("o", hf.start(PropertyObserver, {"w": bounds}, {"w": "/t/w"}, manner=QUICK)))
    return heard


async def test_what_the_process_of_an_actor_uses(system: hf.ActorSystem) -> None:
    # D25
    worker = await system.start(hf.child("w", hf.start(Worker), isolation="process"))
    process = psutil.Process((await system.get_status(worker)).pid)
    heard = await measured(
        system,
        Bound("ok(memory)", Property.MEMORY, Limits(high=process.memory_info().rss + (50 << 20))),
        Bound("ok(files)", Property.DESCRIPTORS, Limits(high=process.num_fds() + 20)),
    )
    await said(heard, "ok(memory)")
    await said(heard, "ok(files)")
    worker.tell(Grow(100))
    await said(heard, "not ok(memory)")
    worker.tell(Open(50))
    await said(heard, "not ok(files)")


async def test_a_process_that_computes_all_the_time_is_busy_and_late(system: hf.ActorSystem) -> None:
    worker = await system.start(hf.child("w", hf.start(Worker), isolation="process"))
    heard = await measured(system, Bound("ok(lag)", Property.LOOP_LAG, Limits(high=0.3)))
    await said(heard, "ok(lag)")
    worker.tell(Burn(1.0))
    await said(heard, "not ok(lag)")
    await said(heard, "ok(lag)")


async def test_messages_that_wait_for_an_actor(system: hf.ActorSystem) -> None:
    worker = await system.start(hf.child("w", hf.start(Worker)))
    heard = await measured(system, Bound("ok(queue)", Property.MAILBOX, Limits(high=10.0)))
    await said(heard, "ok(queue)")
    await system.suspend(worker)
    for _ in range(20):
        worker.tell(Grow(0))
    await said(heard, "not ok(queue)")
    await system.resume(worker)
    await said(heard, "ok(queue)")


async def test_turns_that_take_long(system: hf.ActorSystem) -> None:
    worker = await system.start(hf.child("w", hf.start(Worker)))
    heard = await measured(system, Bound("ok(turn)", Property.TURN, Limits(high=0.02)))
    for seconds, text in ((0.0, "ok(turn)"), (0.05, "not ok(turn)"), (0.0, "ok(turn)")):
        while True:
            worker.tell(Burn(seconds))
            try:
                seen = await heard.fish(Observation, timeout=0.1)
            except Unexpected:  # Not yet: another turn.
                continue
            if str(seen.literal) == text:
                break


async def test_restarts_are_counted(system: hf.ActorSystem) -> None:
    worker = await system.start(hf.child("w", hf.start(Worker)))
    heard = await measured(system, Bound("ok(restarts)", Property.RESTARTS, Limits(high=3.0)))
    await said(heard, "ok(restarts)")
    for _ in range(4):
        worker.tell(Crash())
    await said(heard, "not ok(restarts)")


async def test_of_an_actor_that_is_gone_nothing_is_known(system: hf.ActorSystem) -> None:
    # T50
    worker = await system.start(hf.child("w", hf.start(Worker)))
    heard = await measured(system, Bound("ok(queue)", Property.MAILBOX, Limits(high=10.0)))
    await said(heard, "ok(queue)")
    await system.stop(worker)
    while (taken_back := await heard.fish(Observation, timeout=LONG)).time_to_live > 0:
        pass
    assert str(taken_back.literal) == "ok(queue)"


async def test_an_actor_in_a_process_that_is_killed_is_not_running(system: hf.ActorSystem) -> None:
    # D20
    worker = await system.start(hf.child("w", hf.start(Worker), isolation="process", restart="temporary"))
    heard = probe(system)
    heard.subscribe(OBSERVATIONS)
    await system.start(observer("o", hf.start(NodeObserver, {"w": "/t/w"}, manner=QUICK)))
    await said(heard, "running(w)")
    psutil.Process((await system.get_status(worker)).pid).kill()
    await said(heard, "not running(w)")


async def test_an_actor_whose_process_does_not_answer_is_not_running(system: hf.ActorSystem) -> None:
    worker = await system.start(hf.child("w", hf.start(Worker), isolation="process"))
    heard = probe(system)
    heard.subscribe(OBSERVATIONS)
    await system.start(observer("o", hf.start(NodeObserver, {"w": "/t/w"}, hung_after=0.5, manner=QUICK)))
    await said(heard, "running(w)")
    worker.tell(Burn(1.5))
    await said(heard, "not running(w)")
    await said(heard, "running(w)")


@pytest.mark.parametrize("kind", [hf.start(NodeObserver, {}), hf.start(PropertyObserver, {}, {})])
async def test_who_can_see_only_its_own_process_is_refused_in_another(
    system: hf.ActorSystem, kind: hf.Start[Any]
) -> None:
    with pytest.raises(hf.StartFailed, match="own process"):
        await system.start(hf.child("o", kind, isolation="process"))
