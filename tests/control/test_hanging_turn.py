"""An actor whose turn hangs: operators are told which turn is in their way, and a trace takes effect at once."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from tests.console.commands import holdfast

pytestmark = pytest.mark.usefixtures("warm_programs")

PLACES = ("task", "recorded", "process", "below")


class Pay(hf.Message[str]): ...


class Wait(hf.Message[None]): ...


class Open(hf.Message[None]): ...


class Heard(hf.Message[None]): ...


class Desk(hf.Actor):
    """Whoever waits here waits until it is opened."""

    def __init__(self) -> None:
        self._waiting: list[hf.ReplyHandle[None]] = []

    @hf.on(Wait)
    def wait(self, message: Wait) -> hf.ReplyHandle[None]:
        self._waiting.append(self.ctx.reply_handle())
        return self._waiting[-1]

    @hf.on(Open)
    def open(self, message: Open) -> None:
        for handle in self._waiting:
            handle.reply(None)

    @hf.on(Heard)
    def hear(self, message: Heard) -> None: ...


class Booking(hf.Actor):
    def __init__(self) -> None:
        self.state = "held"

    @hf.on(Pay)
    async def pay(self, message: Pay) -> str:
        desk = self.ctx.find("/app/desk", Desk)
        await desk.ask(Wait(), timeout=400.0)
        desk.tell(Heard())
        return "paid"


CALLS: dict[str, Callable[[hf.ActorSystem, Any], Awaitable[object]]] = {
    "get_state": lambda system, ref: system.get_state(ref, timeout=0.3),
    "outline": lambda system, ref: system.outline(ref, timeout=0.3),
    "suspend": lambda system, ref: system.suspend(ref, timeout=0.3),
    "checkpoint": lambda system, ref: system.checkpoint(ref, timeout=0.3),
    "replace_state": lambda system, ref: system.replace_state(ref, dict, timeout=0.3),
    "replace_code": lambda system, ref: system.replace_code(ref, Booking, timeout=0.3),
    "terminate": lambda system, ref: system.terminate(ref, timeout=0.3),
}


@asynccontextmanager
async def hanging(place: str) -> AsyncGenerator[tuple[hf.ActorSystem, hf.ActorRef[Booking]]]:
    """A system, and an actor in it whose turn waits for nobody knows what."""
    recovery = None if place == "task" else hf.hybrid()
    isolation: Any = "process" if place == "process" else "task"
    spec = hf.child("b", hf.start(Booking), recovery=recovery, isolation=isolation, shutdown=0.2)
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("desk", hf.start(Desk)))
        if place == "below":
            await system.start(hf.supervisor("sup", isolation="process", children=[spec]))
            ref = system.ref("/app/sup/b", Booking)
        else:
            ref = await system.start(spec)
        asked = ref.ask(Pay(), timeout=400.0)
        while not (await system.get_status(ref)).turn:
            await asyncio.sleep(0.01)
        yield system, ref
        asked.cancel()
        ref.kill()


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.some(14)
async def test_whoever_waits_in_vain_is_told_which_turn_is_in_the_way(place: str, call: str) -> None:
    if (place, call) == ("task", "checkpoint"):
        pytest.skip("it keeps no snapshots")
    async with hanging(place) as (system, ref):
        with pytest.raises(hf.AskTimeout, match=r"for its turn of .*Pay has run for \d+ s \(at .*desk.ask") as late:
            await CALLS[call](system, ref)
        assert late.value.turn.startswith("its turn of")


@pytest.mark.parametrize("place", PLACES)
async def test_a_trace_takes_effect_in_the_middle_of_a_turn(place: str) -> None:
    async with hanging(place) as (system, ref):
        with await system.trace(ref, timeout=5.0) as stream:
            assert await system.statistics(ref, True, timeout=5.0) is not None
            await system.ref("/app/desk", Desk).ask(Open())
            sent = await stream.until(hf.events.MessageOut, timeout=20.0)
            assert (sent.to, "Heard" in str(sent.message)) == ("/app/desk", True)
            assert await system.get_state(ref) == {"state": "held"}
        counts = await system.statistics(ref, False)
        assert counts is None


@pytest.mark.parametrize("place", ["recorded", "process"])
async def test_the_command_line_shows_what_is_known_without_the_turn(place: str, tmp_path: Any) -> None:
    async with hanging(place) as (system, ref), control_endpoint(system, f"{tmp_path}/s"):
        code, said, _ = await holdfast("inspect", ref.path, "--state", "--socket", f"{tmp_path}/s")
        assert code == 1
        assert "turn: tests.control.test_hanging_turn.Pay, for" in said
        assert "state: not to be had, for its turn of" in said
        code, _, said = await holdfast("trace", ref.path, "--seconds", "0.1", "--socket", f"{tmp_path}/s")
        assert code == 0
        assert "Pay has run for" in said


@pytest.mark.parametrize("change", ["suspend", "replace_state", "isolation", "protect"])
@pytest.mark.parametrize("place", PLACES)
async def test_a_transaction_says_it_too_and_leaves_the_actor_as_it_was(place: str, change: str) -> None:
    async with hanging(place) as (system, ref):
        begun = system._node.loop.time()
        args: list[Any] = {"isolation": ["task" if place == "process" else "process"], "protect": ["pbr"]}.get(
            change, []
        )
        args = [dict] if change == "replace_state" else args
        said = r"its turn of .*Pay has run for|a turn of .*/b waits for an answer of /app/desk"
        with pytest.raises(hf.TransactionFailed, match=said) as failed:
            async with system.transaction(timeout=0.5) as steps:
                getattr(steps, change)(ref, *args)
        assert "NOT undone" not in str(failed.value)
        assert system._node.loop.time() - begun < 5.0
        await system.ref("/app/desk", Desk).ask(Open())
        asked = ref.ask(Pay(), timeout=60.0)
        while not (await system.get_status(ref)).turn:
            await asyncio.sleep(0.01)
        while not asked.done():
            await system.ref("/app/desk", Desk).ask(Open())
            await asyncio.sleep(0.01)
        assert await asked == "paid"
