"""The hooks by which an actor class defines its own state; without them its attributes are saved."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from .errors import HoldfastError, type_name

if TYPE_CHECKING:
    from .kernel.actor import Actor


class StateMismatch(HoldfastError, text="the state of {actor} does not fit: {problem}"):
    """A saved state does not fit the class that shall take it back."""

    actor: str
    problem: str


def state_getter(actor: object) -> Callable[[], Any] | None:
    """What makes an actor's state, if its class does that itself."""
    return getattr(actor, "get_state", None)


def state_setter(actor: object) -> Callable[[Any], Any] | None:
    """What gives an actor such a state back."""
    return getattr(actor, "set_state", None)


def migrated(kind: type[Actor], state: Any, version: int, where: str) -> Any:
    """A state of an older version of the class, as this one wants it: what its classmethod `migrate` makes of it.

    Raises:
        StateMismatch: the class does not know that version, or says that it cannot.
    """
    known = f"it has schema version {version}, {type_name(kind)} {kind.schema_version}"
    if not isinstance(version, int) or version > kind.schema_version:
        raise StateMismatch(where, f"{known}: an older class cannot read the state of a newer one")
    migrate = getattr(kind, "migrate", None)
    if migrate is None:
        raise StateMismatch(where, f"{known}, which has no classmethod migrate(state, from_version)")
    if inspect.iscoroutinefunction(migrate):
        raise StateMismatch(where, f"{known}, whose migrate is `async def`: it must be plain")
    try:
        return migrate(state, version)
    except BaseException as error:
        raise StateMismatch(where, f"{known}, and its migrate failed: {type(error).__name__}: {error}") from error


def gives_deltas(kind: type) -> bool:
    """Whether the actors of a class say what has changed in their state, and take that in."""
    return hasattr(kind, "get_delta") and hasattr(kind, "apply_delta")
