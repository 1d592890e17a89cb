"""The protected actor inside a replica: its host, and how bricks drive it.

An unmodified class lives a recorded life (`checkpoint.life.Life`) whose inputs come from Proceed.
"""

from __future__ import annotations

import inspect
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final

import msgspec

from ...actors.errors import StartFailed
from ...actors.exit_reasons import ExitReason, pack_exit
from ...actors.kernel import mailbox
from ...actors.kernel.cell import RUNNING, Cell
from ...actors.kernel.message import message_name
from ...checkpoint.life.recorded_inbox import Fed, GoLive, StopRecorded
from ...checkpoint.protocol import (
    AWAITED,
    FAILED,
    START,
    Answer,
    Closed,
    Feed,
    Go,
    Hooked,
    Ignored,
    Live,
    Outcome,
    PipeDone,
    Released,
    Snapshot,
    SnapshotNow,
    ToHome,
    TurnEnd,
    Unsaved,
)
from ..bricks.brick_messages import Request, State
from ..model.mechanism import has_state_access
from .replica_life import BLOCKED, ENDED, OVER, UNDONE, ServerLife
from .replica_reports import Reports

PART: Final = 0.001
"""Seconds of work after which the outcomes so far are handed over: a slow request does not hold up quick ones."""
MOST_CRASHES: Final = 8
"""Ends of the life outside any turn, one after another, after which the replica is given up."""


class Server(Reports):
    """The place of the protected actor, and its port home."""

    # -- as the host of its cell ------------------------------------------------------------------------------------

    def start(self, cell: Cell) -> None:
        """The address is there; a life begins when the replica's role wants one."""
        self.cell = cell
        start = cell.extra().start
        assert start is not None
        kind: Any = start.kind
        cell.table = kind._table
        self.has_access = has_state_access(kind)
        self.has_deltas = self.has_access and hasattr(kind, "get_delta") and hasattr(kind, "apply_delta")
        if self._async is None:
            handlers = kind._declared
            table = kind._table
            found = (one for one in handlers if inspect.iscoroutinefunction(table[one]))
            self._async = frozenset(message_name(one) for one in found)

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        """It ends: by itself, or with the replica. Only one that leads says good-bye."""
        if cell.state is not RUNNING or self.life is None:
            return
        if self.standing.leads:
            cell.urge(StopRecorded(self.life, reason))
        else:
            self._is_stopping = True
            self.kill(cell)

    def finish(self, reason: ExitReason) -> None:
        """End in good order, because the root wants it."""
        if self.life is not None:
            self._is_stopping = True
            self.life.cell.urge(StopRecorded(self.life, reason))

    def retired(self, cell: Cell) -> None:
        self._is_stopping = True

    def _life_ended(self, life: ServerLife, reason: ExitReason) -> None:
        """The life is over, and nobody here has ended it."""
        if life is not self.life:
            return
        self.life = None
        self.note_work(life)
        if not self._is_stopping and self._failed is None and reason.is_clean and life.stage.ignored_why is None:
            self.is_over = True
            self.tell_more(Closed(0, pack_exit(reason), False))
        self.at_rest(ENDED)

    # -- turns ------------------------------------------------------------------------------------------------------

    def runs_alone(self, request: Request) -> bool:
        """Whether it has to stand at the front: it may want something released before its end."""
        if self._is_again or (self.is_lazy and not self.standing.leads):
            return False
        feed = request.feed
        if feed.kind == START or (feed.kind, feed.name) in self.alone:
            return True
        return not self.has_access and self._async is not None and feed.name in self._async

    def _next(self, pending: deque[Request]) -> list[Request]:
        """The next few that can be given to the server at once."""
        if self.runs_alone(pending[0]):
            is_early = self.standing.leads and self.confirmed < self.handed
            return [] if self.begun or self.ends or is_early else [pending.popleft()]
        chunk: list[Request] = []
        if self._singles:
            if self.begun:
                return []
            self._singles -= 1
            return [pending.popleft()]
        while pending and len(chunk) < self._chunk and not (chunk and self.runs_alone(pending[0])):
            chunk.append(pending.popleft())
        return chunk

    async def part(self, pending: deque[Request]) -> list[TurnEnd]:
        """Run requests until enough are done; returns their ends. What has not been run is left in `pending`."""
        begin = time.perf_counter()
        self.begun, self.ends, self._is_abandoned, self._has_released = [], [], False, False
        self._is_given_up = False
        self._pending = pending
        while pending and not self.is_over:
            await self.ensure()
            if self.life is None:  # It was dropped again: another state is put here.
                self._give_up(pending)
                break
            chunk = self._next(pending)
            if not chunk:
                break  # It runs alone, when home has all that comes before it.
            self.begun += chunk
            at = time.perf_counter()
            why = await self._go((one.feed, self._skips.get(one.feed.id)) for one in chunk)
            while why is BLOCKED:
                why = await self._blocked()
            if why is OVER:
                self._crashes = 0
                now = time.perf_counter()
                if now - at < PART / 4 and len(chunk) >= self._chunk:
                    self._chunk = min(256, self._chunk * 2)
                elif now - at > PART and self._chunk > 1:
                    self._chunk //= 2
                if (now - begin > PART and not self._is_again) or self._has_released:
                    break
            elif why is UNDONE:
                self._take_back(pending)
            elif not self._after_end(pending, chunk):
                break
        ends, self.ends = self.ends, []
        return ends

    async def part_again(self, pending: deque[Request], *, single: bool) -> list[TurnEnd]:
        """Nothing of the last part has happened: run it, and no more, again. `single`: one request at a time."""
        if single:
            self._singles = len(self.begun)
        behind = list(pending)
        pending.clear()
        self._take_back(pending)
        ends = await self.part(pending)
        if not self._is_given_up:
            pending.extend(behind)
        return ends

    def _take_back(self, pending: deque[Request]) -> None:
        """Nothing of this part has happened: the life, which has ended, begins again where it began.

        Somebody else may have begun it already: that one is as good, and it must not be begun twice.
        """
        pending.extendleft(reversed(self.begun))
        self.begun, self.ends, self._withheld = [], [], []
        last = -1 if self.point is None else self.point.turn
        self.released = {turn: digests for turn, digests in self.released.items() if turn <= last}
        self.more = [one for one in self.more if not isinstance(one, PipeDone) or one.turn <= last]

    def _give_up(self, pending: deque[Request]) -> None:
        """What was to be run does not count any more: another state is put in the place of what it leads to."""
        self._is_given_up = True
        pending.clear()
        self.begun, self.ends = [], []

    def _after_end(self, pending: deque[Request], chunk: list[Request]) -> bool:
        """The life has ended in the middle of a part. Whether to go on."""
        failed, self._failed = self._failed, None
        if self._is_abandoned:
            self._is_abandoned = False
            self._give_up(pending)
            return False
        if self._is_stopping or self.is_over:
            return False
        if failed is None:
            self._crashes += 1
            if self._crashes >= MOST_CRASHES:
                raise StartFailed(self.address, "its life ends again and again outside its turns")
        else:
            self._crashes = 0
            end = self.ends[-1]
            request = next((one for one in self.begun if one.feed.id == failed), None)
            if request is not None and request.feed.kind == START:
                return False
            self._skips[failed] = end
        if self.has_access and (self.point is not None or failed is None):
            self._take_back(pending)
            return True
        known = {end.id for end in self.ends}
        left = [one for one in chunk if one.feed.id not in known]
        self.begun = [one for one in self.begun if one.feed.id in known]
        pending.extendleft(reversed(left))
        self._start_turn = max(self._start_turn, self.ends[-1].turn if self.ends else -1)
        self.point = None
        return True

    def has_taken(self, request: Request) -> bool:
        """Whether the life has a request without an end: its stash has it, or it is the tick of a cancelled timer."""
        life, number = self.life, request.feed.id
        if life is None or request.feed.origin:
            return True
        return number in life.returned or any(fed.feed.id == number for fed in life.stash)

    def end_turn(self, number: int, *, again: bool) -> None:
        """The turn of this input hangs: if it is in hand, it has failed, as if its handler had raised.

        `again`: it has not, but begins again, from the state before (if that is known).
        """
        life, cell = self.life, self.cell
        if cell is None or life is None or life.feed is None or life.feed.id != number:
            return
        if not again or not self.has_access:
            life.fail_turn(TimeoutError(f"the turn of {life.feed.name} does not end"))
        self.kill(cell)

    # -- the front --------------------------------------------------------------------------------------------------

    @property
    def is_front(self) -> bool:
        """Whether home has the ends of all turns before the one in hand."""
        return self.standing.leads and not self.ends and self.confirmed >= self.handed

    def wants_out(self, life: ServerLife) -> None:
        """A turn wants its outputs to leave before it ends."""
        if life is not self.life:
            return
        if self._is_quiet or self._is_again or not self.standing.leads:
            asked = [out for out in life.outs if out.verb in AWAITED]
            known = [self.heard.get((life.turn, out.k)) for out in asked]
            if all(one is not None for one in known):
                self._note_released(life)
                life.outs = []
                for one in known:
                    assert one is not None
                    life.to_life(one)
                return
        if self.is_front:
            self._let_out(life)
            return
        if not self.standing.leads:  # The leader has sent it; we may have to, when we lead.
            self._note_released(life)
            self._withheld += life.outs
            life.outs = []
        life.cell.node.loop.call_soon(self._look, life, life.feed)

    def _note_released(self, life: ServerLife) -> None:
        self.released.setdefault(life.turn, []).extend(out.digest() for out in life.outs)

    def _let_out(self, life: ServerLife) -> None:
        """What has left cannot be undone: the part ends with this turn, whatever was to come after it."""
        self._note_released(life)
        self._has_released = True
        queue, feed = mailbox.queue_of(life.cell), life.feed
        left = set[int]()
        for index, item in enumerate(queue):
            if type(item) is Fed and item.life is life:
                left.add(item.feed.id)
                queue[index] = mailbox.NOTHING  # Not removed: the run loop has counted them.
        if left and feed is not None:
            self._pending.extendleft(reversed([one for one in self.begun if one.feed.id in left]))
            self.begun = [one for one in self.begun if one.feed.id not in left]
        life.release_now()

    def _look(self, life: ServerLife, feed: Feed | None) -> None:
        """A turn that is not at the front has wanted to release something: does it wait for that?"""
        if self.life is life and life.feed is feed:
            self.at_rest(BLOCKED)

    async def _blocked(self) -> str:
        """The turn in hand waits for what it has not been allowed to send."""
        life = self.life
        feed = None if life is None else life.feed
        if life is None or feed is None or self._missed is not None:
            return await self._on_to_rest()  # It has its outcome meanwhile.
        looks_at_state = self.standing.leads or not self.is_lazy  # Somebody does, when outcomes are handed over.
        if looks_at_state and self.ends and self.has_access and not self._is_again:
            self.alone.add((feed.kind, feed.name))
            await self.drop_life()
            return UNDONE
        resting = self._on_to_rest()
        if not self._is_again:
            leads = self.standing.leads
            await self._hand_over_before(feed)
            if self.standing.leads and not leads:  # Since then: home has to have what was handed over before.
                await self._hand_over_before(feed)
        if self.standing.leads and self.life is life and life.feed is feed:
            self._take_up_withheld(life)
            if life.outs:
                self._let_out(life)
        return await resting

    async def _hand_over_before(self, feed: Feed) -> None:
        """Hand over the ends before the turn in hand, while it stands still."""
        if self.hand_over is None:
            return
        ends, self.ends = self.ends, []
        known = {end.id for end in ends}
        handed = [one for one in self.begun if one.feed.id in known]
        self.begun = [one for one in self.begun if one.feed.id not in known]
        self._keep_tail(handed, ends)
        if ends or (self.standing.leads and self.confirmed < self.handed):
            await self.hand_over(ends, self.standing.leads)

    def lead(self) -> None:
        """A turn that waits for an outcome may ask for it itself, when home has what comes before it."""
        life = self.life
        if life is not None and life.feed is not None and self._withheld:
            self._look(life, life.feed)

    def _take_up_withheld(self, life: ServerLife) -> None:
        """What the last leader may have sent, and may not."""
        if self._withheld:
            self.released.pop(life.turn, None)
            life.outs = self._withheld + life.outs
            self._withheld = []

    # -- the last part once more -----------------------------------------------------------------------------------

    async def again(
        self, since: State | None = None, feeds: list[Request] | None = None
    ) -> tuple[list[TurnEnd], State]:
        """Rewind to the point before the last part, and run that part again; returns ends and state.

        Nothing is handed over. Asks get the outcomes that they had.

        Args:
            since: rewind to this state instead.
            feeds: run these requests instead.
        """
        previous = self.previous
        before, requests = previous if previous is not None else (since, feeds)
        before, requests = since or before, requests if feeds is None else feeds
        assert before is not None
        assert requests is not None
        self.objections.clear()
        if self.life is None:
            self.point, self.tail = before, []
            await self.ensure()
        else:
            self.rewind(before)
        self.released = {turn: digests for turn, digests in self.released.items() if turn <= before.turn}
        pending, ends = deque(requests), list[TurnEnd]()
        self._is_again = True
        try:
            while pending and not self.is_over:
                new = await self.part(pending)
                self._keep_tail(self.begun, new)
                ends += new
        finally:
            self._is_again = False
        await self.ensure()
        skips = dict(self._skips)
        self._skips.clear()
        try:
            state = self.capture()
        except BaseException as error:  # What the user's own values and methods raise: as in `sealed`.
            if len(requests) != 1 or len(ends) != 1 or skips:
                raise
            self.fail(requests[0], ends[0], error)
            await self.drop_life()
            return await self.again(before, requests)
        self.previous = previous
        return ends, state

    def fail(self, request: Request, end: TurnEnd, error: BaseException) -> None:
        """This turn has left what is no state: run again, it fails."""
        codec = self.standing.node.codec
        answer = Answer(*codec.encode_error(error)) if request.feed.is_ask else Answer()
        self._skips[end.id] = TurnEnd(end.turn, end.id, FAILED, [], answer)

    async def adopt(self, state: State) -> None:
        """Go on from this state, with a life of its own; what led to it has happened elsewhere."""
        live = state.live or (self.life is not None and self.life.is_live)
        self._is_work_lost = self.standing.leads  # What the turns that lead there have begun, they began elsewhere.
        await self.drop_life()
        confirmed = self.confirmed
        self.install(msgspec.structs.replace(state, live=live))
        self.confirmed = confirmed  # The part that has led there is not at home yet: nothing may overtake it.
        await self.ensure()

    async def back(self) -> State:
        """Rewind to the point before the last part, for good: it leaves no trace but its numbers."""
        assert self.previous is not None
        before, _ = self.previous
        if self.life is None:
            self.point, self.tail = before, []
            await self.ensure()
        else:
            self.rewind(before)
        return before

    # -- as the port home -------------------------------------------------------------------------------------------

    def to_home(self, record: ToHome) -> None:
        """What the life says, in order."""
        match record:
            case TurnEnd():
                self._withheld = []
                if self.hooks and not self._is_quiet and record.id not in self._skips:
                    for hook in self.hooks:
                        record = hook(self, record)
                if record.status == FAILED and not self._is_quiet and record.id not in self._skips:
                    self._failed = record.id
                if not self._is_quiet:
                    self.ends.append(record)
            case Released():
                self.outward(record)
            case Live():
                self._live = record
            case Snapshot() | PipeDone() | Unsaved() | Ignored() | Hooked():
                self.tell_more(record)
            case _:
                pass

    def when_told(self, then: Callable[[], None]) -> None:
        """It is on its way at once."""
        then()

    def closed(self) -> None:
        """The life is over; what follows from that comes when all of it has been wound down."""
        life, cell = self.life, self.cell
        if life is not None and cell is not None:
            cell.node.loop.call_soon(self._life_ended, life, cell.extra().reason)

    # -- records from home ------------------------------------------------------------------------------------------

    def inward(self, record: Outcome | SnapshotNow) -> None:
        """Take what came past the bricks."""
        life = self.life
        if isinstance(record, Outcome):
            self.heard[record.turn, record.k] = record
            if life is not None:
                life.to_life(record)
        else:
            self.want_snapshot()

    async def go(self, go: Go) -> Live | None:
        """Replay is over: new inputs come from here on."""
        await self.ensure()
        life = self.life
        if life is None:
            return None
        resting = self._rest()
        self._live = None
        self._put([GoLive(life, go)])
        if await resting is not OVER:
            if self.is_over:
                return None
            reason = self.cell.extra().reason if self.cell is not None else ""
            raise StartFailed(self.address, str(reason))
        return self._live
