"""The protected actor inside a replica: its host, its life, and how bricks drive it.

An unmodified class lives a recorded life (`checkpoint.life.Life`) whose inputs come from Proceed. Between two parts of
a batch its state is captured (a *point*); from there it can be begun again, or put back in place.
"""

from __future__ import annotations

import asyncio
import inspect
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterable
from typing import TYPE_CHECKING, Any, Final

import msgspec

from ..actors import lives, mailbox
from ..actors.actor import Actor
from ..actors.cell import DOWN, RUNNING, Cell
from ..actors.errors import StartFailed
from ..actors.exits import ExitReason, pack_exit
from ..actors.mail import Item
from ..actors.message import message_name
from ..actors.ref import ActorRef
from ..actors.values import decode_value, encode_value
from ..checkpoint.context import RecordedContext
from ..checkpoint.keys import key_names, restore_state, save_state, variables
from ..checkpoint.life import Life
from ..checkpoint.method import Method
from ..checkpoint.records import (
    FAILED,
    START,
    Answer,
    Feed,
    Go,
    Ignored,
    Live,
    Outcome,
    PipeDone,
    Released,
    Restore,
    Snapshot,
    SnapshotNow,
    ToHome,
    TurnEnd,
    Unsaved,
    Closed,
    pieces,
)
from ..checkpoint.turns import Fed, GoLive, Hook, StopRecorded
from .mechanism import has_state_access
from .messages import Request, State

if TYPE_CHECKING:
    from .standing import Standing

PART: Final = 0.001
"""Seconds of work after which the outcomes so far are handed over: a slow request does not hold up quick ones."""
MOST_CRASHES: Final = 8
"""Ends of the life outside any turn, one after another, after which the replica is given up."""
COMPACT_BYTES: Final = 64 * 1024
"""Deltas that are larger than the state they belong to, and than this, are replaced by a whole state."""

UNKNOWN: Final = -3
"""In place of the turn that a delta begins after."""

# Why the server came to rest.
OVER, BLOCKED, ENDED, UNDONE = "over", "blocked", "ended", "undone"

HandOver = Callable[[list[TurnEnd], bool], Awaitable[None]]
TurnHook = Callable[["Server", TurnEnd], TurnEnd]


class ServerContext(RecordedContext):
    """`self.ctx` of the protected actor: it knows itself by the address that is protected, on every replica."""

    __slots__ = ("_address",)

    def __init__(self, cell: Cell, address: str) -> None:
        super().__init__(cell)
        self._address = address

    @property
    def path(self) -> str:
        return self._address

    @property
    def ref(self) -> ActorRef[Any]:
        return self.cell.node.cell_at(self._address).ref


class ServerLife(Life):
    """A life of the protected actor. What it wants released in the middle of a turn is the server's to decide."""

    def __init__(self, cell: Cell, server: Server, method: Method) -> None:
        super().__init__(cell, server, method, None)
        self.server = server
        self.ended: Feed | None = None  # what the last turn has handled
        self.saves = server.has_access

    def _context(self, cell: Cell) -> RecordedContext:
        made = self._context_made = ServerContext(cell, self.server.address)
        made.recorded = self
        return made

    def close_turn(self, status: str, answer: Answer) -> None:
        self.ended = self.feed
        super().close_turn(status, answer)

    def release(self) -> None:
        if self.feed is not None and self.outs:
            self.server.wants_out(self)

    def release_now(self) -> None:
        """What the turn in hand has sent leaves."""
        super().release()

    def take_snapshot(self, *, is_last: bool = False) -> None:
        """Asked for by the end in good order; others are made of points."""
        if is_last:
            self.server.last_snapshot()

    def want_snapshot(self) -> None:
        self.server.want_snapshot()

    def replaced(self) -> None:
        self.server.forget_point()
        super().replaced()


class Nowhere:
    """The way home of a life that does not count any more."""

    def to_home(self, record: ToHome) -> None:
        """Nobody hears it."""

    def closed(self) -> None:
        """Nobody waits for it."""


NOWHERE: Final = Nowhere()


class PartOver(Item):
    """Stands behind what the server was given: it has come to rest, between two turns."""

    __slots__ = ("server",)

    def __init__(self, server: Server) -> None:
        self.server = server

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        item.server.at_rest(OVER)
        return None


class Skip(Item):
    """In place of a turn that has failed: its number is used, and it has left nothing else."""

    __slots__ = ("end", "life")

    def __init__(self, life: ServerLife, end: TurnEnd) -> None:
        self.life, self.end = life, end

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        life: ServerLife = item.life
        life.turn += 1
        end: TurnEnd = item.end
        life.port.to_home(TurnEnd(life.turn, end.id, end.status, [], end.answer, end.state))
        return None


class BeginAgain(Hook):
    """`on_start` of a life that begins anew without its state, because nobody can save that."""

    __slots__ = ()

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        item.life.in_hook = True
        result = actor.on_start(False)
        if inspect.iscoroutine(result):
            return item.finish(result)
        item.over()
        return None


class Server(lives.LocalHost):
    """The host of the protected actor, and its port home."""

    def __init__(self, standing: Standing, method: Method) -> None:
        self.standing, self.method = standing, method
        self.address = standing.address
        self.cell: Cell | None = None
        self.life: ServerLife | None = None
        self.has_access = True
        self.has_deltas = False
        self.is_over = False  # it has ended itself
        self.is_lazy = False  # what comes out is the same each time: points may be far apart
        self.point: State | None = None
        self.marks: list[int] = []  # the turns that the point's deltas begin after
        self.tail: list[tuple[Request, TurnEnd | None]] = []  # handed over since the point; with the end if it failed
        self.previous: tuple[State, list[Request]] | None = None  # before the last part, and that part
        self.heard: dict[tuple[int, int], Outcome] = {}  # outcomes of asks since the point before the last part
        self.released: dict[int, list[int]] = {}  # digests of what left in the middle of turns, by turn
        self.ends: list[TurnEnd] = []
        self.more: list[PipeDone | Snapshot | Unsaved | Closed | Ignored] = []
        self.begun: list[Request] = []
        self.alone: set[tuple[str, str]] = set()  # inputs that have wanted to be at the front once
        self.handed = self.confirmed = 0  # parts: handed over, known to be at home
        self.hooks: list[TurnHook] = []  # see each end while the actor is as the turn has left it; the innermost first
        self.objections: dict[int, str] = {}  # what hooks have against turns, by number of the request
        self.hand_over: HandOver | None = None  # Proceed's, while a batch runs
        self.on_more: Callable[[], None] = lambda: None
        self.outward: Callable[[Released], None] = lambda record: None
        self._skips: dict[int, TurnEnd] = {}
        self._failed: int | None = None
        self._live: Live | None = None
        self._missed: str | None = None
        self._has_released = False
        self._pending: deque[Request] = deque()
        self._resting: asyncio.Future[str] | None = None
        self._chunk = 8
        self._is_quiet = self._is_again = self._is_stopping = self._is_abandoned = False
        self._snapshot_wanted = False
        self._point_names: set[str] | None = None
        self._crashes = 0
        self._start_turn = -1
        self._async: frozenset[str] | None = None

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
        cell.node.here.retired(cell)

    def recovers(self, reason: ExitReason) -> bool:
        return not reason.is_clean

    def _life_ended(self, life: ServerLife, reason: ExitReason) -> None:
        """The life is over, and nobody here has ended it."""
        if life is not self.life:
            return
        self.life = None
        if not self._is_stopping and self._failed is None and reason.is_clean and life.ignored_why is None:
            self.is_over = True
            self.tell_more(Closed(0, pack_exit(reason), False))
        self.at_rest(ENDED)

    # -- beginning --------------------------------------------------------------------------------------------------

    def install(self, point: State | None) -> None:
        """The state to begin with, whenever a life is wanted; a life that runs is not touched."""
        self.point, self.marks, self.tail, self.previous = point, [], [], None
        self._point_names = None
        self.confirmed = self.handed
        if point is not None:
            self.marks = [UNKNOWN] * len(point.deltas)

    @property
    def turn(self) -> int:
        """The last turn."""
        if self.life is not None:
            return self.life.turn
        return -1 if self.point is None else self.point.turn

    async def ensure(self) -> None:
        """See to it that there is a life.

        Raises:
            StartFailed: it cannot begin.
        """
        if self.life is None and not self.is_over:
            await self._begin()

    async def _begin(self) -> None:
        """Begin a life where the point is, and handle again what was handed over since."""
        await self._begin_at_point()
        if not self.tail or not self.has_access:
            return
        self._is_quiet = True
        try:
            items = [(one.feed, end) for one, end in self.tail]
            why = await self._go(items)
        finally:
            self._is_quiet = False
        if why is not OVER:
            raise StartFailed(self.address, "what it has handled before cannot be handled again")

    async def _begin_at_point(self) -> None:
        cell, point = self.cell, self.point
        assert cell is not None
        start = cell.extra().start
        assert start is not None
        life = ServerLife(cell, self, self.method)
        has_state = point is not None and point.data != b""
        if point is not None and has_state:
            life.from_home(Restore(point.data))
        turn = self._start_turn if point is None else point.turn
        life.begin(start, turn, [] if point is None else point.stash_ids)
        self.life = life
        actor: Any = cell.actor
        if point is not None:
            for delta in point.deltas:
                actor.apply_delta(decode_value(delta))
            senders = cell.node
            for kept, feeds in ((life.stash, point.stash), (None, point.returned)):
                for feed in feeds:
                    fed = Fed(life, feed, None, None if feed.sender is None else senders.cell_at(feed.sender))
                    if kept is None:
                        life.returned[feed.id] = fed
                    else:
                        kept.append(fed)
        if self.has_deltas:
            actor.get_delta()  # What has changed up to here is known.
        if point is not None and point.live:
            self._put([GoLive(life, Go(has_state, turn))])
        elif point is None and turn >= 0:  # Its state is lost: it begins as without recovery, and is live at once.
            first = [BeginAgain(life, "on_start")] if type(actor).on_start is not Actor.on_start else []
            self._put([*first, GoLive(life, Go(False, turn))])
        else:
            return
        if await self._rest() is not OVER:
            raise StartFailed(self.address, str(cell.extra().reason))

    def abandon(self) -> None:
        """What is being run does not count: another state takes the place of what it leads to."""
        self._is_abandoned = True
        self.at_rest(ENDED)

    async def drop_life(self) -> None:
        """End the life without a word: its state is kept as bytes."""
        cell = self.cell
        life, self.life = self.life, None
        if life is None or cell is None or cell.state is DOWN:
            return
        life.port = NOWHERE
        gone = cell.ended()
        self.kill(cell)
        await gone

    # -- turns ------------------------------------------------------------------------------------------------------

    def _put(self, items: Iterable[Item]) -> None:
        cell = self.cell
        assert cell is not None
        queue = mailbox.queue_of(cell)
        queue.extend(items)
        queue.append(PartOver(self))
        cell.schedule()

    def _rest(self) -> asyncio.Future[str]:
        """Wait for what is given to the server now."""
        self._missed = None
        return self._on_to_rest()

    def _on_to_rest(self) -> asyncio.Future[str]:
        """Wait on for what was given to it; it may have come to rest while nobody waited."""
        assert self.cell is not None
        resting: asyncio.Future[str] = self.cell.node.loop.create_future()
        missed, self._missed = self._missed, None
        if missed is not None:
            resting.set_result(missed)
        else:
            self._resting = resting
        return resting

    def at_rest(self, why: str) -> None:
        """What was given to the server is done, or cannot go on."""
        resting, self._resting = self._resting, None
        if resting is None:
            self._missed = why
        elif not resting.done():
            resting.set_result(why)

    def _go(self, feeds: Iterable[tuple[Feed, TurnEnd | None]]) -> asyncio.Future[str]:
        life = self.life
        assert life is not None
        resting = self._rest()
        queue_of = mailbox.queue_of(life.cell)
        for feed, end in feeds:
            if end is None:
                life.from_home(feed)
            else:
                queue_of.append(Skip(life, end))
        self._put(())
        return resting

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
        while pending and len(chunk) < self._chunk and not (chunk and self.runs_alone(pending[0])):
            chunk.append(pending.popleft())
        return chunk

    async def part(self, pending: deque[Request]) -> list[TurnEnd]:
        """Run requests until enough are done; returns their ends. What has not been run is left in `pending`."""
        begin = time.perf_counter()
        self.begun, self.ends, self._is_abandoned, self._has_released = [], [], False, False
        self._pending = pending
        while pending and not self.is_over:
            if self.life is None:
                await self._begin()
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

    def _take_back(self, pending: deque[Request]) -> None:
        """Nothing of this part has happened: the life begins again where it began."""
        pending.extendleft(reversed(self.begun))
        self.begun, self.ends, self.life = [], [], None
        self.more = [one for one in self.more if not isinstance(one, PipeDone)]

    def _after_end(self, pending: deque[Request], chunk: list[Request]) -> bool:
        """The life has ended in the middle of a part. Whether to go on."""
        failed, self._failed = self._failed, None
        if self._is_abandoned:
            self._is_abandoned = False
            pending.clear()
            self.begun, self.ends = [], []
            return False
        self.life = None
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
            asked = [out for out in life.outs if out.verb in ("ask", "send")]
            known = [self.heard.get((life.turn, out.k)) for out in asked]
            if all(one is not None for one in known):
                self._note_released(life)
                life.outs = []
                for one in known:
                    assert one is not None
                    life.from_home(one)
                return
        if self.is_front:
            self._let_out(life)
        else:
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

    def _look(self, life: ServerLife, feed: Feed) -> None:
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
            await self._hand_over_before(feed)
        if self.standing.leads and self.life is life and life.feed is feed and life.outs:
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
        if life is not None and life.feed is not None and life.outs:
            self._look(life, life.feed)

    # -- points -----------------------------------------------------------------------------------------------------

    def _keep_tail(self, requests: list[Request], ends: list[TurnEnd]) -> None:
        failed = {end.id: end for end in ends if end.status == FAILED}
        self.tail += [(one, failed.get(one.feed.id)) for one in requests]

    def seal(self, ends: list[TurnEnd]) -> None:
        """A part is over: it is not undone any more, whatever comes after it."""
        begun, self.begun = self.begun, []
        self._skips.clear()
        if self.life is None or self.is_over:
            return
        if not self.has_access:
            self._start_turn = self.life.turn
            self._forget_heard(self.life.turn)
            return
        before = self.point
        self._keep_tail(begun, ends)
        if self.is_lazy and before is not None and len(self.tail) < 256 and before.live == self.life.is_live:
            return
        tail, self.tail = self.tail, []
        self.capture()
        if before is not None and tail:
            self.previous = before, [one for one, _ in tail]
        first = before.turn if before is not None else -1
        self._forget_heard(first)

    def _forget_heard(self, turn: int) -> None:
        """Turns up to this one are not run again."""
        if self.heard:
            self.heard = {key: one for key, one in self.heard.items() if key[0] > turn}
        if len(self.released) > 512:
            self.released = {key: digests for key, digests in self.released.items() if key > turn - 256}

    def capture(self) -> State:
        """The state after the last turn, as bytes. Only between two turns.

        Raises:
            UnsavableValue, StateMismatch, what `get_state` raises: it cannot be saved.
        """
        life, point = self.life, self.point
        if life is None:
            assert point is not None
            return point
        assert life.feed is None, "a state is captured between two turns, never in the middle of one"
        if point is not None and point.turn == life.turn and point.live == life.is_live and not self.tail:
            return point
        actor: Any = life.cell.actor
        stash = [fed.feed for fed in life.stash]
        returned = [fed.feed for fed in life.returned.values()]
        is_chain = self.has_deltas and point is not None and not point.stash_ids
        if is_chain and point is not None and sum(map(len, point.deltas)) <= max(COMPACT_BYTES, len(point.data)):
            delta = encode_value(actor.get_delta(), where=f"{self.address}.get_delta()")
            self.marks = [*self.marks, point.turn]
            self.point = State(life.turn, point.data, [*point.deltas, delta], stash, returned, life.is_live)
        else:
            data = save_state(actor)
            if self.has_deltas:
                actor.get_delta()
            self.marks = []
            self.point = State(life.turn, data, [], stash, returned, life.is_live)
        ids = () if life.is_live else sorted(life._stashed_ids)
        self.point.stash_ids = [key for key in ids if all(fed.feed.id != key for fed in life.stash)]
        self._point_names = None
        if getattr(actor, "get_state", None) is None and key_names(actor) is None:
            self._point_names = set(variables(actor))
        self.tail = []
        return self.point

    def since(self, turn: int) -> State:
        """The present point, as what has changed since an earlier one if that is known; else all of it."""
        point = self.capture()
        if turn == point.turn:
            at = len(point.deltas)
        elif turn in self.marks:
            at = self.marks.index(turn)
        else:
            return point
        return State(
            point.turn, b"", point.deltas[at:], point.stash, point.returned, point.live, turn, point.stash_ids
        )

    def apply(self, state: State) -> None:
        """Take a state from another replica, whole or not at all.

        Raises:
            ValueError: it is a delta to a state that is not here.
        """
        if state.base == -2:
            self.install(state)
            return
        point = self.point
        if point is None or point.turn != state.base:
            raise ValueError(f"a delta to turn {state.base}, and turn {-1 if point is None else point.turn} is here")
        state.data, state.deltas, state.base = point.data, [*point.deltas, *state.deltas], -2
        self.install(state)

    def forget_point(self) -> None:
        """The state was replaced in no turn: no earlier point leads to it."""
        self.point, self.tail, self.previous = None, [], None
        if self.life is not None and self.has_access:
            self.capture()

    def rewind(self, point: State) -> None:
        """Put the state of a point back, in place: the actor's object goes on. Only between two turns.

        What is no state (attributes with a leading underscore) stays as it is.
        """
        life = self.life
        assert life is not None
        assert life.feed is None
        actor: Any = life.cell.actor
        names = self._point_names
        restore_state(actor, point.data)
        for delta in point.deltas:
            actor.apply_delta(decode_value(delta))
        if self.has_deltas:
            actor.get_delta()
        if names is not None:
            for name in set(variables(actor)) - set(self._names_of(point)):
                delattr(actor._state_root(), name)
        senders = life.cell.node
        life.turn = point.turn
        life.stash = [
            Fed(life, feed, None, None if feed.sender is None else senders.cell_at(feed.sender))
            for feed in point.stash
        ]
        self.point, self.tail = point, []
        self.marks = [UNKNOWN] * len(point.deltas)

    @staticmethod
    def _names_of(point: State) -> list[str]:
        saved: Any = decode_value(point.data)
        return list(saved[2])

    async def again(
        self, since: State | None = None, feeds: list[Request] | None = None
    ) -> tuple[list[TurnEnd], State]:
        """Rewind to the point before the last part, and run that part again; returns ends and state.

        Nothing is handed over. Asks get the outcomes that they had.

        Args:
            since: rewind to this state instead.
            feeds: run these requests instead.
        """
        assert self.previous is not None or since is not None
        previous = self.previous
        before, requests = previous if previous is not None else (since, feeds)
        before, requests = since or before, requests if feeds is None else feeds
        assert before is not None
        assert requests is not None
        self.objections.clear()
        if self.life is None:
            self.point, self.tail = before, []
            await self._begin()
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
        if self.life is None and not self.is_over:
            await self._begin()
        self._skips.clear()
        state = self.capture()
        self.previous = previous
        return ends, state

    async def back(self) -> State:
        """Rewind to the point before the last part, for good: it leaves no trace but its numbers."""
        assert self.previous is not None
        before, _ = self.previous
        if self.life is None:
            self.point, self.tail = before, []
            await self._begin()
        else:
            self.rewind(before)
        return before

    async def adopt(self, state: State) -> None:
        """Go on from this state, with a life of its own; what led to it has happened elsewhere."""
        live = state.live or (self.life is not None and self.life.is_live)
        await self.drop_life()
        self.install(msgspec.structs.replace(state, live=live))
        await self.ensure()

    def skip_to(self, turn: int) -> None:
        """These numbers are used, though no turn has left anything."""
        if self.life is not None and self.point is not None:
            self.life.turn = turn
            self.marks = [UNKNOWN] * len(self.point.deltas)
            self.point = msgspec.structs.replace(self.point, turn=turn)

    # -- as the port home -------------------------------------------------------------------------------------------

    def to_home(self, record: ToHome) -> None:
        """What the life says, in order."""
        match record:
            case TurnEnd():
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
            case Snapshot() | PipeDone() | Unsaved() | Ignored():
                self.tell_more(record)
            case _:
                pass

    def closed(self) -> None:
        """The life is over; what follows from that comes when all of it has been wound down."""
        life, cell = self.life, self.cell
        if life is not None and cell is not None:
            cell.node.loop.call_soon(self._life_ended, life, cell.extra().reason)

    def tell_more(self, record: PipeDone | Snapshot | Unsaved | Closed | Ignored) -> None:
        """Something goes home behind the ends of the part at hand, or by itself."""
        self.more.append(record)
        self.on_more()

    def take_more(self) -> list[PipeDone | Snapshot | Unsaved | Closed | Ignored]:
        """What goes home behind the ends that are handed over now."""
        if self._snapshot_wanted:
            self._snapshot()
        more, self.more = self.more, []
        return more

    # -- records from home ------------------------------------------------------------------------------------------

    def inward(self, record: Outcome | SnapshotNow) -> None:
        """Take what came past the bricks."""
        life = self.life
        if isinstance(record, Outcome):
            self.heard[record.turn, record.k] = record
            if life is not None:
                life.from_home(record)
        else:
            self.want_snapshot()

    def want_snapshot(self) -> None:
        """A snapshot goes home with the next part, or at once."""
        self._snapshot_wanted = True
        self.on_more()

    def _snapshot(self) -> None:
        life = self.life
        if life is None or life.pipes or life.feed is not None or not life.is_live or not self.method.snapshots:
            return
        self._snapshot_wanted = False
        try:
            self._send_snapshot()
        except Exception as error:  # What the user's own `get_state` raises is no reason to lose what it has.
            self.more.append(Unsaved(str(error)))

    def _send_snapshot(self) -> None:
        life = self.life
        assert life is not None
        begin = time.perf_counter()
        point = self.point
        assert life.cell.actor is not None
        is_known = point is not None and point.turn == life.turn and not point.deltas and not self.tail
        data = point.data if point is not None and is_known else save_state(life.cell.actor)
        stash = [fed.feed.id for fed in life.stash]
        parts, pause = pieces(data), time.perf_counter() - begin
        for index, one in enumerate(parts, 1):
            self.more.append(Snapshot(life.turn, one, index == len(parts), stash, pause))

    def last_snapshot(self) -> None:
        """The life ends in good order."""
        self._snapshot_wanted = True
        self._snapshot()
        self.on_more()

    async def go(self, go: Go) -> Live | None:
        """Replay is over: new inputs come from here on."""
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
