"""The frames of a secured link: hand-shakes and sealed messages. It needs no extra to be imported."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from ...actors.events import Event
from ...actors.kernel.message import Message, Refusal

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...actors.kernel.codec import Codec


class Refused(Refusal, text="{path} does not accept this: {reason}"):
    """A frame, or a part of a hand-shake, was not accepted. Whoever says so may be anybody: it is only a hint."""

    path: str
    reason: str


class Greet(Message[bytes]):
    """The first part of a hand-shake; the reply is the second."""

    hello: bytes


class Agree(Message[None]):
    """The third part of the hand-shake that began with a hello of this digest."""

    hello: bytes
    finish: bytes


class Sealed(Message[bytes]):
    """A frame; the reply is one, too."""

    frame: bytes


class Opened(Message[Any]):
    """Within a replica: what was in a frame lies ready under this number. Nothing can be had by forging it."""

    key: int


class FrameRefused(Event, frozen=True, eq=False):
    """Something that came to `place` was not accepted: forged, replayed, altered, expired, or not sealed at all.

    `count` is how many there were for that reason, in this life of the place.
    """

    place: str
    reason: str
    count: int


class Part(msgspec.Struct, array_like=True):
    """A message: its name and its bytes."""

    name: str
    body: bytes


class OpenNumbers:
    """The numbers of what one end has said in a stream, from 1 on, and which of them have no answer yet."""

    __slots__ = ("_last", "_open")

    def __init__(self) -> None:
        self._last = 0
        self._open: dict[int, None] = {}

    def open(self) -> int:
        """The number of the next message."""
        self._last += 1
        self._open[self._last] = None
        return self._last

    def close(self, number: int) -> None:
        """Nobody waits for this answer any more."""
        self._open.pop(number, None)

    @property
    def floor(self) -> int:
        """All before it are answered, or given up."""
        return next(iter(self._open), self._last + 1)


class Call(msgspec.Struct, array_like=True):
    """What is in a frame on its way there: the messages of one stream are numbered, and each is handled once.

    `floor`: of the ones before it, none is asked again.
    """

    stream: str
    number: int
    floor: int
    parts: list[Part]
    epoch: int = -1
    config: int = -1


class Back(msgspec.Struct, array_like=True):
    """What is in a frame on its way back: a reply or an error, as the codec has them."""

    kind: str
    name: str
    body: bytes


def encode_reply(codec: Codec, value: object) -> Back:
    """A reply, on its way over a secured link."""
    return Back("reply", "", codec.encode(value, ""))


TELLS, ORDERS = "", "order"
"""Streams: messages that want no reply, in order; asks, in no order. All others are letters between bricks."""

Reach = Callable[[Message[Any], float], Awaitable[Any]]
"""Asks the other end something, in so many seconds."""
Handle = Callable[[Call], Awaitable[Back]]
"""Does what a frame says."""
Still = Callable[[], bool]
"""Whether anybody is still interested."""


def tell_over(link: SecuredLink, cell: Cell, message: Message[Any], still: Still) -> None:
    """Tell whoever lives at an address, over a secured link."""

    async def ask(said: Message[Any], seconds: float) -> Any:
        return await cell.ref.ask(said, timeout=seconds)

    link.tell(cell.path, message, ask, still)


class LinkLost(Exception):
    """Nobody waits for it any longer."""


class MovedCertificates(Protocol):
    """What a move of a protected actor needs of the links of its replicas."""

    async def prepare(self) -> None:
        """Have all that take part be certified under their new addresses. Raises HoldfastError."""
        ...

    async def settle(self, *, is_moved: bool) -> None:
        """Have what is certified under the addresses where they are not be revoked. Raises HoldfastError."""
        ...


class SecuredLink(Protocol):
    """What replicas and groups need of a link."""

    mechanism: Any

    def tell(self, path: str, message: Message[Any], reach: Reach, still: Still) -> None:
        """Bring a message there, once, behind those that were told before."""
        ...

    async def call(
        self, path: str, stream: str, part: Part, reach: Reach, still: Still, epoch: int = -1, config: int = -1
    ) -> Back:
        """Ask something, until the answer comes. Raises LinkLost."""
        ...

    async def take(self, frame: bytes, handle: Handle) -> bytes:
        """Open a frame, and have what is in it done once; the reply is sealed. Raises Refused."""
        ...

    async def greet(self, hello: bytes) -> bytes:
        """Answer a hello. Raises Refused."""
        ...

    async def agree(self, hello: bytes, finish: bytes) -> None:
        """Complete a hand-shake. Raises Refused."""
        ...

    def plain(self) -> None:
        """Something came that was not sealed."""
        ...

    async def ready(self) -> None:
        """Get all certificates. Raises HoldfastError."""
        ...

    def moved_certificates(self, address: str) -> MovedCertificates:
        """What has to be certified before the protected actor goes to another address. For the root's end."""
        ...

    def readdress(self, address: str) -> None:
        """Go on at another address of the protected actor, under the names that are certified there."""
        ...

    def begins_life(self, path: str) -> None:
        """Whoever lives there now is another than before. For the root's end."""
        ...

    def close(self) -> None:
        """Nothing is sent or accepted any more."""
        ...
