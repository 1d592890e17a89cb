"""Fields for log records that are written in a turn: whose turn it is, of which message, and in which trace.

They are looked up when a record is written, so turns pay nothing for them.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import MutableMapping
from typing import Any, Final

from ...actors.errors import HoldfastError
from ...actors.kernel.context import begun_in
from ...actors.kernel.envelope import Item, item_name
from ...actors.kernel.ref import current

FIELDS: Final = ("address", "message_type", "message_id", "trace_id", "span_id")
"""What a record may get. `message_id` is there in actors with recovery, the last two inside of a span."""


def turn_fields() -> dict[str, str]:
    """What there is to say of the turn, or of its background work, that calls this; nothing outside of actors."""
    found: dict[str, str] = {}
    ctx = current.get(None)
    if ctx is not None:
        found["address"] = ctx.path
        item = begun_in.get() or ctx._item
        if item is not None:
            found["message_type"] = item.brings() if isinstance(item, Item) else item_name(item)
        try:
            found["message_id"] = ctx.message_id
        except HoldfastError:  # It has no recovery, or nothing is in hand.
            pass
    trace = sys.modules.get("opentelemetry.trace")  # Whoever has spans has imported it.
    if trace is not None:
        span = trace.get_current_span().get_span_context()
        if span.is_valid:
            found["trace_id"], found["span_id"] = format(span.trace_id, "032x"), format(span.span_id, "016x")
    return found


def add_turn(logger: Any, method: str, record: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Add the fields to a record of structlog: `structlog.configure(processors=[add_turn, ...])`."""
    for name, value in turn_fields().items():
        record.setdefault(name, value)
    return record


class TurnFilter(logging.Filter):
    """Adds the fields to records of standard logging: `handler.addFilter(TurnFilter())`. What there is not is ""."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Let every record through, with its fields."""
        found = turn_fields()
        for name in FIELDS:
            if not hasattr(record, name):
                setattr(record, name, found.get(name, ""))
        return True
