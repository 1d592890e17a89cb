"""Messages that do not fit are refused where they are known not to fit: at the call, or by the receiver, by field."""

from __future__ import annotations

import threading
from typing import Any

import msgspec
import pytest

import holdfast as hf
from holdfast.actors.errors import type_name
from holdfast.actors.events import DeadLetter
from holdfast.actors.kernel.codec import MAX_BYTES
from tests.actors.process.players import Account, Add, Fail, Note, Notebook, Notes, Run, Total, Worker
from tests.actors.process.waiting import next_event


async def start(system: hf.ActorSystem, kind: Any = Worker) -> hf.ActorRef[Any]:
    return await system.start(hf.child("one", hf.start(kind), isolation="process"))


async def test_a_field_of_the_wrong_type_fails_the_ask_by_name(system: hf.ActorSystem) -> None:
    one = await start(system, Account)
    wrong: Any = "three"
    with pytest.raises(hf.errors.BadMessage) as refused:
        await one.ask(Add(wrong))
    assert refused.value.actor == "/app/one"
    assert refused.value.message.endswith("players.Add")
    assert refused.value.problem == "Expected `int`, got `str` - at `n`"
    assert await one.ask(Total()) == 0


async def test_a_tell_of_the_wrong_type_is_a_dead_letter(system: hf.ActorSystem) -> None:
    one = await start(system, Notebook)
    wrong: Any = 5
    with system.events() as events:
        one.tell(Note(wrong))
        letter = await next_event(events, DeadLetter)
    assert letter.address == "/app/one"
    assert "Expected `str`, got `int`" in letter.why
    one.tell(Note("fine"))
    assert await one.ask(Notes()) == ["fine"]


@pytest.mark.parametrize("is_up", [True, False])
async def test_a_value_that_cannot_be_coded_is_refused_at_the_call(system: hf.ActorSystem, is_up: bool) -> None:
    """Also while the process restarts and the message would only be queued."""
    one = await start(system)
    if not is_up:
        ended = one._cell.ended()
        one.kill()
        await ended
    message = Run("anything", threading.Lock())
    with pytest.raises(
        hf.errors.BadMessage, match=r"players\.Run to /app/one: field 'with_': a value of type _thread\.lock"
    ):
        one.tell(message)
    with pytest.raises(hf.errors.BadMessage, match="field 'with_'"):
        await one.ask(message)
    with pytest.raises(hf.errors.BadMessage, match="field 'with_'"):
        await one.send(message)
    assert await one.ask(Add(1)) == 1, "nothing of them was sent"


@pytest.mark.parametrize("is_up", [True, False])
async def test_a_message_that_is_too_large_is_refused_at_the_call(system: hf.ActorSystem, is_up: bool) -> None:
    one = await start(system)
    if not is_up:
        ended = one._cell.ended()
        one.kill()
        await ended
    message = Run("anything", bytes(MAX_BYTES + 100_000))
    with pytest.raises(hf.errors.BadMessage, match=rf"players\.Run to /app/one: field 'with_'.*limit is {MAX_BYTES}"):
        one.tell(message)
    with pytest.raises(hf.errors.BadMessage, match="send it in parts"):
        await one.ask(message)
    assert await one.ask(Add(1)) == 1


async def test_the_largest_message_and_reply_go_through(system: hf.ActorSystem) -> None:
    one = await start(system)
    assert len(await one.ask(Run("huge_reply", MAX_BYTES - 100), timeout=20)) == MAX_BYTES - 100


async def test_an_unknown_message_is_refused_at_the_call(system: hf.ActorSystem) -> None:
    one = await start(system, Account)
    with pytest.raises(
        hf.UnknownMessage, match=r"/app/one has no handler for .*players\.Note; add one with @on\(Note\)"
    ):
        one.tell(Note("x"))
    with pytest.raises(hf.UnknownMessage):
        await one.ask(Note("x"))
    with pytest.raises(hf.UnknownMessage):
        await one.send(Note("x"))


async def test_an_unknown_message_from_a_process_fails_the_ask(system: hf.ActorSystem) -> None:
    """The sender's process does not know the receiver's class: its home or the receiver tells."""
    one = await start(system, Account)
    relay = await system.start(hf.child("relay", hf.start(Relay), isolation="process"))
    assert (await relay.ask(Forward(one, "ask"))).startswith("UnknownMessage: /app/one has no handler for")
    with system.events() as events:
        await relay.ask(Forward(one, "tell"))
        assert (await next_event(events, DeadLetter)).address == "/app/one"


class Forward(hf.Message[str]):
    to: hf.ActorRef[Any]
    how: str


class Relay(hf.Actor):
    @hf.on(Forward)
    async def forward(self, message: Forward) -> str:
        try:
            if message.how == "ask":
                await message.to.ask(Note("x"))
            else:
                message.to.tell(Note("x"))
        except hf.HoldfastError as error:
            return f"{type(error).__name__}: {error}"
        return "fine"


@pytest.mark.parametrize("what", ["wrong_reply", "huge_reply"])
async def test_a_reply_that_cannot_be_sent_fails_the_ask(system: hf.ActorSystem, what: str) -> None:
    one = await start(system)
    with pytest.raises(hf.errors.BadReply, match=r"/app/one has handled .*players\.Run, but its reply") as bad:
        await one.ask(Run(what, MAX_BYTES + 100_000), timeout=20)
    assert (bad.value.actor, bad.value.message) == (one.path, type_name(Run))
    assert await one.ask(Add(1)) == 1


async def test_a_reply_of_the_wrong_type_fails_the_ask(system: hf.ActorSystem) -> None:
    one = await start(system, Liar)
    with pytest.raises(hf.errors.BadReply) as bad:
        await one.ask(Total())
    assert bad.value.args == (one.path, type_name(Total), "Expected `int`, got `str`")


class Liar(hf.Actor):
    @hf.on(Total)
    def total(self, message: Total) -> int:
        lie: Any = "a lot"
        return lie


async def test_an_error_with_a_text_of_many_megabytes_is_still_told(system: hf.ActorSystem) -> None:
    one = await start(system)
    with pytest.raises(hf.RemoteCrash) as crash:
        await one.ask(Run("huge_error", MAX_BYTES + 1000), timeout=20)
    assert crash.value.type_name == "ValueError"
    assert crash.value.text.startswith("xxx")
    assert await one.ask(Add(1)) == 1


async def test_an_error_with_text_that_cannot_be_coded_is_still_told(system: hf.ActorSystem) -> None:
    one = await start(system)
    with pytest.raises(hf.RemoteCrash, match="ValueError"):
        await one.ask(Run("surrogate_error"))
    assert await one.ask(Add(1)) == 1


async def test_a_payload_that_lies_about_its_array_is_refused(system: hf.ActorSystem) -> None:
    codec = system._node.codec
    for data in (b"", b"\xff\xff\xff\xff", b"\x01\x00\x00\x00\xc0", b"\x04\x00\x00\x00\x92\xa1?\x90"):
        body = msgspec.msgpack.encode(msgspec.msgpack.Ext(2, data))
        with pytest.raises(msgspec.DecodeError):
            codec.decode(Any, body)


async def test_crash_texts_survive(system: hf.ActorSystem) -> None:
    one = await start(system)
    with pytest.raises(hf.RemoteCrash, match="grün"):
        await one.ask(Fail("grün"))
