"""The hooks by which an actor class defines its own state; without them its attributes are saved."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def state_getter(actor: object) -> Callable[[], Any] | None:
    """What makes an actor's state, if its class does that itself."""
    return getattr(actor, "get_state", None)


def state_setter(actor: object) -> Callable[[Any], Any] | None:
    """What gives an actor such a state back."""
    return getattr(actor, "set_state", None)


def state_migrator(kind: type) -> Callable[[Any, Any], Any] | None:
    """What makes the state of a class of one that an older version of it, or another class, has had."""
    return getattr(kind, "migrate", None)


def gives_deltas(kind: type) -> bool:
    """Whether the actors of a class say what has changed in their state, and take that in."""
    return hasattr(kind, "get_delta") and hasattr(kind, "apply_delta")
