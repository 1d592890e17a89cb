"""What cannot be coded is refused where it is said, whatever kind of actor says it, and never vanishes on the way."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf

SENDERS: dict[str, dict[str, Any]] = {
    "recorded": {"recovery": hf.hybrid(interval=3600.0)},
    "recorded in a process": {"recovery": hf.hybrid(interval=3600.0), "isolation": "process"},
    "replayed": {"recovery": hf.replay_only()},
    "protected": {"mechanism": hf.ftm.PBR()},
}


class Say(hf.Message[str]):
    way: str
    what: str


class Given(hf.Message[str]):
    value: Any = None


class Typed(hf.Message[str]):
    handle: hf.ReplyHandle[str] | None = None
    handles: tuple[hf.ReplyHandle[str], ...] = ()


class Ask(hf.Message[Any]):
    what: str


class No(hf.Refusal):
    value: Any


class Receiver(hf.Actor):
    @hf.on(Given)
    def given(self, message: Given) -> str:
        return repr(message.value)

    @hf.on(Typed)
    def typed(self, message: Typed) -> str:
        return repr(message)


def length(value: Any) -> int:
    return len(str(value))


VALUES: dict[str, Callable[[hf.Actor], Any]] = {
    "reply handle": lambda actor: actor.ctx.reply_handle(),
    "reply handle inside": lambda actor: {"a": [actor.ctx.reply_handle()]},
    "timer": lambda actor: actor.ctx.tell_after(3600.0, Given()),
    "monitor": lambda actor: actor.ctx.monitor(actor.receiver),  # type: ignore[attr-defined]
    "task": lambda actor: actor.ctx.create_task(asyncio.sleep(0)),
    "stream": lambda actor: asyncio.StreamReader(),
    "file": lambda actor: open("/dev/null"),  # noqa: SIM115
    "lambda": lambda actor: lambda: None,
    "context": lambda actor: actor.ctx,
    "actor": lambda actor: actor,
}
REFUSED = ("tell", "send", "ask", "publish", "tell_after", "every", "typed", "typed inside")


class Sender(hf.Actor):
    receiver: hf.Binding[Receiver]

    def __init__(self) -> None:
        self.kept: Any = None

    @hf.on(Say)
    async def say(self, message: Say) -> str:
        value = VALUES[message.what](self)
        try:
            await self.pass_on(message.way, value)
        except (hf.errors.BadMessage, hf.errors.UnsavableValue) as error:
            return f"{type(error).__name__}: {error}"
        finally:
            if message.what == "file":
                value.close()
        return "said"

    async def pass_on(self, way: str, value: Any) -> None:
        match way:
            case "tell":
                self.receiver.tell(Given(value))
            case "send":
                await self.receiver.send(Given(value))
            case "ask":
                await self.receiver.ask(Given(value))
            case "publish":
                await self.ctx.publish("/given", Given(value))
            case "tell_after":
                self.ctx.tell_after(3600.0, Given(value))
            case "every":
                self.ctx.every(3600.0, Given(value))
            case "typed":
                self.receiver.tell(Typed(value))
            case "typed inside":
                self.receiver.tell(Typed(None, (value,)))
            case "effect":
                await self.ctx.effect(length, value, isolation="process")
            case "pipe":
                self.ctx.pipe_to_self(asyncio.sleep(0), lambda _: Given(value))
            case "state":
                self.kept = value

    @hf.on(Ask)
    def ask(self, message: Ask) -> Any:
        kind, _, what = message.what.partition(" ")
        value = VALUES[what](self)
        if kind == "refuse":
            raise No(value)
        if kind == "later":
            handle = self.ctx.reply_handle()
            handle.reply(value)
            return handle
        return [value]

    @hf.on(Given)
    def given(self, message: Given) -> str:
        return "nothing"


async def started(system: hf.ActorSystem, sender: str) -> hf.ActorRef[Sender]:
    await system.start(hf.child("receiver", hf.start(Receiver)))
    bound = {"receiver": "/app/receiver"}
    return await system.start(hf.child("sender", hf.start(Sender), bindings=bound, **SENDERS[sender]))


@pytest.mark.parametrize("sender", SENDERS)
async def test_no_message_takes_it_along(sender: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=0) as system:
        ref = await started(system, sender)
        for way in REFUSED:
            for what in VALUES:
                said = await ref.ask(Say(way, what), timeout=30.0)
                assert said.startswith("BadMessage"), (way, what, said)
                assert ("ctx.forward" in said) == ("handle" in what), (way, what, said)


@pytest.mark.parametrize("sender", SENDERS)
async def test_no_effect_in_a_process_takes_it_along(sender: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=0) as system:
        ref = await started(system, sender)
        for what in VALUES:
            if what in ("reply handle", "reply handle inside", "timer", "monitor"):
                continue
            said = await ref.ask(Say("effect", what), timeout=30.0)
            assert said.startswith("UnsavableValue"), (what, said)


@pytest.mark.parametrize("sender", SENDERS)
@pytest.mark.parametrize("kind", ["return", "later", "refuse"])
async def test_no_reply_takes_it_along(sender: str, kind: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        ref = await started(system, sender)
        for what in VALUES:
            if what in ("task", "file"):
                continue
            with pytest.raises(hf.errors.HoldfastError) as raised:
                await ref.ask(Ask(f"{kind} {what}"), timeout=30.0)
            assert not isinstance(raised.value, hf.errors.AskTimeout), (kind, what)


@pytest.mark.parametrize("sender", SENDERS)
async def test_what_background_work_makes_of_it_ends_the_actor(sender: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        ref = await started(system, sender)
        with system.events() as seen:
            assert await ref.ask(Say("pipe", "reply handle"), timeout=30.0) == "said"
            async with asyncio.timeout(20.0):
                async for event in seen:
                    if isinstance(event, hf.events.ActorCrashed):
                        assert "ctx.forward" in str(event.reason)
                        break
