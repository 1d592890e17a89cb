"""Traces over asks, tells, processes, recoveries and mechanisms; and that nobody pays while nobody traces."""

import asyncio
import inspect
import math
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from opentelemetry import baggage
from opentelemetry import context as otel
from opentelemetry.sdk.trace import ReadableSpan, Span, SpanProcessor, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.sdk.trace.sampling import ALWAYS_OFF
from opentelemetry.trace import SpanKind, StatusCode, Tracer

import holdfast as hf
from holdfast.actors.control.late_spans import LATEST, MOST
from holdfast.actors.kernel.cell import Cell
from holdfast.actors.kernel.context import ActorContext
from holdfast.actors.kernel.ref import ActorRef
from holdfast.checkpoint.store_tools.plain_export import export_store
from holdfast.testing import GuardedSystem, Simulation, simulate
from tests.telemetry.scrapes import until
from tests.telemetry.traced_shop import (
    Again,
    Blame,
    Clerk,
    Count,
    Fail,
    Forwarder,
    Held,
    Later,
    Made,
    Note,
    Noted,
    Onto,
    Onward,
    Pass,
    Piped,
    Published,
    Sent,
    Stasher,
    Stored,
    Through,
    TooLate,
    Where,
)

NEXT = {"next_one": "/app/bob"}


class Traced(NamedTuple):
    """A tracer, and what it has made."""

    tracer: Tracer
    exported: InMemorySpanExporter

    def spans(self, name: str = "") -> list[ReadableSpan]:
        return [one for one in self.exported.get_finished_spans() if one.name.startswith(name)]

    def one(self, name: str) -> ReadableSpan:
        (span,) = self.spans(name)
        return span


@pytest.fixture
def traced() -> Iterator[Traced]:
    provider, exported = TracerProvider(), InMemorySpanExporter()
    provider.add_span_processor(SimpleSpanProcessor(exported))
    yield Traced(provider.get_tracer("test"), exported)
    provider.shutdown()


def parent_of(span: ReadableSpan) -> int:
    assert span.parent is not None
    return span.parent.span_id


def id_of(span: ReadableSpan) -> int:
    assert span.context is not None
    return span.context.span_id


def trace_of(span: ReadableSpan) -> int:
    assert span.context is not None
    return span.context.trace_id


async def test_an_ask_inside_of_a_span_continues_it(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("bob", hf.start(Clerk)))
        alice = await system.start(hf.child("alice", hf.start(Clerk), bindings=NEXT))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            told = await alice.ask(Onward())
    request, onward = traced.one("request"), traced.one("handle Onward")
    ask_alice, ask_bob, where = traced.one("ask Onward"), traced.one("ask Where"), traced.one("handle Where")
    assert parent_of(ask_alice) == id_of(request)
    assert parent_of(onward) == id_of(ask_alice)
    assert parent_of(ask_bob) == id_of(onward)
    assert parent_of(where) == id_of(ask_bob)
    assert told == f"{trace_of(request):032x} {id_of(where):016x}"
    assert (ask_bob.kind, where.kind) == (SpanKind.CLIENT, SpanKind.SERVER)
    assert dict(where.attributes or {}) == {"holdfast.address": "/app/bob"}


async def test_a_tell_inside_of_a_span_continues_it(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        bob = await system.start(hf.child("bob", hf.start(Clerk)))
        alice = await system.start(hf.child("alice", hf.start(Clerk), bindings=NEXT))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            alice.tell(Onto())
        await alice.ask(Where())
        noted = await bob.ask(Noted())
    assert noted == [f"{trace_of(traced.one('request')):032x} {id_of(traced.one('handle Note')):016x}"]
    assert parent_of(traced.one("handle Onto")) == id_of(traced.one("request"))
    assert parent_of(traced.one("handle Note")) == id_of(traced.one("handle Onto"))
    assert traced.one("handle Note").kind is SpanKind.CONSUMER


async def test_what_is_in_no_trace_is_in_none(traced: Traced) -> None:
    unsampled = TracerProvider(sampler=ALWAYS_OFF).get_tracer("off")
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk)))
        system.trace_with(traced.tracer, one_in=math.inf)
        assert await alice.ask(Where()) == "none"
        with unsampled.start_as_current_span("request"):
            assert await alice.ask(Where()) == "none"
        with traced.tracer.start_as_current_span("request"):
            assert await alice.ask(Where()) != "none"
        assert await alice.ask(Where()) == "none"  # Nothing of the turn before is left.
        alice.tell(Note())
        assert await alice.ask(Noted()) == ["none"]


async def test_one_message_in_so_many_begins_a_trace(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        bob = await system.start(hf.child("bob", hf.start(Clerk)))
        alice = await system.start(hf.child("alice", hf.start(Clerk), bindings=NEXT))
        system.trace_with(traced.tracer, one_in=1)
        await alice.ask(Onward())
        begun = traced.one("handle Onward")
        assert begun.parent is None
        assert trace_of(traced.one("handle Where")) == trace_of(begun)
        traced.exported.clear()
        alice.tell(Onto())
        await alice.ask(Where())
        await bob.ask(Where())
        assert traced.one("handle Onto").parent is None
        assert parent_of(traced.one("handle Note")) == id_of(traced.one("handle Onto"))
        with pytest.raises(hf.errors.SpecError, match="one_in"):
            system.trace_with(traced.tracer, one_in=0.5)


async def test_who_enters_a_system_in_a_span_does_not_have_all_turns_in_it(traced: Traced) -> None:
    with traced.tracer.start_as_current_span("lifespan"):
        system = await hf.ActorSystem("app", log=False).__aenter__()
    try:
        bob = await system.start(hf.child("bob", hf.start(Clerk)))
        alice = await system.start(hf.child("alice", hf.start(Clerk), bindings=NEXT))
        system.trace_with(traced.tracer, one_in=math.inf)
        await alice.ask(Onward())
        alice.tell(Onto())
        await alice.ask(Where())
        await bob.ask(Where())
        assert [one.name for one in traced.spans()] == ["lifespan"]
    finally:
        await system.shutdown()


async def test_failures_are_in_the_spans(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk)))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"), pytest.raises(hf.errors.RemoteCrash):
            await alice.ask(Fail())
        await alice.ask(Where())
        await asyncio.sleep(0)
    failed, asked, again = traced.one("handle Fail"), traced.one("ask Fail"), traced.one("restart")
    assert (failed.status.status_code, failed.events[0].name) == (StatusCode.ERROR, "exception")
    assert asked.status.status_code is StatusCode.ERROR
    assert again.parent is None
    assert [link.context.span_id for link in again.links] == [id_of(failed)]
    assert again.attributes is not None
    assert again.attributes["holdfast.reason"] == "ValueError: failed"


async def test_a_circle_is_told_without_the_trace(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk)))
        system.bind(alice, "next_one", alice)
        system.trace_with(traced.tracer)
        with traced.tracer.start_as_current_span("request"), pytest.raises(hf.errors.RemoteCrash) as crash:
            await alice.ask(Onward())
        assert "would wait for itself (/app/alice -> /app/alice)" in str(crash.value)


PLACES: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "recorded": {"recovery": hf.hybrid()},
    "recorded process": {"isolation": "process", "recovery": hf.hybrid()},
    "protected": {"mechanism": hf.ftm.PBR()},
}


@pytest.mark.parametrize("place", PLACES)
async def test_a_trace_crosses_every_border(traced: Traced, place: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        provides = place not in ("task", "recorded")
        alice = await system.start(hf.child("alice", hf.start(Clerk, provides=provides), **PLACES[place]))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request") as request:
            told = await alice.ask(Where())
            alice.tell(Note())
        trace_id = f"{request.get_span_context().trace_id:032x}"
        assert told.split()[0] == trace_id
        (noted,) = await alice.ask(Noted())
        assert noted.split()[0] == trace_id
        if place in ("task", "recorded"):
            where = traced.one("handle Where")
            assert parent_of(where) == id_of(traced.one("ask Where"))
        else:
            made = await alice.ask(Made())
            assert made[0] == f"handle Where {trace_id} {id_of(traced.one('ask Where')):016x}"
            assert made[1].startswith(f"handle Note {trace_id} ")
            assert len(made) == 2


async def test_an_ask_of_a_process_is_in_the_trace_of_its_turn(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        bob = await system.start(hf.child("bob", hf.start(Clerk)))
        alice = await system.start(
            hf.child("alice", hf.start(Clerk, provides=True), isolation="process", bindings=NEXT)
        )
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request") as request:
            told = await alice.ask(Onward())
            alice.tell(Onto())
        assert told.split()[0] == f"{request.get_span_context().trace_id:032x}"
        made = await alice.ask(Made())
        assert [" ".join(line.split()[:2]) for line in made] == ["ask Where", "handle Onward", "handle Onto"]
        assert [one.split()[0] for one in await bob.ask(Noted())] == [told.split()[0]]
        assert trace_of(traced.one("handle Where")) == request.get_span_context().trace_id


async def test_a_replay_makes_no_spans_of_old_work(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("alice", hf.start(Clerk, provides=True), isolation="process", recovery=hf.replay_only())
        alice = await system.start(spec)
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            for _ in range(3):
                alice.tell(Count())
            assert await alice.ask(Count()) == 4
        with system.events() as events:
            os.kill(system.pid_of(alice), 9)
            assert await alice.ask(Count()) == 5
            await until(events, hf.events.Recovered)
        assert await alice.ask(Made()) == []  # The new process has handled all of it again.
    recovery, replay = traced.one("recover"), traced.one("replay")
    assert parent_of(replay) == id_of(recovery)
    assert (recovery.attributes or {})["holdfast.replayed"] == 5
    assert replay.start_time is not None
    assert recovery.start_time is not None
    assert recovery.start_time <= replay.start_time


async def test_a_recovery_links_to_the_turn_that_failed(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk), recovery=hf.hybrid()))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"), pytest.raises(hf.errors.RemoteCrash):
            await alice.ask(Fail())
        assert await alice.ask(Noted()) == []
        await asyncio.sleep(0)
    assert [link.context.span_id for link in traced.one("recover").links] == [id_of(traced.one("handle Fail"))]


@pytest.mark.parametrize("place", ["task", "process", "recorded process"])
async def test_baggage_crosses_on_request(traced: Traced, place: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk), **PLACES[place]))
        token = otel.attach(baggage.set_baggage("request", "r 7"))
        try:
            system.trace_with(traced.tracer, one_in=math.inf)
            assert await alice.ask(Held()) == "None"
            system.trace_with(traced.tracer, one_in=math.inf, baggage=True)
            assert await alice.ask(Held()) == "r 7"
            assert traced.spans() == []
            with traced.tracer.start_as_current_span("request"):
                assert await alice.ask(Held()) == "r 7"
        finally:
            otel.detach(token)
        assert await alice.ask(Held()) == "None"


SENDS: tuple[Any, ...] = (ActorRef.tell, ActorRef.ask, ActorRef.send, ActorContext._tell, ActorContext._ask)


def way_of(system: hf.ActorSystem, ref: ActorRef[Any]) -> list[Any]:
    """Whatever a message passes: code, and who is called."""
    cell = ref._cell
    takes = inspect.getattr_static(cell, "take_in"), cell.take_in, cell.admit, type(cell).push, type(cell).outgoing
    return [*[one.__code__ for one in SENDS], *takes, cell.table, type(cell.ctx), type(system._node.deadlines)]


async def test_nobody_pays_before_and_after(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk)))
        await alice.ask(Where())
        before = way_of(system, alice)
        assert before[len(SENDS)] is inspect.getattr_static(alice._cell, "admit")  # The very slot, by another name.
        system.trace_with(traced.tracer, one_in=1)
        assert way_of(system, alice)[: len(SENDS)] == before[: len(SENDS)]  # They are the same code even then.
        assert way_of(system, alice) != before
        await alice.ask(Where())
        system.trace_with(None)
        assert way_of(system, alice) == before
        made = len(traced.spans())
        with traced.tracer.start_as_current_span("request"):
            assert await alice.ask(Where()) == "none"
        assert len(traced.spans()) == made + 1


async def test_a_system_beside_a_traced_one_is_not_traced(traced: Traced) -> None:
    async with hf.ActorSystem("one", log=False) as one, hf.ActorSystem("two", log=False) as two:
        alice = await two.start(hf.child("alice", hf.start(Clerk)))
        one.trace_with(traced.tracer, one_in=1)
        with traced.tracer.start_as_current_span("request"):
            alice.tell(Note())
            assert await alice.ask(Noted()) == ["none"]
    assert [one.name for one in traced.spans()] == ["request"]


async def test_statistics_count_what_a_traced_turn_tells(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("bob", hf.start(Clerk)))
        alice = await system.start(hf.child("alice", hf.start(Clerk), bindings=NEXT))
        await system.statistics(alice, True)
        system.trace_with(traced.tracer, one_in=1)
        alice.tell(Onto())
        await alice.ask(Onward())
        counts = await system.statistics(alice)
        assert counts is not None
        assert (counts.messages_in, counts.messages_out, counts.turns) == (2, 2, 2)


async def test_the_messages_of_the_runtime_begin_no_trace(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        system.trace_with(traced.tracer, one_in=1)
        alice = await system.start(hf.child("alice", hf.start(Clerk), recovery=hf.hybrid()))
        await system.get_state(alice)
        assert traced.spans() == []
        await alice.ask(Count())
    assert [one.name for one in traced.spans()] == ["handle Count", "ask Count"]


async def test_whoever_waits_for_a_turn_has_decided(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        bob = await system.start(hf.child("bob", hf.start(Clerk)))
        alice = await system.start(hf.child("alice", hf.start(Through), bindings=NEXT))
        await system.suspend(alice)
        asker = await system.start(hf.child("asker", hf.start(Through), bindings={"next_one": "/app/alice"}))
        system.trace_with(traced.tracer, one_in=math.inf)
        asked = asyncio.ensure_future(asker.ask(Pass()))
        await bob.ask(Count())  # By now alice has been asked, in a turn that is in no trace.
        system.trace_with(traced.tracer, one_in=1)
        await system.resume(alice)
        assert await asked == "none"
    assert traced.spans() == []


async def test_a_trace_is_begun_once(traced: Traced) -> None:
    off = TracerProvider(sampler=ALWAYS_OFF).get_tracer("off")
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk, provides=True), isolation="process"))
        dave = await system.start(hf.child("dave", hf.start(Through), bindings={"next_one": alice.path}))
        system.trace_with(off, one_in=1)  # The turn of dave begins a trace, which is not sampled.
        assert await dave.ask(Pass()) == "none"
        assert await alice.ask(Made()) == []


async def test_a_span_that_nobody_looks_at_is_made_later(traced: Traced) -> None:
    """After a while, or when many wait, or when the system is traced no more: with the times of its turn."""
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk)))
        system.trace_with(traced.tracer, one_in=1)
        before = time.time_ns()
        await alice.ask(Count())
        after = time.time_ns()
        assert traced.spans() == []
        await asyncio.sleep(2 * LATEST)
        made = traced.one("handle Count")
        assert made.start_time is not None
        assert made.end_time is not None
        assert before <= made.start_time <= made.end_time <= after
        assert made.parent is None
        for _ in range(MOST):
            await alice.ask(Count())
        assert len(traced.spans("handle Count")) == 1 + MOST
        await alice.ask(Count())
        system.trace_with(None)
        assert len(traced.spans("handle Count")) == 2 + MOST
        system.trace_with(traced.tracer, one_in=1)
        await alice.ask(Count())
    assert len(traced.spans("handle Count")) == 3 + MOST


async def test_a_stashed_ask_goes_on_in_its_trace(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        keeper = await system.start(hf.child("keeper", hf.start(Stasher)))
        system.trace_with(traced.tracer, one_in=1)
        assert await keeper.ask(Pass()) == "again"
    first, second = sorted(traced.spans("handle Pass"), key=lambda one: one.start_time or 0)
    assert parent_of(second) == id_of(first)


async def test_a_forwarded_ask_goes_on_in_its_trace(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("bob", hf.start(Clerk)))
        forwarder = await system.start(hf.child("forwarder", hf.start(Forwarder), bindings=NEXT))
        system.trace_with(traced.tracer, one_in=1)
        assert await forwarder.ask(Pass()) != "none"
    first, second = traced.spans("handle Pass")
    assert parent_of(second) == id_of(first)


@pytest.mark.parametrize("place", PLACES)
async def test_send_and_publish_carry_the_trace(traced: Traced, place: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        bob = await system.start(hf.child("bob", hf.start(Clerk), **PLACES[place]))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request") as request:
            await bob.send(Note())
            await system.publish("/notes", Note())
        trace_id = f"{request.get_span_context().trace_id:032x}"
        noted = await bob.ask(Noted())
    assert [one.split()[0] for one in noted] == [trace_id] * 2


WAYS = {Onto: "tell", Sent: "send", Published: "publish"}


@pytest.mark.parametrize("kind", WAYS, ids=WAYS.values())
@pytest.mark.parametrize("receiver", ["task", "process", "recorded"])
@pytest.mark.parametrize("place", PLACES)
async def test_what_a_turn_sends_is_below_it(
    traced: Traced, place: str, receiver: str, kind: type[hf.Message[None]]
) -> None:
    """The span of the handler, in whatever place, is that in which the receiver is told."""
    async with hf.ActorSystem("app", log=False) as system:
        provides = place not in ("task", "recorded")
        bob = await system.start(hf.child("bob", hf.start(Clerk), **PLACES[receiver]))
        start = hf.start(Clerk, provides=provides)
        alice = await system.start(hf.child("alice", start, bindings=NEXT, **PLACES[place]))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request") as request:
            await alice.ask(kind())
        trace_id = f"{request.get_span_context().trace_id:032x}"
        noted = await noted_by(bob)
        assert [one.split()[0] for one in noted] == [trace_id]
        if not provides and receiver in ("task", "recorded"):
            turn = traced.one(f"handle {kind.__name__}")
            assert {parent_of(one) for one in traced.spans("handle Note")} == {id_of(turn)}


async def noted_by(ref: ActorRef[Clerk], least: int = 1) -> list[str]:
    """What an actor has noted, when it is so much; it asks again, for a note may be on its way."""
    noted = await ref.ask(Noted())
    while len(noted) < least:
        await asyncio.sleep(0)
        noted = await ref.ask(Noted())
    return noted


@pytest.mark.parametrize("receiver", ["task", "process", "recorded"])
async def test_what_a_recorded_turn_asks_is_below_it(traced: Traced, receiver: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("bob", hf.start(Clerk), **PLACES[receiver]))
        alice = await system.start(hf.child("alice", hf.start(Clerk), bindings=NEXT, recovery=hf.hybrid()))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            told = await alice.ask(Onward())
        onward, ask = traced.one("handle Onward"), traced.one("ask Where")
        assert told.split()[0] == f"{trace_of(onward):032x}"
        assert parent_of(ask) == id_of(onward)
        assert (ask.kind, dict(ask.attributes or {})) == (SpanKind.CLIENT, {"holdfast.address": "/app/bob"})
        if receiver == "process":  # It makes no spans: the span that is current there is that of the ask.
            assert told.split()[1] == f"{id_of(ask):016x}"
        else:
            assert parent_of(traced.one("handle Where")) == id_of(ask)


async def test_an_ask_of_a_recorded_turn_that_fails_says_so_in_its_only_span(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False, intensity=9) as system:
        await system.start(hf.child("bob", hf.start(Clerk)))
        spec = hf.child("alice", hf.start(Clerk), bindings=NEXT, recovery=hf.replay_only())
        alice = await system.start(spec)
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            await alice.ask(Blame())
        with system.events() as stream:
            alice.kill()
            await until(stream, hf.events.Recovered)
    failed = traced.one("ask Fail")
    assert (failed.status.status_code, dict(failed.attributes or {})["error.type"]) == (
        StatusCode.ERROR,
        "holdfast.actors.errors.RemoteCrash",
    )


async def test_what_a_recorded_turn_forwards_is_below_it(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("bob", hf.start(Clerk)))
        spec = hf.child("forwarder", hf.start(Forwarder), bindings=NEXT, recovery=hf.hybrid())
        forwarder = await system.start(spec)
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            assert await forwarder.ask(Pass()) != "none"
            assert await forwarder.ask(Pass()) != "none"
    first, second, third, fourth = traced.spans("handle Pass")
    assert (parent_of(second), parent_of(fourth)) == (id_of(first), id_of(third))


async def test_a_recorded_turn_leaves_no_trace_to_the_next_one(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        bob = await system.start(hf.child("bob", hf.start(Clerk)))
        alice = await system.start(hf.child("alice", hf.start(Clerk), bindings=NEXT, recovery=hf.hybrid()))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            await alice.ask(Onto())
        await alice.ask(Onto())
        noted = await bob.ask(Noted())
    assert [one == "none" for one in noted] == [False, True]


async def test_a_replay_makes_no_second_span_of_what_was_released(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        bob = await system.start(hf.child("bob", hf.start(Clerk)))
        spec = hf.child("alice", hf.start(Clerk), bindings=NEXT, isolation="process", recovery=hf.replay_only())
        alice = await system.start(spec)
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            await alice.ask(Onto())
            told = await alice.ask(Onward())
        with system.events() as events:
            os.kill(system.pid_of(alice), 9)
            assert await alice.ask(Count()) == 1
            await until(events, hf.events.Recovered)
        assert len(await bob.ask(Noted())) == 1
    assert told.split()[0] == f"{trace_of(traced.one('request')):032x}"
    assert (len(traced.spans("handle Note")), len(traced.spans("handle Where"))) == (1, 1)


@pytest.mark.parametrize("kind", [Later, Piped], ids=["timer", "pipe"])
async def test_a_timer_and_a_pipe_go_on_in_the_trace(traced: Traced, kind: type[hf.Message[None]]) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk)))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            await alice.ask(kind())
        await noted_by(alice)
        await alice.ask(kind())
        noted = await noted_by(alice, 2)
    assert noted[1] == "none"
    assert parent_of(traced.spans("handle Note")[0]) == id_of(traced.one(f"handle {kind.__name__}"))


async def test_a_timer_that_repeats_is_in_no_trace_of_the_turn_that_set_it(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk)))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            await alice.ask(Again())
        assert (await noted_by(alice))[0] == "none"


async def test_a_cancelled_timer_makes_no_span(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk)))
        system.trace_with(traced.tracer, one_in=math.inf)
        await system.suspend(alice)
        with traced.tracer.start_as_current_span("request"):
            asked = asyncio.ensure_future(alice.ask(TooLate()))
        await system.resume(alice)
        await asked
        assert await alice.ask(Noted()) == []
    assert not traced.spans("handle Note")


async def test_one_timer_in_so_many_begins_a_trace(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk)))
        await alice.ask(Again())
        system.trace_with(traced.tracer, one_in=1)
        while not traced.spans("handle Note"):
            await asyncio.sleep(0)
    assert traced.spans("handle Note")[0].parent is None


async def test_a_trace_is_not_in_the_store(traced: Traced, tmp_path: Path) -> None:
    """What it adds to a message is not journaled: stores from before are read, and an older holdfast reads this one."""

    async def stored(name: str, tracer: Tracer | None) -> list[Any]:
        async with hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path / name}") as system:
            await system.start(hf.child("bob", hf.start(Stored), recovery=hf.replay_only()))
            spec = hf.child("alice", hf.start(Stored), bindings=NEXT, recovery=hf.replay_only())
            alice = await system.start(spec)
            system.trace_with(tracer, one_in=1)
            for kind in (Onto, Sent, Published, Onward):
                await alice.ask(kind())
        kept = (one for one in export_store(tmp_path / name) if one["record"] == "input")
        fields = [{key: value for key, value in one.items() if key not in ("time", "position")} for one in kept]
        for one in fields:  # Of an ask the last number is a time.
            one["origin"] = one["origin"].rpartition(".")[0]
        return sorted(fields, key=lambda one: (one["address"], one["input"]))

    plain = await stored("plain", None)
    assert len(plain) >= 8
    assert await stored("traced", traced.tracer) == plain
    traces = {f"{trace_of(one):032x}".encode() for one in traced.spans("handle Note")}
    assert traces
    written = b"".join(path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())
    assert b"traced_shop:Note" in written
    assert not [one for one in traces if one in written]


async def test_what_carries_no_trace(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk), recovery=hf.hybrid()))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            await alice.ask(Later())  # A timer of a recorded actor runs at its home, perhaps for days.
        assert await noted_by(alice) == ["none"]


async def test_a_process_without_a_provider_makes_no_spans(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("bob", hf.start(Clerk)))
        alice = await system.start(hf.child("alice", hf.start(Clerk), bindings=NEXT, isolation="process"))
        system.trace_with(traced.tracer, one_in=math.inf)
        with traced.tracer.start_as_current_span("request"):
            await alice.ask(Onward())
    assert parent_of(traced.one("handle Where")) == id_of(traced.one("ask Onward"))
    assert [one.name for one in traced.spans()] == ["handle Where", "ask Onward", "request"]


async def test_an_endpoint_in_a_thread_continues_its_span(traced: Traced) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Clerk)))
        system.trace_with(traced.tracer, one_in=math.inf)
        portal = system.from_thread()

        def endpoint() -> str:
            with traced.tracer.start_as_current_span("request"):
                return portal.ask(alice, Where(), timeout=5.0)

        told = await asyncio.to_thread(endpoint)
    assert told.split()[0] == f"{trace_of(traced.one('request')):032x}"
    assert parent_of(traced.one("ask Where")) == id_of(traced.one("request"))


class Raising(SpanProcessor):
    """A processor with a bug."""

    def __init__(self, where: str) -> None:
        self._where = where

    def on_start(self, span: Span, parent_context: Any = None) -> None:
        if self._where == "start":
            raise RuntimeError("of a start")

    def on_end(self, span: ReadableSpan) -> None:
        if self._where == "end":
            raise RuntimeError("of an end")


@pytest.mark.parametrize("where", ["start", "end"])
async def test_a_tracer_that_raises_hurts_no_actor(where: str) -> None:
    """Neither in the span of an ask, nor in that of a turn, of a restart, or of a recovery."""
    troubles: list[str] = []
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(lambda _, context: troubles.append(str(context["exception"])))
    provider = TracerProvider()
    provider.add_span_processor(Raising(where))
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        one = await system.start(hf.child("one", hf.start(Clerk)))
        kept = await system.start(hf.child("kept", hf.start(Clerk), isolation="process", recovery=hf.hybrid()))
        system.trace_with(provider.get_tracer("test"), one_in=1)
        with system.events() as events:
            assert await one.ask(Where(), timeout=30.0)  # It looks at its span, which is made at once.
            for ref in (one, kept):
                assert await ref.ask(Count(), timeout=30.0) == 1
                ref.kill()
                await ref.ask(Count(), timeout=30.0)
            assert not [event for event in events.take() if isinstance(event, hf.events.ActorCrashed)]
        system.trace_with(None)
        assert await system.ref("/app").ask(hf.supervision.CountChildren())
    assert set(troubles) == {f"of {'a start' if where == 'start' else 'an end'}"}


@pytest.mark.parametrize("end", ["crash", "close"])
def test_a_simulated_system_is_traced_alone(traced: Traced, end: str) -> None:
    """Roots and processes of a simulated run live in the process of the test: only the root that says so is traced."""
    inside = list[bool]()

    async def play(system: GuardedSystem, simulation: Simulation) -> None:
        near = await system.start(hf.child("near", hf.start(Clerk)))
        far = await system.start(hf.child("far", hf.start(Clerk), isolation="process"))
        system.trace_with(traced.tracer, one_in=1)
        for ref in (near, far):
            await ref.ask(Count())
        far.kill()
        await far.ask(Count())
        inside.append("take_in" in vars(type(near._cell)))
        if end == "crash":
            await simulation.crash_root()

    before = vars(Cell)["take_in"], ActorRef.tell
    simulate(seeds=3, intensity=100)(play)()
    assert inside
    assert all(inside)
    assert (vars(Cell)["take_in"], ActorRef.tell) == before  # What tracing has put in has gone with its nodes.
