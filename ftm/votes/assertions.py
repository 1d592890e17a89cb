"""Assertions: a user's own functions that say whether the outcome of a turn can be right.

A function takes any of `reply`, `message` and `state` (the actor, to be read only), by these names; only what it
returns as true holds. One that takes `reply` is asked about turns that have replied, one without about every turn.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any

from ...actors.errors import HoldfastError, type_name
from ...actors.process.wire.start_codec import imported
from ...checkpoint.protocol import FAILED, MESSAGE, OK, REPLY, TurnEnd
from ..model.mechanism import FILES, SCRIPTS, MechanismRefused
from ..replica.protected_actor import Server

PARAMETERS = frozenset({"reply", "message", "state"})


class AssertionFailed(HoldfastError, text="{actor}: {why}"):
    """The outcome that was computed for a request cannot be right, whoever computed it: nothing was changed."""

    actor: str
    why: str


def name_of(value: Any) -> str:
    """The name by which another process imports a function or class.

    Raises:
        ValueError: it has none.
    """
    if isinstance(value, str):
        if not all(value.partition(":")[::2]):
            raise ValueError(f"{value!r} is no name such as 'package.module:function'")
        return value
    name = getattr(value, "__qualname__", "")
    if not name or "<" in name:
        raise ValueError(f"{value!r} has no name by which replicas could import it: define it in a module")
    if value.__module__.startswith((SCRIPTS, FILES)):
        raise ValueError(f"{name} stands in a file that replicas cannot import by a name: define it in a module")
    return f"{value.__module__}:{name}"


def names_of(values: Any) -> tuple[str, ...]:
    """The names of several, or of one."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        values = (values,)
    return tuple(map(name_of, values))


def check_assertions(names: Iterable[str], mechanism: str, what: str) -> None:
    """Whether these can be asked.

    Raises:
        MechanismRefused: one cannot; `what` is what the mechanism calls it.
    """
    for name in names:
        try:
            Assertion(name)
        except Exception as error:  # Importing runs the module: anything may be raised.
            why = f"the {what} {name} cannot be used: {type_name(type(error))}: {error}"
            raise MechanismRefused(mechanism, why) from error


class Assertion:
    """One of them, as it is asked."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._function: Callable[..., Any] = imported(name)
        self._takes = tuple(inspect.signature(self._function).parameters)
        if not self._takes or not PARAMETERS.issuperset(self._takes):
            raise ValueError(
                f"{name} takes {', '.join(self._takes) or 'nothing'}; it may take reply, message and state"
            )
        self.takes_reply = "reply" in self._takes

    def objection(self, **given: Any) -> str:
        """Why it does not hold; "" if it does."""
        try:
            holds = bool(self._function(**{name: given[name] for name in self._takes}))
        except Exception as error:  # It is the user's, and a wrong value may break it.
            return f"{self.name} has raised {type_name(type(error))}: {error}"
        return "" if holds else f"{self.name} does not hold"


class Inspector:
    """Asks assertions at the end of each turn, in whatever life of the protected actor it was."""

    def __init__(self, names: Iterable[str]) -> None:
        self._assertions = [Assertion(name) for name in names]

    def __call__(self, server: Server, end: TurnEnd) -> TurnEnd:
        why = self._objection(server, end)
        if why:
            server.traces.objections[end.id] = why
        return end

    def _objection(self, server: Server, end: TurnEnd) -> str:
        if end.status == FAILED:
            return f"it has crashed: {end.answer.name or 'an error'}"
        life = server.life
        if end.status != OK or life is None or life.ended is None or life.ended.id != end.id:
            return ""
        feed = life.ended
        if feed.kind != MESSAGE:
            return ""
        codec, cell = life.cell.node.codec, life.cell
        message = codec.message_in(cell, feed.name, feed.body)
        has_reply = end.answer.kind == REPLY
        reply: Any = None
        if has_reply:
            try:
                reply = codec.decode_reply(type(message), end.answer.body)
            except Exception as error:  # It is not even of the type that was declared.
                return f"the reply cannot be decoded: {error}"
        for one in self._assertions:
            if has_reply or not one.takes_reply:
                why = one.objection(reply=reply, message=message, state=cell.actor)
                if why:
                    return why
        return ""
