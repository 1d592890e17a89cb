"""RequestProtocol: the entry of a replica. One batch at a time inside, duplicates from the reply log, epochs checked.

Everything the root says to a replica comes here. Between two batches, with nothing inside, another replica is brought
to our state, or the state is given out (`transfer`).
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Awaitable, Coroutine
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import ActorStopped, AskTimeout, HoldfastError
from ...actors.exit_reasons import unpack_exit
from ...actors.kernel.actor import on
from ...actors.kernel.bindings import Binding
from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.message import Message, message_name
from ...checkpoint.protocol import DROPPED, Answer, TurnEnd
from ..alarms import RequestsDropped
from .behind import is_still_due
from .brick_messages import (
    MOST_REQUESTS,
    CannotLead,
    ConfigMismatch,
    Done,
    Follow,
    Inward,
    Lead,
    NoReply,
    PartEnded,
    ReplyEvicted,
    Request,
    RequestDropped,
    ServerState,
    Taken,
    Work,
    WorkLost,
    marker_of,
)
from .bricks import FOREVER, AwaitHandled, Brick, Flush, Proceed
from .peer_channel import Where
from .replica_orders import (
    Abort,
    Commit,
    Computes,
    Doing,
    EndTurn,
    Export,
    Finish,
    Install,
    Join,
    PrepareStack,
    Quiesce,
    Rehearse,
    SetPeer,
    Stand,
    Withdraw,
)
from .sealed_frames import Opened, Refused
from .state_images import image_from
from .state_transfer import Assume, Play, Transfer

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor
    from ...actors.kernel.cell import Cell
    from ..model.mechanism import Mechanism
    from .standing import Standing


NO_REPLY = message_name(NoReply)
CANARY = -1
"""The number of a batch without requests that only shows whether all bricks let it pass."""


class InnerProtocol(Brick):
    """Where an inner layer begins and ends: its entry for the outer Before, and its exit to the outer After (A64)."""

    before: Binding[Actor]

    @on(Work)
    def _work(self, work: Work) -> None:
        if not self._refuses():
            self.before.tell(work)

    @on(Done)
    async def _done(self, done: Done) -> Taken:
        return await self.next.ask(done, timeout=FOREVER)


class RequestProtocol(Transfer):
    """The entry and exit of a replica; `next` is the Proxy."""

    before: Binding[Actor]

    def __init__(self, standing: Standing, mechanism: Mechanism | None, slot: str) -> None:
        super().__init__(standing, mechanism, slot)
        self._held: deque[Work] = deque()
        self._current: int | None = None  # the batch that is inside
        self._holds = 0  # who wants nothing to go in
        self._is_leaving = False  # a turn that rests: the next life does not stand before it yet
        self._idle: list[asyncio.Future[None]] = []
        self._pieces: list[bytes] = []
        self._lock = asyncio.Lock()
        self._marker: int | None = None  # what the last leader gave us to compute is over when this comes back
        self._least = -1  # the turn after which we go on, if those up to it have left nothing here
        self._known = -1  # the last turn that home knew of when we were to lead
        self._wanted: int | None = None  # part of Proceed that waits, meanwhile, for home to have all before it
        self._told = math.inf  # the last turn that home knows of, until it has been told all that we know
        self._later: list[Any] = []  # what goes home behind that, and of a follower what it would have to say
        self._behind_turn = -1  # the last turn before that
        self._turn = -1  # the last one before the batch that is inside
        self._came_out = 0  # turns of it that have come out of the bricks
        self._copies = False  # home gets the state behind it
        self._behind: tuple[list[TurnEnd], list[Any]] = [], []  # what goes home with that

    # -- requests ---------------------------------------------------------------------------------------------------

    @on(Work)
    def _work(self, work: Work) -> None:
        standing = self._standing
        if not self._admits():
            return
        if work.epoch != standing.epoch or work.config != standing.config or not standing.leads or standing.is_fenced:
            standing.refused += 1
            return
        self._held.append(work)
        self._go_on()
        if self._wanted is not None:
            self._flush_known(self._wanted)

    def _go_on(self) -> None:
        while self._held and self._current is None and not (self._holds or self._is_leaving):
            self._begin(self._held.popleft())
        if self._current is None:
            idle, self._idle = self._idle, []
            for one in idle:
                if not one.done():
                    one.set_result(None)

    def _begin(self, work: Work) -> None:
        self._standing.server.note_batch(work)
        known, left = self._split(work)
        # What a leader before us has put back, and is in no batch, comes now: home knows of all that came before.
        left = list(self._standing.server.returned_first(deque(left)))
        goes_in = bool(left) or work.go is not None
        if known or self._later or not goes_in:
            more, self._later = self._later, []
            if work.copy and not goes_in:
                more += self._standing.server.copied()
            done = Done(work.epoch, work.config, work.number, known, not goes_in, None, more)
            self.next.tell(msgspec.structs.replace(done, behind=self._behind_turn))
        if goes_in:
            self._standing.inside.update((one.feed.id, one) for one in left)
            self._current, self._copies = work.number, work.copy
            self._turn, self._came_out, self._behind = self._standing.server.turn, 0, ([], [])
            self.before.tell(Work(work.epoch, work.config, work.number, left, work.go))

    def _split(self, work: Work) -> tuple[list[TurnEnd], list[Request]]:
        """The outcomes that are known, in turn order, and the requests that were never handled."""
        standing, left, known = self._standing, list[Request](), list[TurnEnd]()
        log = standing.log
        for request in work.requests:
            number = request.feed.id
            end = log.find(number, request.feed.turn)
            if end is not None:
                log.duplicates += 1
                known.append(end)
            elif request.feed.turn < 0 and log.was_evicted(number):
                error = ReplyEvicted(path=standing.address, number=number)
                answer = Answer(*standing.node.codec.encode_error(error))
                known.append(TurnEnd(-1, number, DROPPED, [], answer))
            else:
                left.append(request)
        if self._told < math.inf:  # It asks in the order of requests. Turns may have had another: some were put aside.
            asked = {end.id for end in known}
            known += [end for *_, end in log.entries() if end.turn > self._told and end.id not in asked]
            self._told = math.inf if self._marker is None else max([self._told, *(end.turn for end in known)])
        known.sort(key=lambda end: end.turn)
        return known, left

    @on(Done)
    def _done(self, done: Done) -> Taken:
        standing = self._standing
        if self._refuses():
            return Taken()
        # What ended with no reply was not handled: the stack before, if it comes back, is asked for it.
        standing.log.add(standing.entries([end for end in done.ends if end.answer.name != NO_REPLY]))
        for end in done.ends:
            standing.inside.pop(end.id, None)
        if self._marker is not None:
            self._drained(done)
        elif standing.leads:
            if done.epoch != standing.epoch:
                done = msgspec.structs.replace(done, epoch=standing.epoch)
            self._came_out += len({end.turn for end in done.ends if end.turn > self._turn})
            self._leave(msgspec.structs.replace(done, is_last=done.is_last and not self._is_leaving))
        else:
            self._keep(done)
        if done.is_last and done.number == self._current:
            self._current = None
            if standing.leads and done.number >= 0 and not standing.server.state.is_over:
                dropped = [number for number, one in standing.inside.items() if not standing.server.has_taken(one)]
                if dropped:
                    self._end_dropped(done, dropped)
            standing.inside.clear()
            self._go_on()
        return Taken()

    def _leave(self, done: Done) -> None:
        """Outcomes go home; with the state behind them if home wants it, which is only there when no turn is run."""
        if self._copies and done.number == self._current:
            ends, more = self._behind
            ends += done.ends
            more += done.more
            if not (done.is_last or done.wait):
                return
            self._behind = [], []
            done = msgspec.structs.replace(done, ends=ends, more=[*more, *self._standing.server.copied()])
        self.next.tell(done)

    def _end_dropped(self, done: Done, numbers: list[int]) -> None:
        """The batch is over, and these requests have no end: a brick has let them fall."""
        standing = self._standing
        may_have_run = standing.server.turn - self._turn > self._came_out
        standing.node.emit(RequestsDropped(standing.address, standing.path, ", ".join(map(str, numbers))))
        ends = list[TurnEnd]()
        for number in numbers:
            error = RequestDropped(path=standing.path, number=number, may_have_run=may_have_run)
            ends.append(TurnEnd(-1, number, DROPPED, [], Answer(*standing.node.codec.encode_error(error))))
        self.next.tell(Done(standing.epoch, done.config, -1, ends, False))

    def _drained(self, done: Done) -> None:
        """An outcome of what the last leader gave us: home gets it, in its order, when it asks for it again."""
        self._later += done.more
        self._behind_turn = max(self._behind_turn, done.behind)
        if done.number == self._marker:
            self._marker = self._wanted = None
            server = self._standing.server
            if server.turn < self._least:
                server.skip_to(self._least)
            server.tell_of_hooks(self._known)
        elif done.wait:
            self._flush_known(done.part)

    def _keep(self, done: Done) -> None:
        """While another one leads: if that dies, nobody else can say it of turns that home does not have then."""
        more, turn = [*self._later, *done.more], self._standing.server.turn
        self._later = [one for one in more if is_still_due(one, turn - MOST_REQUESTS)]
        self._behind_turn = max(self._behind_turn, done.behind)

    def _flush_known(self, part: int) -> None:
        """A turn waits until home has all that came before it: that is what home asks for again and we know."""
        self._wanted = part
        while self._held:
            work = self._held.popleft()
            known, left = self._split(work)
            waits = bool(left)
            if known or not waits:
                done = Done(work.epoch, work.config, work.number, known, not waits, None, [], part, waits)
                self.next.tell(done)
            if waits:
                self._held.appendleft(msgspec.structs.replace(work, requests=left))
                self._wanted = None
                if not known:
                    self.proceed.tell(PartEnded(self._standing.epoch, part))
                return

    @on(Inward)
    def _inward(self, message: Inward) -> None:
        if self._admits():
            self.proceed.tell(message)

    @on(PartEnded)
    def _ended(self, message: PartEnded) -> None:
        if self._admits():
            self.proceed.tell(message)

    # -- orders -----------------------------------------------------------------------------------------------------

    def _answer(self, work: Coroutine[Any, Any, Any]) -> ReplyHandle[Any]:
        """Answer when the work is done; the bricks may need us meanwhile. One such work at a time."""
        handle = self.ctx.reply_handle()
        task = self.ctx.create_task(self._answered(handle, work))
        task.add_done_callback(lambda done: work.close())  # We may end before it has begun.
        return handle

    async def _answered(self, handle: ReplyHandle[Any], work: Awaitable[Any]) -> None:
        async with self._lock:
            try:
                handle.reply(await work)
            except HoldfastError as error:
                handle.fail(error)
            except BaseException:
                handle.fail(ActorStopped(self._standing.path))  # We end: nobody must wait for us.
                raise

    async def _quiet(self) -> None:
        """Wait until nothing is inside, or another epoch has begun. Whoever calls has raised `_holds`."""
        while self._current is not None or self._is_leaving:
            idle: asyncio.Future[None] = self._standing.node.loop.create_future()
            self._idle.append(idle)
            await idle

    def _check(self, epoch: int, config: int | None = None) -> None:
        standing = self._standing
        if not self._admits():
            raise Refused(path=standing.path, reason="plain")
        standing.check(epoch, config)
        standing.epoch = epoch

    @on(Install)
    def _install(self, message: Install) -> Any:
        self._check(message.epoch)
        return self._answer(self._installed(message))

    async def _installed(self, message: Install) -> None:
        self._pieces.append(message.data)
        if message.is_last:
            data, self._pieces = b"".join(self._pieces), []
            server = self._standing.server
            await server.drop_life()
            stash, traps, variables = message.stash, message.traps, list(message.variables)
            image = image_from(data)
            state = ServerState(message.turn, image, [], [], [], False, stash, traps, [], variables, message.timers)
            server.install(state)
            self._standing.log.replace(message.log)

    @on(Lead)
    def _lead(self, message: Lead) -> Any:
        self._check(message.epoch, message.config)
        if self._standing.leads and self._standing.leading != message.epoch:
            # The bricks have kept what was inside, and are others now: it is asked for again. Whoever waits for its
            # end was told so in another epoch.
            self._current = self._marker = None
            self._go_on()
        return self._answer(self._begin_to_lead(message))

    async def _begin_to_lead(self, order: Lead) -> int:
        standing, server, epoch = self._standing, self._standing.server, order.epoch
        if standing.leads and standing.leading == epoch:
            return server.turn
        # It has diverged, or was never brought to the leader's state.
        if standing.following.is_told and not standing.following.is_ready:
            raise CannotLead(path=standing.path)
        standing.other.replace(order.peer, "live")
        standing.is_fenced = standing.following.is_told = False
        standing.following.ready()
        # What the last leader gave us to compute ends first: only then is it known what is a duplicate.
        self._current = self._marker = marker = marker_of(epoch)
        self._least, self._told, self._known = order.turn, order.known, order.known
        if not standing.leads:
            self._later = [one for one in self._later if is_still_due(one, order.known)]
            if server.life is None and server.turn >= 0:  # What has led to our state has begun its work elsewhere.
                self._later, self._behind_turn = [WorkLost(server.turn)], server.turn
        await self._order(Assume(True))
        standing.leading = epoch
        self.before.tell(Work(epoch, standing.config, marker, []))
        server.lead()
        return server.turn

    @on(Follow)
    def _follow(self, message: Follow) -> Any:
        self._check(message.epoch, message.config)
        return self._answer(self._begin_to_follow())

    async def _begin_to_follow(self) -> int:
        standing = self._standing
        standing.other.replace(None, "none")
        standing.is_fenced, standing.leading, standing.following.is_told = False, -1, True
        self._held.clear()
        self._current = self._marker = self._wanted = None
        self._later, self._behind_turn = [], -1
        standing.inside.clear()
        standing.following.unready()
        await self._order(Assume(False))
        return standing.server.turn

    def _order(self, message: Message[Any]) -> asyncio.Future[Any]:
        """Have the replica do it, which obeys us alone."""
        parent = self.ctx._cell.parent
        assert parent is not None
        return parent.ref.ask(Opened(self._standing.opened.put(message)), timeout=FOREVER)

    @on(PrepareStack)
    def _prepare(self, message: PrepareStack) -> Any:
        return self._passed_on(message)

    @on(Commit)
    def _commit(self, message: Commit) -> Any:
        # What was done already changes nothing, whichever way the order has come this time.
        return self._passed_on(message, changes=message.config != self._standing.config)

    @on(Abort)
    def _abort(self, message: Abort) -> Any:
        return self._passed_on(message)

    def _passed_on(self, message: Message[Any], *, changes: bool = True) -> ReplyHandle[Any]:
        """To the replica; not in line with other orders, nor with what else comes: the bricks may need us meanwhile."""
        if changes and not self._admits():
            raise Refused(path=self._standing.path, reason="plain")
        handle = self.ctx.reply_handle()
        self.ctx.create_task(self._passed(handle, self._order(message)))
        return handle

    @on(Where)
    def _where(self, message: Where) -> str:
        self._standing.check(self._standing.epoch, message.config)
        brick = self._standing.bricks.get(message.slot)
        if brick is None:
            raise ConfigMismatch(self._standing.path, self._standing.config, message.config)
        return brick.path

    @on(EndTurn)
    def _end_turn(self, message: EndTurn) -> None:
        self._check(message.epoch)
        self._standing.server.end_turn(message.number, again=message.again)

    # -- the state --------------------------------------------------------------------------------------------------

    @on(Quiesce)
    def _quiesce(self, message: Quiesce) -> Any:
        self._check(message.epoch, message.config)
        handle = self.ctx.reply_handle()
        self.ctx.create_task(
            self._come_to_rest(handle, message)
        )  # Not in line with other orders: one of them may unblock it.
        return handle

    async def _come_to_rest(self, handle: ReplyHandle[Any], message: Quiesce) -> None:
        standing = self._standing
        self._holds += 1
        try:
            await self._quiet()
            if message.settles:
                for brick in self._befores():
                    await brick.ref.ask(AwaitHandled(), timeout=FOREVER)
                await self.proceed.ask(AwaitHandled(), timeout=FOREVER)
            await self.proceed.ask(Flush(), timeout=FOREVER)
            await self._drain_bricks()
            handle.reply(Stand(standing.epoch, standing.config, standing.server.turn, standing.leads))
        except HoldfastError as error:
            handle.fail(error)
        finally:
            self._holds -= 1
            self._go_on()

    @on(Withdraw)
    def _withdraw(self, message: Withdraw) -> Any:
        self._check(message.epoch, message.config)
        handle = self.ctx.reply_handle()
        self.ctx.create_task(
            self._give_back(handle, message)
        )  # Not in line with other orders: one of them may wait for this.
        return handle

    async def _give_back(self, handle: ReplyHandle[bool], message: Withdraw) -> None:
        self._is_leaving = True
        try:
            has_left = await self._has_given_back(message.number, message.stranded)
            if has_left:  # Home sends all of it again; what has not begun here would be run without its knowing.
                self._held.clear()
            handle.reply(has_left)
        except HoldfastError as error:
            handle.fail(error)
        finally:
            self._is_leaving = False
            self._go_on()

    async def _has_given_back(self, number: int, stranded: list[int]) -> bool:
        standing, server = self._standing, self._standing.server
        life = server.life
        if life is None or life.feed is None:
            return self._current is None or not standing.leads
        if not standing.leads and life.feed.id != number:
            return True  # It has yet to end what is at home already: nobody would send it that again.
        if standing.leads and not (server.state.has_access and life.only_rests(stranded)):
            return False
        await server.withdraw()
        if not standing.leads:
            standing.inside.clear()  # What comes again is no duplicate: nothing here will end it.
        await self.proceed.ask(Flush(), timeout=FOREVER)
        await server.ensure_as_given()
        return True

    def _befores(self) -> list[Cell]:
        """What a batch passes on its way to Proceed, outermost first."""
        return [one for slot, one in self._standing.bricks.items() if slot.endswith(".before")]

    @on(Computes)
    def _computes(self, message: Computes) -> Any:
        if self._standing.leads:
            return self._doing(message)
        handle = self.ctx.reply_handle()
        self.ctx.create_task(self._follows(handle, message))
        return handle

    async def _follows(self, handle: ReplyHandle[Any], message: Computes) -> None:
        """Bricks of one that does not lead wait for nobody: what has come to them is handled soon."""
        bricks = [one for slot, one in self._standing.bricks.items() if slot.endswith((".before", ".after"))]
        asked = [one.ref.ask(AwaitHandled(), timeout=message.seconds) for one in bricks]
        found = await asyncio.gather(*asked, return_exceptions=True)
        passes = not any(isinstance(one, AskTimeout) for one in found)
        handle.reply(msgspec.structs.replace(self._doing(message), passes=passes))

    def _doing(self, message: Computes) -> Doing:
        standing = self._standing
        servers = (standing.server, *standing.server.shadows)
        computes = any(one.life is not None and one.life.feed is not None for one in servers)
        proceed = self.proceed._cell.actor
        hands_over = isinstance(proceed, Proceed) and proceed.is_at_work  # It hands it to whoever comes after.
        return Doing(computes, hands_over or standing.server.turn <= message.turn)

    @on(Rehearse)
    def _rehearse(self, message: Rehearse) -> Any:
        if self._standing.epoch >= 0:  # It has a part: whoever says this, plain, must not take it from there.
            raise Refused(path=self._standing.path, reason="plain")
        return self._answer(self._rehearsed(message))

    async def _rehearsed(self, message: Rehearse) -> None:
        """Whatever a brick does wrong when it starts, or when a batch comes, it does here, where it hurts nobody."""
        standing = self._standing
        await self._order(Play(message.leads, message.is_new))
        self._current = self._marker = CANARY
        self.before.tell(Work(standing.epoch, standing.config, CANARY, []))
        await self._quiet()

    @on(Finish)
    def _finish(self, message: Finish) -> Any:
        self._check(message.epoch)
        return self._answer(self._end(message.reason))

    async def _end(self, reason: dict[str, Any]) -> None:
        self._holds += 1
        server = self._standing.server
        if server.life is not None and server.cell is not None:
            gone = server.cell.ended()
            server.finish(unpack_exit(reason))
            await gone
        await self.proceed.ask(Flush(), timeout=FOREVER)


RequestProtocol.handlers = {
    Work: "_work",
    Inward: "_inward",
    PartEnded: "_ended",
    Install: "_install",
    Lead: "_lead",
    Follow: "_follow",
    SetPeer: "_peer",
    EndTurn: "_end_turn",
    PrepareStack: "_prepare",
    Commit: "_commit",
    Abort: "_abort",
    Join: "_join",
    Export: "_export",
    Quiesce: "_quiesce",
    Withdraw: "_withdraw",
    Computes: "_computes",
    Rehearse: "_rehearse",
    Finish: "_finish",
}
OPENED = {message_name(kind): kind for kind in RequestProtocol.handlers}
