"""Spans of what happens to actors between their turns: restarts, recoveries, failovers, and changes of mechanisms."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from opentelemetry import context as otel
from opentelemetry import trace
from opentelemetry.trace import Link, Span, Tracer

from ..actors.control.spans import Spans, end, leave_node, report, spans_of, trace_node
from ..actors.events import ActorStarted, ChildRestarted, Event, Recovered
from ..ftm.events import FailedOver, MechanismAttached, MechanismChanged, MechanismDetached

if TYPE_CHECKING:
    from ..actors.kernel.node import Node

PHASES = ("detect", "isolate", "restart", "restore", "replay", "release")
"""Of a recovery, in order."""


def trace_system(node: Node, tracer: Tracer | None, share: float, *, baggage: bool) -> None:
    """Trace a root's node by this tracer, or (None) no more."""
    before = spans_of(node)
    if before is not None:
        node.events.remove_sink(before.sink)
        leave_node(node)
    if tracer is not None:
        spans = trace_node(node, tracer, share, baggage=baggage)
        spans.sink = EventSpans(spans)
        node.events.add_sink(spans.sink)


class EventSpans:
    """A sink that makes spans of events that tell how long something took. Each links to the last ask at its address.

    What is handled again in a recovery is no new work: the recovery has one span for all of it.
    """

    def __init__(self, spans: Spans) -> None:
        self._spans = spans
        self._restarted: dict[str, tuple[int, str]] = {}  # since when, and why

    def __call__(self, event: Event) -> None:
        spans = self._spans
        match event:
            case ChildRestarted(address=address, reason=reason):
                self._restarted[address] = (time.time_ns(), str(reason))
            case ActorStarted(address=address) if address in self._restarted:
                begun, why = self._restarted.pop(address)
                span = _begin(spans, "restart", event, begun)
                span.set_attributes({"holdfast.reason": why, "holdfast.life": event.life})
                end(span)
            case Recovered():
                _recovery(spans, event)
            case FailedOver(replica=replica, epoch=epoch, seconds=seconds, why=why):
                span = _begin(spans, "failover", event, _ago(seconds))
                span.set_attributes({"holdfast.replica": replica, "holdfast.epoch": epoch, "holdfast.reason": why})
                end(span)
            case MechanismAttached(seconds=seconds) | MechanismDetached(seconds=seconds):
                end(_begin(spans, "change mechanism", event, _ago(seconds)))
            case MechanismChanged(seconds=seconds, layers=layers):
                span = _begin(spans, "change mechanism", event, _ago(seconds))
                span.set_attribute("holdfast.mechanism", "+".join(layers))
                end(span)
            case _:
                pass


def _ago(seconds: float) -> int:
    return time.time_ns() - int(seconds * 1e9)


def _begin(spans: Spans, name: str, event: Event, begun: int, below: otel.Context | None = None) -> Span:
    last = spans.last.get(event.address) if below is None else None
    links = () if last is None else (Link(last.get_span_context()),)
    about = {"holdfast.address": event.address} if below is None else {}
    try:
        return spans.tracer.start_span(name, below or otel.Context(), attributes=about, links=links, start_time=begun)
    except Exception as error:
        report(error)
        return trace.INVALID_SPAN


def _recovery(spans: Spans, event: Recovered) -> None:
    """A span for the recovery, and one for each of its phases below it."""
    begun = _ago(sum(event.phases.values()))
    whole = _begin(spans, "recover", event, begun)
    whole.set_attributes({"holdfast.replayed": event.replayed, "holdfast.life": event.life})
    below = trace.set_span_in_context(whole, otel.Context())
    for phase in PHASES:
        if phase in event.phases:
            until = begun + int(event.phases[phase] * 1e9)
            end(_begin(spans, phase, event, begun, below), until)
            begun = until
    end(whole, begun)
