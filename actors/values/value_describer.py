"""Describes packed values to people and other programs: instances of users' classes as names and fields."""

from __future__ import annotations

from typing import Any, NamedTuple

from msgpack import ExtType

from .forms import ENUM
from .value_reader import Decoder


class ValueDescription(NamedTuple):
    """An instance of a class that is not imported: its name as "module:Class", and its fields.

    A member of an enum has one field, which is "".
    """

    kind: str
    fields: tuple[tuple[str, Any], ...]


class Describer(Decoder):
    """A decoder that imports nothing of users, and makes nothing of their classes."""

    def make_defaultdict(self, parts: list[Any]) -> object:
        return dict(zip(parts[1::2], parts[2::2], strict=True))

    def make_ref(self, parts: list[Any]) -> object:
        [path] = parts
        return ValueDescription("holdfast:ActorRef", (("path", path),))

    def make_enum(self, parts: list[Any]) -> object:
        kind, member = parts
        return ValueDescription(str(kind), (("", member),))

    def make_record(self, mark: ExtType, parts: list[Any]) -> object:
        assert mark is not ENUM
        return ValueDescription(str(parts[0]), tuple(zip(map(str, parts[1::2]), parts[2::2], strict=True)))
