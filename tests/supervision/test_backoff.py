"""Back-off: how long a restart waits, and that the supervisor serves others meanwhile (T29, T30, otp.md W5)."""

import asyncio
import itertools
import math
import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import holdfast as hf
from holdfast.actors.events import ChildRestarted, SupervisorGaveUp

virtual = pytest.mark.asyncio(loop_factories=["virtual"])
STEADY = hf.Backoff(initial=1.0, maximum=8.0, factor=2.0, jitter=0.0, reset_after=60.0)


@given(
    attempt=st.integers(0, 100_000),
    seed=st.integers(),
    backoff=st.builds(
        hf.Backoff,
        initial=st.floats(0, 1),
        maximum=st.floats(1, 100),
        factor=st.floats(1, 10),
        jitter=st.floats(0, 1),
    ),
)
def test_a_delay_stays_within_its_bounds(attempt: int, seed: int, backoff: hf.Backoff) -> None:
    delay = backoff.delay(attempt, random.Random(seed))
    try:
        grown = min(backoff.maximum, backoff.initial * backoff.factor**attempt)
    except OverflowError:
        grown = backoff.maximum if backoff.initial else 0.0
    assert grown <= delay <= grown * (1 + backoff.jitter)


def test_delays_grow_by_the_factor_up_to_the_maximum() -> None:
    rng = random.Random(0)
    assert [STEADY.delay(attempt, rng) for attempt in range(6)] == [1.0, 2.0, 4.0, 8.0, 8.0, 8.0]


def test_jitter_spreads_restarts_of_equal_children() -> None:
    backoff = hf.Backoff(initial=1.0, jitter=0.5)
    delays = {backoff.delay(0, random.Random(seed)) for seed in range(50)}
    assert len(delays) > 40
    assert 1.0 <= min(delays) < 1.1 < 1.4 < max(delays) <= 1.5


@pytest.mark.parametrize("name", ["initial", "maximum", "factor", "jitter", "reset_after"])
@pytest.mark.parametrize("value", ["1", None, True, math.nan, math.inf, -1.0])
def test_a_wrong_setting_is_named(name: str, value: Any) -> None:
    with pytest.raises(hf.SpecError, match=name) as caught:
        hf.Backoff(**{name: value})
    assert caught.value.where == "Backoff"


def test_settings_must_fit_each_other() -> None:
    with pytest.raises(hf.SpecError, match=r"0 <= initial <= maximum must hold, not 2\.0, 1\.0"):
        hf.Backoff(initial=2.0, maximum=1.0)
    with pytest.raises(hf.SpecError, match=r"factor must be >= 1, not 0\.5"):
        hf.Backoff(factor=0.5)
    with pytest.raises(hf.SpecError, match="jitter must be between 0 and 1"):
        hf.Backoff(jitter=1.5)


class Boom(hf.Message): ...


class Born(hf.Message[float]): ...


class Fragile(hf.Actor):
    def __init__(self) -> None:
        self.born = asyncio.get_running_loop().time()

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Born)
    def when(self, message: Born) -> float:
        return self.born


def clinic(**options: Any) -> hf.ChildSpec:
    options = {"intensity": 100, "period": 5.0, "backoff": STEADY, **options}
    backoff = options.pop("backoff")
    children = [hf.child("fragile", hf.start(Fragile), backoff=backoff), hf.child("sound", hf.start(Fragile))]
    return hf.supervisor("clinic", children=children, **options)


@virtual
async def test_a_child_that_keeps_crashing_waits_longer_each_time() -> None:
    async with hf.ActorSystem(log=False) as system:
        await system.start(clinic())
        fragile = system.ref("/app/clinic/fragile", Fragile)
        births = [await fragile.ask(Born())]
        for _ in range(5):
            fragile.tell(Boom())
            births.append(await fragile.ask(Born(), timeout=30.0))
        waits = [later - earlier for earlier, later in itertools.pairwise(births)]
        assert waits == [1.0, 2.0, 4.0, 8.0, 8.0]


@virtual
async def test_a_healthy_life_starts_the_count_anew() -> None:
    async with hf.ActorSystem(log=False) as system:
        await system.start(clinic())
        fragile = system.ref("/app/clinic/fragile", Fragile)
        born = math.inf
        for _ in range(3):
            fragile.tell(Boom())
            born = await fragile.ask(Born(), timeout=30.0)
        await asyncio.sleep(STEADY.reset_after)
        crashed = asyncio.get_running_loop().time()
        fragile.tell(Boom())
        assert await fragile.ask(Born(), timeout=30.0) == crashed + 1.0
        assert born < crashed


@virtual
async def test_siblings_and_the_supervisor_are_served_while_a_child_waits() -> None:
    async with hf.ActorSystem(log=False) as system:
        await system.start(clinic())
        fragile, sound = (system.ref(f"/app/clinic/{name}", Fragile) for name in ("fragile", "sound"))
        fragile.tell(Boom())
        waiting = fragile.ask(Born())
        await system._node.settled()
        assert await sound.ask(Born()) == 0.0
        assert asyncio.get_running_loop().time() == 0.0
        assert not waiting.done()
        assert await waiting == 1.0


@virtual
async def test_each_attempt_counts_toward_the_intensity_when_it_is_made() -> None:
    """DESIGN 5: one counter. With waits of 1 s, two restarts fit into 1.5 s, the third is too many within 5 s."""
    async with hf.ActorSystem(log=False) as system:
        every_second = hf.Backoff(initial=1.0, maximum=1.0, jitter=0.0)
        with system.events() as events:
            await system.start(clinic(intensity=2, period=5.0, backoff=every_second))
            fragile = system.ref("/app/clinic/fragile", Fragile)
            for _ in range(2):
                fragile.tell(Boom())
                await fragile.ask(Born())
            fragile.tell(Boom())
            await asyncio.sleep(1.5)
            seen = events.take()
        assert [
            event.attempt for event in seen if isinstance(event, ChildRestarted) and "fragile" in event.address
        ] == [1, 2]
        assert [event.address for event in seen if isinstance(event, SupervisorGaveUp)] == ["/app/clinic"]


@virtual
async def test_waits_longer_than_the_period_never_reach_the_intensity() -> None:
    async with hf.ActorSystem(log=False) as system:
        slow = hf.Backoff(initial=2.0, maximum=2.0, jitter=0.0)
        await system.start(clinic(intensity=1, period=1.0, backoff=slow))
        fragile = system.ref("/app/clinic/fragile", Fragile)
        for _ in range(20):
            fragile.tell(Boom())
            await fragile.ask(Born())
        assert asyncio.get_running_loop().time() == 40.0
