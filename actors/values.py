"""Values without a schema as bytes, for snapshots: each returns with its type, or is refused by name.

`_Encoder` first looks through the value a level at a time, at C speed. If nothing in it is reached twice, msgpack's C
packer takes it as it is and calls back for what is not JSON-like. If something is shared, or cannot be saved, `_Walk`
goes through it in Python: it knows the path, and what it has met before.

The bytes: version, flag; with flag 0 one msgpack value; with flag 1 the length of the msgpack tree (8 bytes, big
endian), the tree, and the raw buffers to which it points. A list in the tree that starts with a mark, which is an empty
extension value, stands for a value of the type with the mark's code, and the rest of the list are its parts.
"""

from __future__ import annotations

import dataclasses
import enum
import gc
import hashlib
import importlib
import random
import reprlib
import struct
import sys
import types
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable, Iterable
from datetime import date, datetime, time, timedelta, timezone
from decimal import Decimal
from fractions import Fraction
from itertools import chain
from pathlib import PosixPath, PurePosixPath, PureWindowsPath
from typing import Any, Final, NamedTuple
from uuid import UUID, SafeUUID
from zoneinfo import ZoneInfo

import msgspec
from msgpack import ExtType, Packer, unpackb

from .errors import HoldfastError

__all__ = ["DamagedValue", "UnsavableValue", "decode_value", "encode_value", "state_digest"]

FORMAT: Final = 1
_HEAD: Final = struct.Struct(">BBQ")


class UnsavableValue(HoldfastError):
    """A value that no snapshot can hold: `where` is the path to it, `problem` what sits there."""

    def __init__(self, where: str, problem: str) -> None:
        super().__init__(where, problem)
        self.where, self.problem = where, problem

    def __str__(self) -> str:
        return (
            f"{self.where}: {self.problem} cannot be saved; make it a key variable of a supported type, "
            "name it with a leading underscore, or define get_state/set_state"
        )


class DamagedValue(HoldfastError):
    """Saved bytes that cannot be read: cut short, altered, of another format, or of a class that is no longer there."""

    def __init__(self, problem: str) -> None:
        super().__init__(problem)
        self.problem = problem

    def __str__(self) -> str:
        return f"a saved value cannot be read: {self.problem}; use an older one"


def encode_value(value: object, *, where: str = "value") -> bytes:
    """Save a value with the types of all that is in it.

    What can change (a list, dict, array, dataclass ...) and is reached twice is one object again when read; only arrays
    that overlap in memory become separate. Equal values may differ in bytes: compare their `state_digest`.

    Args:
        value: of the builtin types and those of collections, datetime (UTC, fixed offset, ZoneInfo), decimal,
            fractions, uuid and pathlib; a random.Random; an Enum, dataclass, msgspec.Struct or NamedTuple whose class
            can be imported; a numpy array or scalar of any dtype without objects, Generator or RandomState. A subclass
            of one of these is another type.
        where: the name of the value in errors.

    Raises:
        UnsavableValue: something in it is of another type, contains itself, or is nested deeper than about 300 levels.

    >>> decode_value(encode_value({"seen": {(1, 2)}, 7: b"x"}))
    {'seen': {(1, 2)}, 7: b'x'}
    >>> encode_value({"x": [1, object()]}, where="balance")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    holdfast.actors.values.UnsavableValue: balance['x'][1]: a value of type object cannot be saved; make it ...
    """
    try:
        return b"".join(_Encoder(canonical=False).pieces(value))
    except _Refusal as refusal:
        raise refusal.at(where) from None


def state_digest(value: object) -> bytes:
    """Digest a value: 16 bytes (blake2b), the same in every process for values of equal types and contents.

    The order of a dict counts; that of a set does not, nor whether two equal parts are one object.

    Raises:
        UnsavableValue: as `encode_value`.

    >>> state_digest({"b", "a"}) == state_digest({"a", "b"}), state_digest([1]) == state_digest([True])
    (True, False)
    """
    digest = hashlib.blake2b(digest_size=16)
    try:
        for piece in _Encoder(canonical=True).pieces(value):
            digest.update(piece)
    except _Refusal as refusal:
        raise refusal.at("value") from None
    return digest.digest()


def decode_value(data: bytes | memoryview) -> object:
    """Read what `encode_value` wrote. Arrays are writable and own their memory.

    Classes are found by importing their module, and must be of the kind that was saved. No `__init__` is called; only
    a Struct has to be made by its constructor, after which its fields are set to what they were.

    Raises:
        DamagedValue: whatever is wrong with the bytes.

    >>> decode_value(encode_value((1, 2.0, True, None)))
    (1, 2.0, True, None)
    >>> decode_value(b"")
    Traceback (most recent call last):
    holdfast.actors.values.DamagedValue: a saved value cannot be read: it is cut short; use an older one
    """
    view = memoryview(data).cast("B")
    if len(view) < 2:
        raise DamagedValue("it is cut short")
    if view[0] != FORMAT:
        raise DamagedValue(f"it has format {view[0]}, and only format {FORMAT} is known")
    try:
        return _Decoder(view).value()
    except (DamagedValue, MemoryError):  # Out of memory is no damage: the bytes may be good.
        raise
    except Exception as error:
        raise DamagedValue(f"{type(error).__name__}: {error}") from error


class _Refusal(Exception):
    """Something cannot be saved. On its way out each level of the value adds its step to the path."""

    def __init__(self, problem: str, *steps: str) -> None:
        super().__init__(problem)
        self.problem, self.steps = problem, [*steps]

    def at(self, where: str) -> UnsavableValue:
        steps = self.steps if len(self.steps) < 20 else [*self.steps[:8], " ... ", *self.steps[-8:]]
        return UnsavableValue(where + "".join(reversed(steps)), self.problem)


class _Blob:
    """A buffer that goes behind the tree: it is copied once, when the pieces are joined."""

    def __init__(self, buffer: Any) -> None:
        self.view = memoryview(buffer)


class _Mark(int):
    """The code at the head of a list while that list is being read."""


def _type_name(kind: type) -> str:
    return kind.__qualname__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__qualname__}"


# The types that are known beforehand -----------------------------------------------------------------------------


def _flat(mapping: dict[Any, Any]) -> Iterable[Any]:
    return chain.from_iterable(mapping.items())


def _pairs(parts: tuple[Any, ...]) -> dict[Any, Any]:
    return dict(zip(parts[::2], parts[1::2], strict=True))


def _counter(*parts: Any) -> Counter[Any]:
    counter = Counter[Any]()
    dict.update(counter, _pairs(parts))  # Counter's own update would add.
    return counter


def _moment_parts(moment: Any) -> tuple[Any, ...]:
    return moment.replace(tzinfo=None).isoformat(), moment.fold, moment.tzinfo


def _zone_parts(zone: ZoneInfo) -> tuple[str]:
    if zone.key is None:
        raise _Refusal("a ZoneInfo without a key")
    return (zone.key,)


def _random(version: int, internal: tuple[int, ...], gauss: float | None) -> random.Random:
    if version != 3 or not isinstance(gauss, float | None):
        raise DamagedValue("it has a random.Random of another version")
    made = random.Random(0)
    made.setstate((version, internal, gauss))
    return made


class _Kind(NamedTuple):
    code: int
    type: type
    parts: Callable[[Any], Iterable[Any]]  # any values that can be saved
    make: Callable[..., object]


_KINDS: Final = (
    _Kind(1, tuple, iter, lambda *parts: parts),
    _Kind(2, set, iter, lambda *parts: {*parts}),
    _Kind(3, frozenset, iter, lambda *parts: frozenset(parts)),
    _Kind(4, dict, _flat, lambda *parts: _pairs(parts)),  # only from `_Walk`, if a key is no scalar
    _Kind(5, OrderedDict, _flat, lambda *parts: OrderedDict(_pairs(parts))),
    _Kind(6, Counter, _flat, _counter),
    _Kind(7, deque, lambda x: (x.maxlen, *x), lambda limit, *parts: deque(parts, limit)),
    _Kind(8, bytearray, lambda x: (_Blob(x),), lambda view: bytearray(memoryview(view))),  # an int would be a length
    _Kind(9, complex, lambda x: (x.real, x.imag), complex),
    _Kind(10, range, lambda x: (x.start, x.stop, x.step), range),
    _Kind(11, Decimal, lambda x: (str(x),), Decimal),
    _Kind(12, Fraction, lambda x: (x.numerator, x.denominator), Fraction),
    _Kind(13, UUID, lambda x: (x.bytes, x.is_safe.value), lambda raw, safe: UUID(bytes=raw, is_safe=SafeUUID(safe))),
    _Kind(14, date, lambda x: (x.isoformat(),), date.fromisoformat),
    _Kind(15, time, _moment_parts, lambda text, fold, zone: time.fromisoformat(text).replace(fold=fold, tzinfo=zone)),
    _Kind(16, datetime, _moment_parts, lambda text, fold, zone: datetime.fromisoformat(text).replace(fold=fold, tzinfo=zone)),
    _Kind(17, timedelta, lambda x: (x.days, x.seconds, x.microseconds), timedelta),
    _Kind(18, timezone, lambda x: x.__getinitargs__(), timezone),
    _Kind(19, ZoneInfo, _zone_parts, ZoneInfo),
    _Kind(20, PosixPath, lambda x: (str(x),), PosixPath),
    _Kind(21, PurePosixPath, lambda x: (str(x),), PurePosixPath),
    _Kind(22, PureWindowsPath, lambda x: (str(x),), PureWindowsPath),
    _Kind(23, random.Random, lambda x: x.getstate(), _random),
)  # fmt: skip
_KNOWN: Final = {kind.type: (ExtType(kind.code, b""), kind.parts) for kind in _KINDS}
_SCALARS: Final = frozenset({type(None), bool, int, float, str, bytes, _Blob})
_NATIVE: Final = frozenset({list, dict, tuple, set, frozenset})  # what the garbage collector sees into
_FIXED: Final = frozenset(_KNOWN) - {set, dict, OrderedDict, Counter, deque, bytearray, random.Random}
_FACTORIES: Final = {kind.__name__: kind for kind in (bool, int, float, str, bytes, list, *(kind.type for kind in _KINDS))}
_SHARED, _AGAIN, _BUFFER, _DEFAULTDICT, _ENUM, _DATACLASS, _STRUCT, _NAMEDTUPLE = (ExtType(n, b"") for n in range(32, 40))
_ARRAY, _SCALAR, _TEXT, _BYTES, _BITS, _SEED, _GENERATOR, _RANDOM_STATE = (ExtType(n, b"") for n in range(48, 56))


# --- Classes of users and of numpy ---


def _find(name: str) -> type:
    """Find the class "module:qualname"; nothing is called for it, except what importing the module does."""
    module, _, qualname = name.partition(":")
    try:
        found: Any = sys.modules.get(module) or importlib.import_module(module)
        for part in qualname.split("."):
            found = vars(found)[part]
    except (Exception, SystemExit) as error:
        raise DamagedValue(f"{name} is not there ({type(error).__name__}: {error})") from error
    if not isinstance(found, type):
        raise DamagedValue(f"{name} is no class")
    return found


def _name_of(kind: type) -> str:
    # The user's program may be `__mp_main__` here and `__main__` in the process that reads, and the other way round.
    is_main = sys.modules.get(kind.__module__) is sys.modules.get("__main__")
    name = f"{'__main__' if is_main else kind.__module__}:{kind.__qualname__}"
    try:
        if _find(name) is kind:
            return name
    except DamagedValue:
        pass
    raise _Refusal(f"a value of type {_type_name(kind)}, whose class is not found under that name,")


def _mark_of(kind: Any) -> ExtType | None:
    """How an instance is made again from its attributes, if that is possible without a call to code of the class."""
    if issubclass(kind, enum.Enum):
        return _ENUM
    if issubclass(kind, msgspec.Struct):
        return _STRUCT
    if dataclasses.is_dataclass(kind) and kind.__new__ is object.__new__:  # else a dict, say, with contents of its own
        return _DATACLASS
    if issubclass(kind, tuple) and isinstance(getattr(kind, "_fields", None), tuple):
        return _NAMEDTUPLE
    return None


def _slots(kind: type) -> dict[str, Any]:
    found = chain.from_iterable(vars(base).items() for base in reversed(kind.__mro__))
    return {name: slot for name, slot in found if type(slot) is types.MemberDescriptorType}


def _user_parts(x: Any, mark: ExtType, slots: dict[str, Any]) -> Iterable[Any]:
    if mark is _ENUM:
        if type(x).__members__.get(x.name) is not x and not isinstance(x, enum.Flag):
            raise _Refusal(f"the unnamed member {x!r}")
        yield x.name if x.name in type(x).__members__ else x.value
        return
    if mark is _NAMEDTUPLE:
        yield from chain.from_iterable(zip(x._fields, x, strict=True))
    for name, slot in slots.items():
        try:
            value = slot.__get__(x)
        except AttributeError:  # never set, or deleted
            continue
        yield name
        yield value
    yield from _flat(getattr(x, "__dict__", {}))


def _numpy_form(x: Any) -> list[Any] | None:
    np, kind = sys.modules["numpy"], type(x)
    if kind is np.ndarray:
        order = "F" if x.flags.f_contiguous and not x.flags.c_contiguous else "C"
        flat = np.ascontiguousarray(x.T if order == "F" else x).reshape(-1)
        return [_ARRAY, _dtype_parts(x.dtype), [*x.shape], order, _Blob(flat.view(np.uint8) if flat.nbytes else b"")]
    if kind is np.str_:
        return [_TEXT, str.__str__(x)]  # as an array it would lose NULs at its end
    if kind is np.bytes_:
        return [_BYTES, bytes(x)]
    if issubclass(kind, np.generic) and kind is x.dtype.type:
        return [_SCALAR, _dtype_parts(x.dtype), x.tobytes()]
    if kind is np.random.Generator:
        return [_GENERATOR, x.bit_generator]
    if kind is np.random.RandomState and (state := x.get_state(legacy=False))["bit_generator"] == "MT19937":
        return [_RANDOM_STATE, state]
    if kind.__name__ in _BIT_GENERATORS and kind is getattr(np.random, kind.__name__):
        return [_BITS, x.state, getattr(x, "seed_seq", None)]
    if kind is np.random.SeedSequence and x.pool_size <= _MAX_POOL:
        return [_SEED, x.entropy, [*x.spawn_key], x.pool_size, x.n_children_spawned]
    return None


def _dtype_parts(dtype: Any) -> Any:
    """A dtype as text, [base, shape], or [fields, size, is aligned]."""
    if dtype.names is not None:
        fields = [[name, _dtype_parts(dtype[name]), *dtype.fields[name][1:]] for name in dtype.names]
        parts: Any = [fields, dtype.itemsize, dtype.isalignedstruct]
    elif dtype.subdtype is not None:
        parts = [_dtype_parts(dtype.base), [*dtype.shape]]
    else:
        parts = dtype.byteorder + dtype.char if dtype.char in "lLqQ" else dtype.str
    try:
        made = _dtype(parts)
        if (made, made.type, made.metadata) == (dtype, dtype.type, dtype.metadata):
            return parts
    except (DamagedValue, TypeError, ValueError):
        pass
    raise _Refusal(f"a numpy value of dtype {dtype}")


def _dtype(parts: Any) -> Any:
    import numpy as np

    if isinstance(parts, str):
        dtype = np.dtype(parts)
    elif len(parts) == 2:
        dtype = np.dtype((_dtype(parts[0]), tuple(parts[1])))
    else:
        fields, size, is_aligned = parts
        names, formats, offsets, *titles = zip(*fields)
