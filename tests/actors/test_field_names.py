"""The fields of a user's message may have any names: none of them is taken for something of ours."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import ActorCrashed

NAMES = {
    "sender",
    "message",
    "chain",
    "fail",
    "ignored",
    "future",
    "reason",
    "run",
    "timer",
    "feed",
    "stops",
    "started",
}


class Odd(hf.Message[str]):
    how: str
    sender: str = "a"
    message: str = "b"
    chain: str = "c"
    fail: str = "d"
    ignored: str = "e"
    future: str = "f"
    reason: str = "g"
    run: str = "h"
    timer: str = "i"
    feed: str = "j"
    stops: str = "k"
    started: str = "l"


class Said(hf.Message[list[str]]): ...


class Other(hf.Actor):
    """Whatever it is told is told to it once more, by whom it names."""

    def __init__(self) -> None:
        self.said: list[str] = []

    @hf.on(Odd)
    async def odd(self, message: Odd) -> str:
        return self.note(message)

    def note(self, message: Odd) -> str:
        sender = self.ctx.sender
        self.said.append(f"{message.how} from {'outside' if sender is None else sender.path.rpartition('/')[2]}")
        return message.message

    @hf.on(Said, readonly=True)
    def all(self, message: Said) -> list[str]:
        return list(self.said)


class One(Other):
    other: hf.Binding[Other]

    @hf.on(Odd)
    async def odd(self, message: Odd) -> str:
        if message.how == "crash":
            raise ValueError("crash")
        if message.how == "forward":
            self.ctx.forward(self.other)
            return ""
        if message.how == "ask":
            assert await self.other.ask(message) == message.message
        elif message.how == "tell":
            self.other.tell(message)
        elif message.how == "stash":
            if not self.said:
                self.ctx.stash()
                self.said.append("stashed")
                self.ctx.tell_after(0.0, Odd("timer"))
                return ""
        elif message.how == "timer":
            self.ctx.unstash()
        return self.note(message)


def test_the_names_are_those_of_the_message() -> None:
    assert set(Odd.__struct_fields__) > NAMES


@pytest.mark.parametrize("is_asked", [False, True])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()])
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("how", ["plain", "ask", "tell", "forward", "stash", "crash"])
async def test_a_message_with_such_fields_is_handled_as_any_other(
    system: hf.ActorSystem, how: str, isolation: Any, recovery: Any, is_asked: bool
) -> None:
    other = await system.start(hf.child("other", hf.start(Other)))
    ref = await system.start(
        hf.child("one", hf.start(One), bindings={"other": other.path}, isolation=isolation, recovery=recovery)
    )
    with system.events() as events:
        if is_asked and how == "crash":
            with pytest.raises((hf.AskFailed, hf.RemoteCrash, hf.Quarantined)):
                await ref.ask(Odd(how), timeout=30.0)
        elif is_asked and how != "stash":
            assert await ref.ask(Odd(how), timeout=30.0) == "b"
        else:
            ref.tell(Odd(how))
        async with asyncio.timeout(30.0):
            if how == "crash":
                async for event in events:
                    if isinstance(event, ActorCrashed):
                        break
        assert await ref.ask(Odd("plain"), timeout=30.0) == "b"
    if how == "stash":
        async with asyncio.timeout(30.0):
            while "stash" not in " ".join(await ref.ask(Said())).replace("stashed", ""):
                await asyncio.sleep(0.01)
    said = await other.ask(Said())
    expected = {
        "ask": ["ask from one"],
        "tell": ["tell from one"],
        "forward": ["forward from outside" if recovery is None or is_asked else "forward from one"],
    }
    assert said == expected.get(how, [])


async def test_a_pool_and_the_status_of_an_actor_know_such_a_message(system: hf.ActorSystem) -> None:
    await system.start(hf.supervision.pool("pool", hf.start(Other), size=2))
    pool = hf.supervision.pool_of(system, f"/{system.name}/pool", Other)
    assert await pool.ask(Odd("plain")) == "b"
    pool.tell(Odd("plain"))
    assert await pool.ask(Odd("plain")) == "b"
