"""What was read of a home and is coded otherwise than its class codes it now; it is mapped before the home is used."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from ...actors.kernel.actor import Actor
from .field_tables import Shape, difference, shape_of
from .mapping import BodyMapper
from .present_classes import present_class

if TYPE_CHECKING:
    from ...actors.kernel.codec import Codec

Place: TypeAlias = "tuple[int, int]"
"""A turn, and the number of its output."""


class OldRecords:
    """What the journal of one home has that was written otherwise than it would be now, each with what maps it.

    Attributes:
        inputs: by number.
        outcomes: of asks, effects and waits, by (turn, output).
        timers: by key.
        kept: messages that were kept until the home is opened, by origin.
    """

    def __init__(self, codec: Codec, kind: type[Actor] | None) -> None:
        self._codec, self._kind = codec, kind
        self._tables: dict[str, Shape] = {}  # in force at the place to which the journal was read
        self._mappers: dict[str, BodyMapper | None] = {}
        self.inputs: dict[int, BodyMapper] = {}
        self.outcomes: dict[Place, BodyMapper] = {}
        self.timers: dict[str, BodyMapper] = {}
        self.kept: dict[str, BodyMapper] = {}

    def read(self, name: str, table: Shape) -> None:
        """What follows was written with this table."""
        self._tables[name] = table
        self._mappers.pop(name, None)

    def mapper(self, name: str) -> BodyMapper | None:
        """What maps what is read next; None if it would be written just so now, or its class is not known here."""
        if name not in self._mappers:
            self._mappers[name] = mapper_of(name, self._tables.get(name), self._kind, self._codec)
        return self._mappers[name]


def mapper_of(name: str, table: Shape | None, kind: type[Actor] | None, codec: Codec) -> BodyMapper | None:
    """What maps that which was written under a name with a table (None: nobody has said); None if nothing has to be.

    Args:
        name: of its type, or as `shape_name` gives it.
        table: with which it was written.
        kind: the actor's class, if it is known here.
        codec: of this node.
    """
    found = present_class(name, kind)
    if found is None:
        return None
    now, kind_now = found
    if now == name and (table is None or not difference(table, shape_of(kind_now))):
        return None
    return BodyMapper(name, now, kind_now, table, codec)
