"""An actor's state as control sees it: a copy to look at, or to change and put back."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import operator
from collections.abc import Callable, Generator, Iterable
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from ..errors import ControlFailed, error_text, portable, type_name
from ..state_hooks import state_getter, state_setter
from ..values import UnsavableValue, decode_value, encode_value
from ..values.classes import slots_of

if TYPE_CHECKING:
    from ..kernel.actor import Actor


@dataclasses.dataclass(frozen=True, slots=True)
class Opaque:
    """Stands in a state for a value that cannot leave its process: a socket, a lock."""

    text: str


def live_state(actor: Actor) -> Any:
    """The state itself: what `get_state()` gives if the class has it, else a dict of the key variables."""
    get_state = state_getter(actor)
    if get_state is not None:
        return get_state()
    root, names = actor._state_root(), actor.key_variables
    if names is None:
        return {name: value for name, value in attributes(root) if not name.startswith("_") and name != "ctx"}
    return {name: operator.attrgetter(name)(root) for name in names}


def attributes(root: object) -> list[tuple[str, Any]]:
    """Names and values of the attributes of an object, also of one with slots."""
    slots = [(name, getattr(root, name)) for name in slots_of(type(root)) if hasattr(root, name)]
    return [*_own(root).items(), *slots]


def _own(root: object) -> dict[str, Any]:
    """What stands in the object itself; nothing in one that has slots alone."""
    return getattr(root, "__dict__", {})


def set_attribute(holder: object, name: str, value: object, *, is_own: bool) -> None:
    """Set an attribute that was read; `is_own`: as one of the object itself.

    Such a one is set as it is. What a `__setattr__` of the class does beside that, it has done when it was set first.
    """
    own = is_own or name in _own(holder)
    (object.__setattr__ if own else setattr)(holder, name, value)


def _holder(root: object, path: str) -> tuple[Any, str]:
    """What has the variable at a dotted path, and its name there."""
    above, _, name = path.rpartition(".")
    return operator.attrgetter(above)(root) if above else root, name


def _copied(actor: Actor, state: Any, otherwise: Callable[[Any], Any]) -> Any:
    """A copy of an actor's state; `otherwise` says what becomes of a value that cannot be copied."""

    def copy(value: Any) -> Any:
        return decode_value(encode_value(value), refs=actor.ctx._cell.node.ref_at)

    try:
        return copy(state)
    except UnsavableValue:
        if type(state) is not dict:
            return otherwise(state)
    values: dict[str, Any] = {}
    for name, value in cast("dict[str, Any]", state).items():
        try:
            values[name] = copy(value)
        except UnsavableValue:
            values[name] = otherwise(value)
    return values


def state_to_show(actor: Actor) -> Any:
    """A copy that can be sent anywhere; without `get_state`, what control shows beside the attributes is in it."""
    state = live_state(actor)
    if state_getter(actor) is None:
        state = {**actor._overview(), **state}
    return _copied(actor, state, lambda value: Opaque(portable(repr(value))))


def state_to_change(actor: Actor) -> Any:
    """A copy that can be put back: what cannot be copied is in it as it is."""
    return _copied(actor, live_state(actor), lambda value: value)


def put_state(actor: Actor, state: Any, *, is_new: bool = False) -> None:
    """Make `state` the actor's: through `set_state` if the class has `get_state`, else variable by variable.

    Args:
        actor: whose state.
        state: what `live_state` would give.
        is_new: no actor of this class has had it: a `__setattr__` of the class may refuse a variable, and do more.

    Raises:
        ControlFailed: it is no state of this actor. Anything else: the class's own code raised.
    """
    where = actor.ctx.path
    if state_getter(actor) is not None:
        set_state = state_setter(actor)
        if set_state is None:
            raise ControlFailed(where, "replace_state", f"{type_name(type(actor))} has get_state but no set_state")
        set_state(state)
        return
    if not isinstance(state, dict) or not all(isinstance(name, str) for name in state):
        raise ControlFailed(where, "replace_state", f"the state must be a dict of variables, not {state!r}")
    root = actor._state_root()
    for name in live_state(actor):
        if name not in state:
            delattr(*_holder(root, name))
    for name, value in state.items():
        if is_new:
            setattr(*_holder(root, name), value)
        else:
            set_attribute(*_holder(root, name), value, is_own=actor.key_variables is None)


def keeping_variables(actor: Actor, change: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """`change`, refusing what it returns if that has other variables than the state that it was given.

    A class that makes its state itself (`get_state`) says itself what is one. Of any other a variable may be left out
    that has a default in the class's body, and one may be added that the body declares.
    """

    def changed(state: Any) -> Any:
        known = list(state) if state_getter(actor) is None else None
        after = change(state)
        if known is not None and isinstance(after, dict):
            given = cast("dict[object, Any]", after)
            _check_variables(actor, known, [name for name in given if isinstance(name, str)])
        return after

    return changed


def _check_variables(actor: Actor, known: list[str], given: list[str]) -> None:
    kind, is_fixed = type(actor._state_root()), actor.key_variables is not None
    declared = {name for base in kind.__mro__ for name in inspect.get_annotations(base)}
    missing = [name for name in known if name not in given and not _has_default(kind, name)]
    surplus = [
        name for name in given if name not in known and (is_fixed or not (name in declared or _has_default(kind, name)))
    ]
    lacks = [f"lacks {', '.join(missing)}"] if missing else []
    adds = [f"has {', '.join(surplus)}, which {type_name(kind)} has not"] if surplus else []
    if lacks or adds:
        problem = f"the new state {' and '.join(lacks + adds)}: return all of its variables ({', '.join(known)})"
        raise ControlFailed(actor.ctx.path, "replace_state", problem)


def _has_default(kind: type, name: str) -> bool:
    """Whether an object of a class has this variable without its having been set."""
    value = inspect.getattr_static(kind, name, inspect.Parameter.empty)
    is_other = inspect.isroutine(value) or inspect.isdatadescriptor(value)
    return value is not inspect.Parameter.empty and not is_other


def change_state(actor: Actor, change: Callable[[Any], Any], *, is_new: bool = True) -> None:
    """Put `change(state)` in the place of the state. If anything raises, the state is as before.

    Args:
        actor: whose state.
        change: returns the state to be.
        is_new: not if that is what a trial has come to.

    Raises:
        ControlFailed: `change` raised, or what it returned is no state, or cannot be kept.
    """
    with _changing(actor, "replace_state", is_trial=False):
        put_state(actor, change(state_to_change(actor)), is_new=is_new)
        actor.ctx._replaced()


class TriedState(NamedTuple):
    """What has come of the trial of a change.

    Attributes:
        state: the state that the actor would have.
        saved: what its home would be told of it, as bytes.
        added: the attributes that it would have and has not, whether they are of the state or not.
        first_variables: those that `__init__` of its class would have set.
    """

    state: Any
    saved: list[bytes]
    added: dict[str, Any]
    first_variables: list[str]


def tried_state(actor: Actor, changes: Iterable[Callable[[Any], Any]], verb: str) -> TriedState:
    """Try these changes, one after the other; the actor has what it had.

    Raises:
        ControlFailed: one of them raised, or what it returned is no state, or cannot be kept.
    """
    had = {name for name, _ in attributes(actor)}
    with _changing(actor, verb, is_trial=True):
        for change in changes:
            put_state(actor, change(state_to_change(actor)), is_new=True)
        added = {name: value for name, value in attributes(actor) if name not in had}
        return TriedState(state_to_change(actor), actor.ctx._saved(), added, actor.ctx._first_variables)


@contextlib.contextmanager
def _changing(actor: Actor, verb: str, *, is_trial: bool) -> Generator[None]:
    """Have the state as it was before, behind a trial and behind whatever raises."""
    ctx = actor.ctx
    ctx._may_replace()
    kind, before, first_variables = type(actor), dict(vars(actor)), ctx._first_variables
    hooked = state_to_change(actor) if state_setter(actor) is not None else None
    values = live_state(actor) if state_getter(actor) is None else None

    def put_back() -> None:
        actor.__class__ = kind
        ctx._first_variables = first_variables
        vars(actor).clear()
        vars(actor).update(before)
        if values is not None:
            put_state(actor, values)  # They may be another object's than the actor's.
        set_state = state_setter(actor)
        if hooked is not None and set_state is not None:
            set_state(hooked)

    try:
        yield
    except BaseException as error:
        put_back()
        if not isinstance(error, Exception) or isinstance(error, ControlFailed):
            raise
        raise ControlFailed(ctx.path, verb, f"{type_name(type(error))}: {error_text(error)}") from error
    if is_trial:
        put_back()
