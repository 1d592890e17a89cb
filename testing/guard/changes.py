"""Finds what has changed in a value since it was handed on, and where in it.

A value is kept as its bytes, so nobody has to copy it, and compared by them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import msgspec

from ...actors.kernel.codec import encode_special


class ValueBytes:
    """Makes the bytes of values. What the codec does not take is in them by its type and identity."""

    def __init__(self) -> None:
        self.is_whole = True
        self._encoder = msgspec.msgpack.Encoder(enc_hook=self._special)

    def _special(self, value: Any) -> Any:
        try:
            return encode_special(value)
        except TypeError:
            self.is_whole = False
            return f"<{type(value).__qualname__} {id(value):#x}>"

    def of(self, value: object) -> bytes | None:
        """The bytes; None if there are none. `is_whole` says whether everything in the value is in them."""
        self.is_whole = True
        try:
            return self._encoder.encode(value)
        except Exception:  # msgspec raises what a hook or a field's own code raises: all means that there are none.
            self.is_whole = False
            return None


def changes(value: Any, was: bytes, now: bytes) -> dict[str, object]:
    """The containers in a value that are not as they were, by the path to them.

    >>> rows = {"a": [1], "b": [2]}
    >>> was = msgspec.msgpack.encode(rows)
    >>> rows["b"].append(3)
    >>> changes(rows, was, msgspec.msgpack.encode(rows))
    {"['b']": [2, 3]}
    """
    return dict(_differing(value, _plain(was), _plain(now), ""))


def _plain(body: bytes) -> Any:
    try:
        return msgspec.msgpack.decode(body, strict=False)
    except msgspec.DecodeError:  # A key that is a list is no key of a dict.
        return body


def _differing(value: Any, was: Any, now: Any, path: str) -> Iterator[tuple[str, object]]:
    if _same(was, now):
        return
    inner: list[tuple[str, object]] = []
    if type(was) is type(now) and (isinstance(was, dict) or (isinstance(was, list) and len(was) == len(now))):
        for part, name, key in _parts(value):
            if isinstance(was, dict):
                inner += _differing(part, was.get(key), now.get(key), path + name)
            elif isinstance(key, int) and key < len(was):
                inner += _differing(part, was[key], now[key], path + name)
    if inner:
        yield from inner
    elif not isinstance(value, (bool, int, float, str, bytes, type(None))):
        yield path, value


def _same(was: Any, now: Any) -> bool:
    """Whether two plain values are equal; a number that is none is equal to itself here."""
    return bool(was == now) or msgspec.msgpack.encode(was) == msgspec.msgpack.encode(now)


def _parts(value: Any) -> Iterator[tuple[Any, str, Any]]:
    """What is in a container: itself, its name behind the container's, and its place in the plain form."""
    if isinstance(value, msgspec.Struct):
        is_list = type(value).__struct_config__.array_like
        for number, name in enumerate(value.__struct_fields__):
            yield getattr(value, name), f".{name}", number if is_list else value.__struct_encode_fields__[number]
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield getattr(value, field.name), f".{field.name}", field.name
    elif isinstance(value, dict):
        for key, part in value.items():
            yield part, f"[{key!r}]", key
    elif isinstance(value, (list, tuple)):
        for number, part in enumerate(value):
            yield part, f"[{number}]", number
