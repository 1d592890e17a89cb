"""Canonical forms: two answers that mean the same have the same form, whoever computed them (T44).

A form is a number, text, bytes, None, or a tuple that begins with the name of what it is; it can be hashed.
"""

from __future__ import annotations

import dataclasses
import datetime
import decimal
import enum
import math
import sys
from collections import deque
from fractions import Fraction
from typing import Any, Final, TypeGuard

import msgspec

from ...actors.errors import type_name
from ...actors.kernel.codec import ARRAY, decode_array
from ...checkpoint.protocol import CRASH, REPLY, Answer, TurnEnd

_EPOCH: Final = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_NAIVE: Final = datetime.datetime(1970, 1, 1)
_MICROSECOND: Final = datetime.timedelta(microseconds=1)
_TIMES: Final = ("instant", "wall", "span")
_ATOMS: Final = (type(None), str, bytes, int)


class Absent:
    """Stands for a ballot that is missing; there is one, `ABSENT`."""

    def __repr__(self) -> str:
        return "ABSENT"


ABSENT: Final = Absent()


class Other:
    """A value of a class that nothing is known of: equal if it says so."""

    __slots__ = ("value",)

    def __init__(self, value: object) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Other) and type(self.value) is type(other.value) and bool(self.value == other.value)

    def __hash__(self) -> int:
        return hash(type(self.value))

    def __repr__(self) -> str:
        return repr(self.value)


def canonical(value: Any) -> Any:
    """The canonical form of a value.

    Dicts and sets have no order. Lists and tuples are the same, as they are on the wire. Not-a-number is one value,
    -0.0 is 0, 3.0 is 3, but True is not 1. Times with a zone are instants, those without are another kind. Objects are
    their class and fields.

    >>> canonical({"b": 1, "a": (2, 3.0)}) == canonical({"a": [2, 3], "b": 1.0})
    True
    >>> canonical([float("nan"), True]) == canonical([float("nan"), 1])
    False
    """
    kind = type(value)
    if kind in _ATOMS:
        return value
    if kind is float:
        return ("nan",) if math.isnan(value) else value
    if kind is bool:
        return ("bool", value)
    if isinstance(value, enum.Enum):
        return ("enum", type_name(kind), value.name)
    if kind in (list, tuple, deque):
        return ("list", *map(canonical, value))
    if isinstance(value, dict):
        items = [(canonical(key), canonical(item)) for key, item in value.items()]
        return ("dict", *sorted(items, key=lambda item: _key_order(item[0])))
    if isinstance(value, set | frozenset):
        return ("set", frozenset(map(canonical, value)))
    if isinstance(value, datetime.date | datetime.time | datetime.timedelta):
        return _time_form(value)
    return _object_form(kind, value)


def _key_order(key: Any) -> tuple[str, str]:
    number = isinstance(key, int | float)
    return ("number" if number else type(key).__name__, repr(float(key) if number and abs(key) < 2**53 else key))


def _time_form(value: datetime.date | datetime.time | datetime.timedelta) -> Any:
    if isinstance(value, datetime.datetime):
        if value.utcoffset() is None:
            return ("wall", (value.replace(tzinfo=None) - _NAIVE) // _MICROSECOND)
        return ("instant", (value - _EPOCH) // _MICROSECOND)
    if isinstance(value, datetime.timedelta):
        return ("span", value // _MICROSECOND)
    return ("date", value.isoformat())


def _object_form(kind: type, value: Any) -> Any:
    if isinstance(value, bytearray | memoryview):
        return bytes(value)
    if isinstance(value, decimal.Decimal):
        return ("nan",) if value.is_nan() else value
    if isinstance(value, Fraction | complex):
        return value
    if isinstance(value, msgspec.Struct):
        return (type_name(kind), *((name, canonical(getattr(value, name))) for name in kind.__struct_fields__))  # type: ignore[attr-defined]
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        return (type_name(kind), *((field.name, canonical(getattr(value, field.name))) for field in fields))
    if isinstance(value, BaseException):
        return (type_name(kind), *map(canonical, value.args))
    if isinstance(value, msgspec.msgpack.Ext):
        return _extension_form(value)
    numpy = sys.modules.get("numpy")
    if numpy is not None and isinstance(value, numpy.ndarray):
        return ("array", value.shape, canonical(value.reshape(-1).tolist()))
    if numpy is not None and isinstance(value, numpy.generic):
        return canonical(value.item())
    for base in (int, float, str, bytes):  # a subclass means what its base means
        if isinstance(value, base):
            return canonical(base(value))  # type: ignore[arg-type]
    return Other(value)


def _extension_form(value: msgspec.msgpack.Ext) -> Any:
    data = bytes(value.data)
    return canonical(decode_array(memoryview(data))) if value.code == ARRAY else ("extension", value.code, data)


# -- nearness --------------------------------------------------------------------------------------------------------


def close(one: Any, other: Any, abs_: float, rel: float, seconds: float, integers: bool) -> bool:
    """Whether two canonical forms are the same but for numbers and times that differ a little."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        first: tuple[Any, ...] = one
        second: tuple[Any, ...] = other
        if len(first) != len(second):
            return False
        if len(first) == 2 and first[0] in _TIMES and first[0] == second[0]:
            return bool(abs(first[1] - second[1]) <= seconds * 1e6)
        return all(close(a, b, abs_, rel, seconds, integers) for a, b in zip(first, second, strict=True))
    if _is_number(one) and _is_number(other) and (_is_inexact(one, integers) or _is_inexact(other, integers)):
        try:
            return bool(one == other or math.isclose(one, other, rel_tol=rel, abs_tol=abs_))
        except OverflowError:  # an integer that no float can hold
            return bool(one == other)
    if isinstance(one, complex) and isinstance(other, complex):
        return one == other or abs(one - other) <= max(abs_, rel * max(abs(one), abs(other)))
    return bool(one == other)


def _is_number(form: object) -> TypeGuard[float]:
    return isinstance(form, int | float | decimal.Decimal | Fraction)


def _is_inexact(form: object, integers: bool) -> bool:
    return isinstance(form, float | decimal.Decimal | Fraction) or (integers and type(form) is int)


# -- what is encoded -------------------------------------------------------------------------------------------------


def body_form(body: bytes, kind: Any = None) -> Any:
    """The canonical form of an encoded payload; of bytes that are no payload, the bytes.

    Args:
        body: MessagePack, as the wire codec writes it.
        kind: its type, if it has one that matters: a set comes as a list, in no particular order.
    """
    try:
        value: Any = msgspec.msgpack.decode(body, type=Any if kind is None else kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return ("bytes", body)
    return canonical(value)


def answer_form(answer: Answer, kind: Any = None) -> Any:
    """The canonical form of an encoded answer: ("answer", kind, class, payload). A crash's traceback does not count."""
    if answer.kind != CRASH:
        payload = body_form(answer.body, kind if answer.kind == REPLY else None) if answer.body else b""
        return ("answer", answer.kind, answer.name, payload)
    crash = body_form(answer.body)
    has_traceback = isinstance(crash, tuple) and len(crash) == 4 and crash[0] == "list"
    return ("answer", answer.kind, answer.name, crash[:3] if has_traceback else crash)


def end_form(end: TurnEnd, *, with_state: bool = True) -> Any:
    """The canonical form of a turn's end. Numbers that count turns and outputs are text: no tolerance is theirs."""
    outs = tuple(
        (
            f"{out.k}",
            out.verb,
            out.to,
            out.name,
            f"{out.seconds}",
            f"{out.interval}",
            body_form(out.body) if out.body else b"",
        )
        for out in end.outs
    )
    state = f"{end.state}" if with_state else ""
    return ("end", f"{end.turn}", f"{end.id}", end.status, outs, answer_form(end.answer), state)
