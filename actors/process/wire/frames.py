"""Frames: what travels between the root and an actor process, both ways.

A frame is a 4-byte length and a MessagePack array `[kind, ...]`. Addresses and type names are sent as text once, and as
a number from then on, until the sender says that it forgets them (`Forget`). `body` is a payload that whoever routes
the frame does not decode.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import msgspec

from ...errors import HoldfastError

Raw = msgspec.Raw
Name = int | str
"""An address or type name: text the first time, its number in order of first use from then on."""


LONGEST_CHAIN = 4096
"""Turns that wait for each other, in the chain of an ask."""
Chain = Annotated[tuple[tuple[str, int], ...], msgspec.Meta(max_length=LONGEST_CHAIN)]


class BadFrame(HoldfastError, text="malformed frame: {problem}"):
    """The peer sent something that is no frame of ours: the connection is closed."""

    problem: str


class Frame(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """Base of all frames between the root and its workers."""


class Tell(Frame, tag=1):
    """A message nobody waits for, so its `chain` has no turns, perhaps a trace.

    `number` counts those to an actor with a process of its own (0: it has none).
    """

    to: Name
    name: Name
    body: Raw
    number: int = 0
    sender: Name | None = None
    chain: Chain = ()


class Ask(Frame, tag=2):
    """A message whose outcome is awaited under `id`, `until` then on the clock that a machine's processes share."""

    id: int
    to: Name
    name: Name
    body: Raw
    until: float
    number: int = 0
    sender: Name | None = None
    chain: Chain = ()


class Reply(Frame, tag=3):
    """The reply to the ask with this id."""

    id: int
    body: Raw


class Failure(Frame, tag=4):
    """The ask with this id failed."""

    id: int
    kind: str
    name: str
    body: Raw


class Launch(Frame, tag=5):
    """Start an actor at an address: `recipe` is its class and arguments; `options` are the host's."""

    id: int
    to: Name
    life: int
    recipe: bytes
    options: dict[str, Any]


class Launched(Frame, tag=6):
    """The actor is up, or (`problem`) is not; `ignored`: it did not want to be."""

    id: int
    problem: str = ""
    ignored: bool = False


class Ended(Frame, tag=7):
    """The life at an address has ended."""

    to: Name
    life: int
    reason: dict[str, Any]


class Command(Frame, tag=8):
    """A command or signal to the actor at an address: stop, kill, exit, down, bind..."""

    to: Name
    verb: str
    data: dict[str, Any] = {}


class Publish(Frame, tag=9):
    """Publish on a topic; answered under `id` when every subscriber has accepted."""

    id: int
    topic: str
    name: Name
    body: Raw
    sender: Name | None = None
    chain: Chain = ()


class Beat(Frame, tag=10):
    """Says that the event loop of the sender still turns."""


class Note(Frame, tag=11):
    """An event of the other node, for the log and the event stream."""

    kind: str
    data: dict[str, Any]


class Record(Frame, tag=12):
    """For the recovery method at an address; its payload is that method's own."""

    to: Name
    body: Raw


class TellRun(Frame, tag=15):
    """Messages of one type to one address, numbered from `first` on: stands for that many `Tell`s."""

    to: int
    name: int
    first: int
    bodies: Raw


TakeRecord = Callable[[Record], None]
"""Who takes the records for one address."""


class Offer(Frame, tag=13):
    """A message whose acceptance is awaited under `id`, its handling is not: its `chain` has at most a trace."""

    id: int
    to: Name
    name: Name
    body: Raw
    sender: Name | None = None
    chain: Chain = ()


class PageChanged(Frame, tag=14):
    """The page has changed: told to a bounded mailbox only, at most once per loop tick."""


class Forget(Frame, tag=16):
    """All names that the sender has given so far are forgotten; their numbers begin again."""


class Migrate(Frame, tag=17):
    """A word of the migration of one actor, or a piece of it. In both directions; see `migration/words.py`.

    `attempt`: which one it is about; what an earlier one has left on its way is void.
    """

    to: Name
    attempt: int
    step: str
    part: bytes
    is_last: bool


def payload_of(frame: Frame) -> Any:
    """What a frame carries for others; None if it carries nothing."""
    return frame.body if isinstance(frame, (Tell, Ask, Reply, Failure, Publish, Record, Offer)) else None


def tagged(kind: type[Frame]) -> bytes:
    """How a frame of this kind begins: an array, and its tag."""
    tag = kind.__struct_config__.tag
    assert isinstance(tag, int)
    return bytes((0x90 | (len(kind.__struct_fields__) + 1), tag))


AnyFrame = (
    Tell
    | Ask
    | Reply
    | Failure
    | Launch
    | Launched
    | Ended
    | Command
    | Publish
    | Beat
    | Note
    | Record
    | Offer
    | PageChanged
    | TellRun
    | Forget
    | Migrate
)
