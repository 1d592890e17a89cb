"""What is said where something is refused, or comes too late: the cause, once, and what helps."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.values import DamagedValue
from holdfast.actors.values.classes import find_class


class Tick(hf.Message): ...


class Count(hf.Message[int]): ...


class Held(hf.Refusal, text="key {key!r} is held"):
    key: str


class Idle(hf.Actor):
    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.02, Tick())

    @hf.on(Tick)
    def tick(self, message: Tick) -> None: ...

    @hf.on(Count)
    def count(self, message: Count) -> int:
        return 1


class Refuses(hf.Actor):
    async def on_start(self, restored: bool) -> None:
        raise Held("k")


class RefusesAtOnce(hf.Actor):
    def on_start(self, restored: bool) -> None:
        raise Held("k")


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()])
@pytest.mark.parametrize("has_store", [True, False])
async def test_what_comes_after_the_end_is_a_dead_letter_and_nothing_else(
    tmp_path: Path, isolation: Any, recovery: Any, has_store: bool
) -> None:
    store = f"sqlite:{tmp_path}/store" if has_store else None
    letters = list[hf.events.Event]()
    async with hf.ActorSystem("app", store=store, log=False) as system:
        idle = await system.start(hf.child("idle", hf.start(Idle), recovery=recovery, isolation=isolation))
        assert await idle.ask(Count()) == 1
    system._node.events.add_sink(letters.append)
    idle.tell(Tick())
    for late in (idle.ask(Count()), idle.send(Tick())):
        with pytest.raises(hf.ActorStopped):
            await late
    await system.publish("/topic", Tick())
    await asyncio.sleep(0.06)  # Longer than its timer: nothing fires.
    assert [type(one).__name__ for one in letters] == ["DeadLetter"]
    assert isinstance(letters[0], hf.events.DeadLetter)
    assert letters[0].why == "the system has ended"
    assert system.store_problem() == ""


@pytest.mark.parametrize("takeover", [False, True])
async def test_a_store_that_is_open_here_is_not_to_be_taken_over(tmp_path: Path, takeover: bool) -> None:
    store = f"sqlite:{tmp_path}/store"
    async with hf.ActorSystem("app", store=store, log=False):
        with pytest.raises(hf.errors.StoreInUse) as caught:
            await hf.ActorSystem("other", store=store, takeover=takeover, log=False).__aenter__()
    assert "is open in this very process: end the system that has it" in str(caught.value)
    assert "takeover" not in str(caught.value)
    assert "takeover=True" in str(hf.errors.StoreInUse("/app.db", 7))


def test_a_class_that_is_gone_is_to_be_put_back_by_an_alias() -> None:
    with pytest.raises(DamagedValue) as caught:
        find_class(f"{__name__}:Span")
    assert f"leave an alias `Span = NewName` in {__name__}" in str(caught.value)
    assert "older" not in str(caught.value)
    assert str(DamagedValue("it is cut short")).endswith("it is cut short; use an older snapshot")


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()])
@pytest.mark.parametrize("kind", [Refuses, RefusesAtOnce])
async def test_who_could_not_be_started_is_named_once(kind: Any, isolation: Any, recovery: Any) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        with pytest.raises(hf.StartFailed) as caught:
            await system.start(hf.child("one", hf.start(kind), isolation=isolation, recovery=recovery))
        assert str(caught.value) == "/app/one could not be started: key 'k' is held"


PLACES: dict[str, dict[str, Any]] = {
    "task": {},
    "recorded": {"recovery": hf.hybrid()},
    "process": {"isolation": "process"},
    "recorded process": {"recovery": hf.hybrid(), "isolation": "process"},
}


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("place", PLACES)
async def test_who_is_away_with_its_supervisor_or_the_system_is_said_to_be(place: str, isolation: Any) -> None:
    """Each call says the same of it, wherever it lived."""

    async def said() -> set[str]:
        calls = [system.get_state, system.outline, system.get_status, system.suspend, system.terminate]
        outcomes = await asyncio.gather(*(call(ref) for call in calls), return_exceptions=True)
        return {f"{type(one).__name__}: {one}" for one in outcomes}

    counter = hf.child("counter", hf.start(Idle), **PLACES[place])
    stopped = "ActorStopped: /app/below/counter has stopped ({}); the message was not handled"
    async with hf.ActorSystem("app", log=False) as system:
        below = await system.start(hf.supervisor("below", children=[counter], isolation=isolation))
        ref = system.ref("/app/below/counter", Idle)
        await system.stop(below)
        assert await said() == {stopped.format("its supervisor has ended, and may start it again")}
    assert await said() == {stopped.format("the system has ended")}
    with pytest.raises(hf.ActorStopped):
        await ref.ask(Count(), restarting="fail")
