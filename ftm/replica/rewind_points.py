"""Where the life of the protected actor begins, and to what it can be taken back: points, states as bytes.

Between two parts of a batch the state is captured; from there a life can be begun again, or the state be put back.
"""

from __future__ import annotations

import asyncio
import time
import zlib
from collections import deque
from collections.abc import Awaitable, Callable, Iterable
from operator import is_
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec

from ...actors.errors import DamagedValue, StartFailed
from ...actors.kernel import lifecycle, mailbox
from ...actors.kernel.actor import Actor
from ...actors.kernel.cell import DOWN, Cell
from ...actors.kernel.envelope import Item
from ...actors.values import decode_value, encode_value, state_digest
from ...checkpoint.life.recorded_inbox import Fed, GoLive
from ...checkpoint.method import Method
from ...checkpoint.protocol import FAILED, Feed, Go, Live, Out, Outcome, Released, Restore, TurnEnd
from ...checkpoint.snapshot.key_variables import key_names, put_back, state_of, variables
from ..bricks.brick_messages import Beside, Change, Request, State, WorkLost
from ..bricks.state_images import BLOCK, Images, Misfit
from ..bricks.state_images import patch as make_patch
from .replica_life import ENDED, NOWHERE, OVER, BeginAgain, PartOver, ServerLife, Skip

if TYPE_CHECKING:
    from ..bricks.standing import Standing
    from .protected_actor import Server

COMPACT_BYTES: Final = 64 * 1024
"""Deltas that are larger than the state they belong to, and than this, are replaced by a whole state."""
MOST_DELTAS: Final = 4096
"""So are more than these: whoever leads next has to apply them."""
BEGUN_WITHIN: Final = 60.0
"""Seconds that `on_start` of a life that begins at a point may take; then the replica cannot have one."""
UNKNOWN: Final = -3
"""In place of the turn that a delta begins after."""

HandOver = Callable[[list[TurnEnd], bool], Awaitable[None]]
TurnHook = Callable[[Any, TurnEnd], TurnEnd]
"""Takes the server and the end of a turn, and returns what the end is to be."""


def checksum(parts: Iterable[bytes]) -> int:
    """Of bytes, one behind the other."""
    found = 0
    for part in parts:
        found = zlib.crc32(part, found)
    return found


def _begins_with(parts: list[bytes], first: list[bytes]) -> bool:
    return len(first) <= len(parts) and all(map(is_, first, parts))


def is_dropped(life: ServerLife | None) -> bool:
    """Whether a life was ended by whoever put something else in its place: that is no failure of whoever began it."""
    return life is not None and life.port is NOWHERE


def is_blank(point: State) -> bool:
    """Whether it only says how far turns were counted before this life: there is no state to go back to."""
    return not point.data.size


class Points(lifecycle.HerePlace):
    """The lives of the protected actor, and the points that they begin at."""

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
        self._images = Images()
        self._given: State | None = None  # the point that another replica was told last
        self._chain: tuple[State | None, int] = None, 0  # a point, and the bytes of its deltas
        self.marks: list[int] = []  # the turns that the point's deltas begin after
        self.tail: list[tuple[Request, TurnEnd | None]] = []  # handed over since the point; with the end if it failed
        self.previous: tuple[State, list[Request]] | None = None  # before the last part, and that part
        self.heard: dict[tuple[int, int], Outcome] = {}  # outcomes of asks since the point before the last part
        self.released: dict[int, list[int]] = {}  # digests of what left in the middle of turns, by turn
        self.ends: list[TurnEnd] = []
        self.more: list[Beside] = []
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
        self._withheld: list[Out] = []  # of the turn in hand, on a follower
        self._pending: deque[Request] = deque()
        self._resting: asyncio.Future[str] | None = None
        self._part = 0  # the number of what was given to the server last
        self._beginning = asyncio.Lock()
        self._chunk = 8
        self._work_waited_for: list[asyncio.Future[None]] = []
        self._singles = 0  # requests that are run one at a time: one of them has left what cannot be saved
        self.can_save = True  # as far as is known, where nobody looks at the state after each part
        self._is_quiet = self._is_again = self._is_stopping = self._is_abandoned = False
        self._snapshot_wanted = False
        self._point_names: set[str] | None = None
        self._begun_names: set[str] = set()  # the variables that the life has begun with
        self._crashes = 0
        self._is_work_lost = self._is_given_up = False
        self._start_turn = -1
        self._async: frozenset[str] | None = None

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

    @property
    def last_ended(self) -> int:
        """The last turn that is over."""
        life = self.life
        return self.turn if life is None or life.feed is None else life.turn - 1

    async def ensure(self) -> None:
        """See to it that there is a life, and that it has begun.

        The replica, its protocol and Proceed all come here, each in its own time: one of them begins the life, and the
        others wait until it has. Otherwise whoever comes second is given a life that is still replaying, and what it
        gives to that takes the place of what the first one waits for.

        Raises:
            StartFailed: it cannot begin.
        """
        if self.life is not None and not self._beginning.locked():
            return
        async with self._beginning:
            if self.life is None and not self.is_over:
                await self._begin()

    async def _begin(self) -> None:
        """Begin a life where the point is, and handle again what was handed over since."""
        await self._begin_at_point()
        if not self.tail or not self.has_access or self.life is None:
            return
        self._is_quiet = True
        try:
            items = [(one.feed, end) for one, end in self.tail]
            life = self.life
            why = await self._go(items)
        finally:
            self._is_quiet = False
        if why is not OVER and not is_dropped(life):
            raise StartFailed(self.address, "what it has handled before cannot be handled again")

    async def _begin_at_point(self) -> None:
        cell, point = self.cell, self.point
        assert cell is not None
        start = cell.extra().start
        assert start is not None
        life = ServerLife(cell, cast("Server", self), self.method)
        has_state = point is not None and not is_blank(point)
        if point is not None and has_state:
            try:
                data = point.data.whole()
            except DamagedValue as error:
                raise StartFailed(self.address, str(error)) from error
            life.to_life(Restore(data))
        turn = self._start_turn if point is None else point.turn
        life.begin(start, turn, [] if point is None else point.stash_ids)
        self.life = life
        if self._is_work_lost:
            self._is_work_lost = False
            self.more.append(WorkLost(turn))
            self.on_more()
        if point is not None:
            cell.extra().trap_exits = point.traps
        actor: Any = cell.actor
        self._begun_names = set(variables(actor)) if self.has_access else set()
        if point is not None:
            for name in self._begun_names.intersection(point.absent):  # `__init__` has made it, a turn has deleted it.
                delattr(actor._state_root(), name)
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
        elif has_state and type(actor).on_start is not Actor.on_start:
            self._put(())  # `on_start(restored=True)` must have returned before anybody counts on this life.
        else:
            return
        try:
            async with asyncio.timeout(BEGUN_WITHIN):
                why = await self._rest()
        except TimeoutError:
            await self.drop_life()
            raise StartFailed(self.address, f"its on_start did not return within {BEGUN_WITHIN:g} s") from None
        if why is not OVER and not is_dropped(life):
            raise StartFailed(self.address, str(cell.extra().reason))

    def abandon(self) -> None:
        """What is being run does not count: another state takes the place of what it leads to."""
        self._is_abandoned = True
        self.at_rest(ENDED)

    async def drop_life(self) -> None:
        """End the life without a word: its state is kept as bytes. Whoever waits for it to come to rest is told."""
        cell = self.cell
        life, self.life = self.life, None
        self.note_work(life)
        self.work_back()
        if life is not None:
            life.port = NOWHERE
        if self._resting is not None:
            self.abandon()
        if life is None or cell is None or cell.state is DOWN:
            return
        gone = cell.ended()
        self.kill(cell)
        await gone

    def note_work(self, life: ServerLife | None) -> None:
        """A life has ended; its background work has ended with it, and nobody runs its turns again to begin it anew."""
        if life is not None and life.pipes and self.standing.leads:
            self._is_work_lost = True

    async def until_work_is_back(self) -> None:
        """Wait until no background work is out: it is part of no state."""
        while self.life is not None and self.life.pipes:
            back: asyncio.Future[None] = self.life.cell.node.loop.create_future()
            self._work_waited_for.append(back)
            await back

    def work_back(self) -> None:
        """No background work is out any more, or its life is over."""
        waiting, self._work_waited_for = self._work_waited_for, []
        for one in waiting:
            if not one.done():
                one.set_result(None)

    # -- coming to rest -----------------------------------------------------------------------------------------------

    def _put(self, items: Iterable[Item]) -> None:
        cell = self.cell
        assert cell is not None
        queue = mailbox.queue_of(cell)
        queue.extend(items)
        self._part += 1
        queue.append(PartOver(cast("Server", self), self._part))
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

    def part_over(self, number: int) -> None:
        """All of what was given to the server with this number is done; of an earlier life's nobody wants to know."""
        if number == self._part:
            self.at_rest(OVER)

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
                life.to_life(feed)
            else:
                queue_of.append(Skip(life, end))
        self._put(())
        return resting

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
        is_known = point is not None and point.turn == life.turn and point.live == life.is_live and not self.tail
        if point is not None and is_known and not is_blank(point):
            return point
        actor: Any = life.cell.actor
        stash = [fed.feed for fed in life.stash]
        returned = [fed.feed for fed in life.returned.values()]
        if self.has_deltas and point is not None and not is_blank(point) and self._takes_delta(point):
            delta = encode_value(actor.get_delta(), where=f"{self.address}.get_delta()")
            self.marks = [*self.marks, point.turn]
            self.point = State(life.turn, point.data, [*point.deltas, delta], stash, returned, life.is_live)
            self._chain = self.point, self._chain[1] + len(delta)
        else:
            data = self._images.take(actor, None if point is None else point.data)
            if self.has_deltas:
                actor.get_delta()
            self.marks = []
            self.point = State(life.turn, data, [], stash, returned, life.is_live)
        ids = () if life.is_live else sorted(life.restored.stash_ids)
        self.point.traps = life.cell.extra().trap_exits
        self.point.stash_ids = [key for key in ids if all(fed.feed.id != key for fed in life.stash)]
        self._point_names = None
        if getattr(actor, "get_state", None) is None and key_names(actor) is None:
            self._point_names = names = set(variables(actor))
            self.point.absent = sorted(self._begun_names - names)
        self.tail = []
        return self.point

    def state_digest(self) -> bytes:
        """A digest of the state after the last turn, the same on each replica. Only between two turns.

        Raises:
            UnsavableValue, StateMismatch, what `get_state` raises: it cannot be saved.
        """
        life = self.life
        assert life is not None
        assert life.feed is None
        actor: Any = life.cell.actor
        state = state_of(actor)
        value: Any = state.value
        if type(value) is dict and all(type(name) is str for name in value):
            value = sorted(value.items())
        return state_digest([life.turn, [fed.feed.id for fed in life.stash], [state.version, state.form, value]])

    def since_before(self, number: int, turn: int) -> tuple[State, list[Request]] | None:
        """A state before this turn, and the requests from there up to this one; None if that is not known any more."""
        kept = [(self.point, [one for one, _ in self.tail])]
        if self.previous is not None:
            kept.append(self.previous)
        for before, requests in kept:
            numbers = [one.feed.id for one in requests]
            if before is not None and before.turn < turn and number in numbers and not is_blank(before):
                return before, requests[: numbers.index(number) + 1]
        return None

    def _takes_delta(self, point: State) -> bool:
        """Whether what has changed is kept on top of this point."""
        if self._chain[0] is not point:
            self._chain = point, sum(map(len, point.deltas))
        is_short = len(point.deltas) < MOST_DELTAS and self._chain[1] <= max(COMPACT_BYTES, point.data.size)
        return is_short and not point.stash_ids

    def since(self, turn: int) -> Change | None:
        """What leads to the present point from the one after an earlier turn; None if all of it is no more than that.

        Whoever is given it has all of the present point from now on.
        """
        point, given = self.point, self._given
        assert point is not None
        self._given = point
        patch, deltas = None, point.deltas
        at = self._place_of(turn, point)
        if at is not None:
            deltas = point.deltas[at:]
        else:
            before = None if self.previous is None else self.previous[0]
            base = next((one for one in (given, before) if one is not None and one.turn == turn), None)
            if base is None:
                return None
            if base.data is point.data and _begins_with(point.deltas, base.deltas):  # It was taken back meanwhile.
                deltas = point.deltas[len(base.deltas) :]
            elif point.data.size <= BLOCK:
                return None
            else:
                patch = make_patch(base.data, point.data)
        check = checksum(deltas)
        ids, traps, absent = point.stash_ids, point.traps, point.absent
        stash, returned = point.stash, point.returned
        return Change(point.turn, turn, patch, deltas, check, stash, returned, point.live, ids, traps, absent)

    def _place_of(self, turn: int, point: State) -> int | None:
        """The first of the point's deltas that this turn has not got, if there only deltas are missing."""
        if turn == point.turn:
            return len(point.deltas)
        if self.marks and self.marks[-1] == turn:
            return len(self.marks) - 1
        return self.marks.index(turn) if turn in self.marks else None

    def led_to(self, state: State | Change) -> State:
        """The state that another replica has said; the one that is here stays as it is.

        Raises:
            Misfit, DamagedValue: these are differences to something that is not here, or it has come damaged.
        """
        if isinstance(state, State):
            state.data.check()
            return state
        point = self.point
        if point is None or point.turn != state.base:
            raise Misfit(f"it is to turn {state.base}, and turn {-1 if point is None else point.turn} is here")
        if checksum(state.deltas) != state.check:
            raise Misfit("its deltas have come damaged")
        data, deltas = point.data, [*point.deltas, *state.deltas]
        if state.patch is not None:
            data, deltas = state.patch.applied(point.data), state.deltas
        return State(
            state.turn, data, deltas, state.stash, state.returned, state.live, state.stash_ids, state.traps,
            state.absent,
        )  # fmt: skip

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
        names, begin = self._point_names, time.perf_counter()
        saved = point.data.value()
        put_back(actor, saved)
        for delta in point.deltas:
            actor.apply_delta(decode_value(delta))
        if self.has_deltas:
            actor.get_delta()
        if names is not None:
            for name in set(variables(actor)) - set(saved[2]):
                delattr(actor._state_root(), name)
        senders = life.cell.node
        life.cell.extra().trap_exits = point.traps
        stash = [
            Fed(life, feed, None, None if feed.sender is None else senders.cell_at(feed.sender)) for feed in point.stash
        ]
        life.rewind(point.turn, stash)
        self.standing.took(time.perf_counter() - begin, point.data.size)
        self.point, self.tail = point, []
        self.marks = [UNKNOWN] * len(point.deltas)

    def skip_to(self, turn: int) -> None:
        """These numbers are used, though no turn has left anything."""
        if self.life is not None and self.point is not None:
            self.life.turn = turn
            self.marks = [UNKNOWN] * len(self.point.deltas)
            self.point = msgspec.structs.replace(self.point, turn=turn)
