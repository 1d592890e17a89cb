"""One crash, one record, whatever the actor that crashes is hosted by."""

import logging
import traceback
from collections.abc import Iterator, MutableMapping
from typing import Any

import pytest
import structlog

import holdfast as hf

Record = MutableMapping[str, Any]


class Boom(hf.Message[int]):
    secret: str


class Ping(hf.Message[int]): ...


class Fragile(hf.Actor):
    def __init__(self) -> None:
        self.handled = 0

    @hf.on(Boom)
    def boom(self, message: Boom) -> int:
        self.handled += 1
        raise ValueError("bad amount")

    @hf.on(Ping)
    def ping(self, message: Ping) -> int:
        return self.handled


@pytest.fixture
def records() -> Iterator[list[Record]]:
    with structlog.testing.capture_logs() as captured:
        yield captured


KINDS: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "recorded task": {"recovery": hf.hybrid()},
    "recorded process": {"isolation": "process", "recovery": hf.hybrid()},
    "replica": {"mechanism": hf.ftm.PBR()},
}


@pytest.mark.parametrize("log_payloads", [False, True])
@pytest.mark.parametrize("kind", KINDS)
async def test_a_crash_has_one_record_with_one_traceback_and_no_payload(
    records: list[Record], kind: str, log_payloads: bool
) -> None:
    async with hf.ActorSystem(log_payloads=log_payloads) as system:
        ref = await system.start(hf.child("fragile", hf.start(Fragile), **KINDS[kind]))
        with pytest.raises(hf.RemoteCrash):
            await ref.ask(Boom("the number of a card"), 60)
        await ref.ask(Ping(), 60)
    (record,) = [one for one in records if "exception" in one]
    assert (record["event"], record["log_level"], record["reason"]) == (
        "actor crashed",
        "error",
        "ValueError: bad amount",
    )
    assert record["address"].startswith("/app/fragile")
    assert record["message"].endswith("test_crash_record.Boom")
    assert record["exception"].count("Traceback (most recent call last):") == 1
    assert 'raise ValueError("bad amount")' in record["exception"]
    assert ("the number of a card" in repr(record)) == log_payloads
    if kind != "replica":  # A replica is started again without limit.
        assert (record["restarts"], record["allowed"]) == (0, 3)
    crashed = [one for one in records if one["event"] in ("actor crashed", "process died", "child ended")]
    assert [one for one in crashed if one["address"] == record["address"]] == [record]
    assert not [one for one in records if one is not record and "bad amount" in repr(one)]


async def test_a_crash_below_a_supervisor_in_a_process_has_the_same_record(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        children = [hf.child("fragile", hf.start(Fragile))]
        await system.start(hf.supervisor("top", isolation="process", intensity=2, children=children))
        ref = system.ref("/app/top/fragile", Fragile)
        with pytest.raises(hf.RemoteCrash):
            await ref.ask(Boom("a card"), 60)
        assert await ref.ask(Ping(), 60) == 0
    (record,) = [one for one in records if one["log_level"] == "error"]
    assert (record["event"], record["restarts"], record["allowed"]) == ("actor crashed", 0, 2)
    assert "a card" not in repr(records)


async def test_a_dead_letter_of_another_process_is_logged_by_its_type(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        ref = await system.start(hf.child("sender", hf.start(Sender), isolation="process"))
        await ref.ask(Ping(), 60)
    (letter,) = [one for one in records if one["event"] == "dead letter"]
    assert letter["message"].endswith("test_crash_record.Boom")
    assert "a card" not in repr(letter)


class Sender(hf.Actor):
    """Writes to a child of its own that has ended."""

    @hf.on(Ping)
    async def ping(self, message: Ping) -> int:
        child = self.ctx.spawn(hf.start(Fragile), "gone")
        child.stop()
        child.tell(Boom("a card"))
        with pytest.raises(hf.ActorStopped):
            await child.ask(Ping())
        return 0


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_remote_crash_says_little_and_prints_the_traceback_of_the_actor(isolation: Any) -> None:
    async with hf.ActorSystem(log=False) as system:
        ref = await system.start(hf.child("fragile", hf.start(Fragile), isolation=isolation))
        with pytest.raises(hf.RemoteCrash) as caught:
            await ref.ask(Boom("x"), 60)
    assert str(caught.value) == "ValueError: bad amount"
    printed = "".join(traceback.format_exception(caught.value))
    assert printed.count('raise ValueError("bad amount")') == 1
    shown = logging.Formatter().formatException((type(caught.value), caught.value, None))
    assert 'raise ValueError("bad amount")' in shown
