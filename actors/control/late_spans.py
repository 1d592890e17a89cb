"""Spans of turns that begin a trace and look at nothing of it: they are made later, some at once.

An SDK takes three times as long for a span between other work as for one of many in a row. So such a turn leaves a few
values behind, and its span is made of them in an idle moment, with the times that it had. A turn that looks at its
span, or sends something in it, has it made at once.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from opentelemetry.trace import Span, SpanContext, Status, StatusCode
from opentelemetry.util.types import AttributeValue

if TYPE_CHECKING:
    from opentelemetry.util.types import Attributes

MOST = 64
"""Spans that wait to be made; with so many they are made now."""
LATEST = 0.1
"""Seconds after which they are made."""


class LateSpan(Span):
    """A span that is made when somebody looks at it, or some time after its end.

    Args:
        make: makes the real span, which began at this time, in nanoseconds since 1970.
        begun: that time.
    """

    __slots__ = ("_begun", "_ended", "_make", "_real")

    def __init__(self, make: Callable[[int], Span]) -> None:
        self._make, self._begun = make, time.time_ns()
        self._real: Span | None = None
        self._ended = 0

    @property
    def is_made(self) -> bool:
        """Whether there is a real span."""
        return self._real is not None

    def made(self) -> Span:
        """Return the real span, made now if there was none."""
        if self._real is None:
            self._real = self._make(self._begun)
            if self._ended:
                self._real.end(self._ended)
        return self._real

    def get_span_context(self) -> SpanContext:
        return self.made().get_span_context()

    def end(self, end_time: int | None = None) -> None:
        if self._real is not None:
            self._real.end(end_time)
        else:
            self._ended = end_time or time.time_ns()

    def set_attributes(self, attributes: Mapping[str, AttributeValue]) -> None:
        self.made().set_attributes(attributes)

    def set_attribute(self, key: str, value: AttributeValue) -> None:
        self.made().set_attribute(key, value)

    def add_event(self, name: str, attributes: Attributes = None, timestamp: int | None = None) -> None:
        self.made().add_event(name, attributes, timestamp)

    def add_link(self, context: SpanContext, attributes: Attributes = None) -> None:
        self.made().add_link(context, attributes)

    def update_name(self, name: str) -> None:
        self.made().update_name(name)

    def is_recording(self) -> bool:
        return self.made().is_recording()

    def set_status(self, status: Status | StatusCode, description: str | None = None) -> None:
        self.made().set_status(status, description)

    def record_exception(
        self,
        exception: BaseException,
        attributes: Attributes = None,
        timestamp: int | None = None,
        escaped: bool = False,
    ) -> None:
        self.made().record_exception(exception, attributes, timestamp, escaped)


class LateSpans:
    """The spans of a node that have ended and are not made yet: at most `MOST`, and none for longer than `LATEST`."""

    def __init__(self, loop: asyncio.AbstractEventLoop, report: Callable[[Exception], None]) -> None:
        self._loop, self._report = loop, report
        self._spans: list[LateSpan] = []
        self._timer: asyncio.TimerHandle | None = None

    def add(self, span: LateSpan) -> None:
        """Have a span made that has ended."""
        self._spans.append(span)
        if len(self._spans) >= MOST:
            self.flush()
        elif self._timer is None:
            self._timer = self._loop.call_later(LATEST, self.flush)

    def flush(self) -> None:
        """Make all that wait. What the user's tracer raises is told, and hurts no other one."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        spans, self._spans = self._spans, []
        for span in spans:
            try:
                span.made()
            except Exception as error:
                self._report(error)
