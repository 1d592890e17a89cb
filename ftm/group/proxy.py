"""The proxy: sends requests of the home in one batch at a time, and brings each outcome home once (A44, A54)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...actors.kernel.actor import Actor, on
from ...actors.kernel.bindings import Binding
from ...actors.kernel.cell import ORDERS
from ...actors.kernel.message import Message, message_name
from ...actors.process.wire.frames import BadFrame
from ...actors.process.wire.worker_gate import is_order
from ...checkpoint.home.life_ports import outputs_of, require_outputs
from ..bricks.brick_messages import Done, Outward
from ..bricks.replica_orders import Stalled
from ..bricks.sealed_frames import Agree, Back, Call, Greet, Refused, Sealed
from .group import SendNext
from .membership import is_within
from .replicas import GroupPart

if TYPE_CHECKING:
    from ..bricks.sealed_frames import SecuredLink
    from .group import Group


Said = Done | Outward | Stalled
"""What replicas say to it."""
SAID: dict[str, type[Said]] = {message_name(kind): kind for kind in (Done, Outward, Stalled)}


def _records(message: Done | Outward) -> list[Any]:
    return [*message.ends, *message.more] if isinstance(message, Done) else list(message.records)


class TakeAll(Message[None]):
    """Answered when all that came before it has been taken."""


class Proxy(GroupPart):
    """Between the home of a protected actor and the replica that leads. All it knows is in the group."""

    protocol: Binding[Actor]
    """Of the replica that leads."""

    def __init__(self, group: Group) -> None:
        self._group = group

    def on_start(self, restored: bool) -> None:
        """The last life may have taken an outcome, or a batch to send, and not come to its end."""
        if self._group.delivery.out is not None:
            self._group.send_again()
        self._send()

    @on(SendNext)
    def send_next(self, message: SendNext) -> None:
        """There is something to send."""
        self._send()

    @on(Done)
    def done(self, done: Done) -> Any:
        """Take outcomes home, and send what may follow them."""
        self._hear_plain(done)
        self._send()

    @on(Outward)
    def outward(self, outward: Outward) -> None:
        """Something leaves in the middle of a turn."""
        self._hear_plain(outward)

    @on(Stalled)
    def stalled(self, stalled: Stalled) -> None:
        """A turn takes too long."""
        self._hear_plain(stalled)

    def _hear_plain(self, message: Said) -> None:
        """Hear what is not sealed, if it need not be, and comes from one that can know."""
        replicas, sender = self._group.replicas, self.ctx.sender
        if replicas.is_plain():
            place = replicas.place(message.name) if isinstance(message, Stalled) else None
            if replicas.is_from_leader(sender) if place is None else is_within(place, sender):
                self._hear(message)
            else:
                self._group.delivery.stale += 1

    def _may_leave(self, message: Said) -> bool:
        """Whether the leader's process may let all of this out; one that may not is ended, and has said nothing.

        What has come from one that is gone is as good as not said, if it orders somebody: the next one is asked again.
        """
        records = () if isinstance(message, Stalled) else _records(message)
        if not any(map(outputs_of, records)):
            return True
        primary = self._group.membership.primary
        worker = None if primary is None else self._group.replicas.worker_of(primary)
        if worker is None:
            return not any(out.verb in ORDERS or is_order(out.name) for one in records for out in outputs_of(one))
        try:
            for record in records:
                require_outputs(worker.gate, record)
        except BadFrame as error:
            worker.breach(error.problem)
            return False
        return True

    def _hear(self, message: Said) -> None:
        if not self._may_leave(message):
            return
        match message:
            case Done():
                self._group.take_done(message)
            case Outward():
                self._group.take_outward(message)
            case Stalled():
                self._group.stuck.told(message)

    @on(Greet)
    async def greet(self, message: Greet) -> bytes:
        """A replica begins a hand-shake."""
        return await self._link().greet(message.hello)

    @on(Agree)
    async def agree(self, message: Agree) -> None:
        """A replica ends its hand-shake."""
        await self._link().agree(message.hello, message.finish)

    @on(Sealed)
    async def sealed(self, message: Sealed) -> bytes:
        """What a replica says over a secured link."""
        return await self._link().take(message.frame, self._take)

    def _link(self) -> SecuredLink:
        link = self._group.replicas.link
        if link is None:
            raise Refused(path=self.ctx.path, reason="closed")
        return link

    async def _take(self, call: Call) -> Back:
        for part in call.parts:
            self._hear(self.ctx._cell.node.codec.decode(SAID[part.name], part.body))
        self._send()
        return Back("", "", b"")

    @on(TakeAll)
    def take_all(self, message: TakeAll) -> None:
        """Nothing is left to do."""

    def _send(self) -> None:
        for message in self._group.next_messages():
            self._group.replicas.tell_primary(message)
