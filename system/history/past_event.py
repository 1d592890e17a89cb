"""Past events: an event as the history keeps it, as plain data of a bounded size, without the objects it was about."""

from __future__ import annotations

import functools
from typing import Any, TypeAlias

import msgspec

from ...actors.errors import portable, type_name
from ...actors.events import (
    TRACED,
    ActorCrashed,
    Event,
    HookFailed,
    ProcessDied,
    RecoveryPhase,
    ShutdownError,
    SnapshotTaken,
)
from ...actors.exit_reasons import Crash, ExitReason
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import Item, item_name
from ...actors.kernel.message import Message, MessageText, message_of
from .raised import traceback_text

Plain: TypeAlias = "str | int | float | bool | list[str] | dict[str, float] | None"
"""What a field of a past event may be."""

LONGEST = 2_000
"""Characters that are kept of a text; of a longer one its beginning and its end."""
MOST_ITEMS = 50
"""Entries that are kept of a field with several."""
OVERHEAD = 400
"""Bytes that a past event takes in memory besides its texts, about."""
TELL_WHERE = (ActorCrashed, ProcessDied, HookFailed, ShutdownError)
"""Events that tell of a crash first; what others make of it they tell without its traceback."""
UNKEPT: frozenset[type[Event]] = frozenset({*TRACED, SnapshotTaken, RecoveryPhase})
"""Events that are told again and again while all is well; the history does not keep them. Lines are kept elsewhere."""


class PastEvent(msgspec.Struct, frozen=True):
    """An event of a system as its history keeps it.

    Attributes:
        number: rises by one with each event of the system, over restarts of the root too.
        at: Unix time at which it was told.
        kind: the class of the event, such as "ActorCrashed"; or what only the history knows: "SystemStarted",
            "SystemStopped".
        address: whom it is about.
        fields: the other fields of the event as plain values. An exit reason is text, and `reason_kind` is its class;
            of a message there is the type, and its content only with `log_payloads`. Where a life begins or ends there
            are the `turns` of its address so far, and the longest turn, if somebody counts them.
    """

    number: int
    at: float
    kind: str
    address: str
    fields: dict[str, Plain]

    @property
    def size_bytes(self) -> int:
        """The memory that the event takes, about."""
        texts = len(self.address)
        for value in self.fields.values():
            if isinstance(value, str):
                texts += len(value)
            elif isinstance(value, (list, dict)):
                texts += sum(len(one) + 40 for one in value)
        return OVERHEAD + texts


def shortened(text: str, most: int = LONGEST) -> str:
    """A text of at most about `most` characters, its beginning and its end, that any store and any border takes.

    >>> shortened("a" * 5 + "b" * 5, 4), shortened("half a pair: \\ud800")
    ('aa [6 characters left out] bb', 'half a pair: ?')
    """
    if not text.isascii():
        text = portable(text)
    if len(text) <= most:
        return text
    half = most // 2
    return f"{text[:half]} [{len(text) - 2 * half} characters left out] {text[-half:]}"


def plain_fields(event: Event, *, payloads: bool = False) -> dict[str, Plain]:
    """The fields of an event as plain values, except its address.

    Args:
        event: to be kept.
        payloads: with what is in messages; else only their types are kept.
    """
    fields: dict[str, Plain] = {}
    for name in _names(type(event)):
        value: Any = getattr(event, name)
        kind = type(value)
        if kind is int or kind is float or kind is bool or value is None:
            fields[name] = value
        elif kind is str:
            fields[name] = shortened(dotted(value) if name == "message" else value)
        elif isinstance(value, ExitReason):
            fields[name] = shortened(str(value))
            fields[f"{name}_kind"] = kind.__name__
            if isinstance(value, Crash) and isinstance(event, TELL_WHERE):
                fields["traceback"] = shortened(traceback_text(value), 2 * LONGEST)
        elif isinstance(value, (Message, Item, MessageText, Parcel)):
            _put_message(fields, value, payloads=payloads)
        elif isinstance(value, (tuple, list)):
            fields[name] = [shortened(str(one), 200) for one in value[:MOST_ITEMS]]
        elif isinstance(value, dict):
            fields[name] = {str(key): round(float(one), 6) for key, one in list(value.items())[:MOST_ITEMS]}
        else:
            fields[name] = shortened(content(value))
    return fields


@functools.cache
def _names(kind: type[Event]) -> tuple[str, ...]:
    return kind.__struct_fields__[1:]


def dotted(name: str) -> str:
    """The type of a message as people write it; homes know it by its wire name, `module:Class`."""
    return name.replace(":", ".", 1)


def content(value: object) -> str:
    """A value as text; a user's `__str__` may itself raise, and whoever tells an event must not be hurt by that."""
    try:
        return str(value)
    except Exception as error:
        return f"<its text cannot be shown: {type_name(type(error))}>"


def message_type(value: object) -> str:
    """The type of a message or of what brings it, also if its class is not known here."""
    return dotted(value.name) if isinstance(value, Parcel) else item_name(value)


def _put_message(fields: dict[str, Plain], value: Any, *, payloads: bool) -> None:
    """The type of a message and who has sent it, as far as that is known; nothing else of it may stay in memory."""
    fields["message"] = shortened(message_type(value), 200)
    if isinstance(value, Item) and value.sender is not None:
        fields["sender"] = value.sender.path
    if payloads:
        message = message_of(value)
        fields["payload"] = shortened(content(value if message is None else message))
