"""What an ask between two actors ends with, wherever they live and whichever of them is recorded."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.home.pending_asks import SwitchAsk
from tests.checkpoint.players import Do, Doer, Notes, Seen, Sink, start, until
from tests.checkpoint.strikes import home


class No(hf.Refusal):
    why: str


class Give(hf.Message[Any]):
    how: str


class Ask(hf.Message[str]):
    other: hf.ActorRef[Any]
    how: str


class Send(hf.Message[str]):
    other: hf.ActorRef[Any]


class Giver(hf.Actor):
    @hf.on(Give)
    def give(self, message: Give) -> Any:
        match message.how:
            case "a reply":
                return 7
            case "a refusal":
                raise No("not now")
            case "a crash":
                raise ValueError("boom")
            case _:
                return object()


class Busy(Doer):
    @hf.on(Give)
    def give(self, message: Give) -> int:
        return 7


class Asker(hf.Actor):
    @hf.on(Ask)
    async def ask(self, message: Ask) -> str:
        try:
            return repr(await message.other.ask(Give(message.how), timeout=60.0))
        except No as no:
            return f"refused: {no.why}"
        except hf.HoldfastError as error:
            return f"{type(error).__name__}: {error}"

    @hf.on(Send)
    async def send(self, message: Send) -> str:
        try:
            await message.other.send(Give("a reply"))
        except hf.HoldfastError as error:
            return type(error).__name__
        return "sent"


OUTCOMES = {
    "a reply": "7",
    "a refusal": "refused: not now",
    "a crash": "RemoteCrash: ValueError: boom",
    "nonsense": f"BadReply: /app/giver has handled {__name__}.Give, but its reply cannot be passed on: "
    "a value of type object cannot be sent",
}


@pytest.mark.pairs
@pytest.mark.parametrize("recorded", ["the asker", "the giver", "both"])
@pytest.mark.parametrize("giver", ["task", "process"])
@pytest.mark.parametrize("asker", ["task", "process"])
async def test_the_asker_hears_what_became_of_it(asker: str, giver: str, recorded: str) -> None:
    def method(of: str) -> hf.Method | None:
        return hf.hybrid() if recorded in (of, "both") else None

    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        other = await start(system, giver, "giver", hf.start(Giver), recovery=method("the giver"))
        one = await start(system, asker, "asker", hf.start(Asker), recovery=method("the asker"))
        for how, outcome in OUTCOMES.items():
            assert (await one.ask(Ask(other, how), timeout=60.0)).startswith(outcome), how


class Count(hf.Message[int]): ...


class Careless(hf.Actor):
    @hf.on(Count)
    def count(self, message: Count) -> int:
        many: Any = "many"
        return many


async def test_a_reply_of_another_type_is_an_error(isolation: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await start(system, isolation, "careless", hf.start(Careless), recovery=hf.hybrid())
        with pytest.raises(hf.errors.BadReply, match="Expected `int`") as bad:
            await ref.ask(Count(), timeout=60.0)
        assert (bad.value.actor, bad.value.message) == (ref.path, f"{__name__}.Count")


async def test_what_an_unrecorded_actor_has_answered_is_known_after_a_restart_of_the_root(tmp_path: Path) -> None:
    for is_first in (True, False):
        async with hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path / 'app.db'}") as system:
            sink = await start(system, "task", "sink", hf.start(Sink))
            ref = await start(system, "task", "doer", hf.start(Doer), recovery=hf.replay_only())
            if is_first:
                await ref.ask(Do(["ask one", "ask two"], sink))
            assert await ref.ask(Seen()) == ["one:1", "two:2"]
            assert await sink.ask(Notes()) == (["one", "two"] if is_first else [])


async def test_nothing_stays_of_an_ask_that_was_answered(isolation: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        sink = await start(system, "task", "sink", hf.start(Sink))
        ref = await start(system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid())
        before = len(asks())
        for _ in range(50):
            await ref.ask(Do(["ask one"], sink))
        assert len(asks()) < before + 5


def asks() -> list[SwitchAsk]:
    gc.collect()
    return [one for one in gc.get_objects() if isinstance(one, SwitchAsk)]


async def test_who_waits_for_room_hears_that_there_will_be_none(isolation: str, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("busy", hf.start(Busy), mailbox=hf.bounded(1), shutdown="brutal_kill")
        busy = await system.start(spec)
        busy.tell(Do([f"gate {gate}"]))
        await until(gate.exists)
        busy.tell(Give("a reply"))
        one = await start(system, isolation, "asker", hf.start(Asker), recovery=hf.hybrid())
        sending = one.ask(Send(busy), timeout=60.0)
        await until(lambda: bool(home(one).calls.sends))
        await system.stop(busy)
        assert await sending == "ActorStopped"
