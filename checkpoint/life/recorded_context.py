"""`self.ctx` of a recorded actor: what it does becomes an output of the turn in hand."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hashlib
import types
from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine, Generator
from random import Random
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import msgspec

from ...actors.control.orders import Suspend
from ...actors.control.orders_lane import QueuedOrder
from ...actors.effects import EffectCall, FailedAttempt
from ...actors.errors import (
    BadMessage,
    BadReply,
    ControlFailed,
    DamagedValue,
    EffectFailed,
    HoldfastError,
    UnsavableValue,
    error_text,
    remote_crash,
    type_name,
)
from ...actors.exit_reasons import NORMAL, SHUTDOWN, ExitReason, check_reason, pack_exit
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.bindings import note_order
from ...actors.kernel.cell import Cell, Order
from ...actors.kernel.context import NO_MESSAGE, ActorContext, Piped, StashError
from ...actors.kernel.envelope import Ask, Item, ReplyHandle, require_error
from ...actors.kernel.links import MADE_UP_NAME, Monitor
from ...actors.kernel.message import Message, message_name, require_message
from ...actors.kernel.node import check_sought, written
from ...actors.kernel.ref import ActorRef, cell_of, current
from ...actors.kernel.timers import Timer
from ...actors.seconds import check_seconds
from ...actors.values import decode_value, encode_value
from ...actors.values.path_parts import check_topic
from ...actors.values.saved_refs import SavedHandle
from ..protocol import REPLY, SINCE_THEN, Answer, EndWanted, Feed, Perform, Performed, PipeDone, Retried
from .glances import seen_beside
from .life_state import Asked
from .recorded_inbox import INIT, STARTED, Fed, WorkFailed

if TYPE_CHECKING:
    from .life_state import Awaited
    from .recorded_life import Life

T = TypeVar("T")
R = TypeVar("R")
A = TypeVar("A", bound=Actor)


class KeptHandle(SavedHandle):
    """A handle of a recorded actor, which may be kept in a key variable. Equal if it is on the same."""

    __slots__ = ("id",)

    def __init__(self, id: object) -> None:
        self.id = id

    def __eq__(self, other: object) -> bool:
        return self.id == other.id if isinstance(other, KeptHandle) and type(other) is type(self) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.id)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(id={self.id!r})"


class RecordedReplyHandle(KeptHandle, ReplyHandle[R]):
    """The right to answer one ask of a recorded actor later. (No dataclass: a message could take it along.)"""

    __slots__ = ("_asked",)

    id: int

    def __init__(self, id: int, asked: str = "") -> None:
        super().__init__(id)
        self._asked = asked

    @property
    def asked(self) -> str:
        """The name of the message that was asked."""
        try:
            return self._asked
        except AttributeError:  # It was saved by an earlier version.
            return ""

    def reply(self, value: R) -> None:
        life = _own_life("answers later")
        self._answer(life, life.answer_later(value, self.asked))

    def fail(self, error: HoldfastError) -> None:
        require_error(error)
        life = _own_life("answers later")
        self._answer(life, life.answer_error(error))

    def _answer(self, life: Life, answer: Answer) -> None:
        life.put("reply", str(self.id), f"{answer.kind}|{answer.name}", answer.body)


def _own_life(what: str) -> Life:
    """The life whose turn or hook this is."""
    return _own_context(what).acting()


def _own_context(what: str) -> RecordedContext:
    """The context of the actor whose code this is."""
    ctx = current.get(None)
    if not isinstance(ctx, RecordedContext):
        raise HoldfastError(f"a recorded actor {what} from one of its own turns")
    return ctx


class RecordedTimer(KeptHandle, Timer):
    """A handle on a timer of a recorded actor, whose clock runs at its home."""

    __slots__ = ()

    id: str

    @property
    def is_active(self) -> bool:
        return self.id in _own_context("looks at its timers").recorded.timers.active

    def cancel(self) -> None:
        _own_life("cancels its timers").cancel_timer(self.id)


class RecordedMonitor(KeptHandle, Monitor):
    """A handle on a watch that the home keeps."""

    __slots__ = ()

    id: tuple[str, str]  # how the watch is ended, and whom it is over

    def cancel(self) -> None:
        verb, path = self.id
        _own_life("stops watching").put(verb, path)


class OutcomeFuture(asyncio.Future[T]):
    """What comes of an output of a turn. In a set (`asyncio.wait` returns two) it has the same place in each life.

    There is one for each ask, so nothing is done when it is made but what a future does.
    """

    __slots__ = ("place",)

    place: tuple[int, int]  # its turn, and the number of the output

    def __hash__(self) -> int:
        return self.place[1]


class Pending(OutcomeFuture[Any]):
    """What a turn waits for. The clock of the turn moves on when its handler has awaited it.

    Not when it has come: in a replay all comes at once, and `now()` has to say again what it said.
    """

    __slots__ = ("_life", "is_out", "when")

    def __init__(self, life: Life, k: int) -> None:
        super().__init__(loop=life.cell.node.loop)
        self.place = life.turn, k
        self._life, self.when, self.is_out = life, 0.0, False

    def cancel(self, msg: Any = None) -> bool:
        """Nobody waits for it any more: nothing of it is done again in a replay, and no message is taken for it."""
        is_news = super().cancel(msg)
        if is_news:
            self._life.waits.order.cancelled(self.place)
        return is_news

    # It is its own iterator, so that nothing else is kept while it is awaited, perhaps for days.

    def __await__(self) -> Generator[Any, None, Any]:
        return self  # type: ignore[return-value]  # what `await` needs of one

    __iter__ = __await__

    def __next__(self) -> Any:
        if not self.done():
            self._asyncio_future_blocking = True
            return self  # To the task, which goes on when it is done.
        self._move_clock()
        raise StopIteration(self.result())

    def throw(self, error: BaseException) -> NoReturn:
        """Its handler does not wait any more."""
        self._move_clock()
        raise error

    def _move_clock(self) -> None:
        waits = self._life.waits
        waits.moment = max(waits.moment, self.when)


class Resting(Pending):
    """A moment or a message that a turn waits for. When it has come, or is not waited for any more, the turn rests no
    longer for it, as its handler is about to see. (A callback would be kept as long as the turn waits.)
    """

    __slots__ = ()

    def __init__(self, life: Life, k: int) -> None:
        super().__init__(life, k)
        life.waits.resting += (self,)

    def set_result(self, result: Any) -> None:
        self._over_soon()
        super().set_result(result)

    def set_exception(self, exception: Any) -> None:
        self._over_soon()
        super().set_exception(exception)

    def cancel(self, msg: Any = None) -> bool:
        self._life.waits.rested(self)  # At once: what the handler does next may leave in this very step.
        return super().cancel(msg)

    def _over_soon(self) -> None:
        life = self._life
        life.cell.node.loop.call_soon(life.waits.rested, self)  # In front of whoever waits for it.


class RecordedContext(ActorContext):
    """`self.ctx` of a recorded actor: what it does becomes an output of the turn in hand."""

    __slots__ = ("_drawn", "_draws", "recorded")

    _may_fail_fast = False
    _may_rest = True
    _marks_waits = True

    recorded: Life

    def __init__(self, cell: Cell) -> None:
        super().__init__(cell)
        self._drawn, self._draws = -1, dict[str, Random]()  # of which turn, and what is drawn in it

    def _continue_trace(self, tail: str) -> None:
        self.recorded.stage.trace = tail

    def _in_turn(self) -> bool:
        """Whether this code runs in the turn in hand, not in a background task or a thread."""
        return self.recorded.feed is not None and not _in_background()

    def acting(self) -> Life:
        """The life, whose turn or hook it must be that runs.

        Raises:
            HoldfastError: this is `__init__`, a background task, or the function of an effect.
        """
        if not self._in_turn():
            self._outside()
        return self.recorded

    def _outside(self) -> None:
        """Hooks may act (at once, unrecorded); background tasks may not, and neither may `__init__`."""
        self._alive()
        life = self.recorded
        if life.hook == INIT:
            why = "__init__ runs at each life, before the state is back"
            raise HoldfastError(f"{self.path}: {why}; act in on_start, or in on_recovered")
        if not life.hook or _in_background():
            raise HoldfastError(
                f"{self.path}: background tasks of a recorded actor, and functions of its effects, may not send, "
                "nor use ctx.effect or ctx.sleep (asyncio.gather makes a task of a coroutine); report with "
                "ctx.pipe_to_self(), or by what the effect returns"
            )

    def now(self) -> float:
        life = self.recorded
        if life.feed is None or _in_background():
            return self._cell.node.clock.wall()
        return max(life.feed.time, life.waits.moment)

    @property
    def random(self) -> Random:
        """The numbers of the turn in hand, or of the hook; who draws beside it, which no replay repeats, has others."""
        return super().random if _in_background() else self._draw()

    def _draw(self, what: str = "") -> Random:
        """The numbers of the turn in hand, which are the same each time it runs."""
        life = self.recorded
        if self._drawn != life.turn:
            self._drawn, self._draws = life.turn, {}
        found = self._draws.get(what)
        if found is None:
            when = 0.0 if life.feed is None else life.feed.time
            found = self._draws[what] = Random(f"{self.path}|{life.turn}|{when}{what}")
        return found

    def draw_anew(self) -> None:
        """A turn is about to be run again: it draws the same numbers as the first time."""
        self._draws = {}

    def spawn(self, start: Start[A], name: str | None = None) -> ActorRef[A]:
        return super().spawn(start, self._made_up_name() if name is None else name)

    def _made_up_name(self) -> str | None:
        """A name for a child that was given none; a turn that is replayed makes up the same, and no other turn does."""
        return f"{MADE_UP_NAME}{written(self._draw('names').getrandbits(64))}" if self._in_turn() else None

    def find(self, path: str, kind: type[A]) -> ActorRef[A]:
        """A ref to the address, whoever lives there: under replay somebody else, or nobody yet (T21)."""
        if not self._in_turn() and not self.recorded.hook:
            return super().find(path, kind)
        check_sought(path, kind)
        node = self._cell.node
        cell = node.cell_at(path)
        return ActorRef(cell) if cell.is_dead else node.find_ref(path, kind)

    # -- sending ----------------------------------------------------------------------------------------------------

    def _tell(self, cell: Cell, message: Message[Any]) -> None:
        if not self._in_turn():
            self._outside()
            super()._tell(cell, message)
            return
        self._put("tell", cell, message)

    async def _send(self, cell: Cell, message: Message[Any]) -> None:
        if not self._in_turn():
            self._outside()
            await super()._send(cell, message)
            return
        await self._accepted(self._put("send", cell, message))

    async def _accepted(self, k: int) -> None:
        """Have output `k` leave, and wait until it is accepted."""
        life = self.recorded
        accepted: OutcomeFuture[None] = OutcomeFuture(loop=self._cell.node.loop)
        accepted.place = life.turn, k
        life.waits.outcomes[accepted.place] = accepted, None
        life.release()
        await accepted

    def _put(self, verb: str, cell: Cell, message: Message[Any], *, seconds: float = 0.0) -> int:
        if type(message) not in cell.table:
            cell.require(message)
        body = self._cell.node.codec.encode_alike(message, cell.path)
        return self.recorded.put(verb, cell.path, message_name(type(message)), body, seconds=seconds)

    def _ask(self, cell: Cell, message: Message[R], timeout: float) -> asyncio.Future[R]:
        if not self._in_turn():
            self._outside()
            return super()._ask(cell, message, timeout)
        life = self.recorded
        k = self._put("ask", cell, message, seconds=check_seconds(cell.path, "timeout", timeout))
        future: OutcomeFuture[R] = OutcomeFuture(loop=self._cell.node.loop)
        future.place = place = life.turn, k
        life.waits.outcomes[place] = future, Asked(cell.path, type(message))
        life.release()
        return future

    def _whom(self, reply: Any) -> str:
        outcomes = self.recorded.waits.outcomes.values()
        return next((of.actor for future, of in outcomes if future is reply and isinstance(of, Asked)), "")

    def forward(self, to: ActorRef[Any]) -> None:
        cell, fed = cell_of("ctx.forward", to), self._item
        if not self._in_turn() or not isinstance(fed, Fed):
            raise HoldfastError(f"{self.path}: only a message in hand can be forwarded")
        feed = fed.feed
        self.recorded.put("forward", cell.path, feed.name, feed.body)

    def reply_handle(self) -> ReplyHandle[Any]:
        feed = self.recorded.feed  # Its id even if nobody waits (any more): a replay must make the same handle.
        if feed is None:
            return RecordedReplyHandle(-1)
        if not self.recorded.is_live:
            self.recorded.restored.promises.add(feed.id)
        return RecordedReplyHandle(feed.id, feed.name)

    async def publish(self, topic: str, message: Message[Any]) -> None:
        if not self._in_turn():
            self._outside()
            await super().publish(topic, message)
            return
        check_topic("ctx.publish", topic)
        require_message(topic, message)
        body = self._cell.node.codec.encode_alike(message, topic)
        k = self.recorded.put("publish", topic, message_name(type(message)), body)
        if self.waits_for_room(topic):
            await self._accepted(k)

    def waits_for_room(self, topic: str) -> bool:
        """Whether to wait, in the middle of the turn, until all subscribers have accepted what is published."""
        return True

    def _order(self, cell: Cell, order: Order) -> None:
        own = cell.living.path == self.path
        if own and order == "stop":
            self.stop(SHUTDOWN)
        elif not self._in_turn():
            self._outside()
            super()._order(cell, order)
        else:
            cell.node.check_caller(cell.path)
            if not own:
                cell.require_order(order)
                note_order(self._cell, cell)
            self.recorded.put(order, cell.path)

    async def flush(self) -> None:
        self.recorded.release()

    # -- later ------------------------------------------------------------------------------------------------------

    def _timer(self, message: Message[Any], delay: float, interval: float | None) -> Any:
        self._cell.require(message)
        life, interval = self.acting(), interval or 0.0
        name, body = message_name(type(message)), self._cell.node.codec.encode_alike(message, self.path)
        in_turn = life.feed is not None
        key = f"{life.turn}.{life.last_k + 1}" if in_turn else life.timer_of_hook(name, body, interval)
        life.timers.set(key, (name, body, interval))
        life.put("timer", key, name, body, seconds=delay, interval=interval)
        return RecordedTimer(key)

    def pipe_to_self(
        self,
        work: Awaitable[T],
        then: Callable[[T], Message[Any]],
        failed: Callable[[BaseException], Message[Any]] | None = None,
    ) -> None:
        life, feed = self.acting(), self.recorded.feed
        k = 0  # What a hook begins is begun again by the next life's: no turn has to stay in the journal for it.
        if feed is not None:
            k = life.put("pipe", "")
            if life.has_result(k):  # That was journaled before the crash: it will be fed.
                if asyncio.iscoroutine(work):
                    work.close()
                return
            life.pipes += 1
        task = self._beside(self._piped(life.turn, k, work, then, failed), "pipe")
        if asyncio.iscoroutine(work):  # Cancelled before its first step, the task would leave it unawaited.
            task.add_done_callback(lambda _: work.close())

    async def _piped(self, turn: int, k: int, work: Any, then: Any, failed: Any) -> None:
        codec = self._cell.node.codec
        try:
            message = await self._outcome(work, then, failed)
            record = PipeDone(turn, k, message_name(type(message)), codec.encode(message, self.path))
        except BaseException as error:  # Nobody takes it: the actor crashes, once.
            record = PipeDone(turn, k, "", codec.encode_error(remote_crash(self._uncaught(error)))[2])
        if not self._closed:
            self.recorded.port.to_home(record)
            if k:
                self.recorded.pipe_back()

    def _work_failed(self, failed: Piped) -> None:
        self.recorded.work_failed(WorkFailed(self.recorded, failed.error))

    # -- the outside ------------------------------------------------------------------------------------------------

    @property
    def message_id(self) -> str:
        feed = self.recorded.feed
        if feed is None:
            raise HoldfastError(f"{self.path}: no message is in hand")
        said = f"{self.path}|{feed.id}|{feed.time}"
        return hashlib.blake2b(said.encode(), digest_size=16).hexdigest()

    def _performed(self, effect: EffectCall) -> asyncio.Future[object]:
        if not self._in_turn():
            self._outside()
            return super()._performed(effect)
        name = "at most once" if effect.at_most_once else ""
        return self._awaited(Pending, "effect", effect.key, name, 0.0, effect)

    def _awaited(
        self, made: type[Pending], verb: str, to: str, name: str, until: float, kind: Awaited
    ) -> asyncio.Future[Any]:
        """An output of the turn in hand, and a future of what comes of it; the turn need not wait for that."""
        life = self.recorded
        outcome = made(life, life.put(verb, to, name, seconds=until))
        life.waits.outcomes[outcome.place] = outcome, kind
        life.waits.order.rests()
        life.release()
        return outcome

    def _rest(
        self, verb: str, name: str, seconds: float, kinds: tuple[type[Message[Any]], ...], since: str = SINCE_THEN
    ) -> asyncio.Future[Any]:
        """Wait for what the home waits for: nothing of it is out."""
        return self._awaited(Resting, verb, since, name, seconds, kinds)

    def _slept(self, seconds: float, *, is_moment: bool) -> asyncio.Future[None]:
        if self._in_turn():
            return self._rest("sleep", "", seconds, (), "" if is_moment else SINCE_THEN)
        self._outside()
        return super()._slept(seconds, is_moment=is_moment)

    def _signal(self, kinds: tuple[type[Message[Any]], ...], timeout: float | None) -> asyncio.Future[Message[Any]]:
        if not self._in_turn():
            raise HoldfastError(f"{self.path}: only a turn can wait for a message")
        return self._rest("wait", "|".join(map(message_name, dict.fromkeys(kinds))), timeout or 0.0, kinds)

    def perform(self, order: Perform, effect: EffectCall, outcome: Pending) -> None:
        """Perform an effect of the turn in hand, in a task of its own, and have the home journal what it comes to."""
        if outcome.is_out:
            return  # Whoever led before has been told so, too.
        outcome.is_out, self._token = True, order.token
        task = self._beside(self._watched(order, effect), "effect")
        outcome.add_done_callback(lambda _: task.cancel())  # The handler does not wait for it any more.

    async def _watched(self, order: Perform, effect: EffectCall) -> None:
        await self._stepped(order.turn, self._carried_out(order.turn, order.k, effect, alone=order.alone))

    @types.coroutine
    def _stepped(self, turn: int, work: Coroutine[Any, Any, None]) -> Generator[Any, Any, None]:
        """Step what works for a turn that waits: if a step ends the process, the turn has ended it.

        A step that cancels the task has failed by that, as if it had raised: nobody else wants the task to end.
        """
        step: Callable[[], Any] = functools.partial(work.send, None)
        task = asyncio.current_task()
        assert task is not None
        while True:
            wanted = task.cancelling()
            try:
                with self.recorded.work_beside(turn):
                    waiting = step()
            except StopIteration:
                return
            while task.cancelling() > wanted:
                task.uncancel()
            try:
                step = functools.partial(work.send, (yield waiting))
            except GeneratorExit:
                work.close()
                raise
            except BaseException as error:
                step = functools.partial(work.throw, error)

    @contextlib.asynccontextmanager
    async def _in_thread(self, place: tuple[int, int], *, alone: bool) -> AsyncGenerator[None, None]:
        """Around an attempt in a thread, which may end the process unseen; `alone`: one such attempt at a time."""
        waits = self.recorded.waits
        async with self._cell.node.threads.alone if alone else contextlib.nullcontext():
            waits.threads.add(place)
            try:
                yield
            finally:
                waits.threads.discard(place)

    async def _carried_out(self, turn: int, k: int, effect: EffectCall, *, alone: bool) -> None:
        life = self.recorded
        attempt: Callable[[], contextlib.AbstractAsyncContextManager[None]] = contextlib.nullcontext
        if not effect.is_async and effect.isolation == "thread":
            attempt = functools.partial(self._in_thread, (turn, k), alone=alone)

        def failed(attempt: FailedAttempt) -> None:
            if not self._closed and (turn, k) in life.waits.outcomes:
                life.port.to_home(Retried(turn, k, attempt))

        try:
            value = await self._perform(effect, failed, attempt)
            answer = Answer(REPLY, "", self._as_kept(effect, value))
        except Exception as error:
            answer = self._kept(effect, error)
        if self._closed or (turn, k) not in life.waits.outcomes:
            return
        try:
            life.port.to_home(Performed(turn, k, answer))
        except BadMessage as error:
            why = f"what it has returned is too large to leave its process: {error.problem}; return where it is instead"
            life.port.to_home(Performed(turn, k, self._kept(effect, BadReply(self.path, effect.key, why))))

    def _as_kept(self, effect: EffectCall, value: object) -> bytes:
        """What an effect has returned, as it is kept. Raises UnsavableValue: no later life could read it."""
        where = f"the result of {effect.key}"
        body = encode_value(value, where=where)
        try:
            decode_value(body, refs=self._cell.node.ref_at)
        except DamagedValue as error:
            problem = f"{type_name(type(value))}, which could not be read again ({error.problem}),"
            raise UnsavableValue(where, problem) from error
        return body

    def _kept(self, effect: EffectCall, error: Exception) -> Answer:
        """An error as the outcome of an effect, or why it cannot be one."""
        text = error_text(error)
        try:
            if isinstance(error, HoldfastError):
                kept = self._cell.node.codec.encode_own_error(error)
                self._cell.node.codec.decode_own_error(*kept)
                return Answer(*kept)
        except Exception as problem:  # It has fields of the user's own, of whatever types.
            text = f"what it has raised cannot be kept: {error_text(problem)}"
        return self.recorded.answer_error(EffectFailed(effect.key, 1, type_name(type(error)), text))

    # -- stash, links, subscriptions --------------------------------------------------------------------------------

    def stash(self) -> None:
        fed, life = self._item, self.recorded
        if not isinstance(fed, Fed) or life.feed is None or fed.message is None:
            raise StashError(f"{self.path}: {NO_MESSAGE}")
        if fed.is_stashed:
            raise StashError(f"{self.path}: this message is stashed already")
        fed.is_stashed = True
        life.stash.append(fed)

    def unstash(self) -> None:
        life = self.acting()
        if life.hook == STARTED:  # In a process, what was put aside may not be here yet.
            life.restored.unstashes = True
        stash, life.stash = life.stash, []
        again = [Fed(life, once_more(fed.feed), fed.message, fed.sender, fed.feed.chain) for fed in stash]
        life.returned = {fed.feed.id: fed for fed in again} | life.returned  # in front of those put back before
        if life.is_live:
            life.handle_returned()

    def monitor(self, other: ActorRef[Any]) -> Monitor:
        path = cell_of("ctx.monitor", other).path
        self.acting().put("monitor", path)
        return RecordedMonitor(("demonitor", path))

    def watch(self, other: ActorRef[Any]) -> Monitor:
        path = cell_of("ctx.watch", other).path
        self.acting().put("watch", path)
        return RecordedMonitor(("unwatch", path))

    def link(self, other: ActorRef[Any]) -> None:
        self.acting().put("link", cell_of("ctx.link", other).path)

    def unlink(self, other: ActorRef[Any]) -> None:
        self.acting().put("unlink", cell_of("ctx.unlink", other).path)

    def subscribe(self, topic: str) -> None:
        check_topic("ctx.subscribe", topic)
        self.acting().put("subscribe", topic)

    def unsubscribe(self, topic: str) -> None:
        check_topic("ctx.unsubscribe", topic)
        self.acting().put("unsubscribe", topic)

    def _depart(self, owe: Callable[[Ask], int]) -> bytes:
        self.recorded.last_snapshot()
        return b""

    def _has_class(self, old: type[Actor], new: type[Actor]) -> None:
        """Its home subscribes, for the address: subscriptions of this life would end with it."""

    @property
    def _is_adrift(self) -> bool:
        return self.recorded.stage.is_adrift

    @property
    def _owes_turn(self) -> bool:
        return self.recorded.stage.owed >= 0

    def _rests(self) -> bool:
        return bool(self.recorded.waits.resting) or not self.recorded.is_live

    def _turn_waits(self) -> None:
        life = self.recorded
        life.mark(waits=True)
        if life.stage.begun >= 0:
            life.say_it_waits()
        if life.stage.stopping is not None:
            self._cell.node.loop.call_soon(life.leave_waiting)  # It has had something else to wait for.

    def _turn_goes_on(self) -> None:
        self.recorded.mark(waits=False)

    def _leaves_turn(self) -> bool:
        more = self._cell.more
        turn = None if more is None else more.turn
        if turn is None or turn.killed or turn.then is not None or not self.recorded.leave_turn():
            return False
        turn.is_left = True
        turn.runner.task.cancel()
        return True

    @property
    def _is_open(self) -> bool:
        return self.recorded.is_live and self.recorded.waits.is_open

    def _look_beside(self, look: Callable[[], object]) -> tuple[object] | None:
        return seen_beside(self.recorded, self.recorded.feed, look)

    def _postpones(self, call: Item) -> bool:
        if self._is_adrift and isinstance(call, QueuedOrder):
            self._cell.urge(call)  # The next life obeys it, before the turn that was left is run again.
            return True
        if isinstance(call, QueuedOrder) and isinstance(call.order, Suspend):
            self.recorded.stage.owed = -1  # It is not run before an operator says so: what else is ordered comes first.
        is_behind = self._owes_turn and isinstance(call, QueuedOrder) and call.order.is_change
        if self.recorded.is_live and not is_behind:
            self.recorded.say_it_waits()  # The order may be that nothing is handled.
            return False
        self.recorded.stage.postponed.append(call)
        return True

    @property
    def _named_variables(self) -> tuple[str, ...] | None:
        return self.recorded.method.key_variables

    @property
    def _first_variables(self) -> list[str]:
        return self.recorded.saving.variables

    @_first_variables.setter
    def _first_variables(self, names: list[str]) -> None:
        self.recorded.saving.variables = names if self._named_variables is None else list(self._named_variables)

    def _may_replace(self) -> None:
        problem = self.recorded.may_replace()
        if problem:
            raise ControlFailed(self.path, "replace_state", problem)

    def _replaced(self) -> None:
        self.recorded.replaced()

    def _saved(self) -> list[bytes]:
        return [msgspec.msgpack.encode(piece) for piece in self.recorded.replaced_snapshot()]

    def stop(self, reason: ExitReason = NORMAL) -> None:
        check_reason("ctx.stop", reason)
        life = self.recorded
        stage, feed = life.stage, life.feed
        ends_itself = feed is not None and self._in_turn()
        if ends_itself and stage.ending is None:
            stage.ending = EndWanted(life.turn, msgspec.msgpack.encode(pack_exit(reason)), stage.is_cut_off)
        if life.is_live:
            self._alive()
            life.end(reason, ends_itself=ends_itself)
        else:  # A replayed turn, or a hook: the life ends when it has caught up.
            stage.stop_wanted = reason
            stage.stop_turn = -1 if feed is None else feed.turn

    def _close(self) -> None:
        super()._close()
        self.recorded.close()


def _in_background() -> bool:
    """Whether this code runs in a task of its own, or in a thread."""
    try:
        task = asyncio.current_task()
    except RuntimeError:  # No loop runs here.
        return True
    return task is not None and task.get_name() != "holdfast runner"


def once_more(feed: Feed) -> Feed:
    """The same input, to be handled in a turn of its own."""
    return Feed(
        feed.id, -1, feed.kind, feed.name, feed.body, feed.time, feed.sender,
        feed.is_ask, feed.chain, deadline=feed.deadline,
    )  # fmt: skip
