"""What a transaction holds is held for what its steps need, not for the time in which another actor is restarted."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm import LFR
from tests.system.trees import Add, Counter, Stumble, ref

pytestmark = pytest.mark.usefixtures("warm_programs")

AWAY = 3.0
"""Seconds that a restart waits."""
HELD = 2.5
"""Seconds that an actor may stand still at most, also on a busy machine; it is less than the restart takes."""
IN_TIME = 20.0


def hundred(state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "count": state["count"] + 100}


def doubled(state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "count": state["count"] * 2}


class Gap:
    """Tells an actor one thing after another, and takes down how long it let the longest wait."""

    def __init__(self, to: hf.ActorRef[Any]) -> None:
        self._to, self.longest, self.told, self.is_over = to, 0.0, 0, False

    async def measure(self) -> None:
        while not self.is_over:
            begin = time.monotonic()
            await self._to.ask(Add(), IN_TIME)
            self.told += 1
            self.longest = max(self.longest, time.monotonic() - begin)
            await asyncio.sleep(0.01)


def held_by(change: Any, what: str, held: hf.ActorRef[Any]) -> None:
    match what:
        case "replace_state":
            change.replace_state(held, hundred)
        case "isolate":
            change.isolation(held, "process")
        case "protect":
            change.protect(held, LFR())


@pytest.mark.parametrize(
    ("what", "isolation", "fails"),
    [
        ("replace_state", "process", False),
        ("replace_state", "task", True),
        ("isolate", "task", False),
        ("protect", "process", False),
    ],
)
@pytest.mark.some(2)
async def test_who_is_at_rest_goes_on_while_another_one_is_restarted(
    system: hf.ActorSystem, what: str, isolation: Any, fails: bool
) -> None:
    """Nothing of what it has done meanwhile is lost, whether the transaction comes about or not."""
    backoff = hf.Backoff(AWAY, jitter=0.0)
    one = hf.child("one", hf.start(Counter, 5), isolation=isolation, recovery=hf.hybrid(interval=60.0), backoff=backoff)
    other = hf.child("held", hf.start(Counter), recovery=hf.hybrid(interval=60.0))
    await system.start(hf.supervisor("top", intensity=99, children=[one, other]))
    away, held = ref(system, "/app/top/one"), ref(system, "/app/top/held")
    gap = Gap(held)
    killed: list[float] = []

    async def dies(running: hf.ActorSystem) -> None:
        """Once, when all others are at rest; the transaction knows it."""
        if killed:
            return
        cell = away._cell
        killed.append(time.monotonic())
        pid = running.pid_of(away)
        if pid == os.getpid():
            away.kill()
        else:
            os.kill(pid, signal.SIGKILL)
        async with asyncio.timeout(IN_TIME):
            while cell.host.is_up(cell):
                await asyncio.sleep(0)

    measuring = asyncio.create_task(gap.measure())
    try:
        async with system.transaction(timeout=1.0 if fails else IN_TIME) as change:
            held_by(change, what, held)
            change.replace_state(away, hundred)
            change.step(Stumble(dies))
    except hf.TransactionFailed:
        assert fails, "it has not come about"
    else:
        assert not fails, "it was not in time"
        assert time.monotonic() - killed[0] > AWAY, "it was not away"
    gap.is_over = True
    await measuring
    assert gap.longest < HELD
    more = 0 if fails or what != "replace_state" else 100
    assert await held.ask(Add(0), IN_TIME) == gap.told + more
    assert await away.ask(Add(0), IN_TIME) == 5 + (0 if fails else 100)


@pytest.mark.parametrize("fails", [False, True])
@pytest.mark.parametrize("recovery", [None, hf.hybrid(interval=60.0)], ids=["plain", "recorded"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_state_that_is_replaced_while_the_actor_is_held_is_replaced_behind_that(
    system: hf.ActorSystem, isolation: Any, recovery: Any, fails: bool
) -> None:
    """The transaction puts in force what it has tried: what came in between would be gone, and was acknowledged."""
    one = await system.start(hf.child("one", hf.start(Counter, 5), isolation=isolation, recovery=recovery))
    given: list[asyncio.Future[Any]] = []

    async def beside(running: hf.ActorSystem) -> None:
        for change in (doubled, hundred):
            given.append(asyncio.ensure_future(running.replace_state(one, change, timeout=IN_TIME)))
            await asyncio.sleep(0)
            await running.get_status(one)  # The order has come to where the actor lives.
            await asyncio.sleep(0.005)  # Each has looked again at a time of its own.
        if fails:
            raise hf.HoldfastError("given up")

    try:
        async with system.transaction(timeout=IN_TIME) as change:
            change.replace_state(one, hundred)
            change.step(Stumble(beside))
    except hf.TransactionFailed:
        assert fails
    given.append(asyncio.ensure_future(system.replace_state(one, hundred, timeout=IN_TIME)))
    after = 10 if fails else 210
    assert [(await order)["count"] for order in given] == [after, after + 100, after + 200]
    assert await one.ask(Add(0), IN_TIME) == after + 200
