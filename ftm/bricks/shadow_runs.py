"""One replica computes for another: the same requests, from the same state, in a shadow."""

from __future__ import annotations

from typing import Any

import msgspec

from ...actors.kernel.message import Message
from ...checkpoint.protocol import Outcome, TurnEnd
from .brick_messages import Logged, Request, ServerState
from .runs import Digests, Missing, Remembering, Run, Shadow


class Computed(msgspec.Struct, array_like=True):
    """What came of it. `problem`: nothing has, and why; NEEDS_STATE: the state to begin from is not here."""

    ends: list[TurnEnd]
    state: ServerState | None
    digest: bytes
    objections: list[tuple[int, str]]
    problem: str = ""


NEEDS_STATE = "the state to begin from is not here"


class Compute(Message[Computed]):
    """Compute these requests, from `state`, or from the one that is here if `base` is its digest.

    `keep`: the state that they lead to is the one to begin from next time, and to lead with; else it is sent back.
    `log`: the reply log that goes with `state`, if that is kept. `heard` and `sent`: what the first run has.
    """

    turn: int
    base: bytes
    state: ServerState | None
    requests: list[Request]
    heard: list[Outcome]
    keep: bool
    live: bool = True
    log: list[Logged] = msgspec.field(default_factory=list)
    sent: dict[int, list[int]] = msgspec.field(default_factory=dict)


class Settled(Message[None]):
    """`right`: the state that was kept here is the one that was voted for; else this replica has to begin anew."""

    right: bool


class Helping(Remembering):
    """A Before that computes in a shadow what the other replica asks for."""

    peer_messages = (Compute, Settled)

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._shadow: Shadow | None = None
        self._digest = b""
        self._digests = Digests()
        self._kept: ServerState | None = None

    async def on_stop(self, reason: object) -> None:
        """Stop the shadow together with its brick."""
        shadow, self._shadow = self._shadow, None
        if shadow is not None:
            await shadow.close()

    async def from_peer(self, message: Message[Any]) -> Any:
        """Compute a request for the other replica."""
        if isinstance(message, Settled):
            self.settled(message)
            return None
        assert isinstance(message, Compute)
        return await self._compute(message)

    def settled(self, message: Settled) -> None:
        """Hear how a vote went."""

    async def _compute(self, order: Compute) -> Computed:
        before = order.state
        if before is None:
            before = self._base(order)
            if before is None:
                return Computed([], None, b"", [], NEEDS_STATE)
        if before.live != order.live:
            before = msgspec.structs.replace(before, live=order.live)
        epoch = self._standing.epoch
        run: Run | Missing = Run([], before)
        if order.requests:
            if self._shadow is None:
                self._shadow = Shadow(self._standing, None)
            run = await self._shadow.run(before, order.requests, order.heard, order.sent)
        if isinstance(run, Missing) or run.state is None:
            return Computed([], None, b"", [], run.why if isinstance(run, Missing) else "no state")
        digest = b""
        if order.keep:
            digest = self._digests.of(run.state)
            if not self._keep(order, run, digest, epoch):
                return Computed([], None, b"", [], f"{self._standing.path} lives on from another state")
        return Computed(run.ends, None if order.keep else run.state, digest, run.objections)

    def _base(self, order: Compute) -> ServerState | None:
        """The state that is here, if it is the one that is meant."""
        standing = self._standing
        point = standing.server.points.point
        if standing.server.life is not None or point is None or point.turn != order.turn:
            return None
        if point is not self._kept:
            self._digest, self._kept = self._digests.of(point), point
        return point if self._digest == order.base else None

    def _keep(self, order: Compute, run: Run, digest: bytes, epoch: int) -> bool:
        """Whether what it has led to is from now on the state that is here."""
        standing = self._standing
        if standing.leads or standing.server.life is not None:
            return False
        assert run.state is not None
        standing.server.install(run.state)
        self._digest, self._kept = digest, run.state
        clients = {one.feed.id: (one.client, one.incarnation) for one in order.requests}
        entries: list[Logged] = [(*clients.get(end.id, ("", 0)), end.id, end) for end in run.ends]
        if order.state is not None:  # What is here may not be what has led to that.
            standing.log.replace(order.log)
        standing.log.add(entries)
        standing.following.computed = epoch, run.state.turn  # It may have been told meanwhile that another one leads.
        return True
