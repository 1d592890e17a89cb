"""Key variables: which part of an actor is its state, and how it is saved and put back."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from ...actors.control.live_state import attributes, set_attribute
from ...actors.errors import type_name
from ...actors.kernel.actor import Actor
from ...actors.state_hooks import StateMismatch, as_named_now, migrated, state_getter, state_setter
from ...actors.values import ByteParts, UnsavableValue, adopt_value, decode_value, encode_value
from ...actors.values.saved_refs import SavedHandle
from ..method import Method
from .state_image import read_saved


class StateForm(NamedTuple):
    """An actor's state, still made of its own objects."""

    version: int
    form: str  # "state": from `get_state`; "keys": key variables
    value: Any


def state_of(actor: Actor) -> StateForm:
    """What is to be saved: the variables a recovery file names, else `get_state()` or the class's key variables.

    Raises:
        StateMismatch: a declared key variable is not there. What `get_state` raises.
    """
    get_state = state_getter(actor)
    if get_state is not None and key_names(actor) is None:
        return StateForm(actor.schema_version, "state", get_state())
    where, root = actor.ctx.path, actor._state_root()
    return StateForm(actor.schema_version, "keys", {name: read_path(where, root, name) for name in variables(actor)})


def variables(actor: Actor) -> list[str]:
    """The names of an actor's key variables, dotted paths among them."""
    names = key_names(actor)
    if names is not None:
        return list(names)
    return [name for name, _ in attributes(actor._state_root()) if not name.startswith("_") and name != "ctx"]


def as_it_is(value: Any) -> Any:
    """Return the value as it is."""
    return value


def save_state(actor: Actor, told: Callable[[Any], Any] = as_it_is) -> bytes:
    """The actor's state as bytes: `get_state()` if the class has it, else its key variables.

    Args:
        actor: whose state.
        told: gives what is to be saved for a value.

    Raises:
        UnsavableValue: naming the variable and the type. StateMismatch: a declared key variable is not there.
    """
    state, where = state_of(actor), actor.ctx.path
    state = state._replace(value=told(state.value))
    try:
        return encode_value(tuple(state), where=where)
    except UnsavableValue:
        for name, value in _parts(actor, state):  # Once more, one by one: the error shall name the one it is about.
            encode_value(value, where=name)
        raise


def _parts(actor: Actor, state: StateForm) -> list[tuple[str, object]]:
    where = f"{actor.ctx.path}: {type_name(type(actor._state_root()))}"
    if state.form == "state":
        return [(f"{where}.get_state()", state.value)]
    return [(f"{where}.{name}", value) for name, value in state.value.items()]


class StatePutBack(NamedTuple):
    """What became of a saved state.

    Attributes:
        dropped: the saved variables that were dropped: the class has them no more.
        is_mapped: whether the class that has saved it was another version: the actor would save something else now.
    """

    dropped: list[str]
    is_mapped: bool


def restore_state(
    actor: Actor,
    data: bytes | ByteParts,
    variables: tuple[list[str], list[str]] = ([], []),
    meant: Callable[[Any], Any] = as_it_is,
    handles: Callable[[SavedHandle], None] = SavedHandle.nobody,
) -> StatePutBack:
    """Put a saved state back; one of an older schema is handed to the class's `migrate` first.

    Args:
        actor: constructed, and nothing more.
        data: the state; parts are in memory that becomes the actor's own.
        variables: those that the class had that has saved it, and that it has now, after `__init__` alone.
        meant: gives what is meant by a saved value.
        handles: told each handle in the state.

    Raises:
        DamagedValue, StateMismatch: the data is damaged, or of another class or schema version.
    """
    read = adopt_value if isinstance(data, ByteParts) else decode_value
    saved: Any = read_saved(data, partial(read, refs=actor.ctx._cell.node.ref_at, handles=handles))
    dropped: list[str] = []
    is_mapped = isinstance(saved, tuple) and len(saved) == 3 and saved[0] != actor.schema_version
    if isinstance(saved, tuple) and len(saved) == 3 and saved[:2] == (actor.schema_version, "keys"):
        version, form, state = saved
        if isinstance(state, dict):
            named, dropped = as_named_now(actor, state, *variables)
            is_mapped = named.keys() != state.keys() or not named.keys() >= set(variables[1])
            saved = version, form, named
    put_back(actor, meant(saved))
    return StatePutBack(dropped, is_mapped)


def put_back(actor: Actor, saved: Any) -> None:
    """As `restore_state`, of what was read already; it becomes the actor's own.

    Raises:
        StateMismatch: it is of another class or schema version.
    """
    where = actor.ctx.path
    if not (isinstance(saved, tuple) and len(saved) == 3):
        raise StateMismatch(where, "it was not written by save_state")
    version, form, state = saved
    if version != actor.schema_version:
        state = migrated(type(actor), state, version, where)
    if form == "state":
        setter_of(actor)(state)
        return
    if not isinstance(state, dict):
        raise StateMismatch(where, f"its key variables came as {type_name(type(state))}, not as a dict")
    root, are_named = actor._state_root(), key_names(actor) is not None
    for name, value in state.items():
        write_path(where, root, name, value, is_own=not are_named)


def key_names(actor: Actor) -> tuple[str, ...] | None:
    """The key variables that the recovery file names, or the class; None for all attributes."""
    named = actor.ctx._named_variables
    if named is not None:
        return named
    # A class with get_state means that, whatever else it says.
    return actor.key_variables if state_getter(actor) is None else None


def read_path(where: str, root: object, path: str) -> Any:
    """The variable at a dotted path, `robot.pose.x`, from an object down.

    Raises:
        StateMismatch: there is none.
    """
    value = root
    for name in path.split("."):
        try:
            value = getattr(value, name)
        except AttributeError:
            inside = "" if value is root else f": a {type_name(type(value))} has no attribute {name!r}"
            raise StateMismatch(where, f"{type_name(type(root))} has no key variable {path!r}{inside}") from None
    return value


def write_path(where: str, root: object, path: str, value: object, *, is_own: bool = False) -> None:
    """Set the variable at a dotted path; `is_own`: it was read as an attribute of the object itself.

    Raises:
        StateMismatch: there is nothing to set it on, or it cannot be set.
    """
    above, _, name = path.rpartition(".")
    holder = read_path(where, root, above) if above else root
    try:
        set_attribute(holder, name, value, is_own=is_own)
    except (AttributeError, TypeError) as error:
        raise StateMismatch(where, f"{type_name(type(root))}.{path} cannot be set: {error}") from error


def check_keys(actor: Actor, method: Method, *, first: bool) -> None:
    """Check the variables that a recovery file names, when `__init__` has run; `first`: nothing is put back now.

    Raises:
        StateMismatch: naming file, class and variable, and its type if it cannot be saved.
    """
    root, where = actor._state_root(), actor.ctx.path
    for name in method.key_variables or ():
        try:
            value = read_path(where, root, name)
            write_path(where, root, name, value)  # Now, not when it is needed.
            if first:
                encode_value(value, where=f"{type_name(type(root))}.{name}")
        except UnsavableValue as error:
            raise StateMismatch(where, f"{method.origin}: key variable {name!r}: {error}") from error
        except StateMismatch as error:
            raise StateMismatch(where, f"{method.origin}: {error.problem}") from error


def check_saved(actor: Actor, method: Method) -> None:
    """Check, when an actor has been started for the first time, that its state can be saved and put back.

    Raises:
        UnsavableValue: naming the variable and the type. StateMismatch: a declared key variable is not there or cannot
            be set, or the class lacks what puts its state back.
    """
    if method.snapshots and key_names(actor) is None and state_getter(actor) is not None:
        setter_of(actor)
    save_state(actor)
    where, root = actor.ctx.path, actor._state_root()
    for name in key_names(actor) or ():
        write_path(where, root, name, read_path(where, root, name))


def setter_of(actor: Actor) -> Callable[[Any], object]:
    """What puts back a state that `get_state` has given.

    Raises:
        StateMismatch: there is none, or it is a coroutine function, which would only do it later.
    """
    set_state = state_setter(actor)
    if set_state is None:
        raise StateMismatch(actor.ctx.path, f"{type_name(type(actor))} has no set_state, which goes with get_state")
    if inspect.iscoroutinefunction(set_state):
        raise StateMismatch(actor.ctx.path, f"{type_name(type(actor))}.set_state is `async def`: it must be plain")
    return set_state
