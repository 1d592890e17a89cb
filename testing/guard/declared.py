"""Declared types: whether the fields of a message hold what their annotations say, to the last element.

msgspec checks what it decodes, and a tuple is decoded as the list that was declared. In process nothing is decoded, so
the receiver gets the tuple; here the objects themselves are looked at.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import enum
import functools
import operator
import types
import typing
from collections.abc import Callable, Iterable
from typing import Any, Literal, get_args, get_origin

import msgspec

from ...actors.kernel.ref import ActorRef

Problem = str | None
Look = Callable[[Any], Problem]
"""Returns what is wrong with a value: the path from the value, and what was expected; None if nothing is."""

PLAIN = (bool, int, float, complex, str, bytes, type(None))
ACCEPTED: dict[type, tuple[type, ...]] = {float: (float, int), bytes: (bytes, bytearray, memoryview)}
"""What is good for a declared type beside its own instances, as type checkers see it."""
SEQUENCES = (list, tuple, collections.abc.Sequence, collections.abc.MutableSequence, collections.abc.Collection)
SETS = (set, frozenset, collections.abc.Set, collections.abc.MutableSet)
MAPPINGS = (dict, collections.abc.Mapping, collections.abc.MutableMapping)
MUTABLE = (list, set, dict, bytearray, memoryview)


def wrong_field(message: Any) -> Problem:
    """What is wrong in a message, and where; None if every field has the type it declares.

    >>> class Rows(msgspec.Struct):
    ...     rows: dict[str, list[int]]
    >>> wrong_field(Rows({"a": [1]}))
    >>> wrong_field(Rows({"a": (1,)}))
    "Expected `list`, got `tuple` - at `rows['a']`"
    """
    for name, look in _fields(type(message)):
        found = look(getattr(message, name))
        if found is not None:
            path, _, what = found.partition("\0")
            return f"{what} - at `{name}{path}`"
    return None


def wrong_value(declared: Any, value: Any) -> Problem:
    """What is wrong with a value that is declared to be of a type; None if nothing is.

    >>> wrong_value(list[int], ["a"])
    'Expected `int`, got `str` - at `[0]`'
    """
    look = _look(declared)
    found = None if look is None else look(value)
    if found is None:
        return None
    path, _, what = found.partition("\0")
    return f"{what} - at `{path}`" if path else what


def _wrong(expected: str, value: Any) -> str:
    return f"\0Expected `{expected}`, got `{type(value).__name__}`"


def _find_fields(kind: type) -> tuple[tuple[str, Look], ...]:
    looks = {name: _look(declared) for name, declared in _hints(kind).items()}
    return tuple((name, look) for name, look in looks.items() if look is not None)


_fields: Callable[[type], tuple[tuple[str, Look], ...]] = functools.cache(_find_fields)
"""The fields of a class that are worth a look."""


def _is_fixed(kind: type) -> bool:
    declared = _hints(kind)
    return len(declared) == len(_struct_fields(kind)) and all(map(_stays, declared.values()))


is_fixed: Callable[[type], bool] = functools.cache(_is_fixed)
"""Whether a look at the fields says everything of a message of this class: all are plain, and nothing can change them.

Such a message need not be coded to be checked; of others msgspec knows more, such as limits of a number.
"""


def _is_all_looked_at(kind: type) -> bool:
    declared = _hints(kind)
    return len(declared) == len(_struct_fields(kind)) and all(map(_has_no_limits, declared.values()))


is_all_looked_at: Callable[[type], bool] = functools.cache(_is_all_looked_at)
"""Whether `wrong_field` says all of a message of this class that its decoder would: nothing in it has limits."""


def _has_no_limits(declared: Any) -> bool:
    """Whether what is declared is plain, or a container or a choice of what is plain, and nothing is said beside it."""
    if declared in PLAIN or declared is ActorRef or get_origin(declared) is ActorRef:
        return True
    args = [one for one in get_args(declared) if one is not Ellipsis]
    is_container = get_origin(declared) in (list, tuple, set, frozenset, dict, typing.Union, types.UnionType)
    return bool(args) and is_container and all(map(_has_no_limits, args))


def _find_plain_look(kind: type) -> Callable[[Any], bool]:
    declared = _hints(kind)
    names, exact = tuple(declared), tuple(map(_exact, declared.values()))
    if len(declared) != len(_struct_fields(kind)) or None in exact:
        return lambda message: False
    if not names:
        return lambda message: True
    read = operator.attrgetter(*names)
    if len(names) == 1:
        (only,) = exact
        return lambda message: type(read(message)) is only
    return lambda message: tuple(map(type, read(message))) == exact


plain_look: Callable[[type], Callable[[Any], bool]] = functools.cache(_find_plain_look)
"""For a class of messages, what says of one whether each of its fields is of just the plain class that it declares.

Of such a message `wrong_field` finds nothing, and nothing can change it: most messages are so, and this is a tenth of
the work.
"""


def _exact(declared: Any) -> type | None:
    """The plain class that is declared; None: something else is, and more would have to be looked at."""
    if get_origin(declared) is ActorRef:
        return ActorRef
    return declared if declared in PLAIN or declared is ActorRef else None


def _stays(declared: Any) -> bool:
    """Whether what is declared is plain, or a tuple, a frozen set or a choice of what is plain."""
    if isinstance(declared, type) and get_origin(declared) is None:
        return declared in PLAIN or issubclass(declared, (ActorRef, enum.Enum))
    args = [one for one in get_args(declared) if one is not Ellipsis]
    if get_origin(declared) is ActorRef:
        return True
    return get_origin(declared) in (tuple, frozenset, typing.Union, types.UnionType) and all(map(_stays, args))


def _struct_fields(kind: type) -> tuple[str, ...]:
    """The names of a struct's fields; none of what is no struct, such as a class of messages that was sent itself."""
    return kind.__struct_fields__ if issubclass(kind, msgspec.Struct) else ()


def _hints(kind: type) -> dict[str, Any]:
    """The declared types of a struct's or a dataclass's fields; nothing where a name in them is not known."""
    try:
        hints = typing.get_type_hints(kind, include_extras=True)
    except (NameError, TypeError, AttributeError):  # A class within a function, or a name for type checkers only.
        return {}
    if dataclasses.is_dataclass(kind):
        names: Iterable[str] = (field.name for field in dataclasses.fields(kind))
    else:
        names = _struct_fields(kind)
    return {name: hints[name] for name in names if name in hints}


def _look(declared: Any) -> Look | None:
    """How a value of a declared type is looked at; None: anything will do, or nobody can tell."""
    declared = _bare(declared)
    origin = get_origin(declared)
    match declared:
        case None | types.NoneType:
            return _instance_of(types.NoneType)
        case typing.Any | typing.TypeVar():
            return None
        case type() if origin is None:
            return _look_at_class(declared)
        case _:
            pass
    if origin in (typing.Union, types.UnionType):
        return _any_of(get_args(declared))
    if origin is Literal:
        return _one_of(get_args(declared))
    return _look_at_generic(origin, get_args(declared)) if isinstance(origin, type) else None


def _bare(declared: Any) -> Any:
    """A declared type without what is only said beside it."""
    while True:
        if get_origin(declared) is typing.Annotated:
            declared = get_args(declared)[0]
        elif isinstance(declared, typing.NewType):
            declared = declared.__supertype__
        elif type(declared).__name__ == "TypeAliasType":
            declared = declared.__value__
        else:
            return declared


def _instance_of(kind: type, accepted: tuple[type, ...] = ()) -> Look:
    allowed = accepted or ACCEPTED.get(kind, (kind,))

    def look(value: Any) -> Problem:
        if isinstance(value, allowed) and not (type(value) is bool and bool not in allowed and object not in allowed):
            return None
        plain = _from_numpy(value)
        return None if plain is not value and look(plain) is None else _wrong(_named(kind), value)

    return look


def _named(kind: type) -> str:
    return "None" if kind is types.NoneType else kind.__name__


def _from_numpy(value: Any) -> Any:
    """A number of numpy as Python's, which is how it travels."""
    return value.item() if type(value).__module__ == "numpy" and hasattr(value, "item") and not _shape(value) else value


def _shape(value: Any) -> Any:
    return getattr(value, "shape", ())


def _look_at_class(kind: type) -> Look | None:
    if kind is object or getattr(kind, "_is_protocol", False) or typing.is_typeddict(kind):
        return None
    instance = _instance_of(kind)
    if issubclass(kind, enum.Enum) or not (issubclass(kind, msgspec.Struct) or dataclasses.is_dataclass(kind)):
        return instance

    def look(value: Any) -> Problem:
        return instance(value) or _within(value)

    return look


def _within(value: Any) -> Problem:
    for name, look in _fields(type(value)):
        found = look(getattr(value, name))
        if found is not None:
            return f".{name}{found}"
    return None


def _any_of(choices: tuple[Any, ...]) -> Look | None:
    looks: list[Look] = []
    for choice in choices:
        one = _look(choice)
        if one is None:
            return None
        looks.append(one)
    expected = " | ".join(_text(choice) for choice in choices)

    def look(value: Any) -> Problem:
        deepest = ""
        for one in looks:
            found = one(value)
            if found is None:
                return None
            if not found.startswith("\0"):  # The container is right, and something in it is not.
                deepest = found
        return deepest or _wrong(expected, value)

    return look


def _text(declared: Any) -> str:
    bare = _bare(declared)
    if bare is None or isinstance(bare, type):
        return "None" if bare is None else _named(get_origin(bare) or bare)
    return str(bare).removeprefix("typing.")


def _one_of(values: tuple[Any, ...]) -> Look:
    def look(value: Any) -> Problem:
        if any(type(value) is type(one) and value == one for one in values):
            return None
        return f"\0Expected one of {', '.join(map(repr, values))}, got {value!r}"

    return look


def _look_at_generic(kind: type, args: tuple[Any, ...]) -> Look | None:
    if getattr(kind, "_is_protocol", False) or kind in (type, collections.abc.Callable):
        return None
    instance = _instance_of(kind)
    if kind is tuple and not (len(args) == 2 and args[1] is Ellipsis):
        return _tuple_of(instance, args)
    if kind in SEQUENCES or kind in SETS:
        element = _elements(args[0]) if args else None
        return instance if element is None else _both(instance, element)
    if kind in MAPPINGS and len(args) == 2:
        return _mapping_of(instance, _look(args[0]), _look(args[1]))
    if issubclass(kind, msgspec.Struct) or dataclasses.is_dataclass(kind):
        return _both(instance, _within)
    return instance


def _both(first: Look, then: Look) -> Look:
    return lambda value: first(value) or then(value)


def _elements(declared: Any) -> Look | None:
    """Looks at each element of a collection; those of a plain type are looked at all at once."""
    element = _look(declared)
    if element is None:
        return None
    bare = _bare(declared)
    plain = {bare} if bare in PLAIN else set[Any]()
    one: Look = element

    def look(values: Any) -> Problem:
        if plain and set(map(type, values)) <= plain:
            return None
        for number, value in enumerate(values):
            found = one(value)
            if found is not None:
                return f"[{number}]{found}" if isinstance(values, collections.abc.Sequence) else f"[...]{found}"
        return None

    return look


def _tuple_of(instance: Look, args: tuple[Any, ...]) -> Look:
    looks = [_look(declared) for declared in args]

    def look(value: Any) -> Problem:
        found = instance(value)
        if found is not None:
            return found
        if len(value) != len(looks):
            return f"\0Expected `tuple` of length {len(looks)}, got {len(value)}"
        for number, (one, element) in enumerate(zip(looks, value, strict=True)):
            found = None if one is None else one(element)
            if found is not None:
                return f"[{number}]{found}"
        return None

    return look


def _mapping_of(instance: Look, key: Look | None, value: Look | None) -> Look:
    def look(mapping: Any) -> Problem:
        found = instance(mapping)
        if found is not None:
            return found
        for one, other in mapping.items():
            found = key(one) if key is not None else None
            if found is not None:
                return f"[key {one!r}]{found}"
            found = value(other) if value is not None else None
            if found is not None:
                return f"[{one!r}]{found}"
        return None

    return look


def may_change(value: Any, depth: int = 8) -> bool:
    """Whether anything in a value can be changed in place, as far as `depth` containers go.

    >>> may_change((1, "a", (2.0, None))), may_change((1, ["a"]))
    (False, True)
    """
    kind = type(value)
    if kind in PLAIN or isinstance(value, enum.Enum):
        return False
    if issubclass(kind, MUTABLE) or _shape(value) != ():
        return True
    if not depth:
        return False
    if issubclass(kind, (tuple, frozenset)):
        return any(may_change(one, depth - 1) for one in value)
    if issubclass(kind, msgspec.Struct):
        if not kind.__struct_config__.frozen:
            return True
        return any(may_change(getattr(value, name), depth - 1) for name in kind.__struct_fields__)
    if dataclasses.is_dataclass(kind):
        return not kind.__dataclass_params__.frozen or any(  # type: ignore[attr-defined]  # dataclasses set it
            may_change(getattr(value, field.name), depth - 1) for field in dataclasses.fields(kind)
        )
    return False
