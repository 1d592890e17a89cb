"""Key variables: which part of an actor is its state, and how it is saved and put back."""

from __future__ import annotations

from typing import Any

from ..actors.actor import Actor
from ..actors.errors import HoldfastError, type_name
from ..actors.values import UnsavableValue, decode_value, encode_value


class StateMismatch(HoldfastError):
    """A saved state does not fit the class that shall take it back."""

    def __init__(self, actor: str, problem: str) -> None:
        super().__init__(actor, problem)
        self.actor, self.problem = actor, problem

    def __str__(self) -> str:
        return f"the saved state of {self.actor} does not fit: {self.problem}"


def save_state(actor: Actor) -> bytes:
    """The actor's state as bytes: `get_state()` if the class has it, else its key variables.

    Raises:
        UnsavableValue: naming the variable and the type. StateMismatch: a declared key variable is not there.
    """
    where, kind = actor.ctx.path, type_name(type(actor))
    get_state = getattr(actor, "get_state", None)
    if get_state is not None:
        state = get_state()
        return _encode(actor, "state", state, [(f"{where}: {kind}.get_state()", state)])
    names = actor.key_variables
    if names is None:
        state = {name: value for name, value in vars(actor).items() if not name.startswith("_") and name != "ctx"}
    else:
        missing = [name for name in names if not hasattr(actor, name)]
        if missing:
            raise StateMismatch(where, f"{kind} has no key variable {missing[0]!r}")
        state = {name: getattr(actor, name) for name in names}
    return _encode(actor, "keys", state, [(f"{where}: {kind}.{name}", value) for name, value in state.items()])


def _encode(actor: Actor, form: str, state: object, parts: list[tuple[str, object]]) -> bytes:
    try:
        return encode_value((actor.schema_version, form, state), where=actor.ctx.path)
    except UnsavableValue:
        for name, value in parts:  # Once more, variable by variable: the error shall name the one it is about.
            encode_value(value, where=name)
        raise


def restore_state(actor: Actor, data: bytes) -> None:
    """Put a saved state back.

    Raises:
        DamagedValue, StateMismatch: the data is damaged, or of another class or schema version.
    """
    saved: Any = decode_value(data)
    where = actor.ctx.path
    if not (isinstance(saved, tuple) and len(saved) == 3):
        raise StateMismatch(where, "it was not written by save_state")
    version, form, state = saved
    if version != actor.schema_version:
        raise StateMismatch(where, f"it has schema version {version}, {type_name(type(actor))} {actor.schema_version}")
    if form == "state":
        set_state = getattr(actor, "set_state", None)
        if set_state is None:
            raise StateMismatch(where, f"{type_name(type(actor))} has no set_state")
        set_state(state)
        return
    for name, value in state.items():
        setattr(actor, name, value)
