"""What an operator reads: a crash with its traceback, and floods limited and counted (DESIGN 9, otp.md W13)."""

import asyncio
from collections.abc import Iterator, MutableMapping
from typing import Any

import pytest
import structlog

import holdfast as hf

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])
Record = MutableMapping[str, Any]


class Boom(hf.Message):
    text: str = "boom"


class Ping(hf.Message[str]): ...


class Fragile(hf.Actor):
    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError(message.text)

    @hf.on(Ping)
    def ping(self, message: Ping) -> str:
        return "pong"


@pytest.fixture
def records() -> Iterator[list[Record]]:
    with structlog.testing.capture_logs() as captured:
        yield captured


def of(records: list[Record], event: str) -> list[Record]:
    return [record for record in records if record["event"] == event]


async def test_a_crash_is_logged_with_its_traceback(records: list[Record]) -> None:
    async with hf.ActorSystem("shop") as system:
        ref = await system.start(hf.child("fragile", hf.start(Fragile)))
        ref.tell(Boom("the glass fell"))
        assert await ref.ask(Ping()) == "pong"
    (crash,) = of(records, "actor crashed")
    assert (crash["log_level"], crash["system"], crash["address"]) == ("error", "shop", "/shop/fragile")
    assert crash["reason"] == "ValueError: the glass fell"
    assert crash["message"].endswith("test_logs.Boom")
    assert crash["traceback"].startswith("Traceback (most recent call last):")
    assert "raise ValueError(message.text)" in crash["traceback"]
    (restart,) = of(records, "child restarted")
    assert (restart["log_level"], restart["address"], restart["attempt"]) == ("warning", "/shop/fragile", 1)


async def test_a_supervisor_that_gives_up_is_logged_as_an_error(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        top = hf.supervisor("top", intensity=0, restart="temporary", children=[hf.child("x", hf.start(Fragile))])
        await system.start(top)
        system.ref("/app/top/x", Fragile).tell(Boom())
        await system.node.settled()
    (gave_up,) = of(records, "supervisor gave up")
    assert (gave_up["log_level"], gave_up["address"], gave_up["child"]) == ("error", "/app/top", "x")


async def test_a_message_to_the_dead_is_logged_by_its_type(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        ref = system.spawn(hf.start(Fragile), "fragile")
        await system.stop(ref)
        ref.tell(Boom("secret"))
    (letter,) = of(records, "dead letter")
    assert letter["message"].endswith("test_logs.Boom")
    assert letter["address"] == "/app/fragile"
    assert "secret" not in repr(letter)  # what is in a message is nobody's business


async def test_a_flood_is_limited_within_a_second_and_what_is_left_out_is_counted(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        ref = system.spawn(hf.start(Fragile), "fragile")
        await system.stop(ref)
        for _ in range(1000):
            ref.tell(Boom())
        assert len(of(records, "dead letter")) == 10
        await asyncio.sleep(1.0)
        for _ in range(15):
            ref.tell(Boom())
        await asyncio.sleep(5.0)
        ref.tell(Boom())
        assert system.dead_letters == 1016
    letters = of(records, "dead letter")
    assert [letter.get("left_out", 0) for letter in letters] == [0] * 10 + [990] + [0] * 9 + [5]
    assert len(letters) + sum(letter.get("left_out", 0) for letter in letters) == 1016


async def test_a_flood_of_one_kind_hides_no_other(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        gone = system.spawn(hf.start(Fragile))
        await system.stop(gone)
        for _ in range(100):
            gone.tell(Boom())
        system.spawn(hf.start(Fragile), "late").tell(Boom())
        await system.node.settled()
    assert [crash["address"] for crash in of(records, "actor crashed")] == ["/app/late"]


async def test_log_false_is_silent(records: list[Record]) -> None:
    async with hf.ActorSystem(log=False) as system:
        system.spawn(hf.start(Fragile)).tell(Boom())
        await system.node.settled()
    assert records == []
