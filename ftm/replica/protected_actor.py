"""The protected actor inside a replica: its host, and how bricks drive it.

An unmodified class lives a recorded life (`checkpoint.life.Life`) whose inputs come from Proceed. What is known of it
are states (`rewind_points.py`, `replica_state.py`), with the decisions as functions; the server carries them out.
"""

from __future__ import annotations

import asyncio
import inspect
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec

from ...actors.errors import DamagedValue, StartFailed
from ...actors.exit_reasons import ExitReason, pack_exit
from ...actors.kernel import lifecycle, mailbox
from ...actors.kernel.actor import Actor
from ...actors.kernel.cell import DOWN, RUNNING, Cell
from ...actors.kernel.envelope import Item
from ...actors.kernel.message import descended, message_name
from ...actors.state_hooks import gives_deltas
from ...actors.values import encode_value
from ...checkpoint.life.recorded_inbox import Fed, GoLive, StopRecorded
from ...checkpoint.method import Method
from ...checkpoint.protocol import (
    FAILED,
    TICK,
    Answer,
    Closed,
    Feed,
    GivenUp,
    Go,
    Hooked,
    Ignored,
    Live,
    MidTurn,
    Outcome,
    PastInputs,
    Performed,
    PipeDone,
    Released,
    Restore,
    Retried,
    Snapshot,
    SnapshotNow,
    ToHome,
    TurnEnd,
    Unreadable,
    Unsaved,
)
from ...checkpoint.snapshot.key_variables import variables
from ..alarms import ProtectionCostly, ProtectionLost
from ..bricks.brick_messages import Beside, PutBack, Request, ServerState, Work, WorkLost
from ..bricks.state_images import Images
from .actor_state import digest_of_life, names_of_state, point_of, rewind_to, snapshot_of, take_up
from .replica_life import (
    ABANDONED,
    BLOCKED,
    ENDED,
    NOWHERE,
    OVER,
    UNDONE,
    BeginAgain,
    PartOver,
    Rest,
    ServerLife,
    Skip,
)
from .replica_state import (
    GIVE_UP,
    GO_ON,
    PART,
    REWIND,
    Attempts,
    BatchPart,
    ReplicaState,
    Reports,
    Traces,
    after_end,
    is_front,
    known_outcomes,
    next_requests,
    runs_alone,
    size_after,
)
from .rewind_points import RewindPoints, is_blank, needs_point, stands_at, takes_delta

if TYPE_CHECKING:
    from ..bricks.standing import Standing

BEGUN_WITHIN: Final = 60.0
"""Seconds that `on_start` of a life that begins at a point may take; then the replica cannot have one."""
MOST_CRASHES: Final = 8
"""Ends of the life outside any turn, one after another, after which the replica is given up."""
CALM: Final = 60.0
"""Seconds after which such an end is no continuation of the last one."""
COSTLY: Final = 0.01
"""Seconds from which on it is told what going through the state takes."""
MOST_COPIED: Final = 16_000_000
"""Bytes of a state that home gets a copy of."""

Tail = list[tuple[Request, TurnEnd | None]]
"""What was handed over since a point, with the end if it failed."""
TurnHook = Callable[[Any, TurnEnd], TurnEnd]
"""Takes the server and the end of a turn, and returns what the end is to be."""


class Driver(Protocol):
    """Whoever drives the server, and takes from it what goes home."""

    def go_on(self) -> None:
        """See to it that what waits to go home is taken."""
        ...

    def tell_outward(self, record: MidTurn) -> None:
        """Something leaves in the middle of a turn."""
        ...

    async def hand_over_before(self, ends: list[TurnEnd], wait: bool) -> None:
        """Hand over the ends before the turn in hand, which waits for that."""
        ...


def is_dropped(life: ServerLife | None) -> bool:
    """Whether a life was ended by whoever put something else in its place: that is no failure of whoever began it."""
    return life is not None and life.port is NOWHERE


class Server(lifecycle.HerePlace):
    """The place of the protected actor: its lives, one after the other, what they run, and their port home."""

    limits_turns = False  # The failure detector does, which knows who else could take the turn.
    is_trial = False  # Its lives are no lives of the actor: they only compute what another one has.

    def __init__(self, standing: Standing, method: Method) -> None:
        self.standing, self.method = standing, method
        self.cell: Cell | None = None
        self.life: ServerLife | None = None
        self.state, self.points = ReplicaState(), RewindPoints()
        self.part, self.attempts = BatchPart(deque()), Attempts()
        self.traces, self.reports = Traces(), Reports()
        self.left_over: list[Request] = []  # what was taken in place of their run comes first
        self.hooks: list[TurnHook] = []  # see each end while the actor is as the turn has left it; the innermost first
        self.shadows: set[Server] = set()  # more lives of it, which only compute
        self._driver: Driver | None = None  # None: nothing goes home
        self._rest = Rest(standing.node.loop)
        self._images = Images()
        self._beginning = asyncio.Lock()
        self._live: Live | None = None
        self._is_costly = False  # that was told
        self._work_waited_for: list[asyncio.Future[None]] = []

    @property
    def address(self) -> str:
        """Where the actor is for all others, and for itself."""
        return self.standing.address

    @property
    def turn_timeout(self) -> float:
        """Seconds that the actor's class allows a turn; 0: as many as it wants."""
        start = None if self.cell is None else self.cell.extra().start
        return 0.0 if start is None else start.kind.turn_timeout or 0.0

    def report_to(self, driver: Driver) -> None:
        """Have this one drive the server from now on."""
        self._driver = driver

    # -- as the host of its cell ------------------------------------------------------------------------------------

    def start(self, cell: Cell) -> None:
        """The address is there; a life begins when the replica's role wants one."""
        self.cell = cell
        start = cell.extra().start
        assert start is not None
        kind: Any = start.kind
        cell.table = table = kind._table
        state = self.state
        state.has_access = kind.state_access
        state.has_deltas = state.has_access and gives_deltas(kind)
        known = [one for one in descended(*kind._declared) if inspect.iscoroutinefunction(table[one])]
        state.waiting = frozenset(map(message_name, known))

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        """It ends: by itself, or with the replica. Only one that leads says good-bye."""
        if cell.state is not RUNNING or self.life is None:
            return
        if self.standing.leads:
            cell.urge(StopRecorded(self.life, reason))
        else:
            self.state.is_stopping = True
            self.kill(cell)

    def finish(self, reason: ExitReason) -> None:
        """End in good order, because the root wants it."""
        if self.life is not None:
            self.state.is_stopping = True
            self.life.cell.urge(StopRecorded(self.life, reason))

    def retired(self, cell: Cell) -> None:
        self.state.is_stopping = True

    def _life_ended(self, life: ServerLife, reason: ExitReason) -> None:
        self.life = None
        self._note_work(life)
        is_failure, has_said = self.state.is_stopping or self.attempts.failed is not None, life.stage.ending is not None
        if not is_failure and (reason.is_clean or has_said) and life.stage.ignored_why is None:
            self.state.is_over = True
            self.tell_more(Closed(0, pack_exit(reason), False))
        is_missed = not (is_failure or self._rest.is_awaited or self.state.is_over)
        self._rest.reach(ENDED)
        if is_missed and self._driver is not None and self.standing.computes:
            self.state.wants_life = True
            self._driver.go_on()

    # -- lives ------------------------------------------------------------------------------------------------------

    def install(self, point: ServerState | None) -> None:
        """The state to begin with, whenever a life is wanted; a life that runs is not touched."""
        self.points.install(point)
        self.state.confirmed = self.state.handed

    @property
    def turn(self) -> int:
        """The number of the last turn."""
        return self.points.turn if self.life is None else self.life.turn

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
            StartFailed: it cannot begin, or one life after the other ends when it has.
        """
        if self.life is not None and not self._beginning.locked():
            return
        async with self._beginning:
            while self.life is None and not self.state.is_over:
                life = await self._begin()
                if self.life is not None or is_dropped(life):
                    return
                self._note_crash()

    async def ensure_as_given(self) -> None:
        """See to it that there is a life; one that begins stands where the point says, where another one is.

        Its hooks are called, as at each life, but what they do to the state is no part of what the other one has done.
        """
        is_new, point, tail = self.life is None, self.points.point, self.points.tail
        self.state.is_as_given = True
        try:
            await self.ensure()
        finally:
            self.state.is_as_given = False
        life = self.life
        if is_new and life is not None and point is not None and self.state.has_access and not is_blank(point):
            self.rewind(point)
            if tail:
                await self._begun(life, tail, [], [])
                self.points.tail = tail

    async def live_on(self) -> None:
        """Begin the life that follows one that has ended between two turns: what its hooks do waits for no message.

        Raises:
            StartFailed: it cannot begin, or one life after the other ends like this.
        """
        self.state.wants_life = False
        if self.life is None:
            self._note_crash()
        else:
            await self.drop_life()  # It was begun to compute something again, and has no hooks behind it that count.
        if not self.standing.leads:
            await self.ensure_as_given()
            return
        await self.ensure()
        if self.has_returned:
            self.tell_more(PutBack())

    def _note_crash(self) -> None:
        """A life has ended outside its turns.

        Raises:
            StartFailed: too many have, one after the other.
        """
        attempts, now = self.attempts, self.standing.node.loop.time()
        attempts.crashes = 1 if now - attempts.crashed > CALM else attempts.crashes + 1
        attempts.crashed = now
        if attempts.crashes >= MOST_CRASHES:
            raise StartFailed(self.address, "its life ends again and again outside its turns")

    async def _begin(self) -> ServerLife:
        """Begin a life where the point is, have it handle again what was handed over since, and go on from there.

        As in any recovery, `on_start` comes before what is handled again, and `on_recovered` behind it.

        Raises:
            StartFailed: it cannot.
        """
        self.state.wants_life &= self.state.is_as_given
        point = self.points.point
        tail = self.points.tail if self.state.has_access else []
        life = self._begin_at_point(point)
        has_state = point is not None and not is_blank(point)
        is_lost = point is None and life.turn >= 0  # It begins as without recovery, and is live at once.
        actor: Any = life.cell.actor
        greets = type(actor).on_start is not Actor.on_start and (has_state or is_lost)
        first: list[Item] = [BeginAgain(life, "on_start")] if is_lost and greets else []
        last: list[Item] = []
        if is_lost or (point is not None and point.live):
            last.append(GoLive(life, Go(has_state and not self.attempts.is_undone, life.turn)))
        if greets or tail or last:
            await self._begun(life, tail, first, last)
        return life

    async def _begun(self, life: ServerLife, tail: Tail, first: list[Item], last: list[Item]) -> None:
        """Wait until a new life has handled what it begins with: nobody may count on it before.

        Raises:
            StartFailed: it cannot, or makes no progress.
        """
        self.state.is_quiet = True
        try:
            resting = self._give([(one.feed, end) for one, end in tail], first, last)
            turn = life.turn
            while not (await asyncio.wait((resting,), timeout=BEGUN_WITHIN))[0] and life.turn != turn:
                turn = life.turn
        finally:
            self.state.is_quiet = False
        if not resting.done():
            await self.drop_life()
            raise StartFailed(self.address, f"it did not go on within {BEGUN_WITHIN:g} s when it began")
        if resting.result() is not OVER and not is_dropped(life):
            raise StartFailed(self.address, str(life.cell.extra().reason))

    def _begin_at_point(self, point: ServerState | None) -> ServerLife:
        cell, state = self.cell, self.state
        assert cell is not None
        start = cell.extra().start
        assert start is not None
        life = ServerLife(cell, self, self.method)
        has_state = point is not None and not is_blank(point)
        if point is not None and has_state:
            try:
                data = point.data.whole()
            except DamagedValue as error:
                raise StartFailed(self.address, str(error)) from error
            life.to_life(Restore(data, variables=point.variables))
        turn = state.start_turn if point is None else point.turn
        life.begin(start, turn, [] if point is None else point.stash_ids)
        self.life = life
        if state.is_work_lost:
            state.is_work_lost = False
            self.tell_more(WorkLost(turn))
        actor: Any = cell.actor
        life.begun_names = set(variables(actor)) if state.has_access else set()
        if point is not None:
            take_up(life, point, has_deltas=state.has_deltas)
        elif state.has_deltas:
            actor.get_delta()
        if life.restored.is_mapped:  # What is begun with, and gone back to, is a state of the class as it is now.
            present = self._whole(life)
            self.points.stand_changed(present)
            self._note_names(life, present)
        return life

    def abandon(self) -> None:
        """What is being run does not count: another state takes the place of what it leads to."""
        self._rest.reach(ABANDONED)

    async def drop_life(self) -> None:
        """End the life without a word: its state is kept as bytes. Whoever waits for it to come to rest is told."""
        cell = self.cell
        life, self.life = self.life, None
        self._note_work(life)
        self.work_back()
        if life is not None:
            life.port = NOWHERE
        if self._rest.is_awaited:
            self.abandon()
        if life is None or cell is None or cell.state is DOWN:
            return
        gone = cell.ended()
        self.kill(cell)
        await gone

    async def withdraw(self) -> None:
        """What is being run has not happened: the next life stands before it."""
        self.part.begun, self.traces.withheld = [], []
        await self.drop_life()

    def _note_work(self, life: ServerLife | None) -> None:
        """A life has ended; its background work has ended with it, and nobody runs its turns again to begin it anew."""
        if life is not None and life.pipes and self.standing.leads:
            self.state.is_work_lost = True

    @property
    def _has_work(self) -> bool:
        """Whether background work of a turn is out."""
        return self.life is not None and self.life.pipes > 0

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

    def _put(self, items: Iterable[Item]) -> None:
        cell = self.cell
        assert cell is not None
        queue = mailbox.queue_of(cell)
        queue.extend(items)
        queue.append(PartOver(self._rest))
        cell.schedule()

    def _give(
        self, feeds: Iterable[tuple[Feed, TurnEnd | None]], first: Iterable[Item] = (), last: Iterable[Item] = ()
    ) -> asyncio.Future[str]:
        """Give inputs to the life, with the end of those that fail without being run; the future says how it rests.

        What comes `first` and `last` is handled before and behind them.
        """
        life = self.life
        assert life is not None
        resting, queue = self._rest.wait(), mailbox.queue_of(life.cell)
        queue.extend(first)
        for feed, end in feeds:
            if end is None:
                life.to_life(feed)
            else:
                queue.append(Skip(life, feed, end))
        self._put(last)
        return resting

    async def go(self, go: Go) -> Live | None:
        """Replay is over: new inputs come from here on."""
        await self.ensure()
        life = self.life
        if life is None:
            return None
        resting = self._rest.wait()
        self._live = None
        self._put([GoLive(life, go)])
        if await resting is not OVER:
            if self.state.is_over:
                return None
            reason = self.cell.extra().reason if self.cell is not None else ""
            raise StartFailed(self.address, str(reason))
        return self._live

    @property
    def only_computes(self) -> bool:
        """Whether what is run is compared with what was run before, and counts for nothing else."""
        return self.is_trial or self.state.is_again

    def begins_task(self) -> None:
        """The life begins a task of its own."""
        if self.life is not None:
            self.life.has_begun_tasks |= self.life.feed is not None

    # -- points -----------------------------------------------------------------------------------------------------

    def capture(self) -> ServerState:
        """The state after the last turn, as bytes. Only between two turns.

        Raises:
            UnsavableValue, StateMismatch, what `get_state` raises: it cannot be saved.
        """
        life, points, has_deltas = self.life, self.points, self.state.has_deltas
        point = points.point
        if life is None:
            assert point is not None
            return point
        assert life.feed is None, "a state is captured between two turns, never in the middle of one"
        if point is not None and stands_at(points, life.turn, live=life.is_live):
            return point
        if life.spoiled is not None:
            return self._stay(life)
        actor: Any = life.cell.actor
        if has_deltas and point is not None and takes_delta(points):
            delta = encode_value(actor.get_delta(), where=f"{self.address}.get_delta()")
            made = point_of(life, point.data, [*point.deltas, delta])
        else:
            made = self._whole(life)
        points.go_on_to(made)
        self._note_names(life, made)
        life.is_touched = False
        return made

    def _whole(self, life: ServerLife) -> ServerState:
        actor: Any = life.cell.actor
        point = self.points.point
        data = self._images.take(actor, None if point is None else point.data)
        if self.state.has_deltas:
            actor.get_delta()
        return point_of(life, data, [])

    def _note_names(self, life: ServerLife, made: ServerState) -> None:
        self.points.names = names = names_of_state(life.cell.actor)
        if names is not None:
            made.absent = sorted(life.begun_names - names)

    def take_in_hooks(self, life: ServerLife) -> None:
        """What the hooks of a new life have done to the state is part of what its next turns begin from, in all runs.

        At once, before whatever the hooks have begun can end the life: its next one would come to the same.
        """
        is_before = bool(self.points.tail) and not life.is_live  # What was handed over comes first.
        if not life.is_touched or is_before or life is not self.life:
            return
        if self.state.is_as_given or not self.state.has_access:
            return
        try:
            made = self._whole(life)
        except Exception as error:  # What the user's own values and methods raise.
            self._spoil(life, error)
            return
        life.is_touched = False
        self.points.stand_changed(made)
        self._note_names(life, made)

    def _spoil(self, life: ServerLife, error: Exception) -> None:
        """The hooks of a life have left what is no state: that is told, and the state before them stays.

        Nothing is run in this life: it would stand on what nobody else can have. Whoever asks gets the error.
        """
        if not life.is_live:
            return  # What follows may yet make a state of it: else the part that comes to this fails.
        self.tell_more(Unsaved(str(error)))
        if self.state.is_lazy or self.points.point is None or self.points.tail:
            return
        life.spoiled = error
        self._stay(life)

    def _stay(self, life: ServerLife) -> ServerState:
        """Have the state of the point behind what this life has counted and not run."""
        point = self.points.point
        assert point is not None
        made = point_of(life, point.data, point.deltas)
        made.absent = point.absent
        self.points.stay(made)
        return made

    def state_digest(self) -> bytes:
        """A digest of the state after the last turn, the same on each replica. Only between two turns.

        Raises:
            UnsavableValue, StateMismatch, what `get_state` raises: it cannot be saved.
        """
        assert self.life is not None
        return digest_of_life(self.life)

    def readdress(self, cell: Cell, was: str, now: str) -> None:
        """Take the state down: what was handled before is not run again under another address."""
        if self.standing.link is not None:
            self.standing.link.readdress(self.standing.address)
        life = self.life
        if life is not None:
            life.readdress()
        if life is None or life.feed is not None or not self.points.tail:
            return
        try:
            self.capture()
        except Exception:  # What the user's own values and methods raise: it is told that no replica can take it.
            self._go_on_without_point([])

    def rewind(self, point: ServerState) -> None:
        """Put the state of a point back, in place: the actor's object goes on. Only between two turns."""
        life = self.life
        assert life is not None
        assert life.feed is None
        begin = time.perf_counter()
        rewind_to(life, point, self.points.names, has_deltas=self.state.has_deltas)
        self.standing.server.took(time.perf_counter() - begin, point.data.size)
        self.points.go_back_to(point)
        life.is_touched = False

    def took(self, seconds: float, size: int) -> None:
        """The state was gone through to compare runs: tell, once, if that takes long."""
        if seconds > COSTLY and not self._is_costly:
            self._is_costly, standing = True, self.standing
            standing.node.emit(ProtectionCostly(standing.address, standing.path, seconds, size))

    async def _go_back_to(self, point: ServerState) -> None:
        """Have the life stand at a point: the one that there is, or one that begins there."""
        if self.life is None:
            self.points.go_back_to(point)
            await self.ensure_as_given()
        else:
            self.rewind(point)

    def skip_to(self, turn: int) -> None:
        """These numbers are used, though no turn has left anything."""
        if self.life is not None and self.points.point is not None:
            self.life.turn = turn
            self.points.skip_to(turn)

    async def adopt(self, state: ServerState) -> None:
        """Go on from this state, with a life of its own; what led to it has happened elsewhere."""
        live = state.live or (self.life is not None and self.life.is_live)
        self.state.is_work_lost = (
            self.standing.leads
        )  # What the turns that lead there have begun, they began elsewhere.
        await self.drop_life()
        confirmed = self.state.confirmed
        self.install(msgspec.structs.replace(state, live=live))
        self.state.confirmed = confirmed  # The part that has led there is not at home yet: nothing may overtake it.
        await self.ensure()

    # -- turns ------------------------------------------------------------------------------------------------------

    def runs_alone(self, request: Request) -> bool:
        """Whether a request has to stand at the front: it may want something released before its end."""
        return runs_alone(self.state, request.feed, leads=self.standing.leads, has_work=self._has_work)

    async def run_part(self, pending: deque[Request]) -> list[TurnEnd]:
        """Run requests until enough are done; returns their ends. What has not been run is left in `pending`."""
        begin, state, attempts = time.perf_counter(), self.state, self.attempts
        part = self.part = BatchPart(pending)
        while not state.is_over:
            if self.traces.taken:
                part.leave_out(self.traces.taken)
            if not pending:
                break
            if pending[0].feed.id in attempts.owed and not self.only_computes:
                if part.begun:
                    break  # What came before it has happened, and its failure comes behind that.
                await self._fall_to(pending[0])
            is_new = self.life is None
            if self.only_computes or attempts.is_undone:  # Hooks have counted in the first run, if they have.
                await self.ensure_as_given()
            else:
                await self.ensure()
            attempts.is_undone = False
            if self.life is None:  # It was dropped again: another state is put here.
                part.give_up()
                break
            brings = is_new and not state.is_again and (self.reports.is_snapshot_wanted or self.has_returned)
            if brings and pending[0].feed.id not in attempts.skips:
                break  # What its hooks have left goes home before anything that stands on it.
            if brings:  # What has failed ends by itself, and all that is said of the last life stands behind its end.
                attempts.singles = max(attempts.singles, 1)
            chunk = next_requests(state, part, attempts, leads=self.standing.leads, has_work=self._has_work)
            if not chunk:
                break  # It runs alone, when home has all that comes before it.
            part.begun += chunk
            if self.life.spoiled is not None:
                for one in chunk:
                    attempts.skips.setdefault(one.feed.id, self._failure(one, self.turn, self.life.spoiled))
            at = time.perf_counter()
            why = await self._give((one.feed, attempts.skips.get(one.feed.id)) for one in chunk)
            while why is BLOCKED:
                why = await self._blocked()
            if why is OVER:
                attempts.crashes = 0
                now = time.perf_counter()
                attempts.size = size_after(attempts.size, len(chunk), now - at)
                if (now - begin > PART and not state.is_again) or part.is_cut or brings:
                    break
                if pending and self.life is None and not self._goes_on([], self._rest.missed or ENDED):
                    break  # It has ended between two turns, and with it what the first ones have left.
            elif why is UNDONE:
                attempts.is_undone = True
                self._take_back()
            elif not self._goes_on(chunk, why):
                break
        ends, part.ends = part.ends, []
        return ends

    async def _fall_to(self, request: Request) -> None:
        """End the life in which a request has come to its turn again that has failed: the next one recovers from that.

        What its hooks do stands behind all that was handled before the failure, wherever the part has begun.
        """
        self.attempts.owed.discard(request.feed.id)
        if request.feed.id in self.attempts.skips:
            async with self._beginning:  # Whoever wants a life meanwhile has the next one.
                await self.drop_life()

    def forget_objections(self) -> None:
        """What hooks have against requests is known to whoever decides; a failure that is still to come is not."""
        found, owed = self.traces.objections, self.attempts.owed
        self.traces.objections = {number: why for number, why in found.items() if number in owed}

    async def _run_part_again(self, pending: deque[Request], *, single: bool) -> list[TurnEnd]:
        """Nothing of the last part has happened: run it, and no more, again. `single`: one request at a time."""
        if single:
            self.attempts.singles = len(self.part.begun)
        behind = list(pending)
        pending.clear()
        self._take_back()
        ends = await self.run_part(pending)
        if not self.part.is_given_up:
            pending.extend(behind)
        return ends

    def _take_back(self) -> None:
        """Nothing of this part has happened: the life, which has ended, begins again where it began.

        Somebody else may have begun it already: that one is as good, and it must not be begun twice.
        """
        self.part.take_back()
        self.traces.withheld = []
        self.reports.take_back(self.points.turn)

    def _goes_on(self, chunk: list[Request], why: str) -> bool:
        """The life has ended in the middle of a part. Whether to go on."""
        part, attempts, points = self.part, self.attempts, self.points
        failed, attempts.failed = attempts.failed, None
        then = after_end(self.state, part, failed, why, has_point=points.point is not None)
        if then is GIVE_UP:
            part.give_up()
        if then not in (REWIND, GO_ON):
            return False
        if failed is None:
            self._note_crash()
            attempts.singles = len(part.begun)  # What has ended it may do so again before all of it is sealed.
            self.state.wants_life |= self.state.is_again
        else:
            attempts.crashes = 0
            attempts.skips[failed] = part.ends[-1]
        if then is REWIND:
            if failed is not None and failed != part.begun[0].feed.id and not self.only_computes:
                attempts.owed.add(failed)
                attempts.is_undone = True
            self._take_back()
            return True
        known = {end.id for end in part.ends}
        part.send_back({one.feed.id for one in chunk if one.feed.id not in known})
        self.state.start_turn = max(self.state.start_turn, part.ends[-1].turn if part.ends else -1)
        points.point = None
        return True

    async def seal_part(self, ends: list[TurnEnd], pending: deque[Request]) -> list[TurnEnd]:
        """End a part that was run: it is not undone any more. Returns its ends as they are after that.

        What its turns have left may turn out to be no state that can be saved. The turn that has left it so fails:
        whoever asked gets the error, and the state goes back to where it was before. It must never end the replica:
        its successor would be given the same request, and end too.
        """
        while True:
            begun, tail = list(self.part.begun), list(self.points.tail)
            has_run = any(one.feed.id not in self.attempts.skips for one in begun)
            if begun and self._is_unseen():
                self._note_crash()
                ends = await self._run_part_again(pending, single=True)
                continue
            try:
                self._seal(ends)
            except Exception as error:  # What the user's own values and methods raise; it is passed on to who asked.
                self.part.begun, self.points.tail = begun, tail
                if self.state.is_lazy:
                    self._go_on_without_point(ends)
                    return ends
                if self.points.point is None or not has_run:
                    raise  # What `on_start` has left, and no turn.
                if len(begun) == 1 and self.life is not None and self.life.cell.actor is not None:
                    self._fail(begun[0], ends[-1], error)
                # Under replay what `on_start` has done stands before the part, and may be what cannot be saved.
                self.attempts.is_undone = len(begun) > 1 and self.life is not None and self.life.is_live
                await self.drop_life()
                ends = await self._run_part_again(pending, single=len(begun) > 1)
            else:
                return ends

    def _is_unseen(self) -> bool:
        """Whether the life has ended since it ran the part, and with it the state that is to be taken."""
        state = self.state
        is_needed = state.has_access and not state.is_lazy
        return self.life is None and is_needed and not (state.is_over or state.is_stopping)

    def _seal(self, ends: list[TurnEnd]) -> None:
        life, points = self.life, self.points
        begun, self.part.begun = self.part.begun, []
        if begun:  # Else those that have failed are still to be told.
            self.attempts.skips = self.attempts.still_owed()
        if self.state.is_over:
            return
        if life is None:
            points.keep_tail(begun, ends)
            return
        if not self.state.has_access:
            self.state.start_turn = life.turn
            self.traces.forget(life.turn)
            return
        before = points.point
        points.keep_tail(begun, ends)
        is_lazy = self.state.is_lazy and not life.has_begun_tasks  # They would be begun again with their turns.
        if not needs_point(points, is_lazy=is_lazy, live=life.is_live):
            return
        life.has_begun_tasks = False
        handed = [one for one, _ in points.tail]
        self.capture()
        if before is not None and handed:
            points.previous = before, handed
        self.traces.forget(-1 if before is None else before.turn)

    def _go_on_without_point(self, ends: list[TurnEnd]) -> None:
        """Nobody looks at the state now: what is handled goes on; but no other replica can take it."""
        begun, self.part.begun = self.part.begun, []
        self.points.keep_tail(begun, ends)
        standing = self.standing
        if self.state.can_save:
            self.state.can_save = False
            standing.node.emit(ProtectionLost(standing.address, standing.path, standing.epoch))

    def _fail(self, request: Request, end: TurnEnd, error: BaseException) -> None:
        """This turn has left what is no state: run again, it fails."""
        self.attempts.skips[end.id] = self._failure(request, end.turn, error)

    def _failure(self, request: Request, turn: int, error: BaseException) -> TurnEnd:
        codec = self.standing.node.codec
        answer = Answer(*codec.encode_error(error)) if request.feed.is_ask else Answer()
        return TurnEnd(turn, request.feed.id, FAILED, [], answer)

    def _returned(self) -> list[Feed]:
        life, point = self.life, self.points.point
        if life is not None:
            return [fed.feed for fed in life.returned.values()] if life.is_live else []
        if point is None or not point.live:
            return []
        handled = {one.feed.id for one, _ in self.points.tail}
        return [feed for feed in point.returned if feed.id not in handled]

    @property
    def has_returned(self) -> bool:
        """Whether something was put aside, is put back, and has not been handled since."""
        return bool(self._returned())

    def is_returned(self, number: int) -> bool:
        """Whether a request was put aside, is put back, and has not been handled since."""
        return any(feed.id == number for feed in self._returned())

    def returned_first(self, pending: deque[Request]) -> deque[Request]:
        """What was put aside and is put back is handled before anything else, each once."""
        feeds = [] if self.state.is_over else self._returned()
        if not feeds:
            return pending
        numbers, begun = {feed.id for feed in feeds}, self.state.begun
        first = [Request("", 0, feed) for feed in feeds]
        both = [*first, *(one for one in pending if one.feed.id not in numbers)]
        if begun >= 0 and all(one.feed.id != begun for one in both):
            return pending  # It is on its way.
        return deque(sorted(both, key=lambda one: one.feed.id != begun))  # What has sent something comes before all.

    def note_batch(self, work: Work) -> None:
        """A batch has come: the results that it brings, and the request that had begun."""
        self.traces.note_results(work.requests)
        if work.go is not None and work.go.begun >= 0:
            self.state.begun = work.go.begun
        for one in work.requests:
            if one.feed.has_begun:
                self.state.begun = one.feed.id

    def has_taken(self, request: Request) -> bool:
        """Whether the life has a request without an end: its stash has it, a turn has waited for it, or it is a tick.

        (Of a cancelled timer.)
        """
        life, number = self.life, request.feed.id
        if life is None or request.feed.kind == TICK or number in self.traces.taken:
            return True
        return number in life.returned or any(fed.feed.id == number for fed in life.stash)

    def end_turn(self, number: int, *, again: bool) -> None:
        """The turn of this input hangs: if it is in hand, it has failed, as if its handler had raised.

        `again`: it has not, but begins again, from the state before (if that is known).
        """
        life, cell = self.life, self.cell
        if cell is None or life is None or life.feed is None or life.feed.id != number:
            return
        if not again or not self.state.has_access:
            life.fail_turn(TimeoutError(f"the turn of {life.feed.name} does not end"))
        self.kill(cell)

    # -- the front --------------------------------------------------------------------------------------------------

    def wants_out(self, life: ServerLife) -> None:
        """A turn wants its outputs to leave before it ends."""
        if life is not self.life:
            return
        state, leads = self.state, self.standing.leads
        if (state.is_quiet or state.is_again or not leads) and self._hears_as_before(life):
            return
        if is_front(state, self.part, leads=leads):
            self._let_out(life)
            return
        if not leads:  # The leader has sent it; we may have to, when we lead.
            self.traces.withheld += life.outs
            life.hold_back()
        life.cell.node.loop.call_soon(self._look, life, life.feed)

    def _hears_as_before(self, life: ServerLife) -> bool:
        """Have a turn hear what its asks came to when it was run before, if that is known: they do not leave again."""
        known = known_outcomes(self.traces, life.turn, life.outs)
        if known is None:
            return False
        life.hold_back()
        for one in known:
            life.to_life(one)
        return True

    def _let_out(self, life: ServerLife) -> None:
        """What has left cannot be undone: the part ends with this turn, whatever was to come after it."""
        self._cut_part(life)
        life.release_now()

    def puts_back(self, life: ServerLife) -> None:
        """A turn has put back what was put aside: that comes next, and may want something released before its end."""
        if life is self.life and life.feed is not None and not self.state.is_quiet:
            self._cut_part(life)

    def _cut_part(self, life: ServerLife) -> None:
        """The part ends with the turn in hand, whatever was to come after it."""
        self.part.is_cut = True
        queue, left = mailbox.queue_of(life.cell), set[int]()
        for index, item in enumerate(queue):
            if isinstance(item, Fed) and item.life is life:
                left.add(item.feed.id)
                queue[index] = mailbox.NOTHING  # Not removed: the run loop has counted them.
        if left and life.feed is not None:
            self.part.send_back(left)

    def _look(self, life: ServerLife, feed: Feed | None) -> None:
        """A turn that is not at the front has wanted to release something: does it wait for that?"""
        if self.life is life and life.feed is feed:
            self._rest.reach(BLOCKED)

    async def _blocked(self) -> str:
        """The turn in hand waits for what it has not been allowed to send."""
        life, state, standing = self.life, self.state, self.standing
        feed = None if life is None else life.feed
        if life is None or feed is None or self._rest.missed is not None:
            return await self._rest.wait_on()  # It has its outcome meanwhile.
        looks_at_state = standing.leads or not state.is_lazy  # Somebody does, when outcomes are handed over.
        if looks_at_state and self.part.ends and state.has_access and not state.is_again:
            state.alone.add((feed.kind, feed.name))
            await self.drop_life()
            return UNDONE
        resting = self._rest.wait_on()
        if not state.is_again:
            leads = standing.leads
            await self._hand_over_before()
            if standing.leads and not leads:  # Since then: home has to have what was handed over before.
                await self._hand_over_before()
        if standing.leads and self.life is life and life.feed is feed:
            if self.traces.withheld:  # What the last leader may have sent, and may not.
                life.take_again(self.traces.withheld)
                self.traces.withheld = []
            if life.outs:
                self._let_out(life)
        return await resting

    async def _hand_over_before(self) -> None:
        """Hand over the ends before the turn in hand, while it stands still."""
        if self._driver is None:
            return
        handed, ends = self.part.hand_out()
        self.points.keep_tail(handed, ends)
        if ends or (self.standing.leads and self.state.confirmed < self.state.handed):
            await self._driver.hand_over_before(ends, self.standing.leads)

    def lead(self) -> None:
        """A turn that waits for an outcome may ask for it itself, when home has what comes before it."""
        life = self.life
        if life is not None and life.feed is not None and self.traces.withheld:
            self._look(life, life.feed)

    # -- the last part once more -----------------------------------------------------------------------------------

    async def run_again(self, before: ServerState, requests: list[Request]) -> list[TurnEnd]:
        """Rewind to an earlier state, and run requests from there again; returns their ends.

        Nothing is handed over. Asks get the outcomes that they had.
        """
        previous = self.points.previous
        self.forget_objections()
        await self._go_back_to(before)
        self.traces.withheld = []
        self.state.is_again = True
        try:
            ends = await self._run_all(requests, even_stopping=True)
        finally:
            self.state.is_again = False
        await self.ensure_as_given()
        owed = self.attempts.still_owed()
        skips, self.attempts.skips = len(self.attempts.skips) - len(owed), owed
        try:
            self.capture()
        except BaseException as error:  # What the user's own values and methods raise: as when a part is sealed.
            if len(requests) != 1 or len(ends) != 1 or skips:
                raise
            self._fail(requests[0], ends[0], error)
            await self.drop_life()
            return await self.run_again(before, requests)
        self.points.previous = previous
        return ends

    async def _run_all(self, requests: list[Request], *, even_stopping: bool) -> list[TurnEnd]:
        """Run requests, part by part, until all have ended. `even_stopping`: also when the life is ended meanwhile."""
        pending, ends = deque(requests), list[TurnEnd]()
        while pending and not self.state.is_over and (even_stopping or not self.state.is_stopping):
            new = await self.run_part(pending)
            self.points.keep_tail(self.part.begun, new)
            ends += new
            asked = {one.feed.id for one in pending}
            if any(feed.id not in asked for feed in self._returned()):
                break  # That is to be handled first.
        return ends

    # -- as the port home -------------------------------------------------------------------------------------------

    def to_home(self, record: ToHome) -> None:
        """What the life says, in order."""
        match record:
            case TurnEnd():
                self.traces.withheld = []
                if self.state.is_quiet:
                    return
                if self.life is not None and self.life.is_live and not self.state.is_again:
                    self.state.begun = -1
                if record.id not in self.attempts.skips:
                    for hook in self.hooks:
                        record = hook(self, record)
                    if record.status == FAILED:
                        self.attempts.failed = record.id
                self.part.ends.append(record)
            case Released() | Performed() | Retried() | GivenUp() | Unreadable():
                if self._driver is not None:
                    self._driver.tell_outward(record)
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
        """The life is over, and nobody here has ended it: from now on there is none."""
        life, cell = self.life, self.cell
        if life is not None and cell is not None:
            self._life_ended(life, cell.extra().reason)

    def inward(self, record: PastInputs) -> None:
        """Take what came from home past the bricks."""
        if isinstance(record, Outcome):
            self.traces.hear(record)
        if isinstance(record, SnapshotNow):
            self.want_snapshot()
        elif self.life is not None:
            self.life.to_life(record)

    # -- what goes home beside the ends of turns ---------------------------------------------------------------------

    def tell_more(self, record: Beside) -> None:
        """Something goes home behind the ends of the part at hand, or by itself."""
        if self._driver is not None:
            self.reports.more.append(record)
            self._driver.go_on()

    def take_more(self) -> list[Beside]:
        """What goes home behind the ends that are handed over now."""
        more, self.reports.more = self.reports.more, []
        return more

    def take_wanted_snapshot(self) -> None:
        """Save the state for home, if it wants that; only when it is decided that this is the state."""
        if self.reports.is_snapshot_wanted:
            self._take_snapshot()

    def tell_of_hooks(self, turn: int) -> None:
        """To a home that has all turns up to this one: hooks have changed the state here, and no replay leads to that.

        The last leader has told it of its own, if it has come to that: a failure may be known here alone.
        """
        if self.points.untraced >= max(turn - 1, 0):
            self.want_snapshot()

    def want_snapshot(self) -> None:
        """A snapshot goes home behind the part in hand, or at once."""
        if self._driver is not None:
            self.reports.is_snapshot_wanted = True
            self._driver.go_on()

    def last_snapshot(self) -> None:
        """The life ends in good order."""
        if self._driver is not None:
            self.reports.is_snapshot_wanted = True
            self._take_snapshot()
            self._driver.go_on()

    def _take_snapshot(self) -> None:
        life, reports = self.life, self.reports
        if life is None or life.pipes or life.feed is not None or not life.is_live or not self.method.snapshots:
            return
        reports.is_snapshot_wanted = False
        try:
            reports.more += snapshot_of(life, self.points)
        except Exception as error:  # What the user's own `get_state` raises is no reason to lose what it has.
            reports.more.append(Unsaved(str(error)))

    def copied(self) -> list[Snapshot]:
        """The state as it is between two turns, for a home that keeps nothing otherwise; [] if it cannot be had."""
        life, state, reports = self.life, self.state, self.reports
        if life is None or life.feed is not None or not life.is_live or not state.has_access or reports.is_large:
            return []
        try:
            found = snapshot_of(life, self.points)
        except Exception:  # What the user's own `get_state` raises: there is no copy then.
            return []
        reports.is_large = sum(len(one.data) for one in found) > MOST_COPIED
        return [] if reports.is_large else found
