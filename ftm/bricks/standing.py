"""The standing of a replica (role, epoch, peers): one object that all its bricks go by."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Literal

from ...actors.errors import HoldfastError
from ...checkpoint.protocol import START, Feed, TurnEnd
from ..alarms import ProtectionLost
from .brick_messages import FORWARDED, ConfigMismatch, Logged, Request, StaleLeader
from .reply_log import ReplyLog
from .state_comparison import Looking

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...actors.kernel.message import Message
    from ...actors.kernel.node import Node
    from ..model.mechanism import Mechanism
    from ..replica.protected_actor import Server
    from .peer_channel import Outbox
    from .sealed_frames import SecuredLink

PeerState = Literal["none", "joining", "live"]


class PeerLost(HoldfastError, text="{why}"):
    """The other replica does not count any more: nobody waits for it."""

    why: str


class OtherReplica:
    """What is known of the replica that this one speaks with, and who waits for an answer from there."""

    def __init__(self, node: Node) -> None:
        self._node, self._loop = node, node.loop
        self.cell: Cell | None = None  # where it is
        self.state: PeerState = "none"
        self.turn = -2  # the last turn whose state it has acknowledged, -2 if that is not known
        self.forwarded: list[asyncio.Task[bool]] = []  # batches on their way to it
        self.is_missed = False  # there has been one, and that there is none now was not told yet
        self.told = 0  # how often home has said who it is
        self._bricks: dict[str, Outbox] = {}  # by slot
        self._waiting: set[asyncio.Future[Any]] = set()

    @property
    def path(self) -> str | None:
        """Its address; None: there is no other replica."""
        return None if self.cell is None else self.cell.path

    def replace(self, path: str | None, state: PeerState, turn: int = -2) -> None:
        """The other replica is this one from now on; nobody waits any longer for another."""
        self.cell = None if path is None else self._node.cell_at(path)
        self.state, self.turn = state if path is not None else "none", turn
        if self.state == "live":
            self.caught_up()
        self.forget_bricks()
        waiting, self._waiting = self._waiting, set()
        for one in waiting:
            if not one.done():
                one.set_exception(PeerLost("it was replaced, or is gone"))

    def caught_up(self) -> None:
        """It counts from now on."""
        self.state, self.is_missed = "live", True

    def brick(self, slot: str) -> Outbox | None:
        """The way to the same brick there, if that was found already."""
        return self._bricks.get(slot)

    def remember_brick(self, slot: str, outbox: Outbox) -> None:
        """Remember where the same brick is there."""
        self._bricks[slot] = outbox

    def lose_brick(self, slot: str) -> None:
        """The brick is not there any more."""
        self._bricks.pop(slot, None)

    def forget_bricks(self) -> None:
        """The bricks, here and there, may be others now: for what these have said nobody waits any more."""
        self._bricks.clear()
        self.forwarded = []

    async def wait_for(self, asked: asyncio.Future[Any]) -> Any:
        """The outcome of what the other replica was asked, as long as it counts.

        Raises:
            PeerLost: it does not any more. What the ask raises.
        """
        outcome: asyncio.Future[Any] = self._loop.create_future()
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
        outcome: asyncio.Future[None] = self._loop.create_future()
        self._waiting.add(outcome)
        timer = self._loop.call_later(seconds, lambda: None if outcome.done() else outcome.set_result(None))
        try:
            await outcome
        finally:
            timer.cancel()
            self._waiting.discard(outcome)


class Following:
    """How far a replica that does not lead has come to follow the one that does."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self.is_told = False  # to follow, and has not led since
        self.is_ready = False  # it has the state of the one that leads
        self.number = FORWARDED  # of the batches that lead on from the state that is here
        self.computed: tuple[int, int] = -1, -1  # epoch and turn of what was last computed here for the leader
        self._waiting: list[asyncio.Future[None]] = []

    def ready(self) -> None:
        """The state of the one that leads is here: what it says from now on makes sense."""
        self.is_ready = True
        waiting, self._waiting = self._waiting, []
        for one in waiting:
            if not one.done():
                one.set_result(None)

    def unready(self) -> None:
        """Whatever the one that leads says has to wait until its state is here."""
        self.is_ready = False

    async def until_ready(self) -> None:
        """Wait until the state of the one that leads is here."""
        if not self.is_ready:
            waiting: asyncio.Future[None] = self._loop.create_future()
            self._waiting.append(waiting)
            await waiting


class OpenedMessages:
    """What has come over the secured link, and waits for its handler."""

    def __init__(self) -> None:
        self._messages: dict[int, Message[Any]] = {}
        self._keys = itertools.count()

    def put(self, message: Message[Any]) -> int:
        """Have a message wait; the number is for `take`."""
        key = next(self._keys)
        self._messages[key] = message
        return key

    def take(self, key: int, kinds: tuple[type[Message[Any]], ...]) -> Message[Any] | None:
        """Take out a message, once; None if it is not for whoever understands these."""
        return self._messages.pop(key) if isinstance(self._messages.get(key), kinds) else None


class Standing:
    """A replica's address, role, epoch and configuration, and its other half."""

    def __init__(self, replica: Cell, config: int, layers: tuple[Mechanism, ...]) -> None:
        self.node, self._replica = replica.node, replica
        self.epoch, self.config, self.layers = -1, config, layers
        self.leads = False
        self.leading = -1  # the epoch in which it has begun to lead
        self.is_fenced = False  # another one leads: nothing that is said here counts
        self.computes = False  # whether the protected actor lives here
        self.log = ReplyLog()
        self.inside: dict[int, Request] = {}  # requests that are being handled
        self.other, self.following, self.opened = OtherReplica(self.node), Following(self.node.loop), OpenedMessages()
        self.bricks: dict[str, Cell] = {}  # by slot
        self.looking = Looking()
        self.refused = 0  # messages of other epochs or configurations
        self.server: Server = None  # type: ignore[assignment]  # made with it, by the replica
        self.link: SecuredLink | None = None  # what comes and goes has to be sealed

    @property
    def path(self) -> str:
        """The address of the replica."""
        return self._replica.path

    @property
    def address(self) -> str:
        """The address of the protected actor, by which it knows itself on every replica."""
        return protected_at(self.path)

    def go_on_alone(self, numbers: Iterable[int]) -> None:
        """What these requests came to leaves, and no other replica could give it again. Told once, until there is one.

        Before the first other one has joined nothing is lost, nor is what a start came to: whoever starts in its place
        begins with the same.
        """
        inside = (self.inside[number] for number in numbers if number in self.inside)
        if self.other.is_missed and not self.is_fenced and any(one.feed.kind != START for one in inside):
            self.other.is_missed = False
            self.node.emit(ProtectionLost(self.address, self.path, self.epoch))

    def part(self, name: str) -> Cell:
        """The cell of an actor of the mechanism in the root: of its proxy, of its detector."""
        return self.node.cell_at(f"{self.address}/ftm/{name}")

    def check(self, epoch: int, config: int | None = None) -> None:
        """Refuse what an earlier epoch, or another stack of mechanisms, says.

        Raises:
            StaleEpoch, ConfigMismatch.
        """
        if epoch < self.epoch:
            self.refused += 1
            raise StaleLeader(self.path, self.epoch, epoch)
        if config is not None and config != self.config:
            self.refused += 1
            raise ConfigMismatch(self.path, self.config, config)

    def is_inside(self, feed: Feed) -> bool:
        """Whether a request is being handled; one that is replayed for two turns is another one for each."""
        request = self.inside.get(feed.id)
        return request is not None and request.feed.turn == feed.turn

    def entries(self, ends: list[TurnEnd]) -> list[Logged]:
        """Outcomes as the reply log has them."""
        inside, found = self.inside, list[Logged]()
        for end in ends:
            request = inside.get(end.id)
            client, life = ("", 0) if request is None else (request.client, request.incarnation)
            found.append((client, life, end.id, end))
        return found

    def fence(self) -> None:
        """A higher epoch was seen elsewhere: whatever is still said here does not count."""
        self.is_fenced = True
        self.other.replace(None, "none")


def protected_at(replica: str) -> str:
    """The address of the protected actor whose replica has this one."""
    return replica.rsplit("/", 2)[0]
