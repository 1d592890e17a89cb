"""A supervisor that gives up says why: what keeps its child from starting, not how that one ended long before."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import Faults
from tests.supervision.family import Kid, Plan


class Crash(hf.Message): ...


class Idle(hf.Actor):
    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise ValueError("no")


async def gave_up(stream: hf.events.EventStream) -> hf.events.SupervisorGaveUp:
    async with asyncio.timeout(60.0):
        async for event in stream:
            if isinstance(event, hf.events.SupervisorGaveUp):
                return event
    raise AssertionError("it has not given up")


async def test_the_process_that_cannot_be_had_is_named() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        child = hf.child("worker", hf.start(Idle), isolation="process")
        await system.start(hf.supervisor("top", intensity=2, period=60.0, children=[child], restart="temporary"))
        async with Faults(1).on(system, at="process start", fail=1.0):
            with system.events() as stream:
                system.ref("/app/top/worker", Idle).kill()
                event = await gave_up(stream)
    assert (event.address, event.child) == ("/app/top", "worker")
    assert "/app/top/worker could not be started" in str(event.reason)
    assert "injected fault at 'process start'" in str(event.reason)


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_the_crash_far_below_is_named_at_the_end_of_the_system(isolation: Any) -> None:
    """Each supervisor on the way up says of whom it has given up, and why."""
    below = hf.supervisor("mid", intensity=0, children=[hf.child("kid", hf.start(Idle))])
    top = hf.supervisor("top", intensity=0, children=[below], isolation=isolation)
    why = (
        r"the tree of app gave up: restart intensity reached; the last to end was /app/top: shutdown \(.*"
        r"/app/top/mid: shutdown \(.*/app/top/mid/kid: ValueError: no\)\)"
    )

    async def body() -> None:
        async with hf.ActorSystem("app", log=False, intensity=0) as system:
            await system.start(top)
            system.ref("/app/top/mid/kid", Idle).tell(Crash())
            await asyncio.Event().wait()

    with pytest.raises(hf.TreeFailed, match=why):
        await body()


async def test_so_it_is_at_the_end_of_the_system() -> None:
    """Also of a child that crashed at first: the start that fails is what it ends of."""
    plan = Plan()

    async def body() -> None:
        async with hf.ActorSystem("app", log=False, intensity=2) as system:
            kid = await system.start(hf.child("a", hf.start(Kid, plan)))
            plan.todo["a"] = ["fail"] * 9
            kid.kill()
            await asyncio.Event().wait()

    with pytest.raises(hf.TreeFailed, match=r"the last to end was /app/a: /app/a could not be started"):
        await body()
    assert plan.take() == "+a !a !a"
