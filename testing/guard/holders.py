"""Holders: which actors still have an object in their state, and under which name."""

from __future__ import annotations

import functools
import types
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any

import msgspec

from ...actors.kernel.actor import Actor
from ...actors.kernel.cell import Cell
from ...actors.kernel.node import Node
from ..library_code import is_module_of_library
from ..probes import Probe

MOST = 20_000
"""Objects of one actor's state that are looked at."""
PLAIN = (bool, int, float, complex, str, bytes, type(None), type, types.ModuleType, types.FunctionType)


def holders(node: Node, wanted: Iterable[object]) -> dict[Cell, str]:
    """The actors of this process whose state holds one of these objects, and the attribute through which it does."""
    ids = {id(one) for one in wanted}
    found: dict[Cell, str] = {}
    waiting = [node.root] if node.root is not None and ids else []
    while waiting:
        cell = waiting.pop()
        waiting.extend((cell.children or {}).values())
        attribute = None if cell.actor is None else _attribute(cell.actor, ids)
        if attribute is not None:
            found[cell] = attribute
    return found


def _attribute(actor: Actor, ids: set[int]) -> str | None:
    seen: set[int] = set()
    for name, value in vars(actor).items():
        if name != "ctx" and _reaches(value, ids, seen):
            return name
    return None


def _reaches(value: object, ids: set[int], seen: set[int]) -> bool:
    waiting: deque[object] = deque([value])
    while waiting and len(seen) < MOST:
        one = waiting.popleft()
        if id(one) in ids:
            return True
        if isinstance(one, PLAIN) or id(one) in seen:
            continue
        seen.add(id(one))
        waiting.extend(_within(one))
    return False


def _within(value: Any) -> Iterator[object]:
    """What an object holds itself; of the library's own objects only probes are opened."""
    if isinstance(value, dict):
        yield from value
        yield from value.values()
    elif isinstance(value, (list, tuple, set, frozenset, deque)):
        yield from value
    elif isinstance(value, types.MethodType):
        yield value.__self__
    elif isinstance(value, functools.partial):
        yield from value.args
        yield from value.keywords.values()
    elif isinstance(value, msgspec.Struct):
        yield from (getattr(value, name, None) for name in value.__struct_fields__)
    elif isinstance(value, Probe) or not is_module_of_library(type(value).__module__):
        yield from getattr(value, "__dict__", {}).values()
