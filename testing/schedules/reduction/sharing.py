"""Whether an actor shares memory with its test or with other actors: what both of them change has no message."""

from __future__ import annotations

import enum
import types
from collections import deque
from collections.abc import Iterator
from typing import Any, Final

import msgspec

from ....actors.kernel.actor import Actor, Start
from ....actors.kernel.ref import ActorRef

CONTAINERS: Final = (list, dict, set, deque, bytearray)
VALUES: Final = (int, float, complex, str, bytes, type(None), enum.Enum, ActorRef, type)
CODE: Final = (types.FunctionType, types.BuiltinFunctionType, types.ModuleType, types.MethodType, type)


def shares_memory(start: Start[Any]) -> bool:
    """Whether an actor is given something that can be changed, or its code knows something of that kind by name."""
    return _knows_shared(start.kind) or not all(map(_is_fixed, (*start.args, *start.kwargs.values())))


def _is_fixed(value: Any) -> bool:
    """Whether nobody can change a value."""
    if isinstance(value, VALUES):
        return True
    if isinstance(value, (tuple, frozenset)):
        return all(map(_is_fixed, value))
    if isinstance(value, msgspec.Struct) and type(value).__struct_config__.frozen:
        return all(_is_fixed(getattr(value, name)) for name in value.__struct_fields__)
    return False


def _knows_shared(kind: type[Any]) -> bool:
    classes = kind.__mro__[: kind.__mro__.index(Actor)]
    return any(
        isinstance(value, types.FunctionType) and any(map(_is_shared, _known_to(value)))
        for one in classes
        for value in vars(one).values()
    )


def _known_to(function: types.FunctionType) -> Iterator[Any]:
    """What the code of a function knows by name, beside its arguments."""
    for cell in function.__closure__ or ():
        try:
            yield cell.cell_contents
        except ValueError:  # It is empty.
            continue
    left = [function.__code__]
    for code in left:  # It grows meanwhile.
        for name in code.co_names:
            value = function.__globals__.get(name)
            if isinstance(value, CONTAINERS):
                yield value
        left += [value for value in code.co_consts if isinstance(value, types.CodeType)]


def _is_shared(value: Any) -> bool:
    return not (isinstance(value, CODE) or _is_fixed(value))
