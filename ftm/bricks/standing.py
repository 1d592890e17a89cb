"""Where a replica stands: what all of its bricks go by. One object per replica, so that all change at once."""

from __future__ import annotations

import asyncio
import itertools
from typing import TYPE_CHECKING, Any, Literal

from ...actors.errors import HoldfastError
from ...checkpoint.protocol import TurnEnd
from ..alarms import ProtectionCostly
from .brick_messages import FORWARDED, ConfigMismatch, Logged, Request, StaleEpoch
from .reply_log import ReplyLog
from .state_comparison import Looking

if TYPE_CHECKING:
    from ...actors.kernel.message import Message
    from ...actors.kernel.node import Node
    from ..model.mechanism import Mechanism
    from ..replica.protected_actor import Server
    from .peer_channel import Outbox
    from .sealed_frames import SecuredLink

COSTLY = 0.01
"""Seconds from which on it is told what going through the state takes."""
PeerState = Literal["none", "joining", "live"]


class PeerLost(HoldfastError, text="{why}"):
    """The other replica does not count any more: nobody waits for it."""

    why: str


class Standing:
    """A replica's address, role, epoch and configuration, and its other half."""

    def __init__(self, node: Node, address: str, path: str, config: int, layers: tuple[Mechanism, ...]) -> None:
        self.node, self.address, self.path = node, address, path
        self.epoch, self.config, self.layers = -1, config, layers
        self.leads = False
        self.is_fenced = False  # another one leads: nothing that is said here counts
        self.log = ReplyLog()
        self.inside: dict[int, Request] = {}  # requests that are being handled
        self.inputs: dict[int, Request] = {}  # requests as they came in, for whoever runs them once more
        self.peer: str | None = None  # the path of the other replica
        self.peer_state: PeerState = "none"
        self.peer_turn = -2  # the last turn whose state it has acknowledged, -2 if that is not known
        self.kept: tuple[int, int] = (
            -1,
            -1,
        )  # epoch and turn of what was last computed here for the leader
        self.leading = -1  # the epoch in which it has begun to lead
        self.computes = False  # whether the protected actor lives here
        self.is_ready = False  # whether it has the state of the one that leads
        self.follows = False  # it was told to, and has not led since
        self.forwarded_as = FORWARDED  # the number of batches that lead on from the state that is here
        self.paths: dict[str, str] = {}  # of its bricks, by slot
        self.forwarded: list[asyncio.Task[bool]] = []  # batches on their way to a follower
        self.looking = Looking()
        self.refused = 0  # messages of other epochs or configurations
        self.server: Server = None  # type: ignore[assignment]  # made with it, by the replica
        self.shadows: set[Server] = set()  # more lives of it, which only compute
        self.link: SecuredLink | None = None  # what comes and goes has to be sealed
        self._opened: dict[int, Message[Any]] = {}  # came over it, and waits for its handler
        self._is_costly = False  # that was told
        self._opened_keys = itertools.count()
        self._bricks: dict[str, Outbox] = {}  # of the other replica, by slot
        self._unready: list[asyncio.Future[None]] = []
        self._waiting: set[asyncio.Future[Any]] = set()

    def check(self, epoch: int, config: int | None = None) -> None:
        """Refuse what an earlier epoch, or another stack of mechanisms, says.

        Raises:
            StaleEpoch, ConfigMismatch.
        """
        if epoch < self.epoch:
            self.refused += 1
            raise StaleEpoch(self.path, self.epoch, epoch)
        if config is not None and config != self.config:
            self.refused += 1
            raise ConfigMismatch(self.path, self.config, config)

    def put_opened(self, message: Message[Any]) -> int:
        """What has come over the secured link; the number is for `take_opened`."""
        key = next(self._opened_keys)
        self._opened[key] = message
        return key

    def take_opened(self, key: int, kinds: tuple[type[Message[Any]], ...]) -> Message[Any] | None:
        """What has come, once; None if it is not for whoever understands these."""
        return self._opened.pop(key) if isinstance(self._opened.get(key), kinds) else None

    def took(self, seconds: float, size: int) -> None:
        """The state was gone through to compare runs: tell, once, if that takes long."""
        if seconds > COSTLY and not self._is_costly:
            self._is_costly = True
            self.node.emit(ProtectionCostly(self.address, self.path, seconds, size))

    def entries(self, ends: list[TurnEnd]) -> list[Logged]:
        """Outcomes as the reply log has them."""
        inside, found = self.inside, list[Logged]()
        for end in ends:
            request = inside.get(end.id)
            client, life = ("", 0) if request is None else (request.client, request.incarnation)
            found.append((client, life, end.id, end))
        return found

    def ready(self) -> None:
        """The state of the one that leads is here: what it says from now on makes sense."""
        self.is_ready = True
        waiting, self._unready = self._unready, []
        for one in waiting:
            if not one.done():
                one.set_result(None)

    def unready(self) -> None:
        """Whatever the one that leads says has to wait until its state is here."""
        self.is_ready = False

    async def until_ready(self) -> None:
        """Wait until the state of the one that leads is here."""
        if not self.is_ready:
            waiting: asyncio.Future[None] = self.node.loop.create_future()
            self._unready.append(waiting)
            await waiting

    def forget_bricks(self) -> None:
        """The bricks of the other replica may be others now."""
        self._bricks.clear()

    def fence(self) -> None:
        """A higher epoch was seen elsewhere: whatever is still said here does not count."""
        self.is_fenced = True
        self.set_peer(None, "none")

    def set_peer(self, path: str | None, state: PeerState, turn: int = -2) -> None:
        """The other replica is this one from now on; nobody waits any longer for another."""
        self.peer, self.peer_state, self.peer_turn = path, state if path is not None else "none", turn
        self._bricks.clear()
        self.forwarded = []
        waiting, self._waiting = self._waiting, set()
        for one in waiting:
            if not one.done():
                one.set_exception(PeerLost("it was replaced, or is gone"))

    def brick(self, slot: str) -> Outbox | None:
        """The way to the same brick of the other replica, if that was found already."""
        return self._bricks.get(slot)

    def found(self, slot: str, outbox: Outbox) -> None:
        """Remember where the same brick of the other replica is."""
        self._bricks[slot] = outbox

    def lost(self, slot: str) -> None:
        """It is not there any more."""
        self._bricks.pop(slot, None)

    async def wait_for(self, asked: asyncio.Future[Any]) -> Any:
        """The outcome of what the other replica was asked, as long as it counts.

        Raises:
            PeerLost: it does not any more. What the ask raises.
        """
        outcome: asyncio.Future[Any] = self.node.loop.create_future()
        self._waiting.add(outcome)

        def over(done: asyncio.Future[Any]) -> None:
            if done.cancelled():
                outcome.cancel()
            elif outcome.done():
                done.exception()
            elif (error := done.exception()) is not None:
                outcome.set_exception(error)
            else:
                outcome.set_result(done.result())

        asked.add_done_callback(over)
        try:
            return await outcome
        finally:
            self._waiting.discard(outcome)

    async def changes(self, seconds: float) -> None:
        """Wait until the other replica is another one, but not for ever."""
        outcome: asyncio.Future[None] = self.node.loop.create_future()
        self._waiting.add(outcome)
        timer = self.node.loop.call_later(seconds, lambda: None if outcome.done() else outcome.set_result(None))
        try:
            await outcome
        finally:
            timer.cancel()
            self._waiting.discard(outcome)
