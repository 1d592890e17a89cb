"""Restarts that take longer than the period: they are bounded by count all the same (T17, T29)."""

from __future__ import annotations

import asyncio

import pytest

import holdfast as hf

virtual = pytest.mark.asyncio(loop_factories=["virtual"])
ATTEMPT = 7.0
"""Seconds that an attempt takes: more than the period, which is 5."""


class Lives:
    """How many there were, and how many of the next ones fail."""

    def __init__(self, failing: int) -> None:
        self.begun, self.failing = 0, failing


class Crash(hf.Message): ...


class Late(hf.Actor):
    """Comes back only after a while, and perhaps not then."""

    def __init__(self, lives: Lives) -> None:
        self._lives = lives

    async def on_start(self, restored: bool) -> None:
        self._lives.begun += 1
        if self._lives.begun > 1:
            await asyncio.sleep(ATTEMPT)
            if self._lives.begun <= 1 + self._lives.failing:
                raise ValueError("no room")

    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise ValueError("no")


async def end_of(stream: hf.events.EventStream) -> hf.events.SupervisorGaveUp:
    async for event in stream:
        if isinstance(event, hf.events.SupervisorGaveUp):
            return event
    raise AssertionError("it has not given up")


def above(lives: Lives, strategy: str = "one_for_one", **options: object) -> hf.ChildSpec:
    child = hf.child("late", hf.start(Late, lives), **options)  # type: ignore[arg-type]
    return hf.supervisor("top", strategy=strategy, intensity=3, period=5.0, children=[child], restart="temporary")  # type: ignore[arg-type]


@virtual
@pytest.mark.parametrize("strategy", ["one_for_one", "one_for_all", "rest_for_one"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()])
async def test_attempts_that_each_outlast_the_period_are_counted(strategy: str, recovery: hf.Method | None) -> None:
    lives = Lives(failing=1000)
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(above(lives, strategy, recovery=recovery))
        with system.events() as stream:
            system.ref("/app/top/late", Late).tell(Crash())
            event = await end_of(stream)
    assert (event.address, event.child) == ("/app/top", "late")
    assert "no room" in str(event.reason)
    assert lives.begun == 1 + 3, "the intensity is 3"


@virtual
async def test_the_supervisor_above_gives_up_as_well() -> None:
    """Its start fails with the child: that takes as long, and is counted too."""
    lives = Lives(failing=1000)
    child = hf.child("late", hf.start(Late, lives))

    async def body() -> None:
        async with hf.ActorSystem("app", log=False, intensity=2) as system:
            await system.start(hf.supervisor("top", intensity=3, children=[child]))
            system.ref("/app/top/late", Late).tell(Crash())
            await asyncio.Event().wait()

    with pytest.raises(hf.TreeFailed, match=r"not counting the \d+ s that restarts have taken.*no room"):
        await body()


@virtual
async def test_a_child_that_is_up_for_longer_than_the_period_is_not_given_up() -> None:
    lives = Lives(failing=0)
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(above(lives))
        late = system.ref("/app/top/late", Late)
        for begun in range(2, 12):
            late.tell(Crash())
            await asyncio.sleep(ATTEMPT + 6.0)
            assert lives.begun == begun


@virtual
async def test_pauses_between_attempts_still_keep_them_apart() -> None:
    """Whoever asks for pauses wants it to be tried for long."""
    lives = Lives(failing=10)
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(above(lives, backoff=hf.Backoff(initial=6.0, maximum=6.0, factor=1.0, jitter=0.0)))
        system.ref("/app/top/late", Late).tell(Crash())
        await asyncio.sleep(12 * (ATTEMPT + 6.0))
        assert lives.begun == 12


@virtual
async def test_the_slow_restarts_of_one_child_do_not_count_for_another() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        every = [Lives(failing=0) for _ in range(6)]
        children = [hf.child(f"late-{n}", hf.start(Late, lives)) for n, lives in enumerate(every)]
        await system.start(hf.supervisor("top", intensity=3, period=5.0, children=children))
        for n in range(6):  # One each two seconds: three are within the period.
            system.ref(f"/app/top/late-{n}", Late).tell(Crash())
            await asyncio.sleep(2.0)
        await asyncio.sleep(ATTEMPT)
        assert [lives.begun for lives in every] == [2] * 6
