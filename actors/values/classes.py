"""Instances of user-defined classes as plain parts: Enum, dataclass, Struct, NamedTuple."""

from __future__ import annotations

import dataclasses
import enum
import sys
import types
from collections.abc import Callable
from functools import lru_cache, partial
from importlib import import_module
from itertools import chain
from typing import Any, cast

import msgspec
from msgpack import ExtType

from ..errors import DamagedValue, UnsavableValue, type_name
from .forms import DATACLASS, ENUM, KNOWN, NAMED, SCALARS, STRUCT, flat
from .renamed import former_members
from .saved_refs import SavedHandle

Defaults = dict[str, tuple[tuple[str, ...], Callable[[], Any] | None]]
"""Members of a class that may be missing in what was saved: what they were called, and what gives their default."""


def find_class(name: str, *, imports: bool = True) -> type:
    """Find the class "module:qualname". Nothing is called for it, except what importing the module does.

    Args:
        name: of the class.
        imports: whether its module is imported if it is not loaded; False for what others name.
    """
    module, _, qualname = name.partition(":")
    if not imports and module not in sys.modules:
        raise DamagedValue(f"class {name} is not loaded here, and another process may not have it loaded: import it")
    try:
        found: object = sys.modules.get(module) or import_module(module)
        for part in qualname.split("."):
            found = cast(object, vars(found)[part])
    except BaseException as error:  # A module may raise anything, and whoever asks for it may be a supervisor.
        alias = f"if it was renamed, leave an alias `{qualname} = NewName` in {module}"
        raise DamagedValue(
            f"class {name} is not there ({type(error).__name__}: {error})",
            f"{alias}: inside of a state `@hf.renamed` is not looked at",
        ) from error
    if not isinstance(found, type):
        raise DamagedValue(f"{name} is no class")
    return found


def class_name(kind: type) -> str:
    """The name "module:qualname" by which `find_class` finds the class, in other processes too."""
    # The program is `__main__` in its own process, and `__mp_main__` too in those that are started for it.
    is_main = sys.modules.get(kind.__module__) is sys.modules.get("__main__")
    name = f"{'__main__' if is_main else kind.__module__}:{kind.__qualname__}"
    try:
        if find_class(name) is kind:
            return name
    except DamagedValue:
        pass
    raise UnsavableValue("", f"a value of type {type_name(kind)}, whose class is not found by that name,")


def class_mark(kind: Any) -> ExtType | None:
    """What instances can be made from again: their attributes, unless they are, say, a dict besides."""
    if issubclass(kind, enum.Enum):
        return ENUM
    if issubclass(kind, msgspec.Struct):
        return STRUCT
    if hasattr(kind, "_fields") and issubclass(kind, tuple):
        return NAMED
    if issubclass(kind, SavedHandle) or (dataclasses.is_dataclass(kind) and kind.__new__ is object.__new__):
        return DATACLASS
    return None


def _slots_of(kind: type) -> dict[str, Any]:
    found = chain.from_iterable(vars(base).items() for base in reversed(kind.__mro__))
    return {name: slot for name, slot in found if type(slot) is types.MemberDescriptorType}


slots_of: Callable[[type], dict[str, Any]] = lru_cache(1024)(_slots_of)
"""Descriptors of all slots of a class, by name, inherited ones first. (Always the same dict: nobody changes it.)"""


def defaults_of(kind: Any) -> Defaults:
    """The members whose instances may have been saved without, and what to do then."""
    former, slots = former_members(kind), slots_of(kind)
    defaults: dict[str, Callable[[], Any] | None] = dict.fromkeys(former)
    if dataclasses.is_dataclass(kind):
        for field in dataclasses.fields(kind):
            if field.default_factory is not dataclasses.MISSING:
                defaults[field.name] = field.default_factory
            elif field.default is not dataclasses.MISSING and field.name in slots:  # Else the class has it.
                defaults[field.name] = partial(as_it_is, field.default)
    elif class_mark(kind) is NAMED:
        defaults |= {name: partial(as_it_is, default) for name, default in kind._field_defaults.items()}
    return {name: (former.get(name, ()), default) for name, default in defaults.items()}


def as_it_is(value: Any) -> Any:
    """Return the value itself: a default that needs not be made anew."""
    return value


def class_parts(x: Any, slots: dict[str, Any]) -> list[Any]:
    """Names and values in turn of all attributes of `x`; of an Enum the member's name alone."""
    if isinstance(x, enum.Enum):
        return [x.name if x.name in type(x).__members__ else x.value]  # a value: flags together, without a name
    parts: list[Any] = [*flat(getattr(x, "__dict__", {}))]
    if issubclass(type(x), tuple):
        parts += chain.from_iterable(zip(x._fields, x, strict=True))
    for name, slot in slots.items():
        try:
            parts += name, slot.__get__(x)
        except AttributeError:  # never set, or deleted
            if isinstance(x, msgspec.Struct):
                raise UnsavableValue("", f"a {type_name(type(x))} without its field {name}") from None
    return parts


def is_factory(kind: Any) -> bool:
    """Whether a defaultdict may have it: a class that can be saved makes only what can be saved."""
    return isinstance(kind, type) and (kind in SCALARS or kind in KNOWN or kind is list or class_mark(kind) is not None)


def factory_name(factory: object) -> str | None:
    """The name of a defaultdict's factory."""
    if factory is None:
        return None
    if not is_factory(factory):
        raise UnsavableValue(".default_factory", f"a value of type {type_name(type(factory))}")
    return class_name(cast(type, factory))
