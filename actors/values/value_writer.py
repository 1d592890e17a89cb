"""Encodes values: lowers each to types that msgpack knows, and packs the result."""

from __future__ import annotations

import reprlib
import sys
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from datetime import date, time
from itertools import chain
from typing import Any, Final, NamedTuple, cast

import msgpack
import msgspec
from msgpack import ExtType

from ..errors import UnsavableValue, type_name
from .arrays import array_form, arrays_parts, is_array, parts_of_array
from .classes import class_mark, class_name, class_parts, factory_name, slots_of
from .forms import (
    AGAIN,
    ARRAY,
    ARRAYS,
    BUFFER,
    DEFAULTDICT,
    FORMAT,
    HEAD,
    KNOWN,
    REF,
    SCALARS,
    SHARED,
    TUPLES,
    Blob,
    are_scalars,
    can_change,
    flat,
    pairs,
)
from .saved_refs import Addressed

HEAD_ALONE: Final = bytes((FORMAT, 0))
TUPLE: Final = KNOWN[tuple][0]
MANY: Final = 8
"""Entries from which on a list of arrays or tuples that are alike is written as a whole."""
_PLAIN: Final = msgspec.msgpack.Encoder()
_SIMPLE: Final = SCALARS - {Blob}


class Links(NamedTuple):
    """What a value shares with others that are written and read with it, by id and number; numbers are below 0."""

    known: Mapping[int, int] = {}
    """What one of those before it has, so that a reference is enough."""
    given: Mapping[int, int] = {}
    """What those behind it will refer to."""


ALONE: Final = Links()
"""Of a value that shares nothing with others."""


def pieces(value: object, where: str, *, canonical: bool, refs: bool = True) -> list[Any]:
    """The bytes of a value, in parts to be joined; `canonical` and `refs` as in `_Encoder`."""
    return walked_pieces(value, where, canonical=canonical, refs=refs)[0]


def scalar_bytes(value: object) -> bytes | None:
    """The bytes of a scalar, which needs no walk; None: it is none, or one for which msgpack has no type."""
    if type(value) not in _SIMPLE:
        return None
    try:
        return HEAD_ALONE + _PLAIN.encode(value)
    except (OverflowError, UnicodeEncodeError):
        return None


def walked_pieces(
    value: object, where: str, *, canonical: bool = False, links: Links = ALONE, refs: bool = True
) -> tuple[list[Any], dict[int, object]]:
    """As `pieces`, and what can change and was reached, by id: two values that share none of it can be kept apart.

    Args:
        value: what is written.
        where: its name in errors.
        canonical: as in `_Encoder`.
        links: what it shares with others, whose reader has the same `shared`.
        refs: as in `_Encoder`.
    """
    try:
        encoder = _Encoder(canonical, {*links.given}, links, refs)
        tree = encoder.lowered(value)
        while encoder.met_again and not canonical:
            encoder = _Encoder(canonical, encoder.shared | encoder.met_again, links, refs)
            tree = encoder.lowered(value)
        packed = encoder.packed(tree, None)
    except UnsavableValue as refusal:
        path = refusal.where if len(refusal.where) < 200 else f"{refusal.where[:90]} ... {refusal.where[-90:]}"
        raise UnsavableValue(where + path, refusal.problem) from None
    except (RecursionError, ValueError) as error:
        raise UnsavableValue(where, f"a value that is nested too deep or too large ({error})") from None
    if not encoder.has_marks:
        return [HEAD_ALONE, packed], encoder.walked
    return [HEAD.pack(FORMAT, 1, len(packed)), packed, *encoder.blobs], encoder.walked


class _Encoder:
    """One walk through a value.

    Args:
        canonical: the order of sets and arrays, and what is shared, leave no trace.
        shared: the ids of what is known to be reached twice.
        links: what it shares with others.
        refs: False where the reader could make no refs of their addresses: then they are refused.
    """

    def __init__(self, canonical: bool, shared: set[int], links: Links, refs: bool) -> None:
        self.canonical, self.refs = canonical, refs
        self.shared = shared
        self.met_again: set[int] = set()  # and of what turned out to be
        self.given = links.given
        self.numbers: dict[int, int] = dict(links.known)  # of the shared ones that can be referred to, by id
        # by id: None while inside it, then itself, so that the id stays in use
        self.walked: dict[int, object] = dict(links.known)
        self.trees: dict[int, Any] = {}  # what those became
        self.changing: dict[type, bool] = {}  # `can_change`, asked once
        self.classes: dict[type, tuple[ExtType, str, dict[str, Any]]] = {}
        self.blobs: list[Any] = []
        self.has_marks = False

    def lowered(self, x: object) -> Any:
        kind, key = type(x), id(x)
        if kind in SCALARS:
            return x
        changing = self.changing.get(kind)
        if changing is None:
            changing = self.changing[kind] = can_change(kind)
        if not changing:
            return self.inside(kind, x)
        if key in self.walked:
            if self.walked[key] is None:
                raise UnsavableValue("", f"a {type_name(kind)} that contains itself")
            if key in self.numbers:
                self.has_marks = True
                return [AGAIN, self.numbers[key]]
            if not self.canonical:
                return self.again(key, x)
        self.walked[key] = None
        lowered = self.trees[key] = self.inside(kind, x)
        self.walked[key] = x
        if key in self.shared:
            return [SHARED, self.number(key), lowered]
        return lowered

    def number(self, key: int) -> int:
        """Give a number to an object that stands at several places."""
        self.has_marks = True
        self.numbers[key] = number = self.given.get(key, len(self.numbers))
        return number

    def again(self, key: int, x: object) -> Any:
        """What stands where `x` is met for the second time: the first place becomes one that can be referred to."""
        first = self.trees.get(key)
        if first is x or type(first) is not list:  # Not ours to change: one more walk, which knows that it is shared.
            self.met_again.add(key)
            return None
        number = self.number(key)
        first[:] = [SHARED, number, [*first]]
        return [AGAIN, number]

    def inside(self, kind: type, x: Any) -> Any:
        if kind is list:
            return x if are_scalars(map(type, x)) else self.alike(x) or self.each(x, x)
        if kind is dict and are_scalars(map(type, x)):
            return x if are_scalars(map(type, x.values())) else pairs(self.each(x, [*flat(x)]))
        if kind is tuple:  # as `form` would do it, only faster
            self.has_marks = True
            return [TUPLE, *(x if are_scalars(map(type, x)) else self.each(x, x))]
        if is_array(kind):
            self.has_marks = True
            dtype, shape, order, blob = parts_of_array(x, in_order=not self.canonical)
            return [ARRAY, dtype if type(dtype) is str else self.lowered(dtype), [TUPLE, *shape], order, blob]
        mark, *parts = self.form(kind, x)
        return [mark, *(parts if are_scalars(map(type, parts)) else self.each(x, parts))]

    def alike(self, x: list[Any]) -> list[Any] | None:
        """A list of tuples of scalars, or of arrays of one dtype, in a few steps for all of it; None of others."""
        if len(x) < MANY or self.canonical:
            return None
        first = type(x[0])
        if first is tuple and {*map(type, x)} == {tuple} and are_scalars(map(type, chain.from_iterable(x))):
            self.has_marks = True
            return [TUPLES, *x]
        return self.arrays(x) if is_array(first) else None

    def arrays(self, x: list[Any]) -> list[Any] | None:
        """Arrays one behind the other in one buffer; those that are reached twice follow, with their positions."""
        keys = [*map(id, x)]
        once = {*keys}
        twice = (self.walked.keys() & once) | (self.shared & once)
        if len(once) < len(keys):
            twice.update(key for key, times in Counter(keys).items() if times > 1)
        if len(twice) > len(once) // MANY or (parts := arrays_parts(x)) is None:
            return None
        self.has_marks = True
        dtype, shapes, blob = parts
        lowered: list[Any] = [ARRAYS, dtype, [TUPLE if type(shapes) is tuple else TUPLES, *shapes], blob]
        if twice:
            lowered += chain.from_iterable((at, self.lowered(x[at])) for at, key in enumerate(keys) if key in twice)
        self.walked.update(zip(keys, x, strict=True))
        return lowered

    def each(self, x: Any, parts: Sequence[Any]) -> list[Any]:
        lowered: list[Any] = []
        try:
            for part in parts:
                lowered.append(part if type(part) in SCALARS else self.lowered(part))  # noqa: PERF401 - its length is used below
        except UnsavableValue as refusal:  # On its way out each level adds its step to the path.
            refusal.where = _step(x, parts, len(lowered)) + refusal.where
            raise
        return lowered

    def form(self, kind: type, x: Any) -> list[Any]:
        """A mark and the parts of `x`."""
        self.has_marks = True
        if kind in KNOWN:
            mark, parts = KNOWN[kind]
            if self.canonical and (kind is set or kind is frozenset):
                is_ordered = {*map(type, x)} in ({int}, {str})
                return [mark, *sorted(x, key=None if is_ordered else _canonical)]
            return [mark, *parts(x)]
        if kind is defaultdict:
            return [DEFAULTDICT, factory_name(x.default_factory), *flat(x)]
        if kind not in self.classes:
            if kind.__module__.startswith("numpy") and (np := sys.modules.get("numpy")):
                form = array_form(np, kind, x, in_order=not self.canonical)
                if form is not None:
                    return form
            if self.refs and issubclass(kind, Addressed):
                return [REF, x.path]
            if (mark := class_mark(kind)) is None:
                raise UnsavableValue("", f"a value of type {type_name(kind)}")
            self.classes[kind] = mark, class_name(kind), slots_of(kind)
        mark, name, slots = self.classes[kind]
        return [mark, name, *class_parts(x, slots)]

    def packed(self, tree: object, unicode_errors: str | None) -> Any:
        if not self.has_marks and unicode_errors is None:
            try:
                return _PLAIN.encode(tree)  # The same bytes in half the time; it knows nothing of marks.
            except (OverflowError, UnicodeEncodeError, TypeError):
                pass  # A large int, a lone surrogate: msgpack has a way.
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
        if type(x) is Blob:
            self.blobs += x.buffers
            return [BUFFER, sum(map(len, x.buffers))]
        return ExtType(0, x.to_bytes(x.bit_length() // 8 + 1, "big", signed=True))


def _canonical(x: object) -> bytes:
    return b"".join(pieces(x, "{...}", canonical=True))


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
