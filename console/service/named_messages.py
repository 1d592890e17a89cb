"""A message from an operator's hand: its class by name, its fields as JSON, to one actor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, get_origin

import msgspec

from ...actors.errors import BadMessage, SpecError
from ...actors.kernel.actor import Actor
from ...actors.kernel.message import Message, descended, message_name
from ...actors.kernel.node import cell_kind
from ...actors.kernel.ref import ActorRef

if TYPE_CHECKING:
    from ...system.system import ActorSystem

LARGEST: Final = 1 << 63
"""From this size on a whole number is told as Python writes it."""


async def ask_by_name(system: ActorSystem, path: str, name: str, fields: str, timeout: float) -> dict[str, Any]:
    """Ask an actor: the reply as plain data (`reply`), or as Python writes it (`text`).

    Raises:
        NoSuchActor, SpecError, BadMessage: nothing was asked. What `ref.ask` raises.
    """
    ref = system.ref(path)
    reply = await ref.ask(made_message(system, ref, name, fields), timeout)
    return {"reply": reply} if is_plain(reply) else {"text": repr(reply)}


def tell_by_name(system: ActorSystem, path: str, name: str, fields: str) -> None:
    """Tell an actor, without a wait.

    Raises:
        NoSuchActor, SpecError, BadMessage: nothing was told. What `ref.tell` raises.
    """
    ref = system.ref(path)
    ref.tell(made_message(system, ref, name, fields))


def made_message(system: ActorSystem, ref: ActorRef[Any], name: str, fields: str) -> Message[Any]:
    """A message of one of the classes that the actor handles; a field that is a ref is given as an address.

    Nothing is imported for it.

    Raises:
        SpecError: it handles no class of this name, or that is not known in this process. BadMessage: it has no such
            fields. NoSuchActor: nobody lives at an address in them.
    """
    kind = _class_named(ref, name)

    def as_ref(declared: Any, value: Any) -> Any:
        if (get_origin(declared) or declared) is ActorRef and isinstance(value, str):
            return system.ref(value)
        raise TypeError(f"no JSON becomes a {declared.__name__ if isinstance(declared, type) else declared}")

    try:
        given = msgspec.json.decode(fields)
        if not isinstance(given, dict):
            raise TypeError('the fields are a JSON object, such as {"name": "value"}')
        known = {field.name: field for field in msgspec.structs.fields(kind)}
        if unknown := [one for one in given if one not in known]:
            raise TypeError(f"it has no field {unknown[0]!r}, but {', '.join(known) or 'none'}")
        if missing := [one for one, field in known.items() if field.required and one not in given]:
            raise TypeError(f"it lacks the field {missing[0]!r}")
        values = {one: _converted(one, value, known[one].type, as_ref) for one, value in given.items()}
        return kind(**values)
    except (TypeError, ValueError) as error:  # msgspec's own are of these, too.
        raise BadMessage(ref.path, name, str(error)) from error


def _converted(name: str, value: Any, declared: Any, as_ref: Any) -> Any:
    try:
        return msgspec.convert(value, declared, dec_hook=as_ref)
    except msgspec.ValidationError as error:
        raise TypeError(f"field {name!r}: {error}") from error


def _class_named(ref: ActorRef[Any], name: str) -> type[Message[Any]]:
    """The class of messages of this name, or `module:Class`, that the actor handles; it may descend from one."""
    kind = cell_kind(ref._cell)
    if kind is None or kind is Actor:
        raise SpecError(ref.path, "its class is not known in this process, so no message for it can be made here")
    handled = [one for one in kind._declared if issubclass(one, Message)]
    known = {message_name(one): one for one in descended(*handled)}
    meant = [full for full in known if name in (full, full.partition(":")[2])]
    if len(meant) == 1:
        return known[meant[0]]
    those = ", ".join(sorted(meant or (message_name(one).partition(":")[2] for one in handled))) or "nothing"
    problem = f"it handles several classes {name!r}: say which, of" if meant else f"it does not handle {name!r}, but"
    raise SpecError(ref.path, f"{problem} {those}")


def is_plain(value: Any) -> bool:
    """Whether a value consists of what JSON has; a tuple is a list there.

    >>> is_plain({"a": [1, None, "b", 0.5]}), is_plain((1, 2)), is_plain({1: "a"}), is_plain(1 << 64)
    (True, True, False, False)
    """
    match value:
        case None | bool() | float():
            return True
        case int():
            return -LARGEST <= value < LARGEST
        case list() | tuple():
            return all(map(is_plain, value))
        case dict():
            return all(type(key) is str for key in value) and all(map(is_plain, value.values()))
        case _:
            return type(value) is str
