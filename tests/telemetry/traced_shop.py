"""Actors that say which span they are in, and, in a process of their own, which spans were made there."""

import asyncio
import contextlib
from collections.abc import Iterable
from typing import Any

from opentelemetry import baggage, trace
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

import holdfast as hf


class Where(hf.Message[str]):
    """Answered with the trace id and the span id of the handler's span, or "none"."""


class Note(hf.Message):
    """Told: the actor keeps where it was handled."""


class Noted(hf.Message[list[str]]): ...


class Held(hf.Message[str]):
    """Answered with what the baggage has for "request"."""


class Made(hf.Message[list[str]]):
    """Answered with the names and traces of the spans that were made in this process."""


class Count(hf.Message[int]):
    """Counted, and answered with how many there were."""


class Fail(hf.Message[str]): ...


class Onward(hf.Message[str]):
    """Asks the next one where it is."""


class Blame(hf.Message[None]):
    """Has the next one fail."""


class Onto(hf.Message[None]):
    """Tells the next one a note."""


class Sent(hf.Message[None]):
    """Sends the next one a note."""


class Published(hf.Message[None]):
    """Publishes a note."""


class Later(hf.Message[None]):
    """Has a note come to the actor itself, at once."""


class Again(hf.Message[None]):
    """Has notes come to the actor itself, every 10 ms."""


class TooLate(hf.Message[None]):
    """Has a note come to the actor itself, and cancels that when it is queued."""


class Piped(hf.Message[None]):
    """Has a note come from background work."""


def here() -> str:
    at = trace.get_current_span().get_span_context()
    return f"{at.trace_id:032x} {at.span_id:016x}" if at.is_valid else "none"


EXPORTED = InMemorySpanExporter()


def lines(spans: Iterable[ReadableSpan]) -> list[str]:
    """Name, trace and parent of spans."""
    made = list[str]()
    for one in spans:
        assert one.context is not None
        made.append(f"{one.name} {one.context.trace_id:032x} {one.parent.span_id if one.parent else 0:016x}")
    return made


class Pass(hf.Message[str]):
    """Asks the next one onward, or where it is."""


class Clerk(hf.Actor):
    next_one: "hf.Binding[Clerk]"

    def __init__(self, provides: bool = False) -> None:
        self.notes: list[str] = []
        self.count = 0
        if provides and not isinstance(trace.get_tracer_provider(), TracerProvider):  # once in a process
            provider = TracerProvider()
            provider.add_span_processor(SimpleSpanProcessor(EXPORTED))
            trace.set_tracer_provider(provider)

    key_variables = ("notes", "count")

    @hf.on(Where)
    async def where(self, message: Where) -> str:
        return here()

    @hf.subscribe("/notes")
    @hf.on(Note)
    def note(self, message: Note) -> None:
        self.notes = [*self.notes, here()]

    @hf.on(Noted)
    def noted(self, message: Noted) -> list[str]:
        return self.notes

    @hf.on(Held)
    def held(self, message: Held) -> str:
        return str(baggage.get_baggage("request"))

    @hf.on(Made)
    def made(self, message: Made) -> list[str]:
        return lines(EXPORTED.get_finished_spans())

    @hf.on(Count)
    def counted(self, message: Count) -> int:
        self.count += 1
        return self.count

    @hf.on(Fail)
    def fail(self, message: Fail) -> str:
        raise ValueError("failed")

    @hf.on(Onward)
    async def onward(self, message: Onward) -> str:
        return await self.next_one.ask(Where())

    @hf.on(Blame)
    async def blame(self, message: Blame) -> None:
        with contextlib.suppress(hf.errors.RemoteCrash):
            await self.next_one.ask(Fail())

    @hf.on(Onto)
    def onto(self, message: Onto) -> None:
        self.next_one.tell(Note())

    @hf.on(Sent)
    async def sent(self, message: Sent) -> None:
        await self.next_one.send(Note())

    @hf.on(Published)
    async def published(self, message: Published) -> None:
        await self.ctx.publish("/notes", Note())

    @hf.on(Later)
    def later(self, message: Later) -> None:
        self.ctx.tell_after(0.0, Note())

    @hf.on(Again)
    def again(self, message: Again) -> None:
        self.ctx.every(0.01, Note())

    @hf.on(TooLate)
    async def too_late(self, message: TooLate) -> None:
        timer: Any = self.ctx.tell_after(0.0, Note())
        while not timer.is_queued:
            await asyncio.sleep(0)
        timer.cancel()

    @hf.on(Piped)
    def piped(self, message: Piped) -> None:
        self.ctx.pipe_to_self(asyncio.sleep(0), lambda _: Note())

    @hf.on(Pass)
    def passed(self, message: Pass) -> str:
        return here()


class Stored(Clerk):
    """One whose state says nothing of spans."""

    @hf.subscribe("/notes")
    @hf.on(Note)
    def note(self, message: Note) -> None:
        self.count += 1

    @hf.on(Where)
    async def where(self, message: Where) -> str:
        return "here"


class Stasher(hf.Actor):
    """Puts the first message aside, and answers it when it comes again."""

    def __init__(self) -> None:
        self.has_stashed = False

    @hf.on(Pass)
    def passed(self, message: Pass) -> str:
        if self.has_stashed:
            return "again"
        self.has_stashed = True
        self.ctx.stash()
        self.ctx.unstash()
        return ""


class Through(hf.Actor):
    """Hands on what it is asked."""

    next_one: "hf.Binding[Clerk]"

    @hf.on(Pass)
    async def passed(self, message: Pass) -> str:
        return await self.next_one.ask(Pass())


class Forwarder(hf.Actor):
    """Leaves the answer to another one."""

    next_one: "hf.Binding[Clerk]"

    @hf.on(Pass)
    def passed(self, message: Pass) -> hf.ReplyHandle[str]:
        handle: hf.ReplyHandle[str] = self.ctx.reply_handle()
        self.ctx.forward(self.next_one)
        return handle
