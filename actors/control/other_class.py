"""A live actor becomes one of another class: it keeps its state, and gets the variables that only that class has."""

from __future__ import annotations

from contextvars import copy_context
from typing import Any, cast

from ..errors import ControlFailed, SpecError, error_text, type_name
from ..kernel.actor import Actor, Start
from ..kernel.context import ActorContext
from ..kernel.ref import current
from ..state_hooks import as_named_now, renames_in, state_getter
from .live_state import attributes, live_state


class InitContext(ActorContext):
    """`self.ctx` while `__init__` runs in the middle of a life, for its variables alone: all else is refused."""

    __slots__ = ()

    def _alive(self) -> None:
        raise SpecError(self.path, "only a life that begins can do that, and this one goes on")

    @property
    def trap_exits(self) -> bool:
        return super().trap_exits

    @trap_exits.setter
    def trap_exits(self, value: bool) -> None:
        if value != super().trap_exits:
            self._alive()


def become_other(actor: Actor, start: Start[Any], state: Any, *, is_said: bool, is_whole: bool = False) -> Any:
    """Make an actor one of another class, with the variables that `__init__` sets there and that it has not yet.

    As when a saved state is put back: `__init__` runs first, and what the actor has takes the place of what that sets.

    Args:
        actor: between two turns.
        start: the class and its arguments.
        state: of the present class, or, if `is_said`, as somebody has made it for the new one.
        is_said: whether renamed variables have their new names in it.
        is_whole: whether it has all variables, if `__init__` cannot run in the middle of a life.

    Returns:
        The state for the new class, without a variable missing.

    Raises:
        ControlFailed: `__init__` cannot run in the middle of a life. StateMismatch: variables may have been renamed.
    """
    old, new = own_start(actor), start.kind
    cast("Any", actor).__class__ = new
    if new is old.kind or actor._state_root() is not actor:
        return state
    try:
        made, values = _made_by_init(actor, start)
    except ControlFailed:
        if not is_whole:
            raise
        actor.ctx._first_variables = []  # They are not known, so none is missed in the next life.
        return state
    actor.ctx._first_variables = list(values or ())
    if values is not None and isinstance(state, dict):
        given = cast("dict[str, Any]", state)
        if not is_said:
            given, _ = as_named_now(actor, given, _variables_before(actor, old, given, values), list(values))
        state = {**values, **given}
    add_variables(actor, made)
    return state


def own_start(actor: Actor) -> Start[Any]:
    """The recipe of the actor's present life, as far as it is known here."""
    more = actor.ctx._cell.more
    known = None if more is None else more.start
    return Start(type(actor)) if known is None else Start(type(actor), known.args, known.kwargs)


def add_variables(actor: Actor, made: dict[str, Any]) -> None:
    """Give an actor the variables that it has not yet."""
    had = {name for name, _ in attributes(actor)}
    for name, value in made.items():
        if name not in had:
            object.__setattr__(actor, name, value)


def _variables_before(actor: Actor, old: Start[Any], state: dict[str, Any], values: dict[str, Any]) -> list[str]:
    """The variables that `__init__` of the old class sets, if it matters: some have come, and others may have gone."""
    names = renames_in(actor, state)
    come = values.keys() - {names.get(name, name) for name in state}
    if not come or {names.get(name, name) for name in state} <= values.keys():
        return []
    new = type(actor)
    cast("Any", actor).__class__ = old.kind
    try:
        return list(_made_by_init(actor, old)[1] or ())
    except ControlFailed:
        return list(state)  # Then any of them may be what has another name now.
    finally:
        cast("Any", actor).__class__ = new


def _made_by_init(actor: Actor, start: Start[Any]) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """What `__init__` of the actor's class sets, and which of it is the state; None: the class makes that itself.

    It runs on the actor itself, so that what it keeps of it (`self.tick = self.on_tick`) is the actor's own. Then the
    actor is as it was.
    """
    before, ctx = attributes(actor), InitContext(actor.ctx._cell)
    context = copy_context()
    context.run(current.set, ctx)  # What is told by a ref is told by this one.
    vars(actor).clear()
    actor.ctx = ctx
    try:
        context.run(cast("Any", actor).__init__, *start.args, **start.kwargs)
        made = {name: value for name, value in attributes(actor) if name != "ctx"}
        return made, None if state_getter(actor) is not None else live_state(actor)
    except Exception as error:
        problem = (
            f"{type_name(start.kind)}.__init__ says which variables are new, and it cannot run in the middle of a life "
            f"({type_name(type(error))}: {error_text(error)}): give a `change` that returns all variables"
        )
        raise ControlFailed(ctx.path, "replace_code", problem) from error
    finally:
        vars(actor).clear()
        for name, value in before:
            object.__setattr__(actor, name, value)
