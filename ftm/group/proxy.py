"""The proxy: what the home feeds goes out in one batch at a time, and each outcome comes home once (A44, A54)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.bindings import Binding
from ...actors.kernel.message import Message, message_name
from ..bricks.brick_messages import Done, Outward
from ..bricks.replica_orders import Stalled
from ..bricks.sealed_frames import Agree, Back, Call, Greet, Refused, Sealed
from .group import Flush
from .membership import is_within

if TYPE_CHECKING:
    from ..bricks.sealed_frames import SecuredLink
    from .group import Group


SAID: dict[str, type[Message[Any]]] = {message_name(kind): kind for kind in (Done, Outward, Stalled)}
"""What replicas say to it."""


class Settle(Message[None]):
    """Answered when all that came before it has been taken."""


class Proxy(Actor):
    """Between the home of a protected actor and the replica that leads. All it knows is in the group."""

    _is_part: ClassVar[bool] = True

    deterministic = False

    protocol: Binding[Actor]
    """Of the replica that leads."""

    def __init__(self, group: Group) -> None:
        self._group = group

    def on_start(self, restored: bool) -> None:
        """The last life may have taken an outcome, or a batch to send, and not come to its end."""
        group = self._group
        if group.out is not None:
            group.send_again()
        self._send()

    @on(Flush)
    def flush(self, message: Flush) -> None:
        """There is something to send."""
        self._send()

    @on(Done)
    def done(self, done: Done) -> Any:
        """Outcomes have come."""
        group = self._group
        if group.is_plain():
            if group.is_from_leader(self.ctx.sender):
                group.take_done(done)
            else:
                group.stale += 1
            self._send()

    @on(Outward)
    def outward(self, outward: Outward) -> None:
        """Something leaves in the middle of a turn."""
        group = self._group
        if group.is_plain():
            if group.is_from_leader(self.ctx.sender):
                group.take_outward(outward)
            else:
                group.stale += 1

    @on(Stalled)
    def stalled(self, stalled: Stalled) -> None:
        """A turn takes too long."""
        group = self._group
        if group.is_plain() and is_within(group.place(stalled.name), self.ctx.sender):
            group.stuck.told(stalled)

    @on(Greet)
    async def greet(self, message: Greet) -> bytes:
        """A replica begins a hand-shake."""
        return await self._link().greet(message.hello)

    @on(Agree)
    async def agree(self, message: Agree) -> None:
        """Its end."""
        await self._link().agree(message.hello, message.finish)

    @on(Sealed)
    async def sealed(self, message: Sealed) -> bytes:
        """What a replica says over a secured link."""
        return await self._link().take(message.frame, self._take)

    def _link(self) -> SecuredLink:
        link = self._group.link
        if link is None:
            raise Refused(path=self.ctx.path, reason="closed")
        return link

    async def _take(self, call: Call) -> Back:
        group, codec = self._group, self.ctx.cell.node.codec
        for part in call.parts:
            message = codec.decode(SAID[part.name], part.body)
            if isinstance(message, Done):
                group.take_done(message)
            elif isinstance(message, Stalled):
                group.stuck.told(message)
            else:
                group.take_outward(message)
        self._send()
        return Back("", "", b"")

    @on(Settle)
    def settle(self, message: Settle) -> None:
        """Nothing is left to do."""

    def _send(self) -> None:
        group = self._group
        group.is_poked = False
        inward = group.next_inward()
        if inward is not None:
            self._tell(inward)
        finished, group.finished = group.finished, []
        for ended in finished:
            self._tell(ended)
        work = group.next_work()
        if work is not None:
            self._tell(work)

    def _tell(self, message: Message[Any]) -> None:
        name = self._group.primary
        if self._group.link is not None:
            self._group.tell_sealed(message)
            return
        cell = None if name is None else self._group.cell_of(f"{name}/protocol")
        if cell is None:
            return  # It has died: all of it goes to the next one.
        try:
            cell.ref.tell(message)
        except HoldfastError:
            return  # The same.
