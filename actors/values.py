"""Values without a schema as bytes, for snapshots: each returns with its type, or is refused by name.

A value is first lowered to a tree of what msgpack has types for: lists, dicts with scalars for keys, scalars. What is
so already is left as it is. Anything else becomes a list that starts with a mark, which is an empty extension value;
the mark's code is that of the type, and the rest of the list are the value's parts.

The bytes: version, flag; with flag 0 a msgpack tree without marks; with flag 1 the length of the tree (8 bytes, big
endian), the tree, and the raw buffers that its marks mention, in that order.
"""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import math
import re
import reprlib
import struct
import sys
import types
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from datetime import date, datetime, time, timedelta, timezone
from decimal import Decimal
from fractions import Fraction
from functools import partial
from importlib import import_module
from itertools import chain
from operator import index
from pathlib import PosixPath, PurePosixPath, PureWindowsPath
from random import Random
from typing import Any, Final, TypeAlias, cast
from uuid import UUID, SafeUUID
from zoneinfo import ZoneInfo

import msgpack
import msgspec
from msgpack import ExtType

from .errors import HoldfastError, type_name

__all__ = ["DamagedValue", "UnsavableValue", "decode_value", "encode_value", "state_digest"]

_FORMAT: Final = 1
_HEAD: Final = struct.Struct(">BBQ")  # format, flag, length of the tree
_HEAD_ALONE: Final = bytes((_FORMAT, 0))


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
    return b"".join(_pieces(value, where, canonical=False))


def state_digest(value: object) -> bytes:
    """Digest a value: 16 bytes (blake2b), the same in every process for values of equal types and contents.

    The order of a dict counts; that of a set does not, nor whether two equal parts are one object. Only numpy's
    longdouble is not covered: some of its bytes have no meaning.

    Raises:
        UnsavableValue: as `encode_value`.

    >>> state_digest({"b", "a"}) == state_digest({"a", "b"}), state_digest([1]) == state_digest([True])
    (True, False)
    """
    digest = hashlib.blake2b(digest_size=16)
    for piece in _pieces(value, "value", canonical=True):
        digest.update(piece)
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
    if view[0] != _FORMAT or view[1] > 1:
        raise DamagedValue(f"it has format {view[0]}.{view[1]}, and only format {_FORMAT} is known")
    try:
        if view[1] == 0:
            return _unpack(view[2:], ext_hook=_make_int)
        tree_bytes = _HEAD.unpack_from(view)[2]
        return _Decoder(view[_HEAD.size + tree_bytes :]).value(view[_HEAD.size : _HEAD.size + tree_bytes])
    except (DamagedValue, MemoryError):  # Out of memory is no damage: the bytes may be good.
        raise
    except Exception as error:
        raise DamagedValue(f"{type(error).__name__}: {error}") from error


class _Blob:
    """A buffer that goes behind the tree: it is copied once, when the pieces are joined."""

    def __init__(self, buffer: Any) -> None:
        self.buffer = buffer  # no memoryview: as long as one lives, a bytearray cannot grow


class _Mark(int):
    """The code at the head of a list while that list is being read."""


def _flat(mapping: dict[Any, Any]) -> Iterable[Any]:
    return chain.from_iterable(mapping.items())


def _pairs(parts: Sequence[Any]) -> dict[Any, Any]:
    return dict(zip(parts[::2], parts[1::2], strict=True))


def _make_counter(parts: list[Any]) -> Counter[Any]:
    counter = Counter[Any]()
    dict.update(counter, _pairs(parts))  # Counter's own update would add.
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


_Make: TypeAlias = Callable[[list[Any]], Any]
# Code in the data; type; its parts, which may be anything that can be saved; how the parts make it again.
_TYPES: Final[tuple[tuple[int, Any, Callable[[Any], Iterable[Any]], _Make], ...]] = (
    (1, tuple, iter, tuple),
    (2, set, iter, set),
    (3, frozenset, iter, frozenset),
    (4, dict, _flat, _pairs),  # only with keys that are no scalars
    (5, OrderedDict, _flat, lambda parts: OrderedDict(_pairs(parts))),
    (6, Counter, _flat, _make_counter),
    (7, deque, lambda x: (x.maxlen, *x), lambda parts: deque(parts[1:], parts[0])),
    (8, bytearray, lambda x: (_Blob(x),), lambda parts: bytearray(memoryview(*parts))),  # an int would be a length
    (9, complex, lambda x: (x.real, x.imag), lambda parts: complex(*parts)),
    (10, range, lambda x: (x.start, x.stop, x.step), lambda parts: range(*parts)),
    (11, Decimal, lambda x: (str(x),), lambda parts: Decimal(*parts)),
    (12, Fraction, lambda x: (x.numerator, x.denominator), lambda parts: Fraction(*map(index, parts))),
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
_KNOWN: Final[dict[type, tuple[ExtType, Callable[[Any], Iterable[Any]]]]] = {
    kind: (ExtType(code, b""), parts) for code, kind, parts, _ in _TYPES
}
_TUPLE: Final = _KNOWN[tuple][0]
# The marks of what is not in the table.
_SHARED, _AGAIN, _BUFFER, _DEFAULTDICT, _ENUM, _DATACLASS, _STRUCT, _NAMED = (ExtType(n, b"") for n in range(32, 40))
_ARRAY, _TEXT, _BITS, _SEED, _GENERATOR, _RANDOM_STATE = (ExtType(n, b"") for n in range(48, 54))

_SCALARS: Final = frozenset({type(None), bool, int, float, str, bytes, _Blob})
_are_scalars: Final = _SCALARS.issuperset
_CHANGING: Final[frozenset[type]] = frozenset({list, dict, set, OrderedDict, Counter, deque, bytearray, Random})


def _can_change(kind: type) -> bool:
    """Whether it makes a difference that two places hold the same object of this type."""
    if kind in _CHANGING or kind in _KNOWN or issubclass(kind, (tuple, enum.Enum)):
        return kind in _CHANGING
    return kind.__module__ != "numpy" or kind.__name__ in ("ndarray", "void")  # the others are numpy's scalars


# --- Writing ---


def _pieces(value: object, where: str, *, canonical: bool) -> list[Any]:
    try:
        encoder = _Encoder(canonical, shared=set())
        tree = encoder.lowered(value)
        while encoder.met_again and not canonical:
            encoder = _Encoder(canonical, shared=encoder.shared | encoder.met_again)
            tree = encoder.lowered(value)
        packed = encoder.packed(tree, None)
    except UnsavableValue as refusal:
        path = refusal.where if len(refusal.where) < 200 else f"{refusal.where[:90]} ... {refusal.where[-90:]}"
        raise UnsavableValue(where + path, refusal.problem) from None
    except (RecursionError, ValueError) as error:
        raise UnsavableValue(where, f"a value that is nested too deep or too large ({error})") from None
    if not encoder.has_marks:
        return [_HEAD_ALONE, packed]
    return [_HEAD.pack(_FORMAT, 1, len(packed)), packed, *encoder.blobs]


class _Encoder:
    """One walk through a value. `canonical`: the order of sets and arrays, and what is shared, leave no trace."""

    def __init__(self, canonical: bool, shared: set[int]) -> None:
        self.canonical = canonical
        self.shared = shared  # the ids of what is known to be reached twice
        self.met_again: set[int] = set()  # and of what turned out to be
        self.numbers: dict[int, int] = {}  # of the shared ones that are in the tree already, by id
        self.walked: dict[int, object] = {}  # by id: None while inside it, then itself, so that the id stays in use
        self.classes: dict[type, tuple[ExtType, str, dict[str, Any]]] = {}
        self.blobs: list[Any] = []
        self.has_marks = False

    def lowered(self, x: object) -> Any:
        kind, key = type(x), id(x)
        if kind in _SCALARS:
            return x
        if kind not in _CHANGING and not _can_change(kind):
            return self.inside(kind, x)
        if key in self.walked:
            if self.walked[key] is None:
                raise UnsavableValue("", f"a {type_name(kind)} that contains itself")
            if key in self.numbers:
                return [_AGAIN, self.numbers[key]]
            self.met_again.add(key)
            if not self.canonical:
                return None  # This tree is thrown away: the next walk knows what is shared.
        self.walked[key] = None
        lowered = self.inside(kind, x)
        self.walked[key] = x
        if key in self.shared:
            self.has_marks = True
            self.numbers[key] = len(self.numbers)
            return [_SHARED, self.numbers[key], lowered]
        return lowered

    def inside(self, kind: type, x: Any) -> Any:
        if kind is list:
            return x if _are_scalars(map(type, x)) else self.each(x, x)
        if kind is dict and _are_scalars(map(type, x)):
            return x if _are_scalars(map(type, x.values())) else _pairs(self.each(x, [*_flat(x)]))
        if kind is tuple:  # as `form` would do it, only faster
            self.has_marks = True
            return [_TUPLE, *(x if _are_scalars(map(type, x)) else self.each(x, x))]
        mark, *parts = self.form(kind, x)
        return [mark, *(parts if _are_scalars(map(type, parts)) else self.each(x, parts))]

    def each(self, x: Any, parts: Sequence[Any]) -> list[Any]:
        lowered: list[Any] = []
        try:
            for part in parts:
                lowered.append(part if type(part) in _SCALARS else self.lowered(part))  # noqa: PERF401 - its length is used below
        except UnsavableValue as refusal:  # On its way out each level adds its step to the path.
            refusal.where = _step(x, parts, len(lowered)) + refusal.where
            raise
        return lowered

    def form(self, kind: type, x: Any) -> list[Any]:
        """A mark and the parts of `x`."""
        self.has_marks = True
        if kind in _KNOWN:
            mark, parts = _KNOWN[kind]
            if self.canonical and (kind is set or kind is frozenset):
                is_ordered = {*map(type, x)} in ({int}, {str})
                return [mark, *sorted(x, key=None if is_ordered else _canonical)]
            return [mark, *parts(x)]
        if kind is defaultdict:
            return [_DEFAULTDICT, _factory_name(x.default_factory), *_flat(x)]
        if kind not in self.classes:
            if kind.__module__.startswith("numpy") and (np := sys.modules.get("numpy")):
                form = _numpy_form(np, kind, x, in_order=not self.canonical)
                if form is not None:
                    return form
            if (mark := _class_mark(kind)) is None:
                raise UnsavableValue("", f"a value of type {type_name(kind)}")
            self.classes[kind] = mark, _class_name(kind), _slots(kind)
        mark, name, slots = self.classes[kind]
        return [mark, name, *_class_parts(x, slots)]

    def packed(self, tree: object, unicode_errors: str | None) -> Any:
        make = cast("Callable[..., Any]", msgpack.Packer)
        packer = make(default=self.default, autoreset=False, buf_size=1024, unicode_errors=unicode_errors)
        try:
            packer.pack(tree)
        except UnicodeEncodeError:  # A lone surrogate, as in file names that are not UTF-8: rare, so tried second.
            self.blobs = []
            return self.packed(tree, "surrogatepass")
        return packer.getbuffer()

    def default(self, x: Any) -> Any:
        """What the packer packs in place of `x`, for which msgpack has no type."""
        if type(x) is _Blob:
            self.blobs.append(x.buffer)
            return [_BUFFER, len(x.buffer)]
        return ExtType(0, x.to_bytes(x.bit_length() // 8 + 1, "big", signed=True))


def _canonical(x: object) -> bytes:
    return b"".join(_pieces(x, "{...}", canonical=True))


def _step(x: Any, parts: Sequence[Any], index: int) -> str:
    """The way from `x` to one of its parts, as a reader would write it."""
    if isinstance(x, dict):
        position = index - isinstance(x, defaultdict)  # which has its factory in front
        return f"[{reprlib.repr(parts[index - 1])}]" if position % 2 else f".keys()[{position // 2}]"
    if isinstance(x, (set, frozenset)):
        return "{...}"
    if isinstance(x, (date, time)):
        return ".tzinfo"
    if type(x) in (list, tuple, deque):
        return f"[{index - (type(x) is deque)}]"
    return f".{parts[index - 1]}" if index and isinstance(parts[index - 1], str) else ""


# --- Classes of users: Enum, dataclass, Struct, NamedTuple ---


def _find(name: str) -> type:
    """Find the class "module:qualname". Nothing is called for it, except what importing the module does."""
    module, _, qualname = name.partition(":")
    try:
        found: object = sys.modules.get(module) or import_module(module)
        for part in qualname.split("."):
            found = cast(object, vars(found)[part])
    except (Exception, SystemExit) as error:
        raise DamagedValue(f"class {name} is not there ({type(error).__name__}: {error})") from error
    if not isinstance(found, type):
        raise DamagedValue(f"{name} is no class")
    return found


def _class_name(kind: type) -> str:
    # The program is `__main__` in its own process, and `__mp_main__` too in those that are started for it.
    is_main = sys.modules.get(kind.__module__) is sys.modules.get("__main__")
    name = f"{'__main__' if is_main else kind.__module__}:{kind.__qualname__}"
    try:
        if _find(name) is kind:
            return name
    except DamagedValue:
        pass
    raise UnsavableValue("", f"a value of type {type_name(kind)}, whose class is not found by that name,")


def _class_mark(kind: Any) -> ExtType | None:
    """What instances can be made from again: their attributes, unless they are, say, a dict besides."""
    if issubclass(kind, enum.Enum):
        return _ENUM
    if issubclass(kind, msgspec.Struct):
        return _STRUCT
    if hasattr(kind, "_fields") and issubclass(kind, tuple):
        return _NAMED
    if dataclasses.is_dataclass(kind) and kind.__new__ is object.__new__:
        return _DATACLASS
    return None


def _slots(kind: type) -> dict[str, Any]:
    found = chain.from_iterable(vars(base).items() for base in reversed(kind.__mro__))
    return {name: slot for name, slot in found if type(slot) is types.MemberDescriptorType}


def _class_parts(x: Any, slots: dict[str, Any]) -> list[Any]:
    if isinstance(x, enum.Enum):
        return [x.name if x.name in type(x).__members__ else x.value]  # a value: flags together, without a name
    parts: list[Any] = [*_flat(getattr(x, "__dict__", {}))]
    if issubclass(type(x), tuple):
        parts += chain.from_iterable(zip(x._fields, x, strict=True))
    for name, slot in slots.items():
        try:
            parts += name, slot.__get__(x)
        except AttributeError:  # never set, or deleted
            if isinstance(x, msgspec.Struct):
                raise UnsavableValue("", f"a {type_name(type(x))} without its field {name}") from None
    return parts


def _is_factory(kind: Any) -> bool:
    return isinstance(kind, type) and (
        kind in _SCALARS or kind in _KNOWN or kind is list or _class_mark(kind) is not None
    )


def _factory_name(factory: object) -> str | None:
    if factory is None:
        return None
    if not _is_factory(factory):
        raise UnsavableValue(".default_factory", f"a value of type {type_name(type(factory))}")
    return _class_name(cast(type, factory))


# --- numpy, if the program has imported it ---

_LAST_POSITION: Final = {"MT19937": 624, "Philox": 4, "PCG64": 0, "PCG64DXSM": 0, "SFC64": 0}
# Of numbers, text, bytes, times. Other names mean objects, or (a time unit of 0 seconds) end the process.
_DTYPE: Final = re.compile(r"[<>|=]([biufcSUV]\d{1,9}|[qQ]|[mM]8(\[([1-9]\d{0,8})?[a-zA-Z]+\])?)")


def _numpy_form(np: Any, kind: Any, x: Any, *, in_order: bool) -> list[Any] | None:
    if kind is np.str_ or kind is np.bytes_:  # as an array it would lose the NULs at its end
        return [_TEXT, str.__str__(x) if kind is np.str_ else bytes(x)]
    if kind is np.ndarray or (issubclass(kind, np.generic) and kind is x.dtype.type):
        order = "F" if in_order and x.flags.f_contiguous and not x.flags.c_contiguous else "C"
        if x.dtype.names:  # What happens to be between its fields is left out.
            x, old = np.zeros_like(x), x
            x[...] = old
        flat = np.ascontiguousarray(x.T if order == "F" else x).reshape(-1)
        dtype, blob = _dtype_parts(x.dtype), _Blob(flat.view(np.uint8) if flat.nbytes else b"")
        return [_ARRAY, dtype, x.shape, order if kind is np.ndarray else "", blob]
    if kind is np.random.Generator:
        return [_GENERATOR, x.bit_generator]
    if kind is np.random.RandomState and (state := x.get_state(legacy=False))["bit_generator"] == "MT19937":
        return [_RANDOM_STATE, state]
    if kind.__name__ in _LAST_POSITION and kind is getattr(np.random, kind.__name__):
        return [_BITS, x.state, x.seed_seq]
    if kind is np.random.SeedSequence and _is_seed(x.entropy, x.spawn_key, x.pool_size):
        return [_SEED, x.entropy, x.spawn_key, x.pool_size, x.n_children_spawned]
    return None


def _numpy() -> Any:
    import numpy as np

    return np


def _dtype_parts(dtype: Any) -> Any:
    """A dtype as its name, [base, shape], or [fields, size, is aligned]."""
    parts: Any = dtype.byteorder + dtype.char if dtype.char in "qQ" else dtype.str  # longlong is not int64
    if dtype.names is not None:
        fields = [[name, _dtype_parts(dtype[name]), *dtype.fields[name][1:]] for name in dtype.names]
        parts = [fields, dtype.itemsize, dtype.isalignedstruct]
    elif dtype.subdtype is not None:
        parts = [_dtype_parts(dtype.base), dtype.shape]
    try:
        made = _make_dtype(parts)
        if (made, made.type, made.metadata) == (dtype, dtype.type, dtype.metadata):
            return parts
    except (DamagedValue, TypeError, ValueError):  # of objects, or from another library
        pass
    raise UnsavableValue("", f"a numpy value of dtype {dtype}")


def _make_dtype(parts: Any) -> Any:
    np = _numpy()
    if isinstance(parts, str):
        if not _DTYPE.fullmatch(parts):
            raise DamagedValue(f"it has an array of dtype {parts}")
        dtype = np.dtype(parts)
    elif len(parts) == 2:
        base, shape = parts
        dtype = np.dtype((_make_dtype(base), shape))
    else:
        fields, size, is_aligned = parts
        columns = {
            "names": [name for name, *_ in fields],
            "formats": [_make_dtype(form) for _, form, *_ in fields],
            "offsets": [offset for _, _, offset, *_ in fields],
            "titles": [title[0] if title else None for _, _, _, *title in fields],
        }
        dtype = np.dtype({**columns, "itemsize": size}, align=is_aligned)
    if dtype.hasobject:  # Numpy would take its bytes for addresses.
        raise DamagedValue(f"it has an array of dtype {dtype}")
    return dtype


def _make_array(dtype: Any, shape: Any, order: Any, data: memoryview) -> Any:
    made = _make_dtype(dtype)
    sizes = cast("tuple[int, ...]", shape if type(shape) is tuple else (-1,))
    # Numpy would take a size of -1 for "as many as there are", and divide by the size of an item.
    if min(sizes, default=0) < 0 or math.prod(sizes) * made.itemsize != len(data):
        raise DamagedValue(f"it has {len(data)} bytes for an array of shape {shape} and dtype {made}")
    array = _numpy().ndarray(shape, made, data, order=order or "C").copy(order or "C")
    if array.shape != shape:
        raise DamagedValue(f"it has an array of shape {shape}")
    return array if order else array[()]


def _make_text(text: str | bytes) -> Any:
    kinds = {str: _numpy().str_, bytes: _numpy().bytes_}
    return kinds[type(text)](text)


def _make_bits(state: dict[str, Any], seed: Any) -> Any:
    kind, position = state["bit_generator"], state.get("buffer_pos", state["state"].get("pos", 0))
    if not 0 <= position <= _LAST_POSITION[kind]:  # Numpy does not check, and would read what is there.
        raise DamagedValue(f"it has a {kind} at position {position}")
    if not all(isinstance(words, int | _numpy().ndarray) for words in state["state"].values()):
        raise DamagedValue(f"it has a {kind} without a state")
    bits = getattr(_numpy().random, kind)(0 if seed is None else seed)
    bits.state = state
    return bits


def _is_seed(entropy: Any, spawn_key: tuple[int, ...], pool_size: int) -> bool:
    np = _numpy()
    words: Any = entropy if type(entropy) in (list, tuple, np.ndarray) else [0 if entropy is None else entropy]
    is_small = type(spawn_key) is tuple and pool_size <= 64  # Its time grows with the square of the pool.
    return is_small and all(isinstance(word, int | np.integer) for word in (*words, *spawn_key))


def _make_seed(entropy: Any, spawn_key: tuple[int, ...], pool_size: int, n_children: int) -> Any:
    if not _is_seed(entropy, spawn_key, pool_size):
        raise DamagedValue("it has a SeedSequence that is none")
    make = _numpy().random.SeedSequence
    return make(entropy, spawn_key=spawn_key, pool_size=pool_size, n_children_spawned=n_children)


def _make_random_state(state: dict[str, Any]) -> Any:
    made = _numpy().random.RandomState(_make_bits(state, None))
    made.set_state(state)
    return made


# --- Reading ---


def _make_int(code: int, data: bytes) -> int:
    if code != 0:
        raise DamagedValue(f"it has an extension value with code {code}")
    return int.from_bytes(data, "big", signed=True)


_MARKS: Final = {code: _Mark(code) for code in range(1, 64)}
_unpack: Final = cast(
    "Callable[..., Any]", partial(msgpack.unpackb, strict_map_key=False, unicode_errors="surrogatepass")
)
_MAKE: Final[dict[int, _Make]] = {
    **{code: make for code, _, _, make in _TYPES},
    _ARRAY.code: lambda parts: _make_array(*parts),
    _TEXT.code: lambda parts: _make_text(*parts),
    _BITS.code: lambda parts: _make_bits(*parts),
    _SEED.code: lambda parts: _make_seed(*parts),
    _GENERATOR.code: lambda parts: _numpy().random.Generator(*parts),
    _RANDOM_STATE.code: lambda parts: _make_random_state(*parts),
}


class _Decoder:
    """What msgpack calls for each extension value and each list, inner ones first."""

    def __init__(self, buffers: memoryview) -> None:
        self.buffers = buffers  # those not yet read: they lie in the order in which the tree names them
        self.open_marks = 0
        self.shared: dict[int, object] = {}
        self.classes: dict[str, tuple[Any, ExtType | None, dict[str, Any]]] = {}
        self.make: dict[int, _Make] = _MAKE | {
            _BUFFER.code: self.make_buffer,
            _SHARED.code: self.make_shared,
            _AGAIN.code: self.make_again,
            _DEFAULTDICT.code: self.make_defaultdict,
            _ENUM.code: self.make_enum,
            _DATACLASS.code: partial(self.make_record, _DATACLASS),
            _STRUCT.code: partial(self.make_record, _STRUCT),
            _NAMED.code: partial(self.make_record, _NAMED),
        }

    def value(self, tree: memoryview) -> object:
        value: object = _unpack(tree, ext_hook=self.on_extension, list_hook=self.on_list)
        if self.open_marks or self.buffers:
            raise DamagedValue("it has something that belongs nowhere")
        return value

    def on_extension(self, code: int, data: bytes) -> int:
        if code == 0:
            return _make_int(code, data)
        if data:
            raise DamagedValue(f"it has an extension value with code {code}")
        self.open_marks += 1
        return _MARKS[code]

    def on_list(self, parts: list[Any]) -> Any:
        if not parts or type(parts[0]) is not _Mark:
            return parts
        self.open_marks -= 1
        return self.make[parts.pop(0)](parts)

    def make_buffer(self, parts: list[Any]) -> memoryview:
        [n_bytes] = parts
        if not 0 <= n_bytes <= len(self.buffers):
            raise DamagedValue("it is cut short")
        buffer, self.buffers = self.buffers[:n_bytes], self.buffers[n_bytes:]
        return buffer

    def make_shared(self, parts: list[Any]) -> object:
        number, self.shared[number] = parts
        return self.shared[number]

    def make_again(self, parts: list[Any]) -> object:
        [number] = parts
        return self.shared[number]

    def make_defaultdict(self, parts: list[Any]) -> object:
        factory: Any = parts[0] and _find(parts[0])
        if factory is not None and not _is_factory(factory):
            raise DamagedValue(f"it has a defaultdict of {parts[0]}")
        return defaultdict(factory, _pairs(parts[1:]))

    def find(self, mark: ExtType, name: str) -> tuple[Any, dict[str, Any]]:
        if name not in self.classes:
            kind = _find(name)
            self.classes[name] = kind, _class_mark(kind), _slots(kind)
        kind, found, slots = self.classes[name]
        if found is not mark:
            raise DamagedValue(f"class {name} is of another kind now")
        return kind, slots

    def make_enum(self, parts: list[Any]) -> object:
        name, member = parts
        kind, _ = self.find(_ENUM, name)
        if isinstance(member, str):
            return kind.__members__[member]
        if issubclass(kind, enum.Flag):
            return kind(member)
        raise DamagedValue(f"{name} has no member {member!r}")

    def make_record(self, mark: ExtType, parts: list[Any]) -> object:
        name = parts[0]
        kind, slots = self.find(mark, name)
        attributes = _pairs(parts[1:])
        if mark is _DATACLASS:
            made: Any = object.__new__(kind)
        elif mark is _STRUCT:
            made = kind(**{field: attributes[field] for field in kind.__struct_fields__ if field in attributes})
        else:
            made = tuple.__new__(kind, [attributes.pop(field) for field in kind._fields])
        for attribute, slot in slots.items():
            if attribute in attributes:
                slot.__set__(made, attributes.pop(attribute))  # also where it is frozen
        if attributes:
            if not hasattr(made, "__dict__"):
                raise DamagedValue(f"class {name} has no {', '.join(attributes)}")
            made.__dict__.update(attributes)
        return made
