"""The hooks by which an actor class defines its own state; without them its attributes are saved."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from .errors import HoldfastError, type_name
from .values.renamed import former_members

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


def as_named_now(
    actor: Actor, state: dict[str, Any], before: list[str], now: list[str]
) -> tuple[dict[str, Any], list[str]]:
    """A state under the names that its variables have now, without those that the class has no more.

    Variables that are only made later than in `__init__` are nobody's concern here.

    Args:
        actor: of the class that takes the state over.
        state: of an earlier version of the class, with the same `schema_version`.
        before: the variables that `__init__` of that version had set.
        now: those that it sets now.

    Returns:
        The state, and the names of what was dropped.

    Raises:
        StateMismatch: variables have gone and others have come: perhaps they were renamed, and nobody has said so.
    """
    kind, names = type(actor._state_root()), renames_in(actor, state)
    state = {names.get(name, name): value for name, value in state.items()}
    before = [names.get(name, name) for name in before]
    gone = [name for name in before if name in state and name not in now] if now else []
    come = [name for name in now if name not in before]
    if gone and come:
        raise StateMismatch(
            actor.ctx.path,
            f"its class had the variables ({', '.join(before)}), {type_name(kind)} has ({', '.join(now)}): "
            f"{', '.join(gone)} would be lost; if it was renamed, say @hf.renamed({come[0]}={gone[0]!r}) above the "
            "class; else raise its schema_version, and say in migrate(state, from_version) what becomes of it",
        )
    return {name: value for name, value in state.items() if name not in gone}, gone


def renames_in(actor: Actor, state: dict[str, Any]) -> dict[str, str]:
    """What the variables of a saved state are called now, by what they were called then, where that is another name."""
    names: dict[str, str] = {}
    for new, olds in former_members(type(actor._state_root())).items():
        found = [old for old in olds if old in state and new not in state]
        names |= dict.fromkeys(found[:1], new)
    return names


def gives_deltas(kind: type) -> bool:
    """Whether the actors of a class say what has changed in their state, and take that in."""
    return hasattr(kind, "get_delta") and hasattr(kind, "apply_delta")
