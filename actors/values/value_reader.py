"""Decodes packed values, trusting nothing: only what the marks allow is built."""

from __future__ import annotations

import enum
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any, Final, cast

import msgpack
from msgpack import ExtType

from ..errors import DamagedValue
from .arrays import ADOPT_ARRAYS, MAKE_ARRAYS
from .budget import MANY_KEYS, LargeInts, spread
from .byte_parts import ByteParts
from .classes import Defaults, class_mark, defaults_of, find_class, is_factory, slots_of
from .forms import (
    AGAIN,
    BUFFER,
    DATACLASS,
    DEFAULTDICT,
    ENUM,
    NAMED,
    REF,
    SHARED,
    STRUCT,
    TUPLES,
    TYPES,
    HeadMark,
    Make,
    pairs,
)
from .saved_refs import SavedHandle, SavedRef


def _make_tuples(rows: list[Any]) -> list[Any]:
    if any(type(row) is not list for row in rows):
        raise DamagedValue("it has a tuple that is none")
    return [*map(tuple, rows)]


_MARKS: Final = {code: HeadMark(code) for code in range(1, 64)}
unpack: Final = cast(
    "Callable[..., Any]", partial(msgpack.unpackb, strict_map_key=False, unicode_errors="surrogatepass")
)
_KEYS: Final[dict[int, slice]] = {
    **{code: slice(None) for code, kind, _, _ in TYPES if kind in (set, frozenset)},
    **{code: slice(None, None, 2) for code, kind, _, _ in TYPES if issubclass(kind, dict)},
}
"""Where the keys are among the parts of what has some."""


def _spread(make: Make, keys: slice) -> Make:
    """The same, for keys that were not chosen to clash."""

    def make_spread(parts: list[Any]) -> Any:
        if len(parts) > MANY_KEYS:
            spread(parts[keys])
        return make(parts)

    return make_spread


_MAKE: Final[dict[int, Make]] = {
    **{code: _spread(make, _KEYS[code]) if code in _KEYS else make for code, _, _, make in TYPES},
    **MAKE_ARRAYS,
    TUPLES.code: _make_tuples,
}
_ADOPTS: Final[dict[int, Make]] = _MAKE | ADOPT_ARRAYS


class Decoder:
    """What msgpack calls for each extension value and each list, inner ones first."""

    def __init__(
        self,
        buffers: ByteParts,
        *,
        imports: bool = True,
        adopts: bool = False,
        shared: dict[int, object] | None = None,
        refs: Callable[[str], object] = SavedRef,
        handles: Callable[[SavedHandle], None] = SavedHandle.nobody,
    ) -> None:
        self._imports, self._make_int, self._refs, self._handles = imports, LargeInts().make, refs, handles
        self.buffers = buffers  # those not yet read: they lie in the order in which the tree names them
        self.open_marks = 0
        self.shared: dict[int, object] = {} if shared is None else shared
        self.classes: dict[str, tuple[Any, ExtType | None, dict[str, Any], Defaults]] = {}
        self.make: dict[int, Make] = (_ADOPTS if adopts else _MAKE) | {
            BUFFER.code: self.make_buffer,
            SHARED.code: self.make_shared,
            AGAIN.code: self.make_again,
            DEFAULTDICT.code: self.make_defaultdict,
            ENUM.code: self.make_enum,
            REF.code: self.make_ref,
            DATACLASS.code: partial(self.make_record, DATACLASS),
            STRUCT.code: partial(self.make_record, STRUCT),
            NAMED.code: partial(self.make_record, NAMED),
        }

    def value(self, tree: memoryview) -> object:
        value: object = unpack(tree, ext_hook=self.on_extension, list_hook=self.on_list)
        if self.open_marks or self.buffers:
            raise DamagedValue("it has something that belongs nowhere")
        return value

    def on_extension(self, code: int, data: bytes) -> int:
        if code == 0:
            return self._make_int(code, data)
        if data:
            raise DamagedValue(f"it has an extension value with code {code}")
        self.open_marks += 1
        return _MARKS[code]

    def on_list(self, parts: list[Any]) -> Any:
        if not parts or type(parts[0]) is not HeadMark:
            return parts
        self.open_marks -= 1
        return self.make[parts.pop(0)](parts)

    def make_buffer(self, parts: list[Any]) -> memoryview | ByteParts:
        [n_bytes] = parts
        return self.buffers.take(n_bytes)

    def make_shared(self, parts: list[Any]) -> object:
        number, self.shared[number] = parts
        return self.shared[number]

    def make_again(self, parts: list[Any]) -> object:
        [number] = parts
        return self.shared[number]

    def make_defaultdict(self, parts: list[Any]) -> object:
        factory: Any = parts[0] and find_class(parts[0], imports=self._imports)
        if factory is not None and not is_factory(factory):
            raise DamagedValue(f"it has a defaultdict of {parts[0]}")
        if len(parts) > MANY_KEYS:
            spread(parts[1::2])
        return defaultdict(factory, pairs(parts[1:]))

    def make_ref(self, parts: list[Any]) -> object:
        [path] = parts
        if not isinstance(path, str):
            raise DamagedValue("it has a ref without an address")
        return self._refs(path)

    def find(self, mark: ExtType, name: str) -> tuple[Any, dict[str, Any], Defaults]:
        if name not in self.classes:
            kind = find_class(name, imports=self._imports)
            self.classes[name] = kind, class_mark(kind), slots_of(kind), defaults_of(kind)
        kind, found, slots, defaults = self.classes[name]
        if found is not mark:
            raise DamagedValue(f"class {name} is of another kind now")
        return kind, slots, defaults

    def make_enum(self, parts: list[Any]) -> object:
        name, member = parts
        kind, *_ = self.find(ENUM, name)
        if isinstance(member, str):
            return kind.__members__[member]
        if issubclass(kind, enum.Flag):
            return kind(member)
        raise DamagedValue(f"{name} has no member {member!r}")

    def make_record(self, mark: ExtType, parts: list[Any]) -> object:
        name = parts[0]
        kind, slots, defaults = self.find(mark, name)
        attributes = pairs(parts[1:])
        for field in defaults.keys() - attributes.keys():  # It was saved by an earlier version of its class.
            old, default = defaults[field]
            found = next((name for name in old if name in attributes), None)
            if found is not None:
                attributes[field] = attributes.pop(found)
            elif default is not None:
                attributes[field] = default()
        if mark is DATACLASS:
            made: Any = object.__new__(kind)
        elif mark is STRUCT:
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
        if isinstance(made, SavedHandle):
            self._handles(made)
        return made
