"""The life of a recorded actor, wherever it is lived: one turn per input that its home feeds, each reported.

Replay is not a mode here: the home feeds what was handled before in the same order, and drops what it has released
already. Only time and randomness come from the input instead of the world.
"""

from __future__ import annotations

import asyncio
import dataclasses
import random
import time
import types
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from ..actors import lives, mailbox
from ..actors.actor import Actor, Start
from ..actors.cell import RUNNING, Cell
from ..actors.context import ActorContext, StashError
from ..actors.errors import BadMessage, ControlFailed, HoldfastError, RemoteCrash, StartFailed, remote_crash
from ..actors.exits import NORMAL, ExitReason, unpack_exit
from ..actors.links import Monitor
from ..actors.mail import LEAVE, Item, ReplyHandle
from ..actors.message import Message, Refusal, message_name
from ..actors.ref import ActorRef, current
from .keys import restore_state, save_state
from .records import (
    CRASH,
    DROPPED,
    FAILED,
    LATER,
    OK,
    REPLY,
    START,
    STASHED,
    Answer,
    Feed,
    Go,
    Live,
    Out,
    Outcome,
    PipeDone,
    Released,
    Restore,
    Snapshot,
    SnapshotNow,
    ToHome,
    ToLife,
    TurnEnd,
    Unsaved,
    pieces,
)

if TYPE_CHECKING:
    from ..actors.control.calls import Call
    from ..actors.node import Node

T = TypeVar("T")
R = TypeVar("R")
Coroutine_ = types.CoroutineType


class HomePort(Protocol):
    """The way home."""

    def to_home(self, record: ToHome) -> None:
        """Hand a record to the home; it is handled in order."""
        ...

    def closed(self) -> None:
        """The life is over."""
        ...


class Life:
    """One recorded life: the turn in hand, its outputs, and when the next snapshot is due."""

    def __init__(self, cell: Cell, port: HomePort, interval: float, page: memoryview | None) -> None:
        self.cell, self.port, self.interval, self.page = cell, port, interval, page
        self.turn = 0
        self.feed: Feed | None = None
        self.outs: list[Out] = []
        self.last_k = 0
        self.asks: dict[tuple[int, int], tuple[asyncio.Future[Any], type[Message[Any]]]] = {}
        self.pipes = 0
        self.stash: list[Fed] = []
        self.returned: dict[int, Fed] = {}
        self.gone: tuple[int, ...] = ()
        self.cancelled: set[str] = set()  # timers whose ticks may still be on their way
        self.stop_wanted: ExitReason | None = None
        self.postponed: list[Item] = []  # orders from outside that wait until it is live
        self.is_live = False
        self.has_replayed = False
        self.in_hook = False
        self._snapshot_turn = -1
        self._state: list[bytes] = []
        self._has_state = False
        self._restore_seconds = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._snapshot_wanted = False

    # -- beginning --------------------------------------------------------------------------------------------------

    def begin(self, start: Start[Any], turn: int, stash: list[int]) -> None:
        """Construct the actor and put its state back, if there is any; inputs may be fed from now on.

        Raises:
            StartFailed: `__init__` or the restoring raised.
        """
        cell = self.cell
        cell.life += 1
        lives.build(cell, start, self._context)
        actor = cell.actor
        assert actor is not None
        self.turn = turn
        if self._has_state:
            begin = time.perf_counter()
            try:
                restore_state(actor, b"".join(self._state))
            except Exception as error:
                self._context_made.close()
                cell.actor = cell.ctx = None
                raise StartFailed(cell.path, f"its state could not be restored: {error}") from error
            self._restore_seconds = time.perf_counter() - begin
            self._snapshot_turn = turn
        self._state.clear()
        self._stashed_ids = frozenset(stash)
        cell.state = RUNNING
        if self._has_state and start.kind.on_start is not Actor.on_start:
            mailbox.queue_of(cell).append(Hook(self, "on_start"))
        lives.up(cell)

    def _context(self, cell: Cell) -> RecordedContext:
        """Made before `__init__` runs: that may use `ctx` already."""
        self._context_made = RecordedContext(cell)
        self._context_made.recorded = self
        return self._context_made

    # -- records from home ------------------------------------------------------------------------------------------

    def from_home(self, record: ToLife) -> None:
        """Take what the home says, in order."""
        match record:
            case Feed():
                self._take(record)
            case Outcome():
                self._outcome(record)
            case Go():
                self._queue(GoLive(self, record))
            case SnapshotNow(at_once=True):
                self._snapshot_wanted = True
                self._queue(TakeSnapshot(self))
            case SnapshotNow():
                self._snapshot_turn = -2  # no turn: the next one that is due is taken
            case Restore():
                self._has_state = True
                self._state.append(record.data)

    def _take(self, feed: Feed) -> None:
        cell = self.cell
        returned = self.returned.pop(feed.id, None)
        if returned is not None:
            fed = Fed(self, feed, returned.message, returned.sender)
        else:
            sender = None if feed.sender is None else cell.node.cell_at(feed.sender)
            fed = Fed(self, feed, None, sender)
        if feed.origin and feed.origin in self.cancelled and feed.turn < 0:
            return  # Its timer was cancelled while it was on its way; the home drops it too.
        if feed.id in self._stashed_ids and feed.turn < 0 and not self.is_live:
            self.stash.append(fed)
            return
        self._queue(fed)

    def _queue(self, item: Item) -> None:
        mailbox.queue_of(self.cell).append(item)
        self.cell.schedule()

    def _outcome(self, record: Outcome) -> None:
        waiting = self.asks.pop((record.turn, record.k), None)
        if waiting is None:
            return
        future, kind = waiting
        if future.done():
            return
        answer, codec = record.answer, self.cell.node.codec
        try:
            if answer.kind == REPLY:
                future.set_result(codec.decode_reply(kind, answer.body))
            else:
                future.set_exception(codec.decode_error(answer.kind, answer.name, answer.body))
        except Exception as error:
            future.set_exception(BadMessage("reply", message_name(kind), str(error)))

    # -- turns ------------------------------------------------------------------------------------------------------

    def open_turn(self, feed: Feed) -> None:
        """A turn begins; a replayed one gets the number it had."""
        if feed.turn >= 0:
            self.turn, self.has_replayed = feed.turn, True
        else:
            self.turn += 1
        self.feed, self.outs, self.last_k = feed, [], 0
        if self.page is not None:
            self.page[0] = feed.id + 1

    def close_turn(self, status: str, answer: Answer) -> None:
        """A turn has ended: report it, with what it sent."""
        feed = self.feed
        if feed is None:
            return  # The life was abandoned in this very turn: what it says does not count.
        self.feed = None
        self.port.to_home(TurnEnd(self.turn, feed.id, status, self.outs, answer))
        self.outs = []
        if self.page is not None:
            self.page[0] = 0

    def fail_turn(self, error: BaseException) -> None:
        """The turn raised: what it has not released is dropped, its asker gets the error."""
        feed = self.feed
        if feed is None:
            return
        self.outs = []
        self.in_hook = True  # What is left is `on_stop`.
        crash = remote_crash(error)
        self.close_turn(FAILED, self.answer_error(crash) if feed.is_ask else Answer())

    def answer_error(self, error: BaseException) -> Answer:
        """An error as the asker will get it."""
        return Answer(*self.cell.node.codec.encode_error(error))

    def answer_value(self, value: object) -> Answer:
        """A reply as the asker will get it; one that cannot be coded becomes the asker's error."""
        try:
            return Answer(REPLY, "", self.cell.node.codec.encode(value, self.cell.path))
        except BadMessage as error:
            return self.answer_error(BadMessage("reply", error.message, error.problem))

    def put(
        self, verb: str, to: str, name: str = "", body: bytes = b"", *, seconds: float = 0.0, interval: float = 0.0
    ) -> int:
        """One more output of the turn in hand; returns its number.

        Raises:
            HoldfastError: no turn is in hand.
        """
        if self.feed is None:
            raise HoldfastError(f"{self.cell.path}: only a turn can do this, not a hook or a background task")
        self.last_k = k = self.last_k + 1
        self.outs.append(Out(k, verb, to, name, body, seconds, interval))
        return k

    def cancel_timer(self, key: str) -> None:
        """Ticks that are queued here, or on their way, are dropped here and at home."""
        self.put("cancel", key)
        self.cancelled.add(key)
        queue = mailbox.queue_of(self.cell)
        for index, item in enumerate(queue):  # Not removed: the run loop has counted them.
            if type(item) is Fed and item.feed.origin == key and item.feed.turn < 0:
                queue[index] = mailbox.NOTHING

    def release(self) -> None:
        """What this turn has sent so far leaves now."""
        feed = self.feed
        if feed is not None and self.outs:
            self.port.to_home(Released(self.turn, feed.id, self.outs))
            self.outs = []

    # -- snapshots --------------------------------------------------------------------------------------------------

    def go_live(self) -> None:
        """Replay is over."""
        self.is_live = True
        self.stash = [fed for fed in self.stash if fed.feed.id not in self.gone]
        for key in self.gone:
            self.returned.pop(key, None)
        if self.returned:  # Unstashed under replay, and not handled before the crash: they come first.
            queue = mailbox.queue_of(self.cell)
            queue.extendleft(reversed(self.returned.values()))
            self.returned.clear()
        self.port.to_home(Live(self._restore_seconds))
        if self.has_replayed and self.interval > 0:  # A crash loop must not have to replay the same turns for ever.
            self.cell.urge(TakeSnapshot(self))
        self._arm()
        postponed, self.postponed = self.postponed, []
        for call in postponed:
            self.cell.urge(call)
        if self.stop_wanted is not None:
            self.cell.request_stop(self.stop_wanted)

    def _arm(self) -> None:
        if self.interval > 0:
            self._timer = self.cell.node.loop.call_later(self.interval, self._due)

    def _due(self) -> None:
        if self.turn != self._snapshot_turn or self._snapshot_wanted:
            self.cell.urge(TakeSnapshot(self))
        self._arm()

    def take_snapshot(self) -> None:
        """Save the state after the last turn; while background work is out, its turn must stay in the journal."""
        if self.pipes or self.turn == self._snapshot_turn or not self.is_live:
            return
        actor = self.cell.actor
        assert actor is not None
        begin = time.perf_counter()
        try:
            data = save_state(actor)
        except Exception as error:  # What the user's own `get_state` raises is no reason to lose what it has.
            self.port.to_home(Unsaved(str(error)))
            return
        self._send_snapshot(data, begin)

    def may_replace(self) -> str:
        """Why the state cannot be replaced from outside now; "" if it can: a snapshot has to follow at once."""
        return "background work (pipe_to_self) is out; try again when it is back" if self.pipes else ""

    def replaced(self) -> None:
        """The state was replaced from outside, in no turn: only a snapshot can bring it back.

        Raises:
            UnsavableValue, StateMismatch, what `get_state` raises: it cannot be saved.
        """
        actor = self.cell.actor
        assert actor is not None
        begin = time.perf_counter()
        self._send_snapshot(save_state(actor), begin, is_replaced=True)
        if self._snapshot_turn != self.turn:  # A home in another process says so later, and ends this life.
            raise ControlFailed(self.cell.path, "replace_state", "the new state could not be saved")

    def _send_snapshot(self, data: bytes, begin: float, *, is_replaced: bool = False) -> None:
        stash = [fed.feed.id for fed in self.stash]
        pause = time.perf_counter() - begin
        parts = pieces(data)
        self._snapshot_turn = self.turn  # Before it is sent: a home in this process says at once if it cannot keep it.
        self._snapshot_wanted = False
        for index, part in enumerate(parts, 1):
            self.port.to_home(Snapshot(self.turn, part, index == len(parts), stash, pause, is_replaced))

    def close(self) -> None:
        """The life is over."""
        if self._timer is not None:
            self._timer.cancel()
        for future, _ in self.asks.values():
            future.cancel()
        self.asks.clear()
        for call in self.postponed:  # The next life's.
            self.cell.urge(call)
        self.feed, self.outs = None, []  # A turn that swallows its cancellation cannot speak for the next life.
        self.port.closed()


class Fed(Item):
    """An input in the mailbox of its life."""

    __slots__ = ("feed", "is_stashed", "life", "message", "sender")

    def __init__(self, life: Life, feed: Feed, message: Any, sender: Cell | None) -> None:
        self.life, self.feed, self.message, self.sender = life, feed, message, sender
        self.is_stashed = False

    @property
    def chain(self) -> tuple[tuple[str, int], ...]:
        """Who waits for this turn."""
        return self.feed.chain

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        life: Life = item.life
        feed: Feed = item.feed
        life.open_turn(feed)
        if feed.deadline and feed.deadline <= life.cell.node.loop.time() and feed.turn < 0:
            life.close_turn(DROPPED, Answer())  # Nobody waits any more.
            return None
        if item.message is None and feed.name:
            try:
                item.message = life.cell.node.codec.message_in(life.cell, feed.name, feed.body)
            except HoldfastError as error:  # It came encoded, and is none of ours.
                life.close_turn(DROPPED, life.answer_error(error) if feed.is_ask else Answer())
                return None
        try:
            result = item.call(actor)
        except Refusal as no:
            item.refuse(no)
            return None
        if type(result) is Coroutine_:
            return item.finish(result)
        item.end_with(result)
        return None

    def call(self, actor: Any) -> Any:
        """Call the handler or hook that this input is for."""
        feed = self.feed
        node: Node = self.life.cell.node
        match feed.kind:
            case "start":
                return actor.on_start(False)
            case "exit":
                data = node.codec.decode(dict[str, Any], feed.body)
                reason, more = unpack_exit(data["reason"]), self.life.cell.more
                if more is not None and more.trap_exits:
                    return actor.on_exit(node.cell_at(data["source"]).ref, reason)
                if reason != NORMAL:
                    actor.ctx.stop(reason)
                return None
            case "down":
                data = node.codec.decode(dict[str, Any], feed.body)
                return actor.on_down(
                    node.cell_at(data["source"]).ref, unpack_exit(data["reason"]), bool(data["recovering"])
                )
            case "pipe" if not feed.name:
                error = node.codec.decode_error(CRASH, "", feed.body)
                assert isinstance(error, RemoteCrash)
                raise error
            case _:
                return actor._table[type(self.message)](actor, self.message)

    async def finish(self, handler: Any) -> None:
        """The turn of an async handler."""
        try:
            result = await handler
        except Refusal as no:
            self.refuse(no)
        else:
            self.end_with(result)

    def refuse(self, no: Refusal) -> None:
        """The handler said no, which is an answer; nobody has asked an actor to start."""
        if self.feed.kind == START:
            raise StartFailed(self.life.cell.path, str(no)) from no
        self.end(self.life.answer_error(no) if self.feed.is_ask else Answer())

    def end_with(self, result: object) -> None:
        """The handler returned."""
        if not self.feed.is_ask:
            self.end(Answer())
        elif isinstance(result, RecordedReplyHandle):
            self.end(Answer(LATER))
        else:
            self.end(self.life.answer_value(result))

    def end(self, answer: Answer) -> None:
        """The turn is over; a stashed message stays open."""
        life = self.life
        if self.feed.kind == START and self.feed.turn < 0 and life.cell.actor is not None:
            save_state(life.cell.actor)  # What cannot be saved is refused now, not when it is needed.
        if self.is_stashed:
            life.close_turn(STASHED, Answer())
        else:
            life.close_turn(OK, answer if self.feed.is_ask else Answer())

    def fail(self, error: BaseException) -> None:
        """Called when the turn crashed the actor."""
        self.life.fail_turn(error.__cause__ or error)


class Hook(Item):
    """A hook that is no turn: called at each life, what it sends goes out at once and is not journaled."""

    __slots__ = ("life", "name")

    def __init__(self, life: Life, name: str) -> None:
        self.life, self.name = life, name

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        life: Life = item.life
        life.in_hook = True
        try:
            result = actor.on_start(True) if item.name == "on_start" else actor.on_recovered()
        except Refusal as no:  # Nobody asked: an actor that refuses to start has failed to.
            raise StartFailed(life.cell.path, str(no)) from no
        if type(result) is Coroutine_:
            return item.finish(result)
        item.over()
        return None

    async def finish(self, hook: Any) -> None:
        try:
            await hook
        except Refusal as no:
            raise StartFailed(self.life.cell.path, str(no)) from no
        self.over()

    def over(self) -> None:
        """The hook has returned."""
        self.life.in_hook = False


class GoLive(Hook):
    """Everything that was handled before has been handled again."""

    __slots__ = ("go",)

    def __init__(self, life: Life, go: Go) -> None:
        super().__init__(life, "on_recovered")
        self.go = go

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        # Turns that failed are not replayed, but their numbers are used.
        item.life.turn = max(item.life.turn, item.go.turn)
        item.life.gone = item.go.gone
        if item.go.recovered and type(actor).on_recovered is not Actor.on_recovered:
            return Hook.run(actor, item)
        item.over()
        return None

    def over(self) -> None:
        super().over()
        self.life.go_live()


class TakeSnapshot(Item):
    """A command: save the state now, between two turns."""

    __slots__ = ("life",)

    def __init__(self, life: Life) -> None:
        self.life = life

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        item.life.take_snapshot()
        return None


class StopRecorded(Item):
    """A command: end in good order, with a final snapshot."""

    __slots__ = ("life", "reason")

    def __init__(self, life: Life, reason: ExitReason) -> None:
        self.life, self.reason = life, reason

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        life: Life = item.life
        life.take_snapshot()
        life.in_hook = True
        lives.finish(life.cell, item.reason)
        return LEAVE


@dataclasses.dataclass(frozen=True)
class RecordedReplyHandle(ReplyHandle[R]):
    """The right to answer one ask of a recorded actor later; it may be kept in a key variable."""

    id: int

    def reply(self, value: R) -> None:
        """Answer, from a turn of the same actor."""
        life = _life_of_turn()
        answer = life.answer_value(value)
        life.put("reply", str(self.id), f"{answer.kind}|{answer.name}", answer.body)

    def fail(self, error: HoldfastError) -> None:
        """Answer with a Refusal or another typed error, from a turn of the same actor."""
        life = _life_of_turn()
        answer = life.answer_error(error)
        life.put("reply", str(self.id), f"{answer.kind}|{answer.name}", answer.body)


def _life_of_turn() -> Life:
    ctx = current.get(None)
    if not isinstance(ctx, RecordedContext) or not ctx.in_turn():
        raise HoldfastError("a recorded actor answers later from one of its own turns")
    return ctx.recorded


@dataclasses.dataclass(frozen=True)
class RecordedTimer:
    """A handle on a timer of a recorded actor, whose clock runs at its home; it may be kept in a key variable."""

    id: str

    def cancel(self) -> None:
        """The message does not come any more, not even one that is queued already."""
        _life_of_turn().cancel_timer(self.id)


class RecordedContext(ActorContext):
    """`self.ctx` of a recorded actor: what it does becomes an output of the turn in hand."""

    __slots__ = ("_drawn", "recorded")

    may_fail_fast = False

    recorded: Life
    _drawn: int  # the turn that `_random` belongs to

    def in_turn(self) -> bool:
        """Whether this code runs in the turn in hand, not in a background task."""
        if self.recorded.feed is None:
            return False
        try:
            task = asyncio.current_task()
        except RuntimeError:
            return True
        return task is None or task.get_name() == "holdfast runner"

    def _outside(self) -> None:
        """Hooks may send (at once, unrecorded); background tasks may not."""
        self._alive()
        if not self.recorded.in_hook:
            raise HoldfastError(
                f"{self.path}: background tasks of a recorded actor may not send; report with ctx.pipe_to_self()"
            )

    def now(self) -> float:
        feed = self.recorded.feed
        return self.cell.node.wall() if feed is None else feed.time

    @property
    def random(self) -> random.Random:
        life = self.recorded
        if self._random is None or self._drawn != life.turn:
            self._drawn = life.turn
            when = 0.0 if life.feed is None else life.feed.time
            self._random = random.Random(f"{self.path}|{life.turn}|{when}")
        return self._random

    # -- sending ----------------------------------------------------------------------------------------------------

    def tell(self, cell: Cell, message: Message[Any]) -> None:
        if not self.in_turn():
            self._outside()
            super().tell(cell, message)
            return
        self._put("tell", cell, message)

    async def send(self, cell: Cell, message: Message[Any]) -> None:
        if not self.in_turn():
            self._outside()
            await super().send(cell, message)
            return
        self._put("tell", cell, message)
        await self.flush()
        while (room := cell.room()) is not None:
            await room

    def _put(self, verb: str, cell: Cell, message: Message[Any], *, seconds: float = 0.0) -> int:
        if type(message) not in cell.table:
            cell.require(message)
        body = self.cell.node.codec.encode(message, cell.path)
        return self.recorded.put(verb, cell.path, message_name(type(message)), body, seconds=seconds)

    def ask(self, cell: Cell, message: Message[R], timeout: float) -> asyncio.Future[R]:
        if not self.in_turn():
            self._outside()
            return super().ask(cell, message, timeout)
        life = self.recorded
        k = self._put("ask", cell, message, seconds=timeout)
        future: asyncio.Future[R] = self.cell.node.loop.create_future()
        life.asks[life.turn, k] = future, type(message)
        life.release()
        return future

    def forward(self, to: ActorRef[Any]) -> None:
        fed = self.item
        if not self.in_turn() or not isinstance(fed, Fed):
            raise HoldfastError(f"{self.path}: only a message in hand can be forwarded")
        feed = fed.feed
        self.recorded.put("forward", to.path, feed.name, feed.body)

    def reply_handle(self) -> ReplyHandle[Any]:
        feed = self.recorded.feed  # Its id even if nobody waits (any more): a replay must make the same handle.
        return RecordedReplyHandle(feed.id if feed is not None else -1)

    async def publish(self, topic: str, message: Message[Any]) -> None:
        if not self.in_turn():
            self._outside()
            await super().publish(topic, message)
            return
        body = self.cell.node.codec.encode(message, topic)
        self.recorded.put("publish", topic, message_name(type(message)), body)

    async def flush(self) -> None:
        self.recorded.release()

    # -- later ------------------------------------------------------------------------------------------------------

    def _timer(self, message: Message[Any], delay: float, interval: float) -> Any:
        self.cell.require(message)
        life = self.recorded
        if not self.in_turn():
            self._outside()
        body = self.cell.node.codec.encode(message, self.path)
        k = life.put(
            "timer",
            f"{life.turn}.{life.last_k + 1}",
            message_name(type(message)),
            body,
            seconds=delay,
            interval=interval,
        )
        return RecordedTimer(f"{life.turn}.{k}")

    def tell_after(self, delay: float, message: Message[Any]) -> Any:
        return self._timer(message, delay, 0.0)

    def every(self, interval: float, message: Message[Any]) -> Any:
        return self._timer(message, interval, interval)

    def pipe_to_self(
        self,
        work: Awaitable[T],
        then: Callable[[T], Message[Any]],
        failed: Callable[[BaseException], Message[Any]] | None = None,
    ) -> None:
        life = self.recorded
        if not self.in_turn():
            self._outside()
        feed = life.feed
        k = life.put("pipe", "")
        if feed is not None and k in feed.pipes:  # Its result was journaled before the crash: it will be fed.
            if asyncio.iscoroutine(work):
                work.close()
            return
        life.pipes += 1
        tasks = self.cell.extra().tasks
        task = self.cell.node.loop.create_task(
            self._piped(life.turn, k, work, then, failed), name=f"pipe of {self.path}"
        )
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    async def _piped(self, turn: int, k: int, work: Any, then: Any, failed: Any) -> None:
        try:
            message = then(await work)
        except asyncio.CancelledError:
            raise
        except BaseException as error:
            if failed is None:  # Nobody takes the error: the actor crashes, once.
                self._piped_back(PipeDone(turn, k, "", self.cell.node.codec.encode_error(remote_crash(error))[2]))
                return
            message = failed(error)
        self._piped_back(
            PipeDone(turn, k, message_name(type(message)), self.cell.node.codec.encode(message, self.path))
        )

    def _piped_back(self, record: PipeDone) -> None:
        if not self.closed:
            self.recorded.pipes -= 1
            self.recorded.port.to_home(record)

    # -- stash, links, subscriptions --------------------------------------------------------------------------------

    def stash(self) -> None:
        fed, life = self.item, self.recorded
        if not isinstance(fed, Fed) or life.feed is None:
            raise StashError(f"{self.path}: only a message can be stashed")
        if fed.is_stashed:
            raise StashError(f"{self.path}: this message is stashed already")
        fed.is_stashed = True
        life.stash.append(fed)

    def unstash(self) -> None:
        life = self.recorded
        stash, life.stash = life.stash, []
        again = [Fed(life, once_more(fed.feed), fed.message, fed.sender) for fed in stash]
        if life.is_live:
            mailbox.queue_of(self.cell).extendleft(reversed(again))
            self.cell.schedule()
        else:
            life.returned = {fed.feed.id: fed for fed in again} | life.returned  # in front of those put back before

    def monitor(self, other: ActorRef[Any]) -> Monitor:
        self.recorded.put("monitor", other.path)
        return RecordedMonitor(self.cell, other._cell, for_good=False)

    def watch(self, other: ActorRef[Any]) -> Monitor:
        self.recorded.put("watch", other.path)
        return RecordedMonitor(self.cell, other._cell, for_good=True)

    def link(self, other: ActorRef[Any]) -> None:
        self.recorded.put("link", other.path)

    def unlink(self, other: ActorRef[Any]) -> None:
        self.recorded.put("unlink", other.path)

    def subscribe(self, topic: str) -> None:
        self.recorded.put("subscribe", topic)

    def unsubscribe(self, topic: str) -> None:
        self.recorded.put("unsubscribe", topic)

    def postpones(self, call: Call) -> bool:
        if self.recorded.is_live:
            return False
        self.recorded.postponed.append(call)
        return True

    def may_replace(self) -> None:
        problem = self.recorded.may_replace()
        if problem:
            raise ControlFailed(self.path, "replace_state", problem)

    def replaced(self) -> None:
        self.recorded.replaced()

    def stop(self, reason: ExitReason = NORMAL) -> None:
        if self.recorded.is_live:
            super().stop(reason)
        else:  # A replayed turn: the life ends when it has caught up.
            self.recorded.stop_wanted = reason

    def close(self) -> None:
        super().close()
        self.recorded.close()


class RecordedMonitor(Monitor):
    """A handle on a watch that the home keeps."""

    __slots__ = ()

    def cancel(self) -> None:
        """No further DOWN is admitted after the turn in hand."""
        self.active = False
        _life_of_turn().put("unwatch" if self.for_good else "demonitor", self.target.path)


def once_more(feed: Feed) -> Feed:
    """The same input, to be handled in a turn of its own."""
    return Feed(feed.id, -1, feed.kind, feed.name, feed.body, feed.time, feed.sender, feed.is_ask, feed.chain)
