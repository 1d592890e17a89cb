"""Log records of a turn say whose turn it is, of which message, and in which trace; with structlog and without."""

import logging
import math
from collections.abc import Iterator
from typing import Any

import pytest
import structlog
from opentelemetry.sdk.trace import TracerProvider

import holdfast as hf
from holdfast.console.telemetry.log_fields import FIELDS, TurnFilter, add_turn, turn_fields

LOG = logging.getLogger("tests.telemetry.clerk")


class Say(hf.Message[None]):
    text: str


class SayLater(hf.Message[None]): ...


class SayInThread(hf.Message[None]): ...


class Heard(hf.Message): ...


class Speaker(hf.Actor):
    def __init__(self) -> None:
        self.said = 0

    @hf.on(Say)
    async def say(self, message: Say) -> None:
        self.said += 1
        LOG.info("said %s", message.text)
        structlog.get_logger().info("said")

    @hf.on(SayLater)
    def say_later(self, message: SayLater) -> None:
        async def later() -> None:
            LOG.info("later")

        self.ctx.pipe_to_self(later(), lambda _: Heard())

    @hf.on(SayInThread, to_thread=True)
    def say_in_thread(self, message: SayInThread) -> None:
        LOG.info("in thread")

    @hf.on(Heard)
    def heard(self, message: Heard) -> None:
        raise ValueError("heard")


class Kept(logging.Handler):
    """Keeps records, with their fields."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[Any] = []
        self.addFilter(TurnFilter())

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)


@pytest.fixture
def kept() -> Iterator[Kept]:
    handler = Kept()
    LOG.addHandler(handler)
    LOG.setLevel(logging.INFO)
    yield handler
    LOG.removeHandler(handler)


@pytest.fixture
def shown() -> list[Any]:
    capture = structlog.testing.LogCapture()
    structlog.configure(processors=[add_turn, capture])
    return capture.entries


async def test_records_of_a_turn_have_its_fields(kept: Kept, shown: list[Any]) -> None:
    tracer = TracerProvider().get_tracer("test")
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Speaker), recovery=hf.hybrid()))
        bob = await system.start(hf.child("bob", hf.start(Speaker)))
        system.trace_with(tracer, one_in=math.inf)
        with tracer.start_as_current_span("request") as request:
            await alice.ask(Say("a"))
        await bob.ask(Say("b"))
    first, second = kept.records
    say = f"{Say.__module__}.Say"
    trace_id = f"{request.get_span_context().trace_id:032x}"
    assert (first.getMessage(), first.address, first.message_type) == ("said a", "/app/alice", say)
    assert (first.trace_id, bool(first.message_id)) == (trace_id, True)
    assert (second.address, second.message_type, second.message_id, second.trace_id) == ("/app/bob", say, "", "")
    entry = next(one for one in shown if one["address"] == "/app/alice")
    assert {name: entry[name] for name in FIELDS} == {name: getattr(first, name) for name in FIELDS}
    other = next(one for one in shown if one["address"] == "/app/bob")
    assert set(other) & set(FIELDS) == {"address", "message_type"}


async def test_background_work_and_threads_have_them_too(kept: Kept) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        bob = await system.start(hf.child("bob", hf.start(Speaker)))
        await bob.ask(SayLater())
        await bob.ask(SayInThread())
        await system._node.settled()
    found = {one.getMessage(): (one.address, one.message_type.rpartition(".")[2]) for one in kept.records}
    assert found == {"later": ("/app/bob", "SayLater"), "in thread": ("/app/bob", "SayInThread")}


def test_outside_of_actors_there_are_none(kept: Kept) -> None:
    LOG.info("outside")
    assert turn_fields() == {}
    (record,) = kept.records
    assert [getattr(record, name) for name in FIELDS] == [""] * len(FIELDS)


def test_what_the_program_has_said_itself_stays() -> None:
    assert add_turn(None, "info", {"address": "mine"}) == {"address": "mine"}


async def test_the_record_of_a_crash_has_the_trace() -> None:
    tracer = TracerProvider().get_tracer("test")
    with structlog.testing.capture_logs() as records:
        async with hf.ActorSystem("app") as system:
            bob = await system.start(hf.child("bob", hf.start(Speaker)))
            system.trace_with(tracer, one_in=math.inf)
            with tracer.start_as_current_span("request") as request:
                bob.tell(Heard())
            await bob.ask(Say("again"))
    (crash,) = [one for one in records if one["event"] == "actor crashed"]
    assert crash["trace_id"] == f"{request.get_span_context().trace_id:032x}"
    assert crash["span_id"] == f"{request.get_span_context().span_id:016x}"
