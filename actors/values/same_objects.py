"""Whether values are as they were: the same objects, which hold the same objects, all the way down.

Such values are written as the same bytes, so they need not be written to be compared. That is sound however they may
have been changed meanwhile, for each object that can hold others is looked into; only what a type makes unchangeable (a
number, a text, a tuple or frozen struct of these) is not. Each step is made for many objects at once, by functions
that are written in C: it takes a tenth of the time of writing.
"""

from __future__ import annotations

import enum
from collections import Counter, deque
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import chain
from operator import attrgetter, is_
from typing import Any, Final, NamedTuple, TypeAlias

from .classes import class_mark, slots_of
from .forms import KNOWN, NAMED, SCALARS, STRUCT, can_change
from .saved_refs import Addressed

Objects: TypeAlias = Sequence[Any]
_LEAVES: Final = SCALARS | {kind for kind in KNOWN if not can_change(kind)} - {tuple, frozenset}
_ATTRIBUTES: Final = attrgetter("__dict__")


class Inside(NamedTuple):
    """What some objects of one type hold: how many each, under which names; and all of it, one behind the other."""

    shape: list[Any]
    held: list[Any]


class Level(NamedTuple):
    """Some objects, and those of their types that were looked into, with their shapes."""

    objects: Objects
    shapes: list[tuple[type, list[Any]]]


class Form(NamedTuple):
    """How objects of a type are looked into; `look` is None where nobody knows how, or where there is nothing."""

    look: Callable[[Objects], Inside] | None
    is_leaf: bool = False
    is_frozen: bool = False


def seen(objects: Objects, most: int) -> list[Level] | None:
    """What can be seen of some objects now, to be compared later; None if a change could escape.

    Args:
        objects: those that are looked into.
        most: how many objects that may be; more are held by several, again and again.
    """
    levels: list[Level] = []
    try:
        while objects:
            level, following = Level(objects, []), list[Any]()
            for kind in dict.fromkeys(map(type, objects)):
                form = form_of(kind)
                if form.is_leaf:
                    continue
                if form.look is None:
                    return None
                shape, held = form.look(_of(kind, objects))
                if not (form.is_frozen and _never_change(held, most)):
                    level.shapes.append((kind, shape))
                    following += held
            if len(following) > most:
                return None
            levels.append(level)
            objects = following
    except (AttributeError, TypeError):  # A slot that was never set, or attributes that are no dict.
        return None
    return levels


def is_as_seen(levels: list[Level], objects: Objects) -> bool:
    """Whether these objects are as they were `seen`."""
    try:
        for before, shapes in levels:
            if before is not objects and (len(before) != len(objects) or not all(map(is_, before, objects))):
                return False
            following: list[Any] = []
            for kind, shape in shapes:
                look = form_of(kind).look
                assert look is not None
                now, held = look(_of(kind, objects))
                if now != shape:
                    return False
                following += held
            objects = following
    except (AttributeError, TypeError):
        return False
    return True


def _of(kind: type, objects: Objects) -> Objects:
    return [one for one in objects if type(one) is kind]


def _never_change(objects: Objects, most: int) -> bool:
    """Whether nothing can change of these, nor of anything that they hold."""
    for kind in {*map(type, objects)} - _LEAVES:
        form = form_of(kind)
        if form.is_leaf:
            continue
        if form.look is None or not form.is_frozen:
            return False
        held = form.look(_of(kind, objects)).held
        if len(held) > most or not _never_change(held, most):
            return False
    return True


@lru_cache(256)
def form_of(kind: Any) -> Form:
    """How objects of a type are looked into."""
    if (
        kind in _LEAVES
        or issubclass(kind, (enum.Enum, Addressed))
        or (kind.__module__ == "numpy" and not can_change(kind))
    ):
        return Form(None, is_leaf=True)
    if kind in (list, set, deque, tuple, frozenset):
        return Form(_items, is_frozen=kind in (tuple, frozenset))
    if kind in (dict, Counter):
        return Form(_entries)
    mark, has_attributes = class_mark(kind), bool(kind.__dictoffset__)
    if mark is None:
        return Form(None)
    is_named = mark is NAMED
    is_frozen = is_named or (mark is STRUCT and kind.__struct_config__.frozen)
    getters = [slot.__get__ for slot in slots_of(kind).values()]

    def fields(objects: Objects) -> Inside:
        shape, held = _items(objects) if is_named else Inside([len(objects)], [])
        if has_attributes:
            attributes = [*map(_ATTRIBUTES, objects)]
            names = {*map(tuple, attributes)}
            shape += names if len(names) == 1 else map(tuple, attributes)
            held += chain.from_iterable(map(dict.values, attributes))
        for getter in getters:
            held += map(getter, objects)
        return Inside(shape, held)

    return Form(fields, is_frozen=is_frozen and not has_attributes)


def _items(objects: Objects) -> Inside:
    return Inside([*map(len, objects)], [*chain.from_iterable(objects)])


def _entries(objects: Objects) -> Inside:
    keys = chain.from_iterable(objects)
    return Inside([*map(len, objects)], [*keys, *chain.from_iterable(map(dict.values, objects))])
