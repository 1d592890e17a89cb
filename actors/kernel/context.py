"""The context, `self.ctx`: what an actor may do besides handling messages. Each life has its own."""

from __future__ import annotations

import asyncio
import gc
import math
import random
import types
import uuid
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from contextlib import AbstractAsyncContextManager, nullcontext
from contextvars import ContextVar, copy_context
from types import CodeType, FrameType
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, TypeVar, TypeVarTuple, cast, overload

from ..effects import EffectCall, FailedAttempt, Isolation, Retry, effect_of
from ..errors import ActorStopped, AskDeadlock, HoldfastError, SpecError, remote_crash
from ..events import EffectRetried
from ..exit_reasons import NORMAL, ExitReason, check_reason
from ..seconds import check_seconds
from ..values.path_parts import check_topic
from . import links, mailbox
from .bindings import note_order
from .blocking_handlers import is_async
from .cell import TurnRest
from .envelope import (
    NO_DEADLINE,
    Ask,
    AskHandle,
    Chain,
    Envelope,
    Item,
    ReplyHandle,
    chain_of,
    in_next_pass,
    message_in,
    waiters,
)
from .links import Monitor
from .message import Message, reply_type, require_message
from .ref import cell_of, current
from .timers import LoopTimer, Timer
from .topics import NOT_TAKEN, publish

if TYPE_CHECKING:
    from .actor import Actor, Start
    from .cell import Cell, Order
    from .loop import Suspended
    from .ref import ActorRef

A = TypeVar("A", bound="Actor")
M = TypeVar("M", bound=Message[Any])
T = TypeVar("T")
R = TypeVar("R")
Ts = TypeVarTuple("Ts")

begun_in: ContextVar[Any] = ContextVar("begun_in", default=None)
"""In a background task: what was being handled when it was created. That turn may wait for it, a later one does not."""

DRIVEN = "driven_turn"
"""The local in which a generator of ours holds the coroutine that it sends to by hand: Python sees no await there."""
LONGEST: Final = 16
"""Turns in the longest circle that is looked for when an ask is made."""
EXITS: Final = frozenset({"__exit__", "__aexit__"})


NO_MESSAGE: Final = "only a message can be stashed, and what is in hand is none"


class StashError(HoldfastError, text="{why}"):
    """Only a message can be stashed, once per turn."""

    why: str


class Borrowed(list["Ask"]):
    """The promises of a life that has begun beside its address and is not the one there yet."""


class ActorContext:
    """An actor's view of the runtime. It belongs to one life: after that life's end it refuses to send."""

    __slots__ = ("_asked", "_asking", "_cell", "_closed", "_owes", "_random", "_speaker", "_token", "_turn")

    _may_fail_fast: ClassVar[bool] = True
    """Whether an ask may end by what the receiver happens to be doing; a replay could not repeat that."""

    _may_rest: ClassVar[bool] = False
    """Whether a turn may wait for days, and be run again elsewhere."""
    _marks_waits: ClassVar[bool] = False
    """Whether it is to be told when a turn begins to wait, and when that goes on."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._speaker = cell  # who the receivers of what it sends see
        self._closed = False
        self._asked: Cell | None = None  # whom it has asked last
        self._asking: Any = None
        self._turn = 0
        self._random: random.Random | None = None
        self._owes: list[Ask] | None = None  # asks that may be answered later
        self._token = 0  # of its effects; it gets one with the first

    def _continue_trace(self, tail: str) -> None:
        """The turn that begins now is in this trace, if what it sends is not sent at once; "": the turn is over."""

    # -- who, when --------------------------------------------------------------------------------------------------

    @property
    def _item(self) -> Any:
        """What is being handled, or was last; it stands in the cell, so that most turns need not touch this object."""
        return None if self._closed else self._cell.item

    @property
    def ref(self) -> ActorRef[Any]:
        """A ref to this actor."""
        return self._cell.ref

    @property
    def path(self) -> str:
        """The address of this actor."""
        return self._cell.path

    @property
    def life(self) -> int:
        """The number of this life at the address, from 1.

        A replay runs in another life, so a journaled turn must not reply, send or keep it: its replay would diverge.
        """
        return self._cell.life

    @property
    def sender(self) -> ActorRef[Any] | None:
        """Return a ref to the actor that sent the message in hand; None if no actor did."""
        item = self._item
        sender: Cell | None = item.sender if isinstance(item, Item) else None
        return None if sender is None else sender.ref

    def now(self) -> float:
        """Unix time in seconds; in a journaled actor, that of the input in hand."""
        return self._cell.node.clock.wall()

    @property
    def random(self) -> random.Random:
        """A random generator; in a journaled actor the same numbers come again under replay."""
        if self._random is None:
            self._random = random.Random(self._cell.node.numbers.next_seed())
        return self._random

    def uuid(self) -> uuid.UUID:
        """Return a new random UUID, drawn from `random`."""
        return uuid.UUID(int=self.random.getrandbits(128), version=4)

    # -- sending (called by ActorRef for sends inside a turn) -------------------------------------------------------

    def _tell(self, cell: Cell, message: Message[Any]) -> None:
        """Send from this actor: the receiver sees the sender."""
        self._alive()
        if type(message) not in cell.table:
            cell.require(message)
        cell.take_in(cell, Envelope(message, self._speaker))

    async def _send(self, cell: Cell, message: Message[Any]) -> None:
        """Send and wait until it is accepted. Nobody waits for room at itself: that raises MailboxFull, as a tell."""
        self._alive()
        while cell is not self._cell and (room := cell.room()) is not None:
            await room
            self._alive()
        if type(message) not in cell.table:
            cell.require(message)
        try:
            accepted = cell.offer(Envelope(message, self._speaker))
        except HoldfastError:
            await asyncio.sleep(0)  # Who sends again and again leaves the loop to those for whom it waits.
            raise
        if accepted is not None:
            await accepted

    def _ask(self, cell: Cell, message: Message[R], timeout: float) -> asyncio.Future[R]:
        """Ask from this actor: the chain of waiting turns goes along, so that a circle is refused at once.

        If others wait for this turn that are in no such chain, they are looked for as soon as this turn waits, too.
        """
        self._alive()
        if type(message) not in cell.table:
            cell.require(message)
        node = self._cell.node
        future: asyncio.Future[R] = node.loop.create_future()
        chain = self._chain()
        if waits_for(self, cell, chain):
            future.set_exception(AskDeadlock(cell.path, waiters(chain)))
            return in_next_pass(future)
        ask = Ask(message, self._speaker, chain, timeout, NO_DEADLINE, future, cell)
        node.deadlines.add(ask)
        try:
            cell.take_in(cell, ask)
        except BaseException:
            future.cancel()
            raise
        self._asked = cell
        if cell.more is not None and cell.more.turn is not None and may_wait_for(cell, self._cell):
            node.loop.call_soon(end_circle, ask)
        return in_next_pass(future) if future.done() else future

    def _order(self, cell: Cell, order: Order) -> None:
        """A stop or kill by way of a ref."""
        cell.node.check_caller(cell.path)
        note_order(self._cell, cell)
        cell.obey(order, self.path)

    def _chain(self) -> Chain:
        """This turn, and those that wait for it; nothing in a background task whose turn is over."""
        if self._is_left_behind():
            return ()
        if self._asking is not self._item:
            self._asking = self._item
            self._turn = self._cell.node.numbers.next_turn()
        return ((self.path, self._turn), *chain_of(self._item))

    def _turn_in(self, chain: Chain) -> bool:
        """Whether this actor's suspended turn is one of those in the chain."""
        more = self._cell.more
        if more is None or more.turn is None:  # Its last turn has ended: nobody waits here.
            return False
        return self._asking is self._item and (self.path, self._turn) in chain

    def _whom(self, reply: Any) -> str:
        """The address of the actor that was asked for this reply; "" if no ask of this actor waits for it."""
        asks = self._cell.node.deadlines.waiting()
        return next((ask.to.path for ask in asks if ask.future is reply and ask.sender is self._cell), "")

    def _is_left_behind(self) -> bool:
        """Whether a background task asks, and something else than in its turn is being handled now."""
        begun = begun_in.get()
        return begun is not None and begun is not self._item

    def _in_turn(self) -> bool:
        """Whether a turn of this actor runs, seen from its own code: from a background task it may be idle."""
        more = self._cell.more
        return (more is not None and more.turn is not None) or self._cell.node.is_stepping()

    def _alive(self) -> None:
        if self._closed:
            raise ActorStopped(self.path, "this life is over; its leftovers may not send")

    def forward(self, to: ActorRef[Any]) -> None:
        """Hand the message in hand on: the receiver sees the original sender, and its reply goes to the asker."""
        cell = cell_of("ctx.forward", to)
        self._alive()
        item = self._item
        if isinstance(item, Ask):
            cell.require(item.message)
            self._cell.item = Stashed.of(item)
            cell.take_in(cell, item)
        elif isinstance(item, Envelope):
            cell.take_in(cell, Envelope(item.message, item.sender))
        else:
            cell.take_in(cell, message_in(item))  # The item of a timer or a pipe is of this life.

    def reply_handle(self) -> ReplyHandle[Any]:
        """Return the right to answer the ask in hand later: `return self.ctx.reply_handle()`, keep it, call `reply`."""
        item = self._item
        return self._promise(item) if isinstance(item, Ask) else AskHandle(None)

    def _promise(self, ask: Ask) -> ReplyHandle[Any]:
        """A reply handle for an ask, which is remembered while it waits."""
        promised = self._owes
        if promised is None:
            promised = self._owes = []
        elif len(promised) >= 64 and len(promised) & (len(promised) - 1) == 0:  # At each power of two.
            promised[:] = [one for one in promised if not one.is_done]
        promised.append(ask)
        return AskHandle(ask)

    def _promised(self) -> tuple[Ask, ...]:
        """The asks for which there are reply handles; those that are over may be among them."""
        return () if type(self._owes) is Borrowed else tuple(self._owes or ())

    def _borrow_promises(self) -> None:
        """What the actor promises is another life's until `keep_promises`: if this one ends before, nothing fails."""
        self._owes = Borrowed()

    def _keep_promises(self) -> None:
        """The life is the one that answers."""
        if type(self._owes) is Borrowed:
            self._owes = list(self._owes)

    def _hand_on_promises(self) -> None:
        """The actor lives elsewhere now, and answers from there."""
        self._owes = None

    async def publish(self, topic: str, message: Message[Any]) -> None:
        """Publish from this actor, and return when every subscriber has accepted; it waits for room at bounded ones.

        Not at itself, for it would wait for its own turn: without recovery what finds its own mailbox full is a dead
        letter there.
        """
        check_topic("ctx.publish", topic)
        uplink = self._cell.node.ports.uplink
        if uplink is not None:  # The subscribers are known to the root only.
            self._alive()
            require_message(topic, message)
            await uplink.publish(topic, self._cell.outgoing(Envelope(message, self._speaker)))
            return

        async def send(cell: Cell) -> None:
            try:
                await self._send(cell, message)
            except NOT_TAKEN:
                self._alive()  # Else it is this life that is over, and no fault of the subscriber's.
                raise

        await publish(self._cell.node, topic, message, send, self._cell)

    async def flush(self) -> None:
        """Release what this turn has sent so far (a journaled actor otherwise releases at the end of the turn)."""

    # -- later ------------------------------------------------------------------------------------------------------

    def tell_after(self, delay: float, message: Message[Any]) -> Timer:
        """Have a message come to this actor itself after `delay` seconds, >= 0; the timer ends with this life."""
        timer: Timer = self._timer(message, check_seconds(self.path, "delay", delay, or_zero=True), None)
        return timer

    def every(self, interval: float, message: Message[Any]) -> Timer:
        """Have a message come every `interval` seconds, > 0; ticks that fall due while one waits are left out."""
        interval = check_seconds(self.path, "interval", interval)
        timer: Timer = self._timer(message, interval, interval)
        return timer

    def _timer(self, message: Message[Any], delay: float, interval: float | None) -> Any:
        """A handle on a timer that is set now."""
        self._alive()
        return LoopTimer(self._cell, message, delay, interval)

    def pipe_to_self(
        self,
        work: Awaitable[T],
        then: Callable[[T], Message[Any]],
        failed: Callable[[BaseException], Message[Any]] | None = None,
    ) -> None:
        """Await `work` in the background; its result comes back as a message.

        Args:
            work: what is awaited, in a task that ends with this life.
            then: makes the message from the result.
            failed: makes a message from what the work raised, CancelledError if it was cancelled; without it that
                crashes this actor. What `then` or `failed` raises does too, and so does what is no message of its.
        """
        self._alive()
        self._beside(self._pipe(work, then, failed), "pipe")

    async def _pipe(self, work: Awaitable[T], then: Callable[[T], Message[Any]], failed: Any) -> None:
        try:
            outcome = Piped(await self._outcome(work, then, failed), None)
        except BaseException as error:
            outcome = Piped(None, self._uncaught(error))
        if not self._closed:
            self._cell.push(outcome)

    async def _outcome(self, work: Awaitable[T], then: Callable[[T], Message[Any]], failed: Any) -> Message[Any]:
        """The message that background work ends with, whatever becomes of it.

        Raises what the work raised, if nobody takes that, or what a callback did.
        """
        try:
            result = await work
        except BaseException as error:
            if self._closed or failed is None:
                raise
            message: Message[Any] = failed(error)
        else:
            message = then(result)
        self._cell.require(message)
        return message

    def _uncaught(self, error: BaseException) -> BaseException:
        """What the end of background work crashes this actor with; raises it if this life is over."""
        if self._closed:
            raise error
        if isinstance(error, asyncio.CancelledError):  # By whoever else had the work in hand; that is no result.
            return HoldfastError(f"{self.path}: work that was given to pipe_to_self was cancelled")
        return error

    # -- the outside ------------------------------------------------------------------------------------------------

    @property
    def message_id(self) -> str:
        """Return the text that identifies the message in hand for ever: a key for the other side of an effect.

        A handler that is run again for this message gets the same text. No other message of any actor ever has it.

        Raises:
            HoldfastError: the actor has no recovery, so no handler is run again; or nothing is in hand.
        """
        raise HoldfastError(f"{self.path}: only messages of an actor with recovery have an identity")

    @overload
    def effect(
        self,
        function: Callable[[*Ts], Awaitable[T]],
        *args: *Ts,
        key: str = "",
        timeout: float | None = None,
        retry: Retry | None = None,
        at_most_once: bool = False,
        isolation: Isolation = "thread",
    ) -> asyncio.Future[T]: ...

    @overload
    def effect(
        self,
        function: Callable[[*Ts], T],
        *args: *Ts,
        key: str = "",
        timeout: float | None = None,
        retry: Retry | None = None,
        at_most_once: bool = False,
        isolation: Isolation = "thread",
    ) -> asyncio.Future[T]: ...

    def effect(  # type: ignore[misc]  # whatever the two above have found to fit
        self,
        function: Callable[..., Any],
        *args: Any,
        key: str = "",
        timeout: float | None = None,
        retry: Retry | None = None,
        at_most_once: bool = False,
        isolation: Isolation = "thread",
    ) -> asyncio.Future[Any]:
        """Do something to the outside world, such as a payment, once: an actor with recovery has its outcome journaled.

        A handler that is run again after a crash gets the outcome from the journal, and the function is not called. It
        begins when all that precedes it is as safe as the store makes it. If a crash comes between the function and the
        record of its outcome, it is called again: at least once, so give the other side `message_id`. In hooks that
        are no turns, and without recovery, it is called each time. Several may be out at once: call them in the turn
        itself, and `await asyncio.gather(...)` what they return.

        Args:
            function: is awaited if it is async, and runs in a thread otherwise, or in a process. It may not use `ctx`.
            args: its arguments.
            key: names the effect, where a replay is compared, and in errors; left out, the function's name does.
            timeout: seconds that one attempt may take. A thread cannot be stopped: it is left behind.
            retry: how often it is attempted; left out, once.
            at_most_once: a crash while it is out raises EffectInDoubt instead of calling it again.
            isolation: "process" runs a plain function of a module in a process of its own, which is killed when its
                time is over or its life ends. Arguments are values that a snapshot can hold, too.

        Returns:
            A future of what the function returns; that must be a value that a snapshot can hold (`UnsavableValue` says
            why it is not).

        Raises:
            HoldfastError: this is a background task of an actor with recovery; call the function itself there.

        Raises (by the future):
            EffectFailed: the function has raised, or has taken too long, at the last attempt.
            EffectInDoubt: it is performed at most once, and the actor has ended while it was out.
            HoldfastError: the function itself has raised that, a Refusal for instance: it is an outcome too.
        """
        self._alive()
        runs = is_async(function)
        effect = effect_of(
            function, args, key, timeout, retry, at_most_once=at_most_once, is_async=runs, isolation=isolation
        )
        return self._performed(effect)

    def _performed(self, effect: EffectCall) -> asyncio.Future[object]:
        """The outcome of an effect: without recovery, whatever it comes to now."""
        self._token = self._token or self._cell.node.numbers.next_token()

        def failed(attempt: FailedAttempt) -> None:
            cell, rests = self._cell, self._cell.extra().belongings.rests
            if rests is not None and task in rests:
                item, rest = rests[task]
                rests[task] = item, rest.after(attempt, cell.node.clock.wall())
                cell.node.emit(EffectRetried(self.path, effect.key, *attempt))

        task = self._resting(self._perform(effect, failed), "effect", effect.key, None)
        return task

    def _perform(
        self,
        effect: EffectCall,
        failed: Callable[[FailedAttempt], None],
        attempt: Callable[[], AbstractAsyncContextManager[None]] = nullcontext,
    ) -> Coroutine[Any, Any, object]:
        """Perform it here and now, each attempt in an `attempt`."""
        node = self._cell.node
        run = node.threads.run if effect.isolation == "thread" else node.ports.run_in_process
        return effect.perform(self.path, run, node.numbers.next_seed(), self._token, failed, attempt)

    def sleep_until(self, when: float) -> asyncio.Future[None]:
        """Have the turn in hand wait until a moment, be it days away.

        In an actor whose recovery replays, the wait outlives its process, and with a durable store the program: the
        handler is run again from its start, and gets the outcomes that it had. No other message is handled meanwhile.

        Args:
            when: Unix time in seconds; a moment that has passed ends the wait at once.

        Returns:
            A future, to be awaited.

        Raises:
            HoldfastError: this is a background task of an actor with recovery; use `asyncio.sleep` there.
        """
        self._alive()
        if not isinstance(when, int | float) or isinstance(when, bool) or not math.isfinite(when):
            raise SpecError("sleep_until", f"takes Unix time in seconds, not {when!r}")
        return self._slept(float(when), is_moment=True)

    def sleep(self, seconds: float) -> asyncio.Future[None]:
        """Have the turn in hand wait for so many seconds from this call on; see `sleep_until`."""
        self._alive()
        return self._slept(check_seconds(self.path, "sleep", seconds, or_zero=True), is_moment=False)

    def _slept(self, seconds: float, *, is_moment: bool) -> asyncio.Future[None]:
        """Wait until a moment, or for so many seconds: without recovery, in this life."""
        now = self._cell.node.clock.wall()
        left = seconds - now if is_moment else seconds
        return self._resting(asyncio.sleep(left), "sleep", "", now + max(0.0, left))

    def _resting(
        self, work: Coroutine[Any, Any, T], kind: Literal["sleep", "effect"], name: str, until: float | None
    ) -> asyncio.Task[T]:
        """A task of this life, of which those who look see that the turn in hand rests in it."""
        task, belongings = self._beside(work, kind), self._cell.extra().belongings
        rests = belongings.rests = {} if belongings.rests is None else belongings.rests
        rests[task] = self._item, TurnRest(kind, name, self._cell.node.clock.wall(), until)
        task.add_done_callback(rests.pop)
        return task

    def wait_for(self, *kinds: type[M], timeout: float | None = None) -> asyncio.Future[M]:
        """Have the turn in hand wait for a message of one of these classes: a signal. It needs recovery.

        The oldest one that is in the mailbox is taken, before all that came earlier, or the first one that comes. Who
        has asked gets None as its reply. Everything else waits. As with `sleep_until`, the wait outlives the process.

        Args:
            kinds: classes of messages whose reply is None; what derives from one counts, too.
            timeout: seconds from this call on; left out, it waits for as long as it takes.

        Returns:
            A future of the message.

        Raises:
            HoldfastError: the actor has no recovery, or this is no turn.

        Raises (by the future):
            WaitTimeout: none has come in time.
        """
        self._alive()
        if not kinds or not all(isinstance(kind, type) and issubclass(kind, Message) for kind in kinds):
            raise SpecError("wait_for", f"takes classes of messages, not {kinds!r}")
        if answered := [kind.__name__ for kind in kinds if reply_type(kind) is not None]:
            raise SpecError("wait_for", f"takes messages whose reply is None, and {', '.join(answered)} has another")
        if timeout is not None:
            timeout = check_seconds(self.path, "timeout of wait_for", timeout)
        return cast("asyncio.Future[M]", self._signal(kinds, timeout))

    def _signal(self, kinds: tuple[type[Message[Any]], ...], timeout: float | None) -> asyncio.Future[Message[Any]]:
        """Wait for a message: only a home can."""
        raise HoldfastError(f"{self.path}: a turn can wait for a message only in an actor with recovery")

    # -- stash ------------------------------------------------------------------------------------------------------

    def stash(self) -> None:
        """Put the message in hand aside; it comes again after `unstash`. Its turn ends without a reply.

        What a timer, background work or a topic has brought is a message, too, and once it is put aside one like any
        other: to cancel its timer takes nothing back, and what a repeated timer brings next comes as well.

        Raises:
            StashError: no message is in hand (but an EXIT, a DOWN, or the start), or this one was stashed already.
        """
        self._alive()
        item = self._item
        if isinstance(item, Stashed):
            raise StashError(f"{self.path}: this message was stashed or forwarded already")
        if isinstance(item, Item) and item.of_life:
            if item.message is None:
                raise StashError(f"{self.path}: {NO_MESSAGE}")
            item = item.message  # From now on it is one like any other.
        more = self._cell.extra()
        if more.stash is None:
            more.stash = deque()
        more.stash.append(item)
        if isinstance(item, Item):
            item.stashed()
        self._cell.item = Stashed.of(item)

    def unstash(self) -> None:
        """Put all stashed messages back, in order, in front of what is queued."""
        self._alive()
        more = self._cell.extra()
        stash = more.stash
        if not stash:
            return
        if more.bound is not None:
            more.bound.count += len(stash)
        mailbox.put_back(self._cell, stash)
        stash.clear()
        self._cell.schedule()

    # -- others -----------------------------------------------------------------------------------------------------

    def spawn(self, start: Start[A], name: str | None = None) -> ActorRef[A]:
        """Start a child below this actor; it ends with this life and is not restarted.

        Raises:
            NameTaken: a child of that name is alive. StartFailed: its `__init__` raised.
        """
        self._alive()
        return cast("ActorRef[A]", self._cell.node.spawn(start, name, parent=self._cell).ref)

    def find(self, path: str, kind: type[A]) -> ActorRef[A]:
        """Return a ref to the actor at `path`.

        In a turn of a recorded actor it is one to the address, whether somebody lives there or not: a replay must go
        the same way again, when perhaps nobody does.

        Raises:
            NoSuchActor: nobody lives there. WrongActor: another class does.
        """
        return self._cell.node.find_ref(path, kind)

    @property
    def trap_exits(self) -> bool:
        """Say whether EXIT signals come to `on_exit` instead of ending this actor."""
        more = self._cell.more
        return more is not None and more.trap_exits

    @trap_exits.setter
    def trap_exits(self, value: bool) -> None:
        self._cell.extra().trap_exits = value

    def link(self, other: ActorRef[Any]) -> None:
        """Link this life with the one that is lived there: if one ends, and not with `NORMAL`, so does the other.

        Whoever traps exits is told by `on_exit` instead. If nobody lives there now, also because the other one waits
        for its restart, EXIT with `NoProc` comes at once: link again when it is back, not in `on_exit`.
        """
        to = cell_of("ctx.link", other)
        self._alive()
        links.link(self._cell, to.living)

    def unlink(self, other: ActorRef[Any]) -> None:
        """Remove a link; nothing more comes from it."""
        links.unlink(self._cell, cell_of("ctx.unlink", other).living)

    def monitor(self, other: ActorRef[Any]) -> Monitor:
        """`on_down` hears of the end of the present life there."""
        of = cell_of("ctx.monitor", other)
        self._alive()
        return links.monitor(self._cell, of.living, for_good=False)

    def watch(self, other: ActorRef[Any]) -> Monitor:
        """`on_down` hears once, when the address is gone for good."""
        of = cell_of("ctx.watch", other)
        self._alive()
        return links.monitor(self._cell, of.living, for_good=True)

    def subscribe(self, topic: str) -> None:
        """Get what is published there from now on."""
        check_topic("ctx.subscribe", topic)
        self._alive()
        self._cell.node.topics.subscribe(topic, self._cell)

    def unsubscribe(self, topic: str) -> None:
        """Receive no more of what is published on a topic."""
        check_topic("ctx.unsubscribe", topic)
        self._cell.node.topics.unsubscribe(topic, self._cell)

    def _has_class(self, old: type[Actor], new: type[Actor]) -> None:
        """Subscribe as the class that the actor has become does."""
        cell = self._cell
        for topic in old._topics:
            if topic not in new._topics:
                cell.node.topics.unsubscribe(topic, cell)
        for topic in new._topics:
            cell.node.topics.subscribe(topic, cell)

    def _bound(self, port: str) -> ActorRef[Any] | None:
        """What a binding points to now."""
        more = self._cell.more
        target = more.bindings.get(port) if more is not None else None
        return None if target is None else target.ref

    def stop(self, reason: ExitReason = NORMAL) -> None:
        """End this life after the turn in hand, as Erlang's `{stop, Reason, State}`.

        Args:
            reason: what the supervisor, links and monitors are told: `NORMAL`, `Shutdown("TEXT")` for another end in
                good order (its detail is text), or any exit reason that came from elsewhere. To crash, raise.

        Raises:
            SpecError: it is no exit reason of the library's. The life goes on if you catch that.
        """
        check_reason("ctx.stop", reason)
        self._alive()
        self._cell.request_stop(reason)

    # -- control (called between two turns, by what carries orders out) --------------------------------------------

    def _depart(self, owe: Callable[[Ask], int]) -> bytes:
        """Pack the state of an actor that is to be moved; a journaled one takes its last snapshot here instead.

        Raises whatever keeps it from being packed.
        """
        from ..migration.luggage import StatePacker

        actor = self._cell.actor
        assert actor is not None
        return StatePacker(actor, owe).pack()

    @property
    def _is_adrift(self) -> bool:
        """Whether a turn was left in the middle: this life handles nothing any more."""
        return False

    @property
    def _owes_turn(self) -> bool:
        """Whether a turn that had begun in an earlier life is to be run again, as it was, before anything changes."""
        return False

    def _rests(self) -> bool:
        """Whether the turn in hand is at no work: it waits for a moment or a message, or is being handled again."""
        return False

    def _turn_waits(self) -> None:
        """Take down that the turn in hand waits, or has ended behind a wait."""

    def _turn_goes_on(self) -> None:
        """Take down that the turn in hand is at work again."""

    def _leaves_turn(self) -> bool:
        """Leave the turn in hand, if it rests (for days, perhaps) and the next life runs it again from its start."""
        return False

    @property
    def _is_open(self) -> bool:
        """Whether the state can be looked at beside the turn in hand, which rests."""
        return False

    def _look_beside(self, look: Callable[[], object]) -> tuple[object] | None:
        """What is seen of the state in the middle of the turn in hand; None: that does not rest, and is waited for."""
        return None

    def _postpones(self, call: Item) -> bool:
        """Whether an order has to wait (a journaled actor takes none before it has caught up); it comes again then."""
        return False

    @property
    def _named_variables(self) -> tuple[str, ...] | None:
        """The key variables that a recovery file names for this actor; None if none does."""
        return None

    @property
    def _first_variables(self) -> list[str]:
        """The variables of the state that `__init__` has set, where that is kept."""
        return []

    @_first_variables.setter
    def _first_variables(self, names: list[str]) -> None:
        """The actor is of another class from now on."""

    def _may_replace(self) -> None:
        """The state is about to be replaced from outside. Raises ControlFailed if it cannot be now."""

    def _replaced(self) -> None:
        """The state was replaced from outside: a journaled actor saves it before anything else happens.

        Raises whatever keeps it from being saved.
        """

    def _saved(self) -> list[bytes]:
        """The present state as the actor's home would be told of it, if it has one; nobody is told.

        Raises whatever keeps it from being saved.
        """
        return []

    def _close(self) -> None:
        """Refuse everything from now on, because the life is over."""
        self._closed = True

    def create_task(self, work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        """Start a background task that ends with this life; an exception in it crashes the actor."""
        self._alive()
        task = self._beside(work, "task")
        task.add_done_callback(self._task_done)
        return task

    def _beside(self, work: Coroutine[Any, Any, T], what: str) -> asyncio.Task[T]:
        """A task of this life, which knows in what turn it was begun; what it sends is the actor's."""
        tasks, context = self._cell.extra().belongings.tasks, copy_context()
        context.run(begun_in.set, self._item)
        context.run(current.set, self)  # Who begins it may be none of its turns, such as the order to make an effect.
        task = self._cell.node.loop.create_task(contained(work), name=f"{what} of {self.path}", context=context)
        tasks.add(task)

        def over(_: asyncio.Task[T]) -> None:
            tasks.discard(task)
            work.close()  # If it was cancelled before its first step, it never began.

        task.add_done_callback(over)
        return task

    def _task_done(self, task: asyncio.Task[Any]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None and not self._closed:
            self._work_failed(Piped(None, uncontained(error)))

    def _work_failed(self, failed: Piped) -> None:
        """A background task has raised: this ends the life when its turn has come."""
        self._cell.push(failed)


async def contained(work: Coroutine[Any, Any, T]) -> T:
    """Run `work` in a task: what asyncio would let end the whole program ends whoever waits for this.

    Raises:
        RemoteCrash: in place of SystemExit and KeyboardInterrupt.
    """
    try:
        return await work
    except (SystemExit, KeyboardInterrupt) as error:
        raise remote_crash(error) from error


def uncontained(error: BaseException) -> BaseException:
    """What was raised in `contained` work that has failed with `error`."""
    cause = error.__cause__
    return cause if isinstance(cause, (SystemExit, KeyboardInterrupt)) else error


class Stashed(Envelope, eq=False):
    """The rest of a turn whose message was stashed or forwarded: whatever the handler returns is no reply."""

    @classmethod
    def of(cls, item: Any) -> Stashed:
        """Make what stands in the stash in place of `item`."""
        return cls(message_in(item), item.sender if isinstance(item, Item) else None)


class Piped(Item):
    """The result of background work."""

    __slots__ = ("chain", "error", "message")

    def __init__(self, message: Message[Any] | None, error: BaseException | None) -> None:
        self.message, self.error = message, error
        self.chain: Chain = ()

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        if item.message is None:
            raise item.error
        return actor._table[type(item.message)](actor, item.message)

    def hook(self) -> str:
        return "background work"


def waits_for(asker: ActorContext, cell: Cell, chain: Chain) -> bool:
    """Whether the turn that runs at `cell` is in the chain: an ask to it would wait for itself."""
    ctx = cell.ctx
    if ctx is asker:
        return asker._in_turn() and not asker._is_left_behind()
    return ctx is not None and ctx._turn_in(chain)


def awaited(work: Coroutine[Any, Any, Any]) -> Iterator[tuple[Any, CodeType | None, FrameType | None]]:
    """A coroutine and what it awaits, outermost first, each with its code and frame; last what has no code."""
    at: Any = work
    while at is not None:
        frame: FrameType | None
        code: CodeType
        match at:
            case object(cr_frame=frame, cr_code=code, cr_await=inner):
                pass
            case object(gi_frame=frame, gi_code=code, gi_yieldfrom=inner):
                pass
            case _:
                yield at, None, None
                return
        yield at, code, frame
        at = frame.f_locals.get(DRIVEN) if inner is None and frame is not None else inner


def may_wait_for(cell: Cell, other: Cell) -> bool:
    """Whether the turn at `cell` may wait for the one at `other`, by whom each actor in between has asked last."""
    at: Cell | None = cell
    for _ in range(LONGEST):
        if at is None or at is other:
            break
        more, ctx = at.more, at.ctx
        at = ctx._asked if ctx is not None and more is not None and more.turn is not None else None
    return at is other


def end_circle(ask: Ask) -> None:
    """If the asker's turn and those that wait for it stand in a circle, fail the ask in it that would run out first.

    That one cannot be answered in time any more. Nothing is failed if one of the turns may be waiting for something
    else as well, or no longer than some `with` block lets it.
    """
    row: list[Ask] = []
    cell: Cell = ask.sender
    while not row or cell is not ask.sender:
        following = _awaited_of(cell)
        if following is None or len(row) == LONGEST:
            return
        row.append(following)
        cell = following.to
    first = min(range(len(row)), key=lambda at: row[at].deadline)
    refused = row[first]
    refused.deadline = 0.0  # It stands in a mailbox: it is not run there.
    refused.fail(
        AskDeadlock(refused.to.path, tuple(one.sender.path for one in reversed(row[first + 1 :] + row[: first + 1])))
    )


def _awaited_of(cell: Cell) -> Ask | None:
    """The ask that the turn in hand waits for, and for nothing else; None if there is none that has not begun."""
    more, ctx = cell.more, cell.ctx
    if more is None or more.turn is None or ctx is None or ctx._asked is None or not ctx._may_fail_fast:
        return None
    future = more.turn.waiting
    for item in ctx._asked.queue or ():
        if isinstance(item, Ask) and item.future is future and item.sender is cell and item.to is ctx._asked:
            return None if item.is_done or _may_be_cut_short(more.turn) else item
    return None


def _may_be_cut_short(turn: Suspended) -> bool:
    """Whether a coroutine of a suspended turn is inside a `with` block, such as `asyncio.timeout`.

    The way out of the block is on the stack of its coroutine, where Python's collector finds it.
    """
    kinds = (types.MethodType, types.BuiltinMethodType, types.FunctionType)
    return any(
        isinstance(held, kinds) and held.__name__ in EXITS
        for work, _, _ in awaited(turn.coroutine)
        for held in gc.get_referents(work)
    )
