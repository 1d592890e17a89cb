"""Messages, their replies, and refusals.

A message is a frozen, typed struct. `class Deposit(Message[int])` says that its reply is an int; a handler may also
answer with a `Refusal`, a typed "no" that is no crash.
"""

from __future__ import annotations

import functools
import sys
import typing
from collections.abc import Callable, Iterator
from typing import Any, Generic, get_args, get_origin

import msgspec
from typing_extensions import TypeVar, dataclass_transform

from ..errors import BadMessage, HoldfastError, type_name
from ..values.renamed import NOTED, Renames, former_members

R = TypeVar("R", default=None, covariant=True)
T = TypeVar("T")


@dataclass_transform(frozen_default=True, field_specifiers=(msgspec.field,))
class Message(msgspec.Struct, Generic[R], frozen=True, array_like=True):
    """Base of all messages; `R` is the type of the reply, None if it is left out.

    Fields travel by position. What a store has of earlier versions of the class is mapped by their names (`renamed`).

    >>> class Add(Message[int]):
    ...     n: int = 1
    >>> Add(2), Add() == Add(1)
    (Add(n=2), True)
    """


class RuntimeCall(Message[R], Generic[R]):
    """Base of the runtime's messages that users send to its own actors.

    Where it is handled its fields are checked, as those of every message are that comes from another process.
    """


class RuntimeOrder(RuntimeCall[R], Generic[R], repr_omit_defaults=True):
    """Base of messages that are orders of the runtime: they start or end lives, or change what runs.

    From another process only whoever was granted the receiver's address may send them there. Their text has what was
    given: some fields only the runtime gives.
    """


def why_no_message(value: object) -> str:
    """Why something is no message, and what to send instead; nothing if it is one.

    >>> class Ping(Message[str]): ...
    >>> why_no_message(Ping)
    'this is the class of a message; send an instance, Ping(...)'
    """
    if isinstance(value, Message):
        return ""
    if isinstance(value, type) and issubclass(value, Message):
        return f"this is the class of a message; send an instance, {value.__name__}(...)"
    return (
        "messages are instances of a class of their own: class MyMessage(hf.Message[...]), "
        "and a handler with @on(MyMessage)"
    )


def require_message(to: str, value: object) -> None:
    """Refuse what is no message.

    Raises:
        BadMessage: it is none; what to send instead.
    """
    if problem := why_no_message(value):
        raise BadMessage(to, type_name(type(value)), problem)


def message_of(item: object) -> Message[Any] | None:
    """The user's message inside a mailbox item, if there is one."""
    found = item if isinstance(item, Message) else getattr(item, "message", None)
    return found if isinstance(found, Message) else None


class MessageText(str):
    """A message, or another item, of another process: its text, and what it is (`item_name`)."""

    __slots__ = ("type_name",)

    type_name: str

    def __new__(cls, text: str, type_name: str) -> MessageText:
        made = super().__new__(cls, text)
        made.type_name = type_name
        return made


def _message_name(kind: type) -> str:
    module = kind.__module__
    # A process that was forked for an actor knows the classes of the user's script by another module name.
    return f"{'__main__' if module == '__mp_main__' else module}:{kind.__qualname__}"


message_name: Callable[[type], str] = functools.cache(_message_name)
"""The name a message type has on the wire and in journals: `module:Class`."""


@functools.cache
def reply_type(kind: type[Message[Any]]) -> Any:
    """The reply type that a message class declares: `int` for `Message[int]`, `None` if nothing is said.

    >>> class Ping(Message[str]): ...
    >>> reply_type(Ping)
    <class 'str'>
    """
    for base in getattr(kind, "__orig_bases__", ()):
        origin = get_origin(base)
        if origin is Message:
            return _resolve(get_args(base)[0], kind)
        if isinstance(origin, type) and issubclass(origin, Message):
            return _resolve(get_args(base)[0], kind)  # A generic message of the user's own, given its argument.
        if isinstance(base, type) and issubclass(base, Message) and base is not Message:
            return reply_type(base)
    for base in kind.__mro__[1:]:
        if issubclass(base, Message) and base is not Message:
            return reply_type(base)
    return None


def _resolve(declared: Any, kind: type) -> Any:
    """A declared reply type, with names given as text looked up in the message's module."""
    if isinstance(declared, (str, typing.ForwardRef)):
        text = declared if isinstance(declared, str) else declared.__forward_arg__
        scope = vars(sys.modules[kind.__module__]) | {kind.__name__: kind}
        try:
            return eval(text, scope)  # The text is an annotation of the user's own source, not data.
        except NameError as error:
            raise TypeError(f"reply type {text!r} of {type_name(kind)} is not known in its module: {error}") from error
    if isinstance(declared, typing.TypeVar):
        return Any
    return declared


class Refusal(HoldfastError):
    """A typed "no": raised in a handler it is the reply, and the actor lives on.

    Fields are declared as in a dataclass, and what it says as `text`, as every `HoldfastError` has it. One without a
    text shows its fields.

    >>> class Overdrawn(Refusal, text="{missing} are missing: pay in first"):
    ...     missing: int
    >>> Overdrawn(missing=5).missing, str(Overdrawn(5))
    (5, '5 are missing: pay in first')
    """

    _schema: typing.ClassVar[type[msgspec.Struct] | None] = None

    @classmethod
    def schema(cls) -> type[msgspec.Struct]:
        """Return the struct that codes this refusal's fields; made with the first use, when all names are known."""
        if "_schema" not in cls.__dict__ or cls._schema is None:
            hints = typing.get_type_hints(cls)
            names = [name for name in hints if name != "_schema" and get_origin(hints[name]) is not typing.ClassVar]
            spec = [(n, hints[n], getattr(cls, n)) if hasattr(cls, n) else (n, hints[n]) for n in names]
            named = {NOTED: Renames((), former_members(cls))}
            cls._schema = msgspec.defstruct(
                cls.__name__, spec, namespace=named, frozen=True, array_like=True, module=cls.__module__
            )
        assert cls._schema is not None
        return cls._schema

    def __str__(self) -> str:
        if self._text:
            return super().__str__()
        names = type(self).schema().__struct_fields__
        inner = ", ".join(f"{name}={getattr(self, name)!r}" for name in names)
        return f"{type(self).__name__}({inner})"

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and isinstance(other, Refusal) and other.args == self.args

    __hash__ = HoldfastError.__hash__


class UnknownRefusal(
    Refusal,
    text="refused with {type_name}, whose class is not loaded here: import its module; its fields are {fields!r}",
):
    """A refusal whose class is not loaded in this process; `fields` are as they came."""

    type_name: str
    fields: list[Any]


def find_refusal(name: str) -> type[Refusal] | None:
    """The loaded refusal class with this wire name."""
    return next((kind for kind in descended(Refusal) if message_name(kind) == name), None)


def descended(*bases: type[T]) -> Iterator[type[T]]:
    """All loaded classes that are one of these or descend from one, each once.

    >>> class Order(Message): ...
    >>> class Express(Order): ...
    >>> [kind.__name__ for kind in descended(Order)]
    ['Order', 'Express']
    """
    waiting, seen = list(bases), set[type[T]]()
    while waiting:
        kind = waiting.pop(0)
        if kind not in seen:
            seen.add(kind)
            yield kind
            waiting.extend(kind.__subclasses__())
