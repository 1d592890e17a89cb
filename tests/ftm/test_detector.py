"""The failure detector: silence is judged by what heartbeats did before, and the observer's own lag is taken out."""

from __future__ import annotations

import asyncio
import os
import random
import subprocess
import sys
import time
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import holdfast as hf
from holdfast.actors.kernel.actor import Start
from holdfast.actors.observer_clock import OwnClock
from holdfast.ftm.bricks.replica_orders import ReplicaBeat
from holdfast.ftm.group.detector import HIGHEST, Accrual, Detector
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tmr import TMR
from holdfast.ftm.mechanisms.tr import TR
from holdfast.ftm.model.detection import Detection
from tests.ftm.accounts import Add, Counter
from tests.ftm.test_failover import group_of, pid_of, two_again

DETECTION = Detection(interval=0.05, threshold=8.0, pause=0.2, spread=0.01)


def silence(accrual: Accrual, since: float) -> float:
    """Seconds of silence after which it is suspected."""
    late = 0.0
    while not accrual.is_suspect(since + late):
        late += 0.001
    return late


def after(gaps: list[float]) -> tuple[Accrual, float]:
    now = 0.0
    accrual = Accrual(DETECTION, now)
    for gap in gaps:
        now += gap
        accrual.heard(now)
    return accrual, now


def test_a_silent_replica_is_suspected_soon_and_a_beating_one_never() -> None:
    accrual, now = after([0.05] * 100)
    assert not any(accrual.is_suspect(now + late / 1000) for late in range(250))
    assert 0.25 < silence(accrual, now) < 0.35


def test_more_is_put_up_with_from_a_replica_whose_heartbeats_vary() -> None:
    rng = random.Random(7)
    even, at = after([0.05] * 200)
    uneven, when = after([rng.uniform(0.01, 0.25) for _ in range(200)])
    assert silence(uneven, when) > silence(even, at) + 0.2


def test_old_heartbeats_are_forgotten() -> None:
    calm, now = after([0.4] * 300 + [0.05] * 300)
    assert silence(calm, now) < 0.35


def test_phi_has_an_end() -> None:
    accrual, now = after([0.05] * 10)
    assert accrual.phi(now + 1e6) == HIGHEST


@given(st.lists(st.floats(0.0, 5.0), min_size=1, max_size=300), st.floats(0.0, 3.0), st.floats(0.0, 3.0))
def test_phi_only_grows_with_silence(gaps: list[float], first: float, more: float) -> None:
    accrual, now = after(gaps)
    assert accrual.phi(now + first) <= accrual.phi(now + first + more)


@given(st.lists(st.floats(0.0, 10.0), max_size=50))
def test_the_own_clock_takes_out_just_what_the_observer_was_late(waits: list[float]) -> None:
    period, now = 0.025, 0.0
    clock = OwnClock(now, period)
    for wait in waits:
        now += wait
        own = clock.tick(now)
        assert own + clock.lag == pytest.approx(now)
    assert clock.at(now) <= clock.at(now + 100.0) <= clock.at(now) + period


@pytest.mark.parametrize(
    "wrong", [{"interval": 0.0}, {"threshold": -1.0}, {"pause": float("nan")}, {"spread": True}, {"interval": "1"}]
)
def test_settings_that_cannot_be_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(hf.SpecError, match=next(iter(wrong))):
        Detection(**wrong)  # type: ignore[arg-type]


class Watched:
    """What a detector knows of two replicas: stands in for a group, which needs processes."""

    def __init__(self) -> None:
        self.detection = DETECTION
        self.up: dict[str, int] = {}
        self.lives = {"r1": 1, "r2": 1}
        self.starving = {"r1": 0.0, "r2": 0.0}
        self.working = {"r1": 0.0, "r2": 0.0}
        self.suspects: list[tuple[str, int, float]] = []
        self.loop = asyncio.get_running_loop()

    def place(self, name: str) -> str:
        return f"/app/{name}"

    def life_of(self, name: str) -> int:
        return self.lives[name]

    def heard(self, name: str, life: int) -> None:
        self.up[name] = life

    def watched(self) -> list[tuple[str, int]]:
        known = {(name, life) for name, life, _ in self.suspects}
        return [one for one in self.up.items() if one not in known]

    def starved(self, name: str) -> float:
        return self.starving[name]

    def at_work(self, name: str) -> float:
        return self.working[name]

    def silent(self, name: str, life: int, why: str) -> None:
        self.suspects.append((name, life, self.loop.time()))


class Speak(hf.Message[None]):
    name: str


class Voice(hf.Actor):
    """Says that a replica is alive."""

    def __init__(self, detector: hf.ActorRef[Detector]) -> None:
        self._detector = detector

    @hf.on(Speak)
    def speak(self, message: Speak) -> None:
        self._detector.tell(ReplicaBeat(message.name, 1))


async def voices(system: hf.ActorSystem, detector: hf.ActorRef[Detector]) -> list[hf.ActorRef[Voice]]:
    return [await system.start(hf.child(name, hf.start(Voice, detector))) for name in ("r1", "r2")]


async def test_nobody_beats_for_another_one() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        watched = Watched()
        detector = system.spawn(Start(Detector, (watched,)))
        _, r2 = await voices(system, detector)
        detector.tell(ReplicaBeat("r1", 1))
        await r2.ask(Speak("r1"))
        await r2.ask(Speak("r2"))
        async with asyncio.timeout(10):
            while "r2" not in watched.up:
                await asyncio.sleep(0)
        assert watched.up == {"r2": 1}
        await system.stop(detector)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_who_falls_silent_is_suspected_and_the_other_is_not() -> None:
    """A55, A56."""
    async with hf.ActorSystem("app", log=False) as system:
        watched = Watched()
        detector = system.spawn(Start(Detector, (watched,)))
        r1, r2 = await voices(system, detector)
        for beat in range(100):
            r1.tell(Speak("r1"))
            if beat < 50:
                r2.tell(Speak("r2"))
            await asyncio.sleep(DETECTION.interval)
        assert [name for name, _, _ in watched.suspects] == ["r2"]
        assert watched.suspects[0][2] - 0.0 > 2.4
        await system.stop(detector)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_new_life_of_a_suspect_is_judged_anew() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        watched = Watched()
        detector = system.spawn(Start(Detector, (watched,)))
        r1, _ = await voices(system, detector)
        r1.tell(Speak("r1"))
        await asyncio.sleep(2.0)
        assert [one[:2] for one in watched.suspects] == [("r1", 1)]
        watched.lives["r1"] = 2
        r1.tell(Speak("r1"))
        await asyncio.sleep(0.1)
        assert len(watched.suspects) == 1
        await asyncio.sleep(2.0)
        assert [one[:2] for one in watched.suspects] == [("r1", 1), ("r1", 2)]
        await system.stop(detector)


async def test_an_observer_that_was_held_up_suspects_nobody() -> None:
    """T3."""
    async with hf.ActorSystem("app", log=False) as system:
        watched = Watched()
        detector = system.spawn(Start(Detector, (watched,)))
        r1, _ = await voices(system, detector)
        loop = asyncio.get_running_loop()
        for _ in range(10):
            r1.tell(Speak("r1"))
            await asyncio.sleep(DETECTION.interval)
        end = loop.time() + 1.0
        while loop.time() < end:  # Nothing else runs in this process meanwhile: no beat can be heard.
            pass
        r1.tell(Speak("r1"))
        for _ in range(4):
            await asyncio.sleep(DETECTION.interval)
            r1.tell(Speak("r1"))
        assert watched.suspects == []
        await system.stop(detector)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_replica_without_a_processor_is_not_suspected_until_it_had_one_and_said_nothing() -> None:
    """T3."""
    async with hf.ActorSystem("app", log=False) as system:
        watched = Watched()
        watched.starving["r1"] = watched.starving["r2"] = 5.0  # Of the time before: no excuse.
        detector = system.spawn(Start(Detector, (watched,)))
        for voice, name in zip(await voices(system, detector), ("r1", "r2"), strict=True):
            voice.tell(Speak(name))
        await asyncio.sleep(DETECTION.interval)
        for _ in range(40):
            watched.starving["r1"] += DETECTION.interval
            await asyncio.sleep(DETECTION.interval)
        assert [name for name, _, _ in watched.suspects] == ["r2"]
        await asyncio.sleep(1.0)
        assert [name for name, _, _ in watched.suspects] == ["r2", "r1"]
        await system.stop(detector)


async def test_what_a_replica_waits_for_a_processor_is_read_of_its_process(system: hf.ActorSystem) -> None:
    """T3: one that shares a processor with a busy process has waited."""
    ref = await system.start(hf.child("one", hf.start(Counter), mechanism=PBR()))
    await two_again(ref)
    group, name = group_of(ref), "r1"
    pid = pid_of(system, ref, name)
    processor = min(os.sched_getaffinity(pid))
    before = group.replicas.starved(name)
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        for one in (pid, busy.pid):
            os.sched_setaffinity(one, {processor})
        async with asyncio.timeout(60):
            while group.replicas.starved(name) == before:
                await asyncio.sleep(0.005)  # It beats, and has to wait for that.
    finally:
        busy.kill()
        busy.wait()


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_replica_at_work_on_its_state_is_suspected_when_that_should_be_over() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        watched = Watched()
        watched.working["r1"] = 2.0
        detector = system.spawn(Start(Detector, (watched,)))
        for voice, name in zip(await voices(system, detector), ("r1", "r2"), strict=True):
            voice.tell(Speak(name))
        await asyncio.sleep(2.0)
        assert [name for name, _, _ in watched.suspects] == ["r2"]
        await asyncio.sleep(2.0)
        assert [name for name, _, _ in watched.suspects] == ["r2", "r1"]
        await system.stop(detector)


class Bulky(Counter):
    """Takes long to say what it has."""

    def __init__(self) -> None:
        super().__init__()
        self.bulk = b"x" * 60_000_000

    def get_state(self) -> Any:
        end = time.process_time() + 1.2
        while time.process_time() < end:
            pass
        return self.total, self.tags, self.bulk

    def set_state(self, state: Any) -> None:
        self.total, self.tags, self.bulk = state


async def test_a_replica_that_goes_through_a_large_state_is_not_suspected(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("one", hf.start(Bulky), mechanism=PBR()))
    await two_again(ref)
    group = group_of(ref)
    assert [await ref.ask(Add(tag), timeout=60) for tag in range(3)] == [1, 2, 3]
    await two_again(ref)
    assert (group.replicas.wrong, group.failovers, group.membership.members) == (0, 0, {"r1": 1, "r2": 1})


QUICK, QUICKER = Detection(pause=0.2), Detection(pause=0.1)


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_the_outermost_mechanism_that_says_how_is_heard() -> None:
    """Also one that another stands around, and one that has come later."""
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=TR(detection=QUICKER)))
        host: Any = ref._cell.host.place
        assert host.group.replicas.detection == QUICKER
        for layers, said in (
            ((PBR(detection=QUICK), TR(detection=QUICKER)), QUICK),
            ((PBR(), TR(detection=QUICKER)), QUICKER),
            ((PBR(), TR()), Detection()),
        ):
            async with system.transaction(timeout=30) as change:
                change.protect(ref, layers)
            assert host.group.replicas.detection == said


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_killed_detector_suspects_nobody_any_more() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        watched = Watched()
        detector = system.spawn(Start(Detector, (watched,)))
        r1, _ = await voices(system, detector)
        r1.tell(Speak("r1"))
        await asyncio.sleep(0.1)
        detector._cell.kill()
        await asyncio.sleep(10.0)
        assert watched.suspects == []


async def test_a_new_replica_is_not_judged_by_an_earlier_one_of_its_name(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("one", hf.start(Counter), mechanism=TMR()))
    await two_again(ref)
    group = group_of(ref)
    (gone,) = {"r2", "r3"} - set(adapted_to := (await changed(system, ref, PBR())))
    assert len(adapted_to) == 2
    detector = group.replicas.cell_of("detector")
    assert detector is not None
    assert isinstance(detector.actor, Detector)
    before = detector.actor._known[gone, 1]
    assert gone in await changed(system, ref, TMR())
    assert detector.actor._known[gone, 1] is not before


async def changed(system: hf.ActorSystem, ref: hf.ActorRef[Counter], mechanism: hf.ftm.Mechanism) -> tuple[str, ...]:
    """The replicas that there are with another mechanism, when all are there."""
    async with system.transaction(timeout=120) as change:
        change.protect(ref, mechanism)
    await two_again(ref)
    return group_of(ref).membership.names


def test_what_is_no_detection_is_refused() -> None:
    with pytest.raises(hf.errors.MechanismRefused, match="detection must be a Detection"):
        hf.ftm.compose(PBR(detection=0.1))  # type: ignore[arg-type]


def test_another_interval_is_not_judged_by_the_heartbeats_before() -> None:
    accrual = beating(0.5)
    accrual.watch_as(Detection(interval=0.05, pause=0.2))
    assert accrual.is_suspect(accrual.last + 0.5)
    accrual.watch_as(Detection(interval=2.0, pause=0.2))
    assert not accrual.is_suspect(accrual.last + 2.0)


def beating(interval: float) -> Accrual:
    """A replica that has beaten regularly."""
    accrual = Accrual(Detection(interval=interval), 0.0)
    for beat in range(1, 50):
        accrual.heard(beat * interval)
    return accrual
