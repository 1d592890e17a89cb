"""The state of an actor in outline: one short text for each variable, however large it is."""

from __future__ import annotations

import reprlib
import sys
from collections import deque
from typing import TYPE_CHECKING, Any

from ..errors import portable, type_name
from ..state_hooks import state_getter
from .live_state import live_state

if TYPE_CHECKING:
    from ..kernel.actor import Actor

FEW = 10
"""Entries of a collection up to which it is not said how many there are."""
MOST_TEXT = 200
"""Characters of one variable."""
MOST_VARIABLES = 200
"""Variables that are told of."""


def outline_of(actor: Actor) -> dict[str, str]:
    """The variables of an actor, each in a line; nothing is copied. A state that is no dict has the name ""."""
    state: Any = live_state(actor)
    if state_getter(actor) is None:
        state = {**actor._overview(), **state}
    if not isinstance(state, dict):
        return {"": outline(state)}
    return {portable(str(name))[:MOST_TEXT]: outline(value) for name, value in list(state.items())[:MOST_VARIABLES]}


def outline(value: Any) -> str:
    """A value in a line of bounded length; of a large collection how many entries it has, and their bytes, about.

    >>> outline({"a": 1})
    "{'a': 1}"
    >>> outline(["x" * 951] * 5000)[:34]
    'list of 5000 entries, about 5.0 MB'
    """
    shown = portable(SHORT.repr(value))[:MOST_TEXT]
    if isinstance(value, (dict, list, tuple, set, frozenset, deque)) and len(value) > FEW:
        entries = (*value.keys(), *value.values()) if isinstance(value, dict) else tuple(value)
        size = sys.getsizeof(value) + sum(map(sys.getsizeof, entries))
        return f"{type(value).__name__} of {len(value)} entries, about {size / 1e6:.1f} MB: {shown}"
    if isinstance(value, (str, bytes, bytearray)) and len(value) > MOST_TEXT:
        return f"{type_name(type(value))} of {len(value)}: {shown}"
    return shown


SHORT = reprlib.Repr()
SHORT.maxdict = SHORT.maxlist = SHORT.maxtuple = SHORT.maxset = SHORT.maxfrozenset = SHORT.maxdeque = FEW
SHORT.maxstring = SHORT.maxother = 100
