"""Damage: another value of the same type, as a transient value fault leaves it."""

from __future__ import annotations

import random
from typing import Any

import msgspec

from ..actors.message import Message


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
            return _one_changed(value, draw, lambda one: chr(ord(one) ^ 1)) if value else "\x00"
        case bytes():
            return bytes(_one_changed(list(value), draw, lambda one: one ^ 1)) if value else b"\x00"
        case msgspec.Struct():
            return _damaged_struct(value, draw)
        case list() | tuple():
            return type(value)(_one_damaged(list(value), draw))
        case dict():
            return dict(zip(value, _one_damaged(list(value.values()), draw), strict=True))
        case _:
            return value


def _one_changed(value: Any, draw: random.Random, change: Any) -> Any:
    index = draw.randrange(len(value))
    middle = change(value[index])
    return value[:index] + (middle if isinstance(value, str) else [middle]) + value[index + 1 :]


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
