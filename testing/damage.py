"""Damage: another value of the same type, as a transient value fault leaves it."""

from __future__ import annotations

import random
from typing import Any

import msgspec

from ..actors.kernel.message import Message


def damaged(value: Any, draw: random.Random) -> Any:
    """A value of the same type that differs in one place; the same object if there is nothing to change in it.

    >>> damaged(5, random.Random(1)) != 5, damaged("bank", random.Random(1)) != "bank", damaged(None, random.Random(1))
    (True, True, None)
    """
    match value:
        case bool():
            return not value
        case int():
            return value ^ (1 << draw.randrange(31))  # One bit is flipped.
        case float():
            return -value if value else 1.0
        case str():
            return "".join(map(chr, _one_flipped([ord(one) for one in value], draw)))
        case bytes():
            return bytes(_one_flipped(list(value), draw))
        case msgspec.Struct():
            return _damaged_struct(value, draw)
        case list() | tuple():
            return type(value)(_one_damaged(list(value), draw))
        case dict():
            return dict(zip(value, _one_damaged(list(value.values()), draw), strict=True))
        case _:
            return value


def _one_flipped(codes: list[int], draw: random.Random) -> list[int]:
    """The lowest bit of one of the codes is flipped; without any there is one now."""
    if not codes:
        return [0]
    index = draw.randrange(len(codes))
    return [*codes[:index], codes[index] ^ 1, *codes[index + 1 :]]


def _one_damaged(parts: list[Any], draw: random.Random) -> list[Any]:
    """The first part, from a random one on, that can be damaged, is."""
    begin = draw.randrange(len(parts)) if parts else 0
    for index in [*range(begin, len(parts)), *range(begin)]:
        other = damaged(parts[index], draw)
        if other is not parts[index]:
            return [*parts[:index], other, *parts[index + 1 :]]
    return parts


def _damaged_struct(value: Any, draw: random.Random) -> Any:
    names = value.__struct_fields__
    fields = [getattr(value, name) for name in names]
    others = _one_damaged(fields, draw)
    if all(one is other for one, other in zip(fields, others, strict=True)):
        return value
    changed: Message[Any] = msgspec.structs.replace(value, **dict(zip(names, others, strict=True)))
    return changed
