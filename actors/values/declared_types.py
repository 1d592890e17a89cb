"""What the declared types of a message say of its values: where an order has to be made, and where a class gets lost.

A value is decoded as what its field declares. One of a subclass would come out as its base, without what is its own.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, NamedTuple, get_origin

import msgspec
from msgspec import inspect

from ..errors import shown, type_name
from ..exit_reasons import ExitReason

CLASSES: Final = (inspect.StructType, inspect.DataclassType, inspect.NamedTupleType)
"""Of these a value may be of a subclass, with fields and methods of its own."""
ITEMS: Final = (inspect.ListType, inspect.SetType, inspect.FrozenSetType, inspect.VarTupleType, inspect.CollectionType)


def _parts(info: inspect.Type) -> Iterator[inspect.Type]:
    """All types that a declared one is made of, itself first, each once."""
    waiting: list[Any] = [info]
    seen: set[int] = set()
    while waiting:
        part = waiting.pop()
        if isinstance(part, (inspect.Type, inspect.Field)) and id(part) not in seen:
            seen.add(id(part))
            waiting.extend(getattr(part, name) for name in part.__struct_fields__)
            if isinstance(part, inspect.Type):
                yield part
        elif isinstance(part, tuple):
            waiting.extend(part)


def _described(declared: Any) -> inspect.Type:
    try:
        return inspect.type_info(declared)
    except Exception:  # It is no type that a payload is decoded as: the codec says so, in its own words.
        return inspect.AnyType()


def _holds_set(declared: Any) -> bool:
    """Whether there is a set somewhere in what this type declares.

    >>> holds_set(dict[str, list[frozenset[str]]]), holds_set(dict[str, float]), holds_set(Any), holds_set(set)
    (True, False, False, True)
    """
    return any(isinstance(part, (inspect.SetType, inspect.FrozenSetType)) for part in _parts(_described(declared)))


holds_set: Callable[[Any], bool] = functools.cache(_holds_set)
"""Whether there is a set somewhere in what a type declares."""


# -- classes that would get lost ------------------------------------------------------------------------------------


class Declared(NamedTuple):
    """A field, or all of a value, as it is declared.

    Attributes:
        name: the field's; "" for all of a value.
        info: its type.
        classes: those that it and its parts may be of. Something can get lost where one of them has a subclass; a dict
            whose keys are declared may have more of them.
    """

    name: str
    info: inspect.Type
    classes: tuple[type, ...]

    @classmethod
    def of(cls, name: str, info: inspect.Type) -> Declared:
        """Find the classes in a type."""
        parts = [part for part in _parts(info) if isinstance(part, (*CLASSES, inspect.TypedDictType))]
        return cls(name, info, tuple({origin_of(part.cls): None for part in parts}))

    def lost(self, value: Any) -> str:
        """What gets lost of a value, behind the path to it and a NUL; "" if nothing does."""
        if any(issubclass(kind, dict) or kind.__subclasses__() for kind in self.classes):
            return _lost(self.info, value)
        return ""


def origin_of(cls: Any) -> type:
    """The class itself of a generic one with its parameters."""
    found: type = get_origin(cls) or cls
    return found


def _find_class_fields(kind: Any) -> tuple[Declared, ...]:
    info = _described(kind)
    fields = [Declared.of(field.name, field.type) for field in info.fields] if isinstance(info, CLASSES) else []
    return tuple(field for field in fields if field.classes)


class_fields: Callable[[Any], tuple[Declared, ...]] = functools.cache(_find_class_fields)
"""The fields of a message class in which something can get lost: those that declare a class. Most have none."""


@functools.cache
def _whole(declared: Any) -> Declared:
    return Declared.of("", _described(declared))


def lost_class(message: Any) -> str:
    """Say which class or key would get lost of a message, and where; "" if none would."""
    for field in class_fields(type(message)):
        path, _, what = field.lost(getattr(message, field.name)).partition("\0")
        if what:
            return f"field {field.name + path!r}: {what}"
    return ""


def lost_from(declared: Any, value: Any) -> str:
    """Say which class or key would get lost of a value that is decoded as `declared`, and where; "" if none would.

    Without a type (None) it is a message, which is decoded as what it is.

    >>> class Shape(msgspec.Struct): ...
    >>> class Circle(Shape): ...
    >>> lost_from(list[Shape], [Shape()])
    ''
    >>> lost_from(list[Shape], [Shape(), Circle()]).split(",")[0].replace(f"{__name__}.", "")
    "at '[1]': a Circle is given where Shape is declared"
    """
    if declared is None:
        return lost_class(value)
    path, _, what = _whole(declared).lost(value).partition("\0")
    return f"at {path.removeprefix('.')!r}: {what}" if path else what


def _lost(info: inspect.Type, value: Any) -> str:
    """What gets lost, behind the path to it and a NUL; "" if nothing does, or if the value is none of this type."""
    if isinstance(info, inspect.UnionType):
        return _lost_in_union(info, value)
    if isinstance(info, CLASSES):
        cls = origin_of(info.cls)
        if not isinstance(value, cls):
            return ""
        if type(value) is not cls:
            return f"\0{_told(type(value), cls)}"
        for field in info.fields:
            if found := _lost(field.type, getattr(value, field.name)):
                return f".{field.name}{found}"
        return ""
    if isinstance(info, inspect.DictType):
        entries = value.items() if isinstance(value, dict) else ()
        for key, part in entries:
            if found := _lost(info.key_type, key) or _lost(info.value_type, part):
                return f"[{shown(key)}]{found}"
        return ""
    if isinstance(info, inspect.TypedDictType):
        return _lost_in_typed(info, value) if isinstance(value, dict) else ""
    types: Iterable[inspect.Type] = ()
    if isinstance(info, ITEMS):
        types = itertools.repeat(info.item_type)
    elif isinstance(info, inspect.TupleType):
        types = info.item_types
    parts = value if isinstance(value, (list, tuple, set, frozenset)) else ()
    for place, (one, part) in enumerate(zip(types, parts, strict=False)):
        if found := _lost(one, part):
            return f"[{place}]{found}"
    return ""


def _lost_in_typed(info: inspect.TypedDictType, value: dict[Any, Any]) -> str:
    known = {field.name: field.type for field in info.fields}
    for key, part in value.items():
        if key not in known:
            return f"\0the key {shown(key)} is none of those that {type_name(info.cls)} declares, and would get lost"
        if found := _lost(known[key], part):
            return f"[{key!r}]{found}"
    return ""


def _lost_in_union(info: inspect.UnionType, value: Any) -> str:
    """As `_lost`: what a value is itself counts before what it descends from."""
    first = ""
    for one in info.types:
        if isinstance(one, CLASSES) and type(value) is origin_of(one.cls):
            return _lost(one, value)
        first = first or _lost(one, value)
    return first


def _told(given: type, declared: type) -> str:
    return (
        f"a {type_name(given)} is given where {type_name(declared)} is declared, and would arrive as that, without "
        f"what is its own; {_hint(declared)}"
    )


def _hint(declared: type) -> str:
    if issubclass(declared, ExitReason):
        return "send what matters of it: str(reason) says why, reason.is_clean whether in good order"
    if issubclass(declared, msgspec.Struct):
        return f"declare the classes that may come, as in A | B, each with tag=True, in place of {declared.__name__}"
    return "declare the class itself, or make them structs with tag=True and declare those that may come, as in A | B"
