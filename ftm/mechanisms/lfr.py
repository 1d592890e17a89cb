"""Semi-active replication (LFR, leader-follower): both compute, one answers.

Fault model  the crash of a replica: its process, its bricks, a hang that the failure detector sees.
Guarantee    a reply leaves when the follower has the request: no request is lost or doubled. A difference between the
             two is found by comparing digests of all outcomes (`Diverged` names the first request) and, now and then,
             of the states (`StatesDiffer`); the follower then joins again with the leader's state. What has differed
             is computed again: if it comes out differently from the same state, that is told (`NondeterminismFound`).
Not covered  value faults: a difference is seen, not whose it is.
Needs        determinism; two units. State access only to bring a follower in later, or back after a divergence, and to
             compare states.
Cost         little bandwidth: requests and digests. Both units compute.
Source       Lauer et al. 2018, Tables I and II (A36, A37).
"""

from __future__ import annotations

import asyncio
import dataclasses
import math
import zlib
from collections import deque
from typing import Any, ClassVar

from ...actors.errors import HoldfastError
from ...actors.kernel.message import Message
from ...checkpoint.protocol import Outcome, TurnEnd
from ..alarms import Diverged, NondeterminismFound, StatesDiffer
from ..bricks.brick_messages import FORWARDED, Done, Request, ServerState, Work
from ..bricks.bricks import After, Before, Brick, Proceed
from ..bricks.runs import Missing, Shadow, compared_body, digest_of_state
from ..bricks.standing import PeerLost
from ..bricks.state_transfer import GoneAstray
from ..model.mechanism import Mechanism, Role
from ..replica.rewind_points import before_turn

RUNS_AGAIN = 3
"""How often what has differed is computed again."""
GONE = 1e-9
"""A deadline that is over, on whatever clock."""


class Forward(Message[None]):
    """A batch, for the follower to compute too (A36). `looks`: both take a digest of the state behind it."""

    work: Work
    looks: bool = False


class AskOutcome(Message[None]):
    """The outcome of an ask that the actor has made on the leader."""

    outcome: Outcome


class Notify(Message[None]):
    """What the leader's turns have come to: number of the request, turn, digest. `state`: that of the state behind."""

    ends: list[tuple[int, int, int]]
    state: bytes = b""


def digest(end: TurnEnd) -> int:
    """A checksum of the outcome of a turn: how it ended, its answer, and all that it has sent."""
    answer = end.answer
    head = f"{end.turn}|{end.status}|{answer.kind}|{answer.name}".encode()
    found = zlib.crc32(compared_body(answer), zlib.crc32(head))
    for sent in (out.digest() for out in end.outs):
        found = zlib.crc32(sent.to_bytes(8, "little"), found)
    return found


class Sender(Brick):
    """A brick that tells its peer things in order, and waits for the answers when it wants."""

    _under_way: set[asyncio.Task[bool]] | None = None

    def send_peer(self, message: Message[Any]) -> asyncio.Task[bool]:
        """Tell the peer; the result says whether it has it, False if it does not count any more."""
        under_way = self._under_way = self._under_way or set()
        task = self.ctx.create_task(self._sent(message))
        under_way.add(task)
        task.add_done_callback(under_way.discard)
        return task

    async def drain(self) -> None:
        """Wait until the peer has all of it."""
        for task in list(self._under_way or ()):
            await asyncio.wait((task,))

    async def _sent(self, message: Message[Any]) -> bool:
        try:
            await self.ask_peer(message)
        except PeerLost:
            return False
        return True


class Forwarding(Before, Sender):
    """Before of the leader: the follower has a request before anybody gets its reply."""

    @property
    def _every(self) -> float:
        return self.mechanism.compare_every if isinstance(self.mechanism, LFR) else math.inf

    async def before(self, work: Work) -> Work:
        """Forward a batch; one whose deadline is over is over on both sides."""
        standing = self._standing
        if standing.other.path is None:
            return work
        now = standing.node.loop.time()
        requests = [decided(one, now) for one in work.requests]
        work = Work(work.epoch, work.config, work.number, requests, work.go)
        if requests or work.go is not None:
            looks = standing.server.state.has_access and standing.looking.is_due(requests, now, self._every)
            standing.other.forwarded.append(self.send_peer(Forward(work, looks)))
        return work


def decided(request: Request, now: float) -> Request:
    """The same request, with its deadline decided: over, or of no concern any more."""
    feed = request.feed
    if not feed.deadline or feed.turn >= 0:
        return request
    past = GONE if feed.deadline <= now else 0.0
    new = type(feed)(
        feed.id, feed.turn, feed.kind, feed.name, feed.body, feed.time, feed.sender,
        feed.is_ask, feed.chain, feed.pipes, past, feed.origin, feed.has_begun,
    )  # fmt: skip
    return Request(request.client, request.incarnation, new)


class Handling(Before):
    """Before of the follower: what the leader forwards is computed here too."""

    peer_messages = (Forward,)

    async def from_peer(self, message: Message[Any]) -> None:
        """Take a batch of requests from the leader."""
        assert isinstance(message, Forward)
        standing = self._standing
        await standing.following.until_ready()
        log = standing.log
        work = message.work
        left = [
            one
            for one in work.requests
            if not standing.is_inside(one.feed)
            and (log.find(one.feed.id, one.feed.turn) is None or standing.server.is_returned(one.feed.id))
        ]
        standing.inside.update((one.feed.id, one) for one in left)
        if message.looks:
            standing.looking.name(left)
        self.next.tell(Work(standing.epoch, work.config, standing.following.number, left, work.go))


class Computing(Proceed, Sender):
    """Proceed of both: what the actor hears on the leader, it hears on the follower."""

    peer_messages = (AskOutcome,)
    answers_later = True  # What has to wait for the leader's state must not hold up the order that brings it.

    async def heard(self, outcome: Outcome) -> None:
        """Pass on what the leader's turn has heard."""
        if self.leads and self._standing.other.path is not None:
            self._standing.other.forwarded.append(self.send_peer(AskOutcome(outcome)))

    async def from_peer(self, message: Message[Any]) -> None:
        """The leader's turn has heard this."""
        assert isinstance(message, AskOutcome)
        await self._standing.following.until_ready()
        self._standing.server.inward(message.outcome)


class Notifying(After, Sender):
    """After of the leader: outcomes leave when the follower has the requests, and it gets their digests."""

    async def after(self, done: Done) -> Done:
        """Wait for the follower to have the requests."""
        standing = self._standing
        if not done.ends:
            return done
        if standing.other.path is None:
            standing.go_on_alone(end.id for end in done.ends)
            return done
        if standing.other.state == "live":
            for task in list(standing.other.forwarded):
                await task
        if standing.other.path is None:  # It was lost with this in hand.
            standing.go_on_alone(end.id for end in done.ends)
        standing.other.forwarded = [task for task in standing.other.forwarded if not task.done()]
        digests = [(end.id, end.turn, digest(end)) for end in done.ends]
        self.send_peer(Notify(digests, standing.looking.take(standing.server, done)))
        return done


class Comparing(After):
    """After of the follower: what the leader's turns have come to must be what came out here (T8)."""

    peer_messages = (Notify,)
    answers_later = True  # What has to wait for the leader's state must not hold up our own outcomes.

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._ours: deque[tuple[int, int, int, str]] = deque()  # number, turn, digest, name
        self._theirs: deque[tuple[int, int, int]] = deque()
        self._states: dict[int, bytes] = {}  # digests of states that only one of us has come to yet, by request
        self._has_diverged = False
        self._since = 0  # the state that these lead on from

    async def after(self, done: Done) -> Done:
        """Remember what came out here."""
        if done.number <= FORWARDED and done.number != self._standing.following.number:
            return done  # It leads on from a state that is given up.
        self._begin_anew()
        inside = self._standing.inside
        for end in done.ends:
            request = inside.get(end.id)
            name = "" if request is None else request.feed.name
            self._ours.append((end.id, end.turn, digest(end), name))
        self._compare()
        state = self._standing.looking.take(self._standing.server, done)
        if done.ends:
            self._compare_states(done.ends[-1].id, done.ends[-1].turn, state)
        return done

    async def from_peer(self, message: Message[Any]) -> None:
        """Remember what came out there."""
        assert isinstance(message, Notify)
        await self._standing.following.until_ready()
        self._begin_anew()
        self._theirs.extend(message.ends)
        self._compare()
        if message.ends:
            number, turn, _ = message.ends[-1]
            self._compare_states(number, turn, message.state)

    def _begin_anew(self) -> None:
        """Another state was taken: what came before it is of no concern."""
        if self._since != self._standing.following.number:
            self._since = self._standing.following.number
            self._ours.clear()
            self._theirs.clear()
            self._states.clear()
            self._has_diverged = False

    def _compare(self) -> None:
        while self._ours and self._theirs and not self._has_diverged:
            if self._theirs[0][1] < self._ours[0][1]:
                self._theirs.popleft()  # Of before we came.
            elif self._ours[0][1] < self._theirs[0][1]:
                self._ours.popleft()  # The leader has died in between, or its notice has.
            else:
                ours, theirs = self._ours.popleft(), self._theirs.popleft()
                if ours[:3] != theirs:
                    standing = self._standing
                    number, turn, _ = theirs
                    standing.node.emit(Diverged(standing.address, standing.path, standing.epoch, number, ours[3], turn))
                    self._stray(number, turn, ours[3], {ours[2], theirs[2]})

    def _compare_states(self, number: int, turn: int, digest: bytes) -> None:
        """One of the two states behind a batch is known; when both are, they must be the same."""
        if not digest or self._has_diverged:
            return
        other = self._states.pop(number, digest)
        self._states = {number: digest} if other is digest else {}
        if other != digest:
            standing = self._standing
            standing.node.emit(StatesDiffer(standing.address, standing.path, standing.epoch, turn))
            self._stray(number, turn, "", None)

    def _stray(self, number: int, turn: int, name: str, known: set[int] | None) -> None:
        """From here on our state is not the leader's: we must not lead, and do not count until we have joined again."""
        standing = self._standing
        if not standing.server.state.has_access:
            raise HoldfastError(f"{standing.path} has diverged from its leader at request {number}")
        self._has_diverged = True
        standing.following.unready()
        begin = before_turn(standing.server.points, number, turn)
        if begin is not None:
            self.ctx.create_task(self._compute_again(*begin, number, name, known))
        standing.bricks["protocol"].ref.tell(GoneAstray())

    async def _compute_again(
        self, before: ServerState, requests: list[Request], number: int, name: str, known: set[int] | None
    ) -> None:
        """Run what has differed again, from the same state: an actor that is deterministic comes to the same each time.

        `known`: digests of the outcomes that the request had; that it has one of these again is no proof of anything.
        """
        standing = self._standing
        heard, shadow = list(standing.server.traces.heard.values()), Shadow(standing, None)
        found: set[tuple[int, bytes]] = set()
        turn = before.turn
        try:
            for _ in range(RUNS_AGAIN):
                run = await shadow.run(before, requests, heard, {})
                if isinstance(run, Missing) or not run.ends or run.state is None:
                    return  # It cannot be told.
                end = run.ends[-1]
                turn = end.turn
                found.add((digest(end), digest_of_state(run.state)))
        finally:
            await shadow.close()
        if len(found) > 1 or (known is not None and known.isdisjoint(outcome for outcome, _ in found)):
            kind = NondeterminismFound
            standing.node.emit(kind(standing.address, standing.path, standing.epoch, number, name, turn))


@dataclasses.dataclass(frozen=True)
class LFR(Mechanism):
    """Leader-follower replication: every replica computes each request, and the leader's replies leave.

    Args:
        compare_every: seconds between two comparisons of the states, more where one takes longer than 1 % of that.
            0: behind each batch, whatever it takes; `math.inf`: never.
    """

    name: ClassVar[str] = "lfr"
    replicas: ClassVar[int] = 2
    tolerates: ClassVar[frozenset[str]] = frozenset({"crash"})
    needs: ClassVar[frozenset[str]] = frozenset({"determinism"})
    bandwidth: ClassVar[str] = "low"
    cpu: ClassVar[str] = "high"
    units: ClassVar[int] = 2
    layer: ClassVar[str] = "replication"
    roles: ClassVar[dict[str, Role]] = {
        "leader": Role(before=Forwarding, proceed=Computing, after=Notifying),
        "follower": Role(before=Handling, proceed=Computing, after=Comparing),
    }

    compare_every: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.compare_every, int | float) or not 0 <= self.compare_every <= math.inf:
            raise ValueError(f"LFR: compare_every must be seconds >= 0, not {self.compare_every!r}")
