"""Letters: the messages between bricks of two replicas, also over a secured link."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.errors import AskTimeout, HoldfastError
from ...actors.kernel.actor import Actor
from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.message import Message, Refusal, message_name
from ...actors.kernel.ref import ActorRef
from ...checkpoint.protocol import pieces
from .brick_messages import NotFollowing, StaleLeader
from .sealed_frames import Back, Call, LinkLost, Part, Refused, Sealed
from .standing import PeerLost

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from .sealed_frames import SecuredLink
    from .standing import Standing


FOREVER = 10.0 * 86400.0
"""Seconds: the bricks of one replica wait for each other as long as it takes; a death is told otherwise."""
SEALED = "sealed"
"""The name of a letter that says it inside."""
LETTER_BYTES = 8 * 1024 * 1024
"""What is said to the other replica in one message; more goes in sheets."""


class Letter(Message[bytes]):
    """What a brick says to the same brick of the other replica; sheets with its number come before it."""

    epoch: int
    config: int
    name: str
    body: bytes
    sheets: int = 0
    size: int = 0  # of the body, sheets and all
    stream: int = 0
    number: int = 0  # in the stream
    floor: int = 0  # of those before it, none is asked again


class Sheet(Message):
    """A piece of a letter that is too large for one message."""

    sheets: int
    data: bytes


def tell_in_sheets(ref: ActorRef[Any], body: bytes, numbers: Iterator[int]) -> tuple[int, bytes]:
    """Tell a body that is too large for one letter ahead of it; the number of its sheets (0: none), what is left."""
    if len(body) <= LETTER_BYTES:
        return 0, body
    number = next(numbers)
    for piece in pieces(body):
        ref.tell(Sheet(number, piece))
    return number, b""


class Letters(Actor):
    """Opens sealed letters, and seals what is answered."""

    _is_part: ClassVar[bool] = True

    peer_messages: ClassVar[tuple[type[Message[Any]], ...]] = ()
    """What `from_peer` understands."""
    answers_later: ClassVar[bool] = False
    """Whether other messages are handled while `from_peer` waits for something."""
    follows_at_once: ClassVar[bool] = False
    """Whether a follower takes what the next leader says before it is told of it: it says itself what it builds on."""

    slot: str
    _standing: Standing
    _numbers: Iterator[int]

    async def from_peer(self, message: Message[Any]) -> Any:
        """Take what the same brick of the other replica says."""
        raise NotImplementedError

    def _check_sender(self, epoch: int, config: int) -> None:
        """Refuse what an earlier leader says, and, as a rule, what one says of whom we were not told.

        Raises:
            StaleEpoch, ConfigMismatch, NotFollowing.
        """
        standing = self._standing
        standing.check(epoch, config)
        if epoch > standing.epoch:
            follows = standing.epoch >= 0 and not standing.leads and not standing.is_fenced
            if not (follows and self.follows_at_once):
                raise NotFollowing(standing.path, standing.epoch, epoch)
            standing.epoch = epoch

    def _kind_of(self, name: str) -> type[Message[Any]] | None:
        return next((one for one in self.peer_messages if message_name(one) == name), None)

    async def _handle_part(self, epoch: int, config: int, name: str, body: bytes) -> bytes:
        """Have `from_peer` handle what the peer says, and encode what it returns.

        Raises:
            Refusal: the sender does not count, or what `from_peer` raises.
        """
        self._check_sender(epoch, config)
        kind, codec = self._kind_of(name), self._standing.node.codec
        if kind is None:
            raise TypeError(f"{type(self).__name__} takes no {name} from its peer")
        return codec.encode(await self.from_peer(codec.decode(kind, body)), self.ctx.path)

    async def _ask_sealed(
        self,
        link: SecuredLink,
        replica: Cell,
        slot: str,
        part: Part,
        find: Callable[[], Awaitable[ActorRef[Any]]],
        failed: Callable[[HoldfastError], None],
        still: Callable[[], bool],
    ) -> bytes:
        """Ask a brick of a replica over a secured link, which does again what has to be.

        `failed` hears when it is not there.

        Raises:
            PeerLost: nobody waits any longer. What the brick has raised.
        """
        standing = self._standing

        async def reach(said: Message[Any], seconds: float) -> Any:
            if not still():
                raise PeerLost("it does not count any more")
            try:
                if not isinstance(said, Sealed):
                    ref, out = standing.node.cell_at(f"{replica.path}/protocol").ref, said
                else:
                    ref = await find()
                    number, frame = tell_in_sheets(ref, said.frame, self._numbers)
                    out = Letter(-1, -1, SEALED, frame, number)
                return await standing.other.wait_for(ref.ask(out, timeout=seconds))
            except (PeerLost, AskTimeout, Refused):
                raise
            except HoldfastError as error:  # It has died, which we shall be told, or its brick was exchanged.
                failed(error)
                raise

        try:
            back = await link.call(replica.path, slot, part, reach, still, standing.epoch, standing.config)
        except LinkLost:
            raise PeerLost("it was replaced, or is gone") from None
        if back.kind == "reply":
            return back.body
        error = standing.node.codec.decode_error(back.kind, back.name, back.body)
        if isinstance(error, StaleLeader):
            standing.fence()
        raise error

    async def _take_sealed(self, link: SecuredLink, frame: bytes) -> bytes | ReplyHandle[bytes]:
        if not self.answers_later:
            return await link.take(frame, self._read)
        handle: ReplyHandle[bytes] = self.ctx.reply_handle()
        self.ctx.create_task(self._answer_sealed(handle, link, frame))
        return handle

    async def _answer_sealed(self, handle: ReplyHandle[bytes], link: SecuredLink, frame: bytes) -> None:
        try:
            handle.reply(await link.take(frame, self._read))
        except Refusal as no:
            handle.fail(no)

    async def _read(self, call: Call) -> Back:
        """What was in a sealed letter."""
        part = call.parts[0]
        try:
            if call.stream != self.slot or self._kind_of(part.name) is None:
                raise Refused(path=self.ctx.path, reason="malformed")
            reply = await self._handle_part(call.epoch, call.config, part.name, part.body)
        except Refusal as no:
            return Back(*self._standing.node.codec.encode_error(no))
        return Back("reply", "", reply)
