"""The format that reader and writer share: the header, the marks, and the forms of builtin types."""

from __future__ import annotations

import enum
import struct
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable, Sequence
from datetime import date, datetime, time, timedelta, timezone
from decimal import Decimal
from fractions import Fraction
from itertools import chain
from operator import index
from pathlib import PosixPath, PurePosixPath, PureWindowsPath
from random import Random
from typing import Any, Final, TypeAlias, cast
from uuid import UUID, SafeUUID
from zoneinfo import ZoneInfo

from msgpack import ExtType

from ..errors import DamagedValue, UnsavableValue
from .byte_parts import in_one
from .saved_refs import Addressed

FORMAT: Final = 1
HEAD: Final = struct.Struct(">BBQ")  # format, flag, length of the tree
LENGTH: Final = struct.Struct(">Q")


class Blob:
    """Bytes in one or more buffers that go behind the tree: they are copied once, when the pieces are joined."""

    def __init__(self, *buffers: Any) -> None:
        self.buffers = buffers  # no memoryviews: as long as one lives, a bytearray cannot grow


class HeadMark(int):
    """The code at the head of a list while that list is being read."""


def flat(mapping: dict[Any, Any]) -> Iterable[Any]:
    """Keys and values in turn."""
    return chain.from_iterable(mapping.items())


def pairs(parts: Sequence[Any]) -> dict[Any, Any]:
    """The dict that `flat` was given."""
    return dict(zip(parts[::2], parts[1::2], strict=True))


def _make_counter(parts: list[Any]) -> Counter[Any]:
    counter = Counter[Any]()
    dict.update(counter, pairs(parts))  # Counter's own update would add.
    return counter


def _zone_parts(zone: ZoneInfo) -> tuple[str]:
    if zone.key is None:
        raise UnsavableValue("", "a ZoneInfo without a key")
    return (zone.key,)


def _make_random(parts: list[Any]) -> Random:
    version, internal, gauss = parts
    if version != 3 or not isinstance(gauss, float | None):
        raise DamagedValue("it has a random.Random of another version")
    made = Random(0)
    made.setstate((version, internal, gauss))
    return made


def _make_fraction(parts: list[Any]) -> Fraction:
    """As it was, in lowest terms: to see whether it is takes a time that grows with the square of its length."""
    numerator, denominator = map(index, parts)
    if denominator <= 0:
        raise DamagedValue("it has a Fraction that is none")
    if max(numerator.bit_length(), denominator.bit_length()) <= _SHORT_BITS:
        return Fraction(numerator, denominator)
    made: Any = object.__new__(Fraction)
    made._numerator, made._denominator = numerator, denominator
    return cast(Fraction, made)


_SHORT_BITS: Final = 4096
Make: TypeAlias = Callable[[list[Any]], Any]
# Code in the data; type; its parts, which may be anything that can be saved; how the parts make it again.
TYPES: Final[tuple[tuple[int, Any, Callable[[Any], Iterable[Any]], Make], ...]] = (
    (1, tuple, iter, tuple),
    (2, set, iter, set),
    (3, frozenset, iter, frozenset),
    (4, dict, flat, pairs),  # only with keys that are no scalars
    (5, OrderedDict, flat, lambda parts: OrderedDict(pairs(parts))),
    (6, Counter, flat, _make_counter),
    (7, deque, lambda x: (x.maxlen, *x), lambda parts: deque(parts[1:], parts[0])),
    (8, bytearray, lambda x: (Blob(x),), lambda parts: bytearray(in_one(*parts))),  # an int would be a length
    (9, complex, lambda x: (x.real, x.imag), lambda parts: complex(*parts)),
    (10, range, lambda x: (x.start, x.stop, x.step), lambda parts: range(*parts)),
    (11, Decimal, lambda x: (str(x),), lambda parts: Decimal(*parts)),
    (12, Fraction, lambda x: (x.numerator, x.denominator), _make_fraction),
    (13, UUID, lambda x: (x.bytes, x.is_safe.value), lambda parts: UUID(bytes=parts[0], is_safe=SafeUUID(parts[1]))),
    (14, date, lambda x: (x.year, x.month, x.day), lambda parts: date(*parts)),
    (15, time, lambda x: (x.fold, x.hour, x.minute, x.second, x.microsecond, x.tzinfo),
     lambda parts: time(*parts[1:], fold=parts[0])),
    (16, datetime, lambda x: (x.fold, x.year, x.month, x.day, x.hour, x.minute, x.second, x.microsecond, x.tzinfo),
     lambda parts: datetime(*parts[1:], fold=parts[0])),
    (17, timedelta, lambda x: (x.days, x.seconds, x.microseconds), lambda parts: timedelta(*parts)),
    (18, timezone, lambda x: x.__getinitargs__(), lambda parts: timezone(*parts)),
    (19, ZoneInfo, _zone_parts, lambda parts: ZoneInfo(*parts)),
    (20, PosixPath, lambda x: (str(x),), lambda parts: PosixPath(*parts)),
    (21, PurePosixPath, lambda x: (str(x),), lambda parts: PurePosixPath(*parts)),
    (22, PureWindowsPath, lambda x: (str(x),), lambda parts: PureWindowsPath(*parts)),
    (23, Random, lambda x: x.getstate(), _make_random),
)  # fmt: skip
KNOWN: Final[dict[type, tuple[ExtType, Callable[[Any], Iterable[Any]]]]] = {
    kind: (ExtType(code, b""), parts) for code, kind, parts, _ in TYPES
}
# The marks of what is not in the table.
SHARED, AGAIN, BUFFER, DEFAULTDICT, ENUM, DATACLASS, STRUCT, NAMED = (ExtType(n, b"") for n in range(32, 40))
TUPLES, REF = (ExtType(n, b"") for n in range(40, 42))
ARRAY, TEXT, BITS, SEED, GENERATOR, RANDOM_STATE, ARRAYS = (ExtType(n, b"") for n in range(48, 55))

SCALARS: Final = frozenset({type(None), bool, int, float, str, bytes, Blob})
are_scalars: Final = SCALARS.issuperset
CHANGING: Final[frozenset[type]] = frozenset({list, dict, set, OrderedDict, Counter, deque, bytearray, Random})


def can_change(kind: type) -> bool:
    """Whether it makes a difference that two places hold the same object of this type."""
    if kind in CHANGING or kind in KNOWN or issubclass(kind, (tuple, enum.Enum, Addressed)):
        return kind in CHANGING
    return kind.__module__ != "numpy" or kind.__name__ in ("ndarray", "void")  # the others are numpy's scalars
