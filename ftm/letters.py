"""What comes to a brick from the other replica over a secured link."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from ..actors.actor import Actor
from ..actors.mail import ReplyHandle
from ..actors.message import Message, Refusal, message_name
from .sealed import Back, Call, Refused

if TYPE_CHECKING:
    from .sealed import SecuredLink
    from .standing import Standing


class Letters(Actor):
    """Opens sealed letters, and seals what is answered."""

    peer_messages: ClassVar[tuple[type[Message[Any]], ...]] = ()
    """What `from_peer` understands."""
    answers_later: ClassVar[bool] = False
    """Whether other messages are handled while `from_peer` waits for something."""

    slot: str
    _standing: Standing

    async def from_peer(self, message: Message[Any]) -> Any:
        """Take what the same brick of the other replica says."""
        raise NotImplementedError

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
        standing, codec = self._standing, self._standing.node.codec
        try:
            standing.check(call.epoch, call.config)
            kind = next((one for one in self.peer_messages if message_name(one) == call.parts[0].name), None)
            if kind is None or call.stream != self.slot:
                raise Refused(path=self.ctx.path, reason="malformed")
            reply = await self.from_peer(codec.decode(kind, call.parts[0].body))
        except Refusal as no:
            return Back(*codec.encode_error(no))
        return Back("reply", "", codec.encode(reply, self.ctx.path))
