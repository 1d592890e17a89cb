"""What an ask between two actors ends with, wherever they live and whichever of them is recorded."""

from __future__ import annotations

from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import start


class No(hf.Refusal):
    why: str


class Give(hf.Message[Any]):
    how: str


class Ask(hf.Message[str]):
    other: hf.ActorRef[Any]
    how: str


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


class Asker(hf.Actor):
    @hf.on(Ask)
    async def ask(self, message: Ask) -> str:
        try:
            return repr(await message.other.ask(Give(message.how), timeout=60.0))
        except No as no:
            return f"refused: {no.why}"
        except hf.HoldfastError as error:
            return f"{type(error).__name__}: {error}"


OUTCOMES = {
    "a reply": "7",
    "a refusal": "refused: not now",
    "a crash": "RemoteCrash: ValueError: boom",
    "nonsense": "BadMessage: object to reply: a value of type object cannot be sent",
}


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
        return many  # type: ignore[no-any-return]


async def test_a_reply_of_another_type_is_an_error(isolation: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await start(system, isolation, "careless", hf.start(Careless), recovery=hf.hybrid())
        with pytest.raises(hf.HoldfastError, match=f"the reply of {ref.path} does not fit its type: Expected `int`"):
            await ref.ask(Count(), timeout=60.0)
