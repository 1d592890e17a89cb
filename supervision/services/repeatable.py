"""Which messages lead to the same if they are handled twice, of those that the actors of the runtime answer.

Such actors keep no journal of what they were asked. When the program ends while a recorded turn waits for an answer of
theirs, nobody knows whether they had the message: the next program asks again what bears that.
"""

from __future__ import annotations

from typing import Any, Final

from ...actors.kernel.codec import Codec
from ...actors.kernel.message import Message, message_name
from ..admin import (
    CountChildren,
    DeleteChild,
    EndedChildren,
    GetChildSpec,
    StartChild,
    TerminateChild,
    WhichChildren,
)
from .partition import CountPartitions, ResizePartitions, Route
from .pool import PoolInfo, ResizePool
from .registrar import Count, DeleteMeta, DropEntries, Find, GetMeta, Lock, PutMeta, Register

ALWAYS: Final[tuple[type[Message[Any]], ...]] = (
    *(WhichChildren, EndedChildren, CountChildren, GetChildSpec, TerminateChild, DeleteChild),
    *(PoolInfo, ResizePool, Route, CountPartitions, ResizePartitions),
    *(Find, Count, GetMeta, PutMeta, DeleteMeta, Register, DropEntries, Lock),
)
KINDS: Final[dict[str, type]] = {message_name(kind): kind for kind in ALWAYS} | {message_name(StartChild): StartChild}


def bears_repetition(codec: Codec, name: str, body: bytes) -> bool:
    """Whether a message, which is encoded, leads to the same if it is handled twice.

    A child that is started by its id is there already, and its ref comes with `AlreadyStarted`. One that gets its id
    at its start would be there twice, and what a `fresh` one has recorded by then would be lost.
    """
    kind = KINDS.get(name)
    if kind is not StartChild:
        return kind is not None
    start: StartChild = codec.decode(StartChild, body)
    return not start.fresh and start.id is not None
