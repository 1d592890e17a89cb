"""Recipes as bytes: a `Start` with its class by name, so that another process can begin the same actor."""

from __future__ import annotations

import dataclasses
import importlib
import operator
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

from ...errors import SpecError, error_text, type_name
from ...kernel.actor import Actor, Start
from ...kernel.message import message_name
from ...values import SavedRef, decode_value, encode_value, state_digest

T = TypeVar("T")


class Described(ABC):
    """A value that travels in a recipe as its description, in plain data."""

    revived_by: ClassVar[str]
    """The function, as "module:function", that makes the value of its description again."""

    @abstractmethod
    def describe(self) -> Any:
        """Describe the value, in plain data."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Packed:
    """A Start inside saved arguments."""

    kind: str
    args: tuple[Any, ...]
    kwargs: dict[str, Any]


@dataclasses.dataclass(frozen=True, slots=True)
class _PackedSuccessor:
    """A Start of who takes the place of another one."""

    start: _Packed
    begins_with: tuple[Any, ...]


@dataclasses.dataclass(frozen=True, slots=True)
class _PackedData:
    """A dataclass that holds a Start somewhere, such as a child spec."""

    kind: str
    fields: dict[str, Any]


@dataclasses.dataclass(frozen=True, slots=True)
class _Description:
    """A value that describes itself: what makes it again, and from what."""

    by: str
    description: Any


def pack_recipe(start: Start[Any], where: str) -> bytes:
    """The recipe as bytes.

    Raises:
        UnsavableValue: naming the argument that cannot be encoded.
        SpecError: the class cannot be found by name.
    """
    return encode_value(_lower(start, where), where=f"{where}: start({start.kind.__name__}, ...)", refs=False)


def pack_data(value: object, where: str) -> bytes:
    """A value with recipes somewhere in it, such as a child spec, as bytes.

    Raises:
        UnsavableValue, SpecError: as `pack_recipe`.
    """
    return encode_value(_lower(value, where), where=where, refs=False)


def packed_digest(value: object, where: str) -> bytes:
    """Digest what `pack_data` would write: the same in every process for equal values.

    Raises:
        UnsavableValue, SpecError: as `pack_recipe`.
    """
    return state_digest(_lower(value, where))


def unpack_data(data: bytes) -> Any:
    """The value again. Imports the modules that define its classes: only for what the root has sent.

    Raises:
        SpecError: a class cannot be found. DamagedValue: these are no such bytes.
    """
    return _read(data)


def pack_argument(value: object, where: str) -> bytes:
    """An argument of a start that is sent by itself, as bytes: unlike a recipe it may hold refs.

    Raises:
        UnsavableValue, SpecError: as `pack_recipe`.
    """
    return encode_value(_lower(value, where), where=where)


def unpack_argument(data: bytes, refs: Callable[[str], object], *, imports: bool) -> Any:
    """The argument again, with the refs of those who read it. `imports`: only for what the root has sent.

    Raises:
        SpecError, DamagedValue: as `unpack_data`.
    """
    return _read(data, refs, imports=imports)


def unpack_told(data: bytes, kind: type[T]) -> T:
    """A dataclass that another process has told, with recipes in it. Nothing is imported, and nothing else is made.

    Raises:
        SpecError: it is none, or names what is not loaded here. DamagedValue: these are no such bytes.
    """
    value = _read(data, imports=False, told=kind)
    if not isinstance(value, kind):
        raise SpecError("recipe", f"the data is no {kind.__name__}")
    return value


def unpack_recipe(data: bytes, *, imports: bool = True) -> Start[Any]:
    """The recipe again. Imports the module that defines the class, if `imports`: not for what others name.

    Raises:
        SpecError: the class cannot be found, or is no actor.
    """
    start = _read(data, imports=imports)
    if not isinstance(start, Start):
        raise SpecError("recipe", "the data is no actor recipe")
    return start


def _read(
    data: bytes, refs: Callable[[str], object] = SavedRef, *, imports: bool = True, told: type | None = None
) -> Any:
    """The value, whoever has made its bytes.

    Raises:
        SpecError: what stands for a recipe in it is none. DamagedValue: these are no such bytes.
    """
    try:
        return _raise_up(decode_value(data, imports=imports, refs=refs), imports=imports, told=told)
    except (AttributeError, TypeError, RecursionError) as error:  # No such fields, or others in them; or it is endless.
        raise SpecError("recipe", f"the data is none: {error_text(error)}") from error


def _lower(value: Any, where: str) -> Any:
    """`value` with every Start replaced by plain data."""
    if isinstance(value, Start):
        kind = value.kind
        if "<locals>" in kind.__qualname__:
            raise SpecError(where, f"{type_name(kind)} is defined in a function, so another process cannot import it")
        start = _Packed(message_name(kind), _lower(value.args, where), _lower(value.kwargs, where))
        begins_with = value.begins_with
        return start if begins_with is None else _PackedSuccessor(start, _lower(begins_with, where))
    if type(value) in (list, tuple):
        return type(value)(_lower(inner, where) for inner in value)
    if type(value) is dict:
        return {key: _lower(inner, where) for key, inner in value.items()}
    if isinstance(value, Described):
        return _Description(value.revived_by, value.describe())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        if any(isinstance(inner, Start) for inner in fields.values()):
            return _PackedData(
                message_name(type(value)), {name: _lower(inner, where) for name, inner in fields.items()}
            )
    return value


def _raise_up(value: Any, *, imports: bool = True, told: type | None = None) -> Any:
    """The value with every Start again; without imports a dataclass with one is made only if it is a `told`."""

    def up(inner: Any) -> Any:
        return _raise_up(inner, imports=imports, told=told)

    if isinstance(value, _Packed):
        if not imports and loaded(value.kind, Actor) is None:
            raise SpecError("recipe", f"{value.kind} is no actor class that is loaded here")
        return Start(_find(value.kind, Actor), up(value.args), up(value.kwargs))
    if isinstance(value, _PackedSuccessor):
        start = up(value.start)
        return Start(start.kind, start.args, start.kwargs, up(value.begins_with))
    is_told = told is not None and isinstance(value, _PackedData) and value.kind == message_name(told)
    if not (imports or is_told) and isinstance(value, (_PackedData, _Description)):
        raise SpecError("recipe", "another process names what is to be made of its words: nothing is")
    if isinstance(value, _PackedData):
        return _find(value.kind, object)(**up(value.fields))
    if isinstance(value, _Description):
        return _named(value.by)(value.description)
    if type(value) in (list, tuple):
        return type(value)(up(inner) for inner in value)
    if type(value) is dict:
        return {key: up(inner) for key, inner in value.items()}
    return value


def imported(name: str) -> Any:
    """The class or function "module:path"; its module is imported if it is not loaded.

    Raises:
        AttributeError: there is none. What importing raises, which may be anything.
    """
    module, _, path = name.partition(":")
    return operator.attrgetter(path)(sys.modules.get(module) or importlib.import_module(module))


def loaded(name: str, base: type[T]) -> type[T] | None:
    """The class with this name, if it is loaded here; nothing is imported."""
    module_name, _, path = name.partition(":")
    found: Any = sys.modules.get(module_name)
    for part in path.split("."):
        found = getattr(found, part, None)
    return found if isinstance(found, type) and issubclass(found, base) else None


def _find(name: str, base: type) -> type[Any]:
    """The class with this name, if it is of the expected kind."""
    found = _named(name)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise SpecError("recipe", f"{name} is no {base.__name__}")
    if base is object and not dataclasses.is_dataclass(found):
        raise SpecError("recipe", f"{name} is no dataclass")
    return found


def _named(name: str) -> Any:
    """Find the class or function that has this name."""
    try:
        return imported(name)
    except BaseException as error:  # Importing a module runs it: it may raise anything.
        raise SpecError("recipe", f"{name} cannot be imported: {error}") from error
