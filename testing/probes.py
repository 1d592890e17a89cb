"""Probes: actors that a test holds in its hand. They note what comes, answer when told to, and say what was missing."""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import math
from collections import deque
from collections.abc import AsyncGenerator, Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar, cast, overload

from ..actors.errors import BadMessage, HoldfastError, type_name
from ..actors.events import DeadLetter, Event
from ..actors.exit_reasons import ExitReason
from ..actors.kernel import links
from ..actors.kernel.actor import Actor, Start
from ..actors.kernel.cell import Cell
from ..actors.kernel.envelope import Ask, AskHandle, Envelope, Handler, Item, ReplyHandle, Table, message_in
from ..actors.kernel.links import Monitor
from ..actors.kernel.message import Message, Refusal, reply_type
from ..actors.kernel.ref import DEFAULT_TIMEOUT, ActorRef, current
from ..actors.seconds import check_seconds
from ..system.system import ActorSystem
from .barrier import NotIdle, idle, patience
from .guard.declared import wrong_value
from .probing.taps import Tap

M = TypeVar("M", bound=Message[Any])
R = TypeVar("R")

TIMEOUT = 3.0
"""Seconds, on the loop's clock, that a probe waits for what is expected."""
KEPT = 50
"""What came last and is shown when something else was expected."""


class Unexpected(AssertionError):
    """Something else came, or nothing; the text lists what the probe has received."""


class Received(NamedTuple):
    """A message, with who sent it, the right to answer it, and whether the autopilot has done so."""

    message: Message[Any]
    sender: ActorRef[Any] | None
    handle: ReplyHandle[Any] | None
    is_answered: bool = False

    def __str__(self) -> str:
        verb = "asked" if self.handle is not None else "told"
        source = "" if self.sender is None else f" by {self.sender.path}"
        return f"{self.message!r} ({verb}{source})"


class Down(NamedTuple):
    """A monitor's or watch's notice."""

    ref: ActorRef[Any]
    reason: ExitReason
    recovering: bool

    def __str__(self) -> str:
        return f"DOWN of {self.ref.path}: {self.reason}{' (recovering)' if self.recovering else ''}"


class Exit(NamedTuple):
    """A link's signal; probes trap exits."""

    ref: ActorRef[Any]
    reason: ExitReason

    def __str__(self) -> str:
        return f"EXIT of {self.ref.path}: {self.reason}"


Heard = Received | Down | Exit
S = TypeVar("S", Down, Exit)
E = TypeVar("E", bound=Event)
Pilot = Callable[[Any], object] | Mapping[type, object]
"""What answers for a test: a function of the message, or replies by its type."""


class Anything(Table):
    """The handler table of a probe: every message has a handler, also one that comes by name from another process."""

    def __missing__(self, kind: type) -> Handler:
        if issubclass(kind, Item):
            return super().__missing__(kind)
        self[kind] = _take
        return _take

    def __contains__(self, kind: object) -> bool:
        return True

    def __iter__(self) -> Iterator[type]:
        waiting: list[type] = [Message]
        while waiting:
            kind = waiting.pop()
            yield kind
            waiting.extend(kind.__subclasses__())

    def knows(self, kind: type) -> bool:
        return True


def _take(actor: Any, message: Any) -> object:
    ctx = actor.ctx
    asked = isinstance(ctx._item, Ask)
    handle = ctx.reply_handle() if asked else None
    actor.hear(Received(message, ctx.sender, handle))
    return handle


class ProbeActor(Actor):
    """The actor behind a probe."""

    def __init__(self, hear: Callable[[Heard], None]) -> None:
        self.hear = hear
        self.ctx.trap_exits = True

    def on_down(self, source: ActorRef[Any], reason: ExitReason, recovering: bool) -> None:
        self.hear(Down(source, reason, recovering))

    def on_exit(self, source: ActorRef[Any], reason: ExitReason) -> None:
        self.hear(Exit(source, reason))


ProbeActor._table = Anything()


class Probe:
    """A test's own actor. What it receives waits in order until it is expected.

    Made by `probe(system)`. Time-outs are seconds on the loop's clock: under the virtual one they take no time.
    """

    def __init__(self, system: ActorSystem, name: str | None = None) -> None:
        self._system = system
        self._inbox: deque[Heard] = deque()
        self._past: deque[Heard] = deque(maxlen=KEPT)
        self._wake: asyncio.Event = asyncio.Event()
        self._last: Received | None = None
        self._answered = False
        self._expects: asyncio.Task[Any] | None = None
        self._deadline = math.inf
        self._pilot: Pilot | None = None
        self._taps: list[Tap] = []
        self._events = system._node.events.listen()
        self.ref: ActorRef[Any] = system.spawn(Start(ProbeActor, (self._hear,)), name)

    def _hear(self, heard: Heard) -> None:
        self._inbox.append(heard)
        self._wake.set()
        if self._pilot is not None and isinstance(heard, Received) and self._fly(self._pilot, heard):
            self._inbox[-1] = heard._replace(is_answered=True)

    @property
    def path(self) -> str:
        """The address at which the probe receives."""
        return self.ref.path

    @property
    def sender(self) -> ActorRef[Any] | None:
        """Return a ref to the sender of the message that was expected last; None if it was no actor."""
        return self._last.sender if self._last is not None else None

    @property
    def waiting(self) -> tuple[Message[Any], ...]:
        """Messages that came and were not expected yet, oldest first."""
        return tuple(heard.message for heard in self._inbox if isinstance(heard, Received))

    # -- expecting --------------------------------------------------------------------------------------------------

    @overload
    async def expect(self, what: type[M], *, timeout: float | None = None) -> M: ...
    @overload
    async def expect(self, what: M, *, timeout: float | None = None) -> M: ...
    async def expect(self, what: Any, *, timeout: float | None = None) -> Any:
        """Take the next message, which must be of this type, or equal to this message.

        Returns:
            The message; `reply` answers it.

        Raises:
            Unexpected: something else came, or nothing within `timeout` seconds. NotIdle: virtual time stood still.
        """
        heard = await self._next(_name(what), timeout)
        if not isinstance(heard, Received) or not _matches(heard.message, what):
            raise self._unexpected(_name(what), heard)
        self._took(heard)
        return heard.message

    async def expect_all(self, *what: Any, timeout: float | None = None) -> tuple[Message[Any], ...]:
        """Take the next messages, which are these, each once, in any order: of these types, or equal to these messages.

        Returns:
            The messages, in the order of `what`. The one that came last is answered by `reply`.

        Raises:
            Unexpected: another came, or not all within `timeout` seconds. NotIdle: virtual time stood still.
        """
        loop = asyncio.get_running_loop()
        seconds = self._seconds(timeout)
        deadline = loop.time() + seconds
        came: list[Received] = []
        while len(came) < len(what):
            missing = [_name(one) for one in _unmatched(what, came)]
            name = f"all of {', '.join(map(_name, what))} (still {', '.join(missing)})"
            heard = await self._next(name, max(0.0, deadline - loop.time()), seconds)
            if not isinstance(heard, Received) or len(_unmatched(what, [*came, heard])) == len(missing):
                raise self._unexpected(name, heard)
            came.append(heard)
            self._took(heard)
        return tuple(came[number].message for number in _matching(what, came))

    @contextlib.asynccontextmanager
    async def within(self, seconds: float) -> AsyncGenerator[None]:
        """Have all that is expected inside come within so many seconds; a `timeout` inside can only be shorter.

        Raises:
            Unexpected: the block has taken longer.
        """
        loop = asyncio.get_running_loop()
        own = loop.time() + check_seconds(self.path, "within", seconds, or_zero=True)
        outer, self._deadline = self._deadline, min(self._deadline, own)
        try:
            yield
            if loop.time() > own:
                raise Unexpected(f"{self.path}: what was to end within {seconds:g} s took longer")
        finally:
            self._deadline = outer

    def _seconds(self, timeout: float | None) -> float:
        """How long an expectation waits. Raises SpecError: the time-out is no finite number >= 0."""
        if timeout is not None:
            check_seconds(self.path, "timeout", timeout, or_zero=True)
        if self._deadline == math.inf:
            return TIMEOUT if timeout is None else timeout
        left = max(0.0, self._deadline - asyncio.get_running_loop().time())
        return left if timeout is None else min(left, timeout)

    def _took(self, heard: Received) -> None:
        self._last, self._answered = heard, heard.is_answered

    @overload
    async def expect_event(self, wanted: type[E], *, timeout: float | None = None) -> E: ...
    @overload
    async def expect_event(self, wanted: Callable[[Event], bool], *, timeout: float | None = None) -> Event: ...
    async def expect_event(self, wanted: Any, *, timeout: float | None = None) -> Any:
        """Wait for the next event of this type, or for which this is true, since the probe was made.

        Events before it are dropped.

        Raises:
            Unexpected: none came within `timeout` seconds; it lists the others. NotIdle: virtual time stood still.
        """
        name = f"the event {_name(wanted) if isinstance(wanted, type) else 'that was described'}"
        seconds, others = self._seconds(timeout), list[Event]()
        try:
            async with patience(seconds, self._system._node):
                async for event in self._events:
                    if isinstance(event, wanted) if isinstance(wanted, type) else wanted(event):
                        return event
                    others.append(event)
        except NotIdle:
            raise
        except TimeoutError:
            pass
        lines = [f"  {number}. {event}" for number, event in enumerate(others[-KEPT:], 1)]
        text = f"{self.path} expected {name}, got nothing in {seconds:g} s"
        raise Unexpected("\n".join([text, "other events:" if lines else "there were no events", *lines]))

    async def expect_dead_letter(
        self, what: Any = Message, to: ActorRef[Any] | None = None, *, timeout: float | None = None
    ) -> DeadLetter:
        """Wait for the next dead letter of this type, or equal to this message, at this address if one is given.

        A guarded system counts it as one that was expected.

        Raises:
            Unexpected: none came within `timeout` seconds. NotIdle: virtual time stood still.
        """

        def is_it(event: Event) -> bool:
            if not isinstance(event, DeadLetter) or (to is not None and event.address != to.path):
                return False
            return _matches(message_in(event.message), what)

        from .guarded import GuardedSystem

        letter = await self.expect_event(is_it, timeout=timeout)
        if isinstance(self._system, GuardedSystem):
            self._system.expect_dead_letters(1)
        return cast("DeadLetter", letter)

    async def fish(self, wanted: type[M] | Callable[[Any], bool], *, timeout: float | None = None) -> M:
        """Take the first message of this type, or for which the predicate is true; others before it are dropped.

        Raises:
            Unexpected: none came within `timeout` seconds. NotIdle: virtual time stood still.
        """
        name = _name(wanted) if isinstance(wanted, type) else "a message that the predicate takes"
        timeout = self._seconds(timeout)
        deadline = asyncio.get_running_loop().time() + timeout
        while True:
            heard = await self._next(name, max(0.0, deadline - asyncio.get_running_loop().time()), timeout)
            if isinstance(heard, Received):
                found = isinstance(heard.message, wanted) if isinstance(wanted, type) else wanted(heard.message)
                if found:
                    self._took(heard)
                    return cast("M", heard.message)

    async def expect_no_message(self, within: float | None = None) -> None:
        """Make sure that nothing comes until the system is idle, or for `within` seconds.

        Raises:
            Unexpected: something did, or had come before.
        """
        self._alive()
        if within is None:
            await idle(self._system)
        elif not self._inbox:
            check_seconds(self.path, "within", within, or_zero=True)
            self._wake.clear()
            try:
                async with patience(within, self._system._node):
                    await self._wake.wait()
            except NotIdle:
                raise
            except TimeoutError:
                pass
        if self._inbox:
            raise self._unexpected("no message", self._inbox[0])

    async def expect_down(
        self, ref: ActorRef[Any], reason: ExitReason | type[ExitReason] | None = None, *, timeout: float | None = None
    ) -> Down:
        """Take the DOWN of this ref (after `monitor` or `watch`), which comes next, for this reason if one is given.

        Raises:
            Unexpected: something else came, or nothing within `timeout` seconds. NotIdle: virtual time stood still.
        """
        return await self._signal(Down, "DOWN", ref, reason, timeout)

    async def expect_exit(
        self, ref: ActorRef[Any], reason: ExitReason | type[ExitReason] | None = None, *, timeout: float | None = None
    ) -> Exit:
        """Take the EXIT of this ref (after `link`), which comes next, for this reason if one is given.

        Raises:
            Unexpected: something else came, or nothing within `timeout` seconds. NotIdle: virtual time stood still.
        """
        return await self._signal(Exit, "EXIT", ref, reason, timeout)

    async def _signal(self, kind: type[S], word: str, ref: ActorRef[Any], reason: Any, timeout: float | None) -> S:
        name = f"{word} of {ref.path}" + ("" if reason is None else f" for {_reason_name(reason)}")
        heard = await self._next(name, timeout)
        if not isinstance(heard, kind) or heard.ref != ref or not _has_reason(heard, reason):
            raise self._unexpected(name, heard)
        return heard

    async def _next(self, name: str, timeout: float | None, shown: float | None = None) -> Heard:
        seconds = self._seconds(timeout)
        if self._expects is not None:
            raise HoldfastError(
                f"{self.path} is waited for by {self._expects.get_name()} already: of two tasks that expect at once "
                "nobody knows which one gets what comes; give each a probe of its own"
            )
        self._expects = asyncio.current_task()
        try:
            async with patience(seconds, self._system._node):
                while not self._inbox:
                    self._alive()
                    self._wake.clear()
                    await self._wake.wait()
        except NotIdle:
            raise
        except TimeoutError:
            raise self._unexpected(name, None, seconds if shown is None else shown) from None
        finally:
            self._expects = None
        heard = self._inbox.popleft()
        self._past.append(heard)
        return heard

    def _alive(self) -> None:
        if self.ref._cell.is_dead:
            raise HoldfastError(f"{self.path} has stopped: nothing can come any more")

    def _unexpected(self, expected: str, heard: Heard | None, timeout: float = 0.0) -> Unexpected:
        lines = [f"{self.path} expected {expected}, " + (f"got {heard}" if heard else f"got nothing in {timeout:g} s")]
        history = [*self._past, *(one for one in self._inbox if one is not heard)]
        lines.append("received so far:" if history else "it has received nothing")
        lines += [f"  {number}. {one}" for number, one in enumerate(history, 1)]
        return Unexpected("\n".join(lines))

    # -- doing ------------------------------------------------------------------------------------------------------

    def reply(self, value: object = None) -> None:
        """Answer the message that was expected last.

        Raises:
            HoldfastError: nobody asked, or it was answered before.
            BadMessage: the message declares another type of reply.
        """
        handle = self._handle()
        assert self._last is not None
        self._require_type(self._last.message, value)
        self._answered = True
        handle.reply(value)

    def _require_type(self, message: Message[Any], value: object) -> None:
        problem = wrong_value(reply_type(type(message)), value)
        if problem is not None:
            raise BadMessage(self.path, type_name(type(message)), f"the reply {value!r}: {problem}")

    def refuse(self, no: Refusal) -> None:
        """Answer the message that was expected last with a Refusal.

        Raises:
            HoldfastError: nobody asked, or it was answered before.
        """
        handle = self._handle()
        self._answered = True
        handle.fail(no)

    def forward(self, to: ActorRef[Any]) -> None:
        """Hand the message that was expected last on: the receiver sees the original sender, and its reply goes there.

        Raises:
            HoldfastError: nothing was expected yet, or it was answered or forwarded before.
            UnknownMessage: the receiver's class is known and has no handler for it.
        """
        last = self._last
        if last is None or self._answered:
            raise HoldfastError(f"{self.path} cannot forward: {_why_not(last, self._answered)}")
        cell: Cell = to._cell
        cell.require(last.message)
        self._answered = True
        ask = last.handle.ask if isinstance(last.handle, AskHandle) else None
        if ask is not None:
            cell.admit(cell, ask)
        elif last.sender is not None:
            cell.admit(cell, Envelope(last.message, last.sender._cell))
        else:
            cell.admit(cell, last.message)

    def _handle(self) -> ReplyHandle[Any]:
        last = self._last
        if last is None or last.handle is None or self._answered:
            raise HoldfastError(f"{self.path} cannot reply: {_why_not(last, self._answered)}")
        return last.handle

    def autopilot(self, pilot: Pilot | None) -> None:
        """Have each message that comes answered at once; None ends that. What came can still be expected.

        Args:
            pilot: a function of the message, or replies by the type of the message, each of them a value or a function
                of the message. What it returns, or a Refusal that it raises, is the reply to an ask; `NotImplemented`,
                or a type that is not in the mapping, leaves the answer to the test.
        """
        self._pilot = pilot

    def _fly(self, pilot: Pilot, heard: Received) -> bool:
        """Whether the autopilot has answered."""
        try:
            value = _piloted(pilot, heard.message)
            if value is NotImplemented or heard.handle is None:
                return False
            self._require_type(heard.message, value)
        except Refusal as no:
            if heard.handle is None:
                return False
            heard.handle.fail(no)
        else:
            heard.handle.reply(value)
        return True

    def tap(self, first: ActorRef[Any], second: ActorRef[Any] | None = None) -> Tap:
        """See what goes to an address, `tap(receiver)`, or from one actor to another, `tap(sender, receiver)`.

        Each message that is let in there comes to the probe too, with its sender, and is delivered as ever; only the
        receiver can answer it. The tap ends with its `close`, its context, the probe's life, or the address.
        """
        receiver, sender = (first, None) if second is None else (second, first)
        self._alive()

        def hear(message: Message[Any], source: ActorRef[Any] | None) -> None:
            if not self.ref._cell.is_dead:
                self._hear(Received(message, source, None))

        tap = Tap(receiver, sender, hear)
        self._taps.append(tap)
        return tap

    def tell(self, ref: ActorRef[Any], message: Message[Any]) -> None:
        """Send from the probe: the receiver sees it as the sender."""
        self._context().run(ref.tell, message)

    def ask(self, ref: ActorRef[Any], message: Message[R], timeout: float = DEFAULT_TIMEOUT) -> asyncio.Future[R]:
        """Ask from the probe; the reply comes back here, not into the probe."""
        return self._context().run(ref.ask, message, timeout)

    def _context(self) -> contextvars.Context:
        ctx = self.ref._cell.ctx
        if ctx is None:
            raise HoldfastError(f"{self.path} has stopped")
        context = self._system._node.base_context.copy()
        context.run(current.set, ctx)
        return context

    def monitor(self, ref: ActorRef[Any]) -> Monitor:
        """Hear of the end of the present life there: `expect_down`."""
        return links.monitor(self.ref._cell, ref._cell, for_good=False)

    def watch(self, ref: ActorRef[Any]) -> Monitor:
        """Hear, once, when the address is gone for good: `expect_down`."""
        return links.monitor(self.ref._cell, ref._cell, for_good=True)

    def link(self, ref: ActorRef[Any]) -> None:
        """Link the probe: `expect_exit`. It does not end with others, but others end with it."""
        links.link(self.ref._cell, ref._cell)

    def subscribe(self, topic: str) -> None:
        """Receive what is published there."""
        self._system._node.topics.subscribe(topic, self.ref._cell)

    async def stop(self) -> None:
        """End the probe's life, and its taps."""
        for tap in self._taps:
            tap.close()
        self._events.close()
        await self._system.stop(self.ref)
        self._wake.set()

    def __repr__(self) -> str:
        return f"<Probe {self.path}, {len(self._inbox)} waiting>"


def probe(system: ActorSystem, name: str | None = None) -> Probe:
    """Start a probe in a running system, as an actor that the test holds in its hand.

    Raises:
        NameTaken: a child of the root has this name.
    """
    return Probe(system, name)


def _matches(message: Message[Any], what: Any) -> bool:
    return isinstance(message, what) if isinstance(what, type) else message == what


def _matching(what: Sequence[Any], came: Sequence[Received]) -> list[int]:
    """For each of what is wanted the number of the message that stands for it, -1 for none: as many as can be."""
    taken: dict[int, int] = {}  # message: what it stands for

    def take(wanted: int, tried: set[int]) -> bool:
        for number, heard in enumerate(came):
            if number not in tried and _matches(heard.message, what[wanted]):
                tried.add(number)
                if number not in taken or take(taken[number], tried):
                    taken[number] = wanted
                    return True
        return False

    for wanted in range(len(what)):
        take(wanted, set())
    number_of = {wanted: number for number, wanted in taken.items()}
    return [number_of.get(wanted, -1) for wanted in range(len(what))]


def _unmatched(what: Sequence[Any], came: Sequence[Received]) -> list[Any]:
    return [one for one, number in zip(what, _matching(what, came), strict=True) if number < 0]


def _piloted(pilot: Pilot, message: Message[Any]) -> object:
    if callable(pilot):
        return pilot(message)
    for kind in type(message).__mro__:
        if kind in pilot:
            answer = pilot[kind]
            return answer(message) if callable(answer) else answer
    return NotImplemented


def _why_not(last: Received | None, answered: bool) -> str:
    if last is None:
        return "no message was expected yet"
    return f"{last} was answered or forwarded before" if answered else f"{last} is no ask"


def _name(what: Any) -> str:
    """What is expected, in words.

    Raises:
        TypeError: it is neither a class nor a message, so that it can never come.
    """
    if isinstance(what, type):
        return type_name(what)
    if not isinstance(what, Message):
        raise TypeError(f"a probe expects a class of messages or a message, not {what!r}")
    return repr(what)


def _reason_name(reason: Any) -> str:
    return reason.__name__ if isinstance(reason, type) else str(reason)


def _has_reason(heard: Any, reason: Any) -> bool:
    if reason is None:
        return True
    return isinstance(heard.reason, reason) if isinstance(reason, type) else bool(heard.reason == reason)
