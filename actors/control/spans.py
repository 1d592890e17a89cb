"""Spans of asks, tells and turns, in the traces of OpenTelemetry. Imported only when somebody wants them.

Nothing is tested for while nobody does: what is sent passes other methods of the cells of its node, and what stands in
a mailbox has another `run`, for as long as a system is traced. Other nodes of the process have other classes of cells.
"""

from __future__ import annotations

import asyncio
import contextvars
import functools
import math
import random
import types
from collections.abc import Callable
from contextvars import Token
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from opentelemetry import context as otel
from opentelemetry import trace
from opentelemetry.baggage.propagation import W3CBaggagePropagator
from opentelemetry.trace import (
    NonRecordingSpan,
    Span,
    SpanContext,
    SpanKind,
    Status,
    StatusCode,
    TraceFlags,
    Tracer,
)

from ..errors import type_name
from ..kernel.cell import Cell
from ..kernel.context import Piped
from ..kernel.envelope import Ask, Envelope, Item, chain_of
from ..kernel.ref import current
from ..kernel.timers import Tick
from .late_spans import LateSpan, LateSpans
from .trace_tail import TracedEnvelope, follow, tail_of, with_tail

if TYPE_CHECKING:
    from ..events import Event
    from ..kernel.context import ActorContext
    from ..kernel.node import Node

Coroutine_ = types.CoroutineType
NAME = "holdfast"
"""Of the tracer that an actor process takes from its global tracer provider."""
ADDRESS, BAGGAGE = "holdfast.address", "baggage"
PACKAGE = f"{__name__.partition('.')[0]}."
MOST_LAST = 1000
"""Addresses of which it is known what was asked there last."""
_BAGGAGE = W3CBaggagePropagator()


class _Current(NamedTuple):
    """How the current context of OpenTelemetry is read, set, and set back."""

    get: Callable[[], otel.Context]
    attach: Callable[[otel.Context], Token[otel.Context]]
    detach: Callable[[Token[otel.Context]], None]


def _current() -> _Current:
    """The context variable itself, if it can be found: every ask looks there, and the functions for it are slower."""
    mark = otel.Context()
    token = otel.attach(mark)
    try:
        for variable, value in contextvars.copy_context().items():
            if value is mark:
                return _Current(functools.partial(variable.get, mark), variable.set, variable.reset)
    finally:
        otel.detach(token)
    return _Current(otel.get_current, otel.attach, otel.detach)


_here, _attach, _detach = _current()


class Spans:
    """What a node needs to make spans.

    Args:
        node: whose actors are traced.
        tracer: makes the spans.
        share: of the messages that come from no trace, the part that begin one, from 0 to 1.
        baggage: what is in the baggage of whoever sends goes along, also where nothing is traced.
    """

    def __init__(self, node: Node, tracer: Tracer, share: float, *, baggage: bool) -> None:
        self.tracer, self.baggage = tracer, baggage
        self.share = share
        self._base = node.base_context.run(otel.get_current)  # of whoever entered the system: of no turn
        self.sink: Callable[[Event], None] = lambda event: None  # who makes spans of events, if anybody does
        self.last: dict[str, Span] = {}  # by address: of the last turn there that is in a trace
        self.late = LateSpans(node.loop, report)

    def around(self, ctx: ActorContext | None) -> otel.Context | None:
        """In which context of OpenTelemetry a message is sent that belongs to a trace; None if it does to none.

        Args:
            ctx: of the actor that sends it; None if none does.
        """
        here = otel.get_current()
        if (ctx is None or here is not self._base) and self._decides(here):
            return self._continued(here)
        if ctx is not None and chain_of(ctx._item):
            return None  # Whoever waits for this turn has decided.
        return self._begun()

    def _decides(self, here: otel.Context) -> bool:
        """Whether a context of OpenTelemetry says of what is sent in it whether it is in a trace."""
        if not here:
            return False
        return trace.get_current_span(here).get_span_context().is_valid or (self.baggage and bool(_held(here)))

    def _continued(self, here: otel.Context) -> otel.Context | None:
        """That context, if there is something in it that has to go along."""
        sampled = _is_sampled(trace.get_current_span(here).get_span_context())
        return here if sampled or (self.baggage and _held(here)) else None

    def _begun(self) -> otel.Context | None:
        """An empty context, if a trace begins with what is sent."""
        return otel.Context() if random.random() < self.share else None

    def remember(self, address: str, span: Span) -> None:
        """A turn there is in a trace: what happens to the actor next may have to do with it."""
        self.last[address] = span
        if len(self.last) > MOST_LAST:
            self.last.pop(next(iter(self.last)))

    def begin(
        self, verb: str, kind: SpanKind, cell: Cell, message: str, parent: otel.Context, begun: int | None = None
    ) -> Span:
        """A span about one message, of which the type is given, to one address; it began then, or begins now."""
        try:
            return self.tracer.start_span(_title(verb, message), parent, kind, {ADDRESS: cell.path}, start_time=begun)
        except Exception as error:
            report(error)
            return trace.INVALID_SPAN

    def tail(self, at: SpanContext, around: otel.Context) -> str:
        """What goes along with a message whose parent is this span."""
        held = _held(around) if self.baggage else ""
        return f"{_written(at)} {held}" if held else _written(at)

    def ask(self, ask: Ask, around: otel.Context) -> None:
        """An ask is about to be made: give it its trace, and perhaps a span up to its outcome."""
        if not around and _is_ours(ask.message):
            return
        if not around and _runs_here(ask.to):
            tail = BEGIN
        elif around and not _is_sampled(trace.get_current_span(around).get_span_context()):
            tail = self.tail(SpanContext(0, 0, is_remote=False), around)
        else:
            span, tail = self.ask_span(ask.to, ask.brings(), around)
            ask.future.add_done_callback(functools.partial(_outcome, span))
        ask.chain = with_tail(ask.chain, tail) if ask.chain else ((tail, 0),)
        follow(ask)

    def ask_span(self, to: Cell, message: str, around: otel.Context) -> tuple[Span, str]:
        """The span of an ask, and what goes along with the message."""
        span = self.begin("ask", SpanKind.CLIENT, to, message, around)
        return span, self.tail(span.get_span_context(), around)

    def outgoing(self, cell: Cell, item: Any) -> Any:
        """What is sent in place of an ask, a message or an envelope: one that has its trace, if it belongs to one."""
        kind = type(item)
        if kind is Ask:
            around = self.around(None if item.sender is None else current.get(None))
            if around is not None:
                self.ask(item, around)
            elif tail_of(item.chain) == BEGIN:
                item.chain = with_tail(item.chain, NO_TRACE)  # The trace of the turn that asks has begun.
            return item
        if kind is not Envelope and isinstance(item, Item):
            goes_on(item)
            return item
        message, sender = (item.message, item.sender) if kind is Envelope else (item, None)
        around = self.around(current.get(None))
        if around is None or (not around and _is_ours(message)):
            return item
        if type(message) not in cell.table:
            cell.require(message)
        if around:
            tail = self.tail(trace.get_current_span(around).get_span_context(), around)
        elif _runs_here(cell):
            tail = BEGIN
        else:
            span = self.begin("tell", SpanKind.PRODUCER, cell, type_name(type(message)), around)
            end(span)
            tail = self.tail(span.get_span_context(), around)
        return TracedEnvelope(message, sender, ((tail, 0),))

    def coming_back(self, item: Tick | Piped) -> None:
        """An actor's own timer or background work brings a message: it goes on in the trace of the turn that began it.

        What comes again and again does not, for that trace would have no end.
        """
        here = otel.get_current()  # It was kept with the timer, and with the task.
        is_once = not (isinstance(item, Tick) and item.timer.is_repeated)
        if item.message is None:
            return
        if is_once and here is not self._base and self._decides(here):
            around = self._continued(here)
        else:
            around = self._begun()
        if around is not None and (around or not _is_ours(item.message)):
            at = trace.get_current_span(around).get_span_context()
            item.chain = ((self.tail(at, around) if around else BEGIN, 0),)
            follow(item)

    def methods(self) -> dict[str, Callable[..., Any]]:
        """What is put before the methods of the node's cells."""
        outgoing, ask, share = self.outgoing, self.ask, self.share
        left = _next_one(share)

        def take_in(cell: Cell, _: Cell, item: Any) -> None:
            nonlocal left
            if type(item) is Ask and item.sender is None and not _here():  # From outside of any trace: the hot path.
                left -= 1
                if left <= 0:
                    left = _next_one(share)
                    ask(item, otel.Context())
                cell.admit(cell, item)
            else:
                cell.admit(cell, outgoing(cell, item))

        def push(cell: Cell, item: Item) -> None:
            if isinstance(item, Tick | Piped):
                self.coming_back(item)
            Cell.push(cell, item)

        def sent(cell: Cell, item: Any) -> Any:
            return outgoing(cell, item)

        return {"take_in": take_in, "push": push, "outgoing": sent}


BEGIN, NO_TRACE = "+", "-"
"""Stand for the trace of a message: its turn begins one; there is only baggage."""


def _next_one(share: float) -> float:
    """How many messages on the next one is that begins a trace, if each of them does with this probability.

    One number is drawn for all of them: those in between cost a subtraction.
    """
    if share <= 0.0:
        return math.inf
    return 1 if share >= 1.0 else int(math.log(1.0 - random.random()) / math.log1p(-share)) + 1


def _written(at: SpanContext) -> str:
    """A span, as W3C Trace Context writes it."""
    return f"00-{at.trace_id:032x}-{at.span_id:016x}-01" if _is_sampled(at) else NO_TRACE


def goes_on(item: Item) -> None:
    """Have what handles an item next, which leaves its turn, go on with the trace that this turn has begun."""
    if tail_of(item.chain) == BEGIN:
        at = trace.get_current_span().get_span_context()
        cast("Any", item).chain = with_tail(item.chain, _written(at))


@functools.lru_cache(4096)
def _title(verb: str, message: str) -> str:
    """The name of a span: what is done with a message, and the type of that without its module."""
    return f"{verb} {message.rpartition('.')[2]}"


def _runs_here(cell: Cell) -> bool:
    """Whether the very item that is sent is run here: then its turn can begin a trace, and needs no span before it."""
    return cell.ctx is not None and not cell.ctx._may_rest


def _is_ours(message: object) -> bool:
    """Whether it is a message of the runtime's own: such a one begins no trace."""
    return type(message).__module__.startswith(PACKAGE)


def _is_sampled(at: SpanContext) -> bool:
    return at.is_valid and at.trace_flags.sampled


def _held(around: otel.Context) -> str:
    """The baggage of a context, as it is written."""
    carrier = dict[str, str]()
    _BAGGAGE.inject(carrier, around)
    return carrier.get(BAGGAGE, "")


def context_of(tail: str) -> otel.Context:
    """The context that a message was sent in, as far as it came along."""
    found = otel.Context()
    if tail == BEGIN:
        return found
    written, _, held = tail.partition(" ")
    parts = written.split("-")
    if len(parts) == 4:
        try:
            ids = (int(part, 16) for part in parts[1:])
            at = SpanContext(next(ids), next(ids), is_remote=True, trace_flags=TraceFlags(next(ids)))
        except ValueError:  # Another process may say anything.
            return found
        found = trace.set_span_in_context(NonRecordingSpan(at), found)
    return _BAGGAGE.extract({BAGGAGE: held}, found) if held else found


def spans_of(node: Node) -> Spans | None:
    """What makes the spans of a node; None if nobody traces it."""
    watcher = node.cell_kinds.watcher
    return watcher if isinstance(watcher, Spans) else None


def trace_node(node: Node, tracer: Tracer, share: float, *, baggage: bool) -> Spans:
    """Trace a node from now on, by this tracer."""
    spans = Spans(node, tracer, share, baggage=baggage)
    node.cell_kinds.put_in(spans, spans.methods())
    return spans


def leave_node(node: Node) -> None:
    """Make no more spans of what a node sends and runs, but for those that wait to be made."""
    spans = spans_of(node)
    if spans is not None:
        spans.late.flush()
    node.cell_kinds.take_out()


# -- a turn -----------------------------------------------------------------------------------------------------------


def end(span: Span, at: int | None = None) -> None:
    """End a span. What the user's tracer raises is told, and hurts no actor."""
    try:
        span.end(at)
    except Exception as error:
        report(error)


def report(error: Exception) -> None:
    """Tell whoever looks after the loop that the user's tracer has failed."""
    context = {"message": "the tracer has failed; actors go on", "exception": error}
    asyncio.get_running_loop().call_exception_handler(context)


def in_span(run: Callable[[Any, Any], object], actor: Any, item: Any) -> object:
    """Run the turn of an item whose chain ends with a trace: it is a span, and so is current in the handler."""
    ctx: ActorContext = actor.ctx
    cell = ctx._cell
    tail, node = tail_of(item.chain), cell.node
    spans = spans_of(node)
    if item.is_cancelled or (spans is None and node.ports.uplink is None):
        return run(actor, item)  # There is nothing to do, or nobody traces any more what was sent in a trace.
    if spans is None:
        spans = trace_node(node, trace.get_tracer(NAME), 0.0, baggage=True)
    around = context_of(tail)
    span: Span | None = None
    if not tail.startswith(NO_TRACE):
        kind, brings = SpanKind.SERVER if item.is_ask else SpanKind.CONSUMER, item.brings()
        if tail == BEGIN:
            span = LateSpan(functools.partial(spans.begin, "handle", kind, cell, brings, around))
        else:
            span = spans.begin("handle", kind, cell, brings, around)
        spans.remember(cell.path, span)
        around = trace.set_span_in_context(span, around)
    if ctx._may_rest:
        ctx._continue_trace(tail if span is None else spans.tail(span.get_span_context(), around))
    turn = _Turn(ctx, spans, span, _attach(around))
    try:
        result = run(actor, item)
    except BaseException as error:
        turn.over(error)
        raise
    if type(result) is Coroutine_:
        return turn.followed(result)
    turn.over(None)
    return result


class _Turn(NamedTuple):
    """A turn that is in a trace."""

    ctx: ActorContext
    spans: Spans
    span: Span | None
    token: Token[otel.Context]

    async def followed(self, turn: Any) -> object:
        """Await the rest of the turn."""
        try:
            result = await turn
        except BaseException as error:
            self.over(error)
            raise
        self.over(None)
        return result

    def over(self, error: BaseException | None) -> None:
        """The turn has ended: by this error, if there is one."""
        if not isinstance(error, GeneratorExit):  # Else the life is over, and its context with it.
            _detach(self.token)
        if self.ctx._may_rest:
            self.ctx._continue_trace("")
        span = self.span
        if span is None:
            return
        if error is not None:
            if isinstance(error, Exception):
                span.record_exception(error)
            span.set_status(Status(StatusCode.ERROR, type(error).__name__))
        end(span)
        if isinstance(span, LateSpan) and not span.is_made:
            self.spans.late.add(span)


def _outcome(span: Span, done: Any) -> None:
    """The ask has its outcome, or nobody waits for it any more."""
    answered(span, asyncio.CancelledError() if done.cancelled() else done.exception())


def answered(span: Span, error: BaseException | None) -> None:
    """End the span of an ask: it was answered, or has failed by this error."""
    if isinstance(error, asyncio.CancelledError):
        span.set_status(Status(StatusCode.ERROR, "cancelled"))
    elif error is not None:
        span.set_attribute("error.type", type_name(type(error)))
        span.set_status(Status(StatusCode.ERROR, str(error)))
    end(span)


def ask_of_turn(node: Node, to: Cell, message: str, tail: str) -> tuple[str, Callable[[BaseException | None], None]]:
    """Make the span of an ask that a turn makes which was sent this trace; the home of that turn makes it.

    Returns:
        what goes along with the ask, and what is called with its outcome.
    """
    spans = spans_of(node)
    if spans is None or tail.startswith(NO_TRACE):
        return tail, lambda error: None
    span, onward = spans.ask_span(to, message, context_of(tail))
    return onward, functools.partial(answered, span)
