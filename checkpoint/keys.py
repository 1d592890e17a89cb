"""Key variables: which part of an actor is its state, and how it is saved and put back."""

from __future__ import annotations

from typing import Any, NamedTuple

from ..actors.actor import Actor
from ..actors.errors import HoldfastError, type_name
from ..actors.values import UnsavableValue, decode_value, encode_value
from .image import is_image, read_image


class StateMismatch(HoldfastError):
    """A saved state does not fit the class that shall take it back."""

    def __init__(self, actor: str, problem: str) -> None:
        super().__init__(actor, problem)
        self.actor, self.problem = actor, problem

    def __str__(self) -> str:
        return f"the saved state of {self.actor} does not fit: {self.problem}"


class State(NamedTuple):
    """An actor's state, still made of its own objects."""

    version: int
    form: str  # "state": from `get_state`; "keys": key variables
    value: Any


def state_of(actor: Actor) -> State:
    """What is to be saved: `get_state()` if the class has it, else its key variables.

    Raises:
        StateMismatch: a declared key variable is not there. What `get_state` raises.
    """
    get_state = getattr(actor, "get_state", None)
    if get_state is not None:
        return State(actor.schema_version, "state", get_state())
    names = actor.key_variables
    if names is not None:
        missing = [name for name in names if not hasattr(actor, name)]
        if missing:
            raise StateMismatch(actor.ctx.path, f"{type_name(type(actor))} has no key variable {missing[0]!r}")
    return State(actor.schema_version, "keys", {name: getattr(actor, name) for name in variables(actor)})


def variables(actor: Actor) -> list[str]:
    """The names of an actor's key variables."""
    if actor.key_variables is not None:
        return list(actor.key_variables)
    return [name for name in vars(actor) if not name.startswith("_") and name != "ctx"]


def save_state(actor: Actor) -> bytes:
    """The actor's state as bytes: `get_state()` if the class has it, else its key variables.

    Raises:
        UnsavableValue: naming the variable and the type. StateMismatch: a declared key variable is not there.
    """
    state, where = state_of(actor), actor.ctx.path
    try:
        return encode_value(tuple(state), where=where)
    except UnsavableValue:
        for name, value in _parts(actor, state):  # Once more, one by one: the error shall name the one it is about.
            encode_value(value, where=name)
        raise


def _parts(actor: Actor, state: State) -> list[tuple[str, object]]:
    where = f"{actor.ctx.path}: {type_name(type(actor))}"
    if state.form == "state":
        return [(f"{where}.get_state()", state.value)]
    return [(f"{where}.{name}", value) for name, value in state.value.items()]


def restore_state(actor: Actor, data: bytes) -> None:
    """Put a saved state back; one of an older schema is handed to the class's `migrate` first.

    Raises:
        DamagedValue, StateMismatch: the data is damaged, or of another class or schema version.
    """
    saved: Any = read_image(data) if is_image(data) else decode_value(data)
    where = actor.ctx.path
    if not (isinstance(saved, tuple) and len(saved) == 3):
        raise StateMismatch(where, "it was not written by save_state")
    version, form, state = saved
    if version != actor.schema_version:
        state = migrated(type(actor), state, version, where)
    if form == "state":
        set_state = getattr(actor, "set_state", None)
        if set_state is None:
            raise StateMismatch(where, f"{type_name(type(actor))} has no set_state")
        set_state(state)
        return
    if not isinstance(state, dict):
        raise StateMismatch(where, f"its key variables came as {type_name(type(state))}, not as a dict")
    for name, value in state.items():
        setattr(actor, name, value)


def migrated(kind: type[Actor], state: Any, version: int, where: str) -> Any:
    """A state that an older version of the class has saved, as this one wants it.

    Raises:
        StateMismatch: the class does not know that version, or says that it cannot. Nothing is lost: what was saved
            stays as it is.
    """
    known = f"it has schema version {version}, {type_name(kind)} {kind.schema_version}"
    migrate = getattr(kind, "migrate", None)
    if migrate is None:
        raise StateMismatch(where, f"{known}, which has no classmethod migrate(state, from_version)")
    if not isinstance(version, int) or version > kind.schema_version:
        raise StateMismatch(where, f"{known}: an older class cannot read what a newer one has saved")
    try:
        return migrate(state, version)
    except Exception as error:
        raise StateMismatch(where, f"{known}, and its migrate failed: {type(error).__name__}: {error}") from error
