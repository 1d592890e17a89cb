"""Bricks: Before, Proceed and After, as a mechanism's file derives them; what it leaves out passes through.

`work -> Before -> Proceed -> After -> done`, each an actor that is joined to the `next` one by a binding. A mechanism's
brick sets `before`, `after` or `from_peer`, and may use `ask_peer`, `state`, `leads`, `epoch`.
"""

from __future__ import annotations

import asyncio
import itertools
from collections import deque
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from ...actors.errors import BadMessage, HoldfastError, type_name
from ...actors.kernel import lifecycle
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.bindings import Binding
from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.message import Message, Refusal, reply_type
from ...actors.kernel.ref import current
from ...checkpoint.protocol import (
    DROPPED,
    MESSAGE,
    REPLY,
    Answer,
    Live,
    MidTurn,
    Outcome,
    Snapshot,
    TurnEnd,
)
from .brick_messages import (
    FORWARDED,
    Beside,
    Done,
    Inward,
    NoReply,
    Outward,
    PartEnded,
    Request,
    StaleLeader,
    Taken,
    Work,
)
from .letters import FOREVER as FOREVER
from .peer_channel import AGAIN, Inbox, Posting

if TYPE_CHECKING:
    from ..model.mechanism import Mechanism
    from .standing import Standing

R = TypeVar("R")


class AwaitHandled(Message[None]):
    """Answered when all that came before it was handled."""


class Flush(Message[None]):
    """Answered when all that is ready was handed over."""


class Abandon(Message[None]):
    """Drop what is being computed, and what waits to be; answered when nothing is."""


class Brick(Posting):
    """Base of all bricks: the parts of which a replica of a protected actor is made."""

    deterministic = False

    next: Binding[Actor]
    peer: Binding[Actor]
    state: Binding[Actor]

    def __init__(self, standing: Standing, mechanism: Mechanism | None, slot: str) -> None:
        self._standing, self.mechanism, self.slot = standing, mechanism, slot
        self._sheets: dict[int, list[bytes]] = {}
        self._inboxes: dict[int, Inbox] = {}
        self._numbers = itertools.count(1)
        self._sending = asyncio.Lock()
        self._handle: ReplyHandle[Any] | None = None

    @property
    def leads(self) -> bool:
        """Say whether this replica is the primary (leader)."""
        return self._standing.leads

    @property
    def role(self) -> str:
        """Return the mechanism's name for the part that this replica plays."""
        return "" if self.mechanism is None else self.mechanism.role_name(leads=self._standing.leads)

    @property
    def epoch(self) -> int:
        """The highest epoch that was seen here."""
        return self._standing.epoch

    @property
    def has_peer(self) -> bool:
        """Say whether another replica has all that this one has acknowledged."""
        return self._standing.other.state == "live"

    # -- the other replica ------------------------------------------------------------------------------------------

    async def from_peer(self, message: Message[Any]) -> Any:
        """Take what the same brick of the other replica says; its epoch and configuration are ours."""
        raise TypeError(f"{type(self).__name__} takes nothing from its peer, and got {type(message).__name__}")

    @on(AwaitHandled)
    def _settle(self, message: AwaitHandled) -> None:
        """All that came before is done."""

    async def drain(self) -> None:
        """Wait until the other replica has what it was sent, if that is not waited for anyway; nothing new comes."""

    async def answered(self) -> None:
        """Wait until whoever has asked has the answer."""

    def _refuses(self, epoch: int | None = None) -> bool:
        """Whether this comes from an earlier epoch, or nothing from here counts any more.

        What the bricks of a replica say to each other is refused for the latter only: a follower that leads from now
        on has still to compute what the last leader gave it.
        """
        standing = self._standing
        if standing.is_fenced or (epoch is not None and epoch < standing.epoch):
            standing.refused += 1
            return True
        return False

    def _raised(self, method: str, no: Refusal) -> HoldfastError:
        """What ends the replica when a method of a brick has raised a refusal, as any other exception does."""
        raised = type_name(type(no))
        return HoldfastError(f"{self.ctx.path}: {method} raised {raised}: {no}; self.refuse in `before` ends a request")


class Before(Brick):
    """The brick that does something with a batch before it is computed; without `before` it passes through."""

    async def before(self, work: Work) -> Work | None:
        """Prepare a batch. None: none of its requests goes further from here.

        A request that is neither passed on nor ended by `answer` or `refuse` fails, and that is told
        (`RequestsDropped`).
        """
        return work

    def message_of(self, request: Request) -> Any:
        """Return the message that a request brings to the protected actor; None if it is a timer or the like."""
        feed, cell = request.feed, self._standing.server.cell
        if feed.kind != MESSAGE or cell is None:
            return None
        return cell.node.codec.message_in(cell, feed.name, feed.body)

    def answer(self, work: Work, request: Request, reply: object) -> Work:
        """End one request here with this reply; it is computed nowhere. Returns the batch without it.

        If the reply is not of the type that the message declares, its asker gets `NoReply`, and a new mechanism is
        taken back.
        """
        codec, message = self._standing.node.codec, self.message_of(request)
        kind: type[Message[Any]] = type(message)
        try:
            declared = None if message is None else reply_type(kind)
            body = codec.encode(reply, self._standing.address, declared)
            if message is not None:
                codec.decode(declared, body)
        except (BadMessage, msgspec.MsgspecError, TypeError) as error:  # Its type may not be known in its module.
            problem = error.problem if isinstance(error, BadMessage) else str(error)
            return self.refuse(
                work,
                request,
                NoReply(f"{type(self).__name__} of {self.ctx.path}", request.feed.name.replace(":", "."), problem),
            )
        return self._end(work, request, Answer(REPLY, "", body))

    def refuse(self, work: Work, request: Request, error: HoldfastError) -> Work:
        """End one request here: whoever has asked gets the error. Returns the batch without it."""
        return self._end(work, request, Answer(*self._standing.node.codec.encode_error(error)))

    def _end(self, work: Work, request: Request, answer: Answer) -> Work:
        standing = self._standing
        if self.leads:  # Elsewhere, nobody hears of outcomes.
            end = TurnEnd(-1, request.feed.id, DROPPED, [], answer if request.feed.is_ask else Answer())
            done = Done(standing.epoch, standing.config, -1, [end], False)
            standing.bricks["protocol"].ref.tell(done)
        return msgspec.structs.replace(work, requests=[one for one in work.requests if one is not request])

    @on(Work)
    async def _work(self, work: Work) -> None:
        if self._refuses():
            return
        try:
            out = await self.before(work)
        except StaleLeader:
            return  # Another one leads: this batch never was.
        except Refusal as no:  # Nobody would hear of it.
            raise self._raised("before", no) from no
        self.next.tell(msgspec.structs.replace(work, requests=[]) if out is None else out)


class After(Brick):
    """The brick that does something with outcomes before they leave; without `after` they pass through."""

    async def after(self, done: Done) -> Done | None:
        """Make outcomes ready to leave. None: they do not, and their requests have been let fall.

        Proceed goes on when this has returned, or has said `taken()`: the state is not looked at after that.
        """
        return done

    def taken(self) -> None:
        """Go on, for the state behind these outcomes has been captured, or is not needed: the next turns may run."""
        if self._handle is not None:
            self._handle.reply(Taken())

    @on(Done)
    async def _done(self, done: Done) -> Any:
        self._handle = handle = self.ctx.reply_handle()
        if not self._refuses():
            try:
                out = await self.after(done)
                if out is None and self._standing.leads:  # Whoever let the batch in hears that it is over.
                    out = msgspec.structs.replace(done, ends=[], more=[])
            except StaleLeader:
                out = None  # Another one leads: these outcomes never were.
            except Refusal as no:  # Proceed would hand over the same again, for ever.
                raise self._raised("after", no) from no
            if out is not None:
                await self.next.ask(out, timeout=FOREVER)
        handle.reply(Taken())
        return handle


class Proceed(Brick):
    """Has the protected actor compute: one turn for each request of a batch, one batch after the other (A49)."""

    server: Binding[Actor]
    out: Binding[Actor]

    def __init__(self, standing: Standing, mechanism: Mechanism | None, slot: str) -> None:
        super().__init__(standing, mechanism, slot)
        self._works: deque[Work] = deque()
        self._task: asyncio.Task[None] | None = None
        self._number = -1
        self._last, self._last_epoch = -1, -1  # batch that came last
        self._at_home: asyncio.Future[None] | None = None
        self._flushes: list[ReplyHandle[None]] = []
        self._work_now: Work | None = None

    @property
    def is_at_work(self) -> bool:
        """Say whether a batch is being computed, or handed over."""
        return self._task is not None

    def take_over(self) -> None:
        """The server reports here from now on. (Not from the start: a brick that is only prepared must not hear it.)"""
        self._standing.server.report_to(self)

    async def heard(self, outcome: Outcome) -> None:
        """Hear that an ask of the protected actor has an outcome; called before the actor gets it."""

    # -- batches ----------------------------------------------------------------------------------------------------

    @on(Work)
    def _take(self, work: Work) -> None:
        if self._refuses() or self._knows(work):
            return
        if len({one.feed.id for one in work.requests}) < len(work.requests):  # It would be handled twice.
            raise HoldfastError(f"{self.ctx.path}: a brick before it has handed on a request twice; mend the brick")
        self._standing.server.note_batch(work)
        self._works.append(work)
        self.go_on()

    def _knows(self, work: Work) -> bool:
        """Whether this came before (a duplicate on its way here), or was meant for a state that is not here any more.

        To run it again is to do it twice.
        """
        if work.number <= FORWARDED:
            return work.number != self._standing.following.number
        if work.number < 0:  # A marker.
            return False
        is_known = work.number <= self._last and work.epoch == self._last_epoch
        if is_known:
            self._standing.refused += 1
        else:
            self._last, self._last_epoch = work.number, work.epoch
        return is_known

    @on(Abandon)
    def _abandon(self, message: Abandon) -> Any:
        self._works.clear()
        if self._work_now is not None:
            self._standing.server.abandon()
        return self._flushed()

    @on(Flush)
    def _flush(self, message: Flush) -> Any:
        return self._flushed()

    def _flushed(self) -> ReplyHandle[None]:
        handle: ReplyHandle[None] = self.ctx.reply_handle()
        self._flushes.append(handle)
        self.go_on()
        return handle

    def go_on(self) -> None:
        """See to it that what waits is handled. Called from our turns, and from the protected actor's."""
        if self._task is not None or self.ctx._closed:
            return
        cell = self.ctx._cell
        context = cell.context or lifecycle.open_context(cell)
        if current.get(None) is self.ctx:
            self._task = self.ctx.create_task(self._run())
        else:  # What the task sends must not count as sent by somebody else's turn.
            self._task = context.run(self.ctx.create_task, self._run())

    async def _run(self) -> None:
        server = self._standing.server
        try:
            while True:
                if server.state.wants_life:
                    await server.live_on()
                elif self._works:
                    self._work_now = self._works.popleft()
                    await self._batch(self._work_now)
                elif not await self._hand_more():
                    break
        finally:
            self._task = self._work_now = None
            flushes, self._flushes = self._flushes, []
            for handle in flushes:
                handle.reply(None)

    async def _batch(self, work: Work) -> None:
        server = self._standing.server
        state = server.state
        self._number = work.number
        if work.number >= 0 and self.leads:
            state.confirmed = state.handed  # It is sent when home has all that came before.
        pending, go = deque(work.requests), work.go
        brings = bool(pending) or go is not None  # Else home may not have what was handled before.
        if pending and not state.is_over:
            await server.ensure()
            await self._hand_more()  # A snapshot of what its hooks have left, before anything that stands on it.
            pending = server.returned_first(pending)
        while True:
            ends = await server.run_part(pending)
            live = None
            # What was handled before is decided as it was: `on_recovered` and what follows from it are no part of that.
            is_replay = go is not None and not pending and bool(ends) and not state.is_over
            if go is not None and not is_replay and (not pending or state.is_over):
                is_live = server.life is not None and server.life.is_live
                live = Live(0.0) if is_live else await server.go(go)
            ends = await server.seal_part(ends, pending)
            if pending and not state.is_over:  # Some of it has to be run again.
                live = None
            if live is not None:
                go = None
            follow = server.returned_first(pending) if brings and not server.part.is_given_up else pending
            is_last = state.is_over or not (follow or is_replay)
            waits = not is_last and self.leads and bool(follow) and server.runs_alone(follow[0])
            await self._hand(ends, is_last=is_last, live=live, wait=waits)
            left, server.left_over = server.left_over, []
            if brings and not server.part.is_given_up:  # What was taken instead may have put back something.
                pending.extendleft(reversed(left))
                pending = server.returned_first(pending)
            if is_last and (not pending or state.is_over):
                return

    async def hand_over_before(self, ends: list[TurnEnd], wait: bool) -> None:
        """Hand over the ends before the turn in hand, which has to wait until home has them."""
        await self._hand(ends, is_last=False, live=None, wait=wait)

    async def _hand(self, ends: list[TurnEnd], *, is_last: bool, live: Live | None, wait: bool) -> None:
        server, standing = self._standing.server, self._standing
        server.state.handed = part = server.state.handed + 1
        behind = server.last_ended
        ends, more = await self._hand_pieces(ends, server.take_more(), behind)
        done = Done(standing.epoch, standing.config, self._number, ends, is_last, live, more, part, wait, behind)
        if wait:
            self._at_home = standing.node.loop.create_future()
        await self._pass(done)
        if self._at_home is not None:
            await self._at_home
            self._at_home = None
        await self._hand_more()

    async def _hand_more(self) -> bool:
        """Hand over what stands behind what was handled. Now a snapshot can be taken: the state is decided on."""
        server, standing = self._standing.server, self._standing
        if not server.reports.more and not server.reports.is_snapshot_wanted:
            return False
        server.take_wanted_snapshot()
        more, behind = server.take_more(), server.last_ended
        if not more:
            return False  # A snapshot that has to wait.
        _, more = await self._hand_pieces([], more, behind)
        await self._pass(Done(standing.epoch, standing.config, self._number, [], False, None, more, behind=behind))
        return True

    async def _hand_pieces(
        self, ends: list[TurnEnd], more: list[Beside], behind: int
    ) -> tuple[list[TurnEnd], list[Beside]]:
        """Hand over all pieces of a large snapshot but the last, each by itself; returns what is left to hand over."""
        standing = self._standing
        while len(more) > 1 and any(isinstance(one, Snapshot) and len(one.data) > 1_000_000 for one in more):
            first, more = more[:1], more[1:]
            await self._pass(
                Done(standing.epoch, standing.config, self._number, ends, False, None, first, behind=behind)
            )
            ends = []
        return ends, more

    async def _pass(self, done: Done) -> None:
        pause = 0.0
        while True:
            try:
                await self.next.ask(done, timeout=FOREVER)
            except HoldfastError:  # It was exchanged in between, and the one that is bound now gets it; or has died.
                await asyncio.sleep(pause)
                pause = AGAIN
            else:
                return

    # -- past the bricks --------------------------------------------------------------------------------------------

    @on(PartEnded)
    def _ended(self, message: PartEnded) -> None:
        state = self._standing.server.state
        if self._refuses(message.epoch):
            return
        state.confirmed = max(state.confirmed, min(message.number, state.handed))
        if self._at_home is not None and state.confirmed >= state.handed and not self._at_home.done():
            self._at_home.set_result(None)

    @on(Inward)
    async def _inward(self, message: Inward) -> None:
        if self._refuses(message.epoch):
            return
        for record in message.records:
            if isinstance(record, Outcome):
                try:
                    await self.heard(record)
                except Refusal as no:  # The turn would wait for ever.
                    raise self._raised("heard", no) from no
            self._standing.server.inward(record)

    def tell_outward(self, record: MidTurn) -> None:
        """Tell a message that the protected actor has let out, if this replica leads and is not fenced."""
        standing = self._standing
        if standing.leads and not standing.is_fenced:
            # Called in the protected actor's turn: a plain `tell` would be taken for one of its own.
            self.ctx._tell(self.out._cell, Outward(standing.epoch, [record]))
