"""Finds the classes that what was recorded belongs to now: under the same name, or under one that says `@renamed`."""

from __future__ import annotations

from typing import Any, TypeVar

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor
from ...actors.kernel.message import Message, Refusal, descended, find_refusal, message_name, reply_type
from ...actors.process.wire.start_codec import loaded
from ...actors.values.renamed import former_names
from ..protocol import MESSAGE, REPLY, TIMED, Answer

T = TypeVar("T")

REPLY_TO, REFUSAL = "the reply to ", "the refusal "
"""How the names begin under which the fields of outcomes are kept."""


def shape_name(answer: Answer) -> str:
    """Under which name the fields of an ask's outcome are kept; "" if they are not."""
    kind = answer.kind.removeprefix(TIMED)
    if kind == "refusal":
        return REFUSAL + answer.name
    if kind == MESSAGE:
        return answer.name
    return REPLY_TO + answer.name if kind == REPLY and answer.name else ""


def present_class(name: str, kind: type[Actor] | None) -> tuple[str, Any] | None:
    """What decodes that which is kept under a name, and the name it has now; None if that is not known here.

    Args:
        name: of a message's type, or as `shape_name` gives it.
        kind: the actor's class, if it is known here.
    """
    try:
        if name.startswith(REPLY_TO):
            asked = message_called(name.removeprefix(REPLY_TO), kind)
            return None if asked is None else (REPLY_TO + message_name(asked), reply_type(asked))
        if name.startswith(REFUSAL):
            refusal = refusal_called(name.removeprefix(REFUSAL))
            return None if refusal is None else (REFUSAL + message_name(refusal), refusal.schema())
        message = message_called(name, kind)
        return None if message is None else (message_name(message), message)
    except (HoldfastError, TypeError, NameError):  # Annotations that say nothing: the codec tells.
        return None


def former_keys(name: str, kind: type[Actor] | None) -> tuple[str, ...]:
    """Under which names the same was kept before."""
    for prefix in (REPLY_TO, REFUSAL, ""):
        if name.startswith(prefix):
            own = name.removeprefix(prefix)
            found = refusal_called(own) if prefix == REFUSAL else message_called(own, kind)
            return () if found is None else tuple(prefix + old for old in former_names(found))
    return ()


def message_called(name: str, kind: type[Actor] | None) -> type[Message[Any]] | None:
    """The message class of this name: the one that the actor handles, or else any that is loaded."""
    handled = () if kind is None else tuple(one for one in kind._table if issubclass(one, Message))
    found = next((one for one in handled if message_name(one) == name), None)
    if found is None:
        found = next((one for one in handled if name in former_names(one)), None)
    return found or loaded(name, Message) or _renamed(name, Message)


def refusal_called(name: str) -> type[Refusal] | None:
    """The refusal of this name."""
    return loaded(name, Refusal) or find_refusal(name) or _renamed(name, Refusal)


def _renamed(name: str, base: type[T]) -> type[T] | None:
    """The class that says that it had this name; a module that was loaded once more has left others behind."""
    found = [one for one in descended(base) if name in former_names(one)]
    return next((one for one in found if loaded(message_name(one), base) is one), found[0] if found else None)
