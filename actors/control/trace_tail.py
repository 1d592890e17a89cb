"""Which trace a message belongs to: it rides at the end of the chain of those who wait for the message.

A chain travels wherever a message does: through mailboxes, homes, mechanisms and processes. Its last entry may be no
turn but a trace, as W3C Trace Context writes it, perhaps with baggage behind it. So nothing else had to learn of
traces, and a message without one carries nothing more than before. This module never imports OpenTelemetry.
"""

from __future__ import annotations

import functools
import types
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import msgspec

from ..kernel.envelope import Chain, Envelope, waiters

if TYPE_CHECKING:
    from ..kernel.cell import Cell
    from ..kernel.envelope import Item
    from ..kernel.node import Node


def tail_of(chain: Chain) -> str:
    """The trace that a chain ends with; "" if it has none."""
    return chain[-1][0] if chain and not chain[-1][0].startswith("/") else ""


def with_tail(chain: Chain, tail: str) -> Chain:
    """The chain with this trace at its end, in the place of the one that it had."""
    return (*(chain[: len(waiters(chain))]), (tail, 0))


class TracedEnvelope(Envelope, eq=False):
    """A message that nobody waits for, and that belongs to a trace."""

    is_followed = True
    chain: Chain = ()

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        return _in_span()(Envelope.run, actor, item)

    def stashed(self) -> None:
        _goes_on()(self)


def enveloped(message: Any, sender: Any, chain: Chain) -> Any:
    """What stands in a mailbox for a message nobody waits for: itself, if it has neither a sender nor a trace."""
    if chain:
        return TracedEnvelope(message, sender, chain)
    return message if sender is None else Envelope(message, sender)


def follow(item: Item) -> None:
    """Have the turn of an item be a span, if its chain ends with a trace: it gets another class, with another `run`."""
    if tail_of(item.chain) and not item.is_followed:
        cast("Any", item).__class__ = _traced_class(cast("Any", type(item)))


@functools.cache
def _traced_class(kind: type[Item]) -> Any:
    """The class of such items whose turn is a span, made once."""

    def run(actor: Any, item: Any) -> object:
        return _in_span()(kind.run, actor, item)

    def stashed(item: Any) -> None:
        kind.stashed(item)
        _goes_on()(item)

    space, options = (
        {"run": staticmethod(run), "stashed": stashed, "__module__": kind.__module__, "is_followed": True},
        dict[str, Any](),
    )
    if issubclass(kind, msgspec.Struct):
        options["eq"] = False
    else:
        space["__slots__"] = cast("Any", ())
    return types.new_class(f"Traced{kind.__name__}", (kind,), options, lambda made: made.update(space))


def ask_of_turn(node: Node, to: Cell, message: str, tail: str) -> tuple[str, Callable[[BaseException | None], None]]:
    """Make the span of an ask whose turn is in this trace: what goes along with it, and what hears its outcome."""
    from .spans import ask_of_turn

    return ask_of_turn(node, to, message, tail)


@functools.cache
def _goes_on() -> Callable[[Any], None]:
    """What has an item go on with the trace that its turn has begun."""
    from .spans import goes_on

    return goes_on


@functools.cache
def _in_span() -> Callable[[Any, Any, Any], object]:
    """What runs a turn in a span. Only who has a message of a trace in hand needs OpenTelemetry."""
    from .spans import in_span

    return in_span
