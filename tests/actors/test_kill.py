"""A killed life ends without hooks, at once, with its children, whatever its turn does (otp.md 1.13)."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import LifeAbandoned
from holdfast.actors.kernel import lifecycle
from tests.actors.doers import Do, Doer, Doers, DoNow, pause


@pytest.fixture
def doer(system: hf.ActorSystem) -> Doers:
    return lambda: system.spawn(hf.start(Doer))


@pytest.mark.parametrize("steps", [0, 1, 2, 5])
async def test_killing_a_suspended_turn_ends_the_life_without_hooks(system: hf.ActorSystem, steps: int) -> None:
    told: list[str] = []

    class Polite(Doer):
        def on_stop(self, reason: hf.ExitReason) -> None:
            told.append("on_stop")

    async def work(_: Any) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            told.append("finally")

    polite = system.spawn(hf.start(Polite))
    system._node._idle.clear()
    polite.tell(Do(work))
    await asyncio.sleep(0)
    await pause(steps)
    ended = polite._cell.ended()
    polite.kill()
    assert await ended == hf.KILLED
    assert told == ["finally"]


async def test_killing_a_turn_cancels_what_it_waits_for(doer: Doers) -> None:
    """Also in the tick in which it begins to wait, as `Task.cancel` does."""
    for steps in range(4):
        inner = asyncio.get_running_loop().create_task(asyncio.Event().wait())

        async def work(_: Any, task: asyncio.Task[Any] = inner) -> None:
            await task

        victim = doer()
        victim.tell(Do(work))
        await pause(1 + steps)
        ended = victim._cell.ended()
        victim.kill()
        await ended
        await asyncio.wait([inner], timeout=30)
        assert inner.cancelled()


async def test_a_turn_that_swallows_its_kill_is_abandoned_and_may_not_send(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lifecycle, "GRACE", 0.01)
    attempts: list[str] = []
    gate, over = asyncio.Event(), asyncio.Event()
    other = system.spawn(hf.start(Doer))

    async def work(actor: Doer) -> str:
        while not gate.is_set():
            try:
                await gate.wait()
            except asyncio.CancelledError:
                continue
        leftovers: list[Callable[[], object]] = [
            lambda: other.tell(DoNow(print)),
            lambda: other.ask(DoNow(print)),
            lambda: actor.ctx.tell_after(0, DoNow(print)),
            lambda: actor.ctx.every(1, DoNow(print)),
            lambda: actor.ctx.spawn(hf.start(Doer)),
            lambda: actor.ctx.forward(other),
            lambda: actor.ctx.subscribe("/x"),
            lambda: actor.ctx.monitor(other),
            lambda: actor.ctx.link(other),
            lambda: actor.ctx.unstash(),
            lambda: actor.ctx.stop(),
        ]
        for leftover in leftovers:
            try:
                leftover()
            except hf.ActorStopped:
                attempts.append("refused")
            else:
                attempts.append("done")
        over.set()
        return "too late"

    with system.events() as stream:
        stubborn = await system.start(hf.child("stubborn", hf.start(Doer)))
        asked = stubborn.ask(Do(work))
        await pause(2)
        stubborn.kill()
        with pytest.raises(hf.AskFailed, match="killed"):
            await asked
        assert await stubborn.ask(DoNow(lambda actor: actor.ctx.life)) == 2
        gate.set()
        await over.wait()
        assert [event.address for event in stream.take() if isinstance(event, LifeAbandoned)] == [stubborn.path]
    assert set(attempts) == {"refused"}
    async with asyncio.timeout(30):
        await system._node.settled()  # it is counted no more
    assert await stubborn.ask(DoNow(lambda actor: actor.ctx.life)) == 2


async def test_a_killed_parent_waits_for_a_stubborn_child_and_ends(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lifecycle, "GRACE", 0.02)
    gate = asyncio.Event()

    async def stubborn(_: Any) -> None:
        while not gate.is_set():
            try:
                await gate.wait()
            except asyncio.CancelledError:
                continue

    async def spawn(actor: Doer) -> None:
        actor.ctx.spawn(hf.start(Doer), "child").tell(Do(stubborn))
        await asyncio.Event().wait()

    parent = system.spawn(hf.start(Doer), "parent")
    parent.tell(Do(spawn))
    await pause(4)
    ended = parent._cell.ended()
    parent.kill()
    async with asyncio.timeout(30):
        assert await ended == hf.KILLED
    assert system.tree() == ["/t"]
    gate.set()


async def test_a_kill_while_children_are_stopped_leaves_no_child_behind(system: hf.ActorSystem) -> None:
    gate = asyncio.Event()
    parent = system.spawn(hf.start(Doer), "parent")

    def spawn(actor: Doer) -> None:
        child = actor.ctx.spawn(hf.start(Doer), "child")
        child.tell(Do(lambda _: gate.wait()))
        actor.ctx.spawn(hf.start(Doer), "other")

    await parent.ask(DoNow(spawn))
    child = system.ref("/t/parent/child", Doer)
    await pause(2)
    parent.stop()  # waits for the child, which waits for the gate
    await pause(4)
    ended, child_ended = parent._cell.ended(), child._cell.ended()
    parent.kill()
    assert await ended == hf.KILLED
    assert await child_ended == hf.KILLED
    assert system.tree() == ["/t"]


async def test_a_stop_that_comes_when_a_turn_has_just_failed_finds_the_asker_answered(system: hf.ActorSystem) -> None:
    """What is left to do after a turn is done before any command, or the crash would be lost with its asker."""
    loop = asyncio.get_running_loop()

    async def work(actor: Doer) -> None:
        await asyncio.sleep(0)
        loop.call_soon(actor.ctx._cell.request_stop)  # Comes behind this turn and ahead of the actor's next slice.
        raise RuntimeError("boom")

    ref = system.spawn(hf.start(Doer))
    ended = ref._cell.ended()
    with pytest.raises(hf.RemoteCrash, match="boom"):
        await ref.ask(Do(work), timeout=30.0)
    assert "boom" in str(await ended)


async def test_a_turn_that_kills_its_own_actor_does_not_wait_for_ever(doer: Doers) -> None:
    """Neither in its first step nor in a later one."""
    for steps in range(2):

        async def work(actor: Any, steps: int = steps) -> None:
            await pause(steps)
            actor.ctx.ref.kill()
            await asyncio.Event().wait()

        victim = doer()
        asked = victim.ask(Do(work), timeout=30.0)
        with pytest.raises(hf.AskFailed, match="killed"):
            await asked
        assert await victim._cell.ended() == hf.KILLED
