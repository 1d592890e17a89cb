"""Probes: actors that a test holds in its hand. They note what comes, answer when told to, and say what was missing."""

from __future__ import annotations

import asyncio
import contextvars
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeVar, cast, overload

from ..actors.errors import HoldfastError, type_name
from ..actors.exit_reasons import ExitReason
from ..actors.kernel import links
from ..actors.kernel.actor import Actor, Start
from ..actors.kernel.envelope import Ask, Handler, Item, ReplyHandle, Table
from ..actors.kernel.links import Monitor
from ..actors.kernel.message import Message, Refusal
from ..actors.kernel.ref import DEFAULT_TIMEOUT, ActorRef, current
from ..system.system import ActorSystem
from .barrier import NotIdle, idle, patience

M = TypeVar("M", bound=Message[Any])
R = TypeVar("R")

TIMEOUT = 3.0
"""Seconds, on the loop's clock, that a probe waits for what is expected."""
KEPT = 50
"""What came last and is shown when something else was expected."""


class Unexpected(AssertionError):
    """Something else came, or nothing; the text lists what the probe has received."""


class Received(NamedTuple):
    """A message, with who sent it and the right to answer it."""

    message: Message[Any]
    sender: ActorRef[Any] | None
    handle: ReplyHandle[Any] | None

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
    asked = isinstance(ctx.item, Ask)
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
        self.ref: ActorRef[Any] = system.spawn(Start(ProbeActor, (self._hear,)), name)

    def _hear(self, heard: Heard) -> None:
        self._inbox.append(heard)
        self._wake.set()

    @property
    def path(self) -> str:
        """Its address."""
        return self.ref.path

    @property
    def sender(self) -> ActorRef[Any] | None:
        """Who sent the message that was expected last; None if it was no actor."""
        return self._last.sender if self._last is not None else None

    @property
    def waiting(self) -> tuple[Message[Any], ...]:
        """Messages that came and were not expected yet, oldest first."""
        return tuple(heard.message for heard in self._inbox if isinstance(heard, Received))

    # -- expecting --------------------------------------------------------------------------------------------------

    @overload
    async def expect(self, what: type[M], *, timeout: float = TIMEOUT) -> M: ...
    @overload
    async def expect(self, what: M, *, timeout: float = TIMEOUT) -> M: ...
    async def expect(self, what: Any, *, timeout: float = TIMEOUT) -> Any:
        """The next message must be of this type, or equal to this message.

        Returns:
            The message; `reply` answers it.

        Raises:
            Unexpected: something else came, or nothing within `timeout` seconds. NotIdle: virtual time stood still.
        """
        heard = await self._next(_name(what), timeout)
        if not isinstance(heard, Received) or not _matches(heard.message, what):
            raise self._unexpected(_name(what), heard)
        self._last = heard
        return heard.message

    async def fish(self, wanted: type[M] | Callable[[Any], bool], *, timeout: float = TIMEOUT) -> M:
        """The first message that is of this type, or for which the predicate is true; others before it are dropped.

        Raises:
            Unexpected: none came within `timeout` seconds. NotIdle: virtual time stood still.
        """
        name = _name(wanted) if isinstance(wanted, type) else "a message that the predicate takes"
        deadline = asyncio.get_running_loop().time() + timeout
        while True:
            heard = await self._next(name, deadline - asyncio.get_running_loop().time(), timeout)
            if isinstance(heard, Received):
                found = isinstance(heard.message, wanted) if isinstance(wanted, type) else wanted(heard.message)
                if found:
                    self._last = heard
                    return cast("M", heard.message)

    async def expect_no_message(self, within: float | None = None) -> None:
        """Nothing comes until the system is idle, or for `within` seconds.

        Raises:
            Unexpected: something did, or had come before.
        """
        if within is None:
            await idle(self._system)
        elif not self._inbox:
            self._wake.clear()
            try:
                async with patience(within, self._system.node):
                    await self._wake.wait()
            except NotIdle:
                raise
            except TimeoutError:
                pass
        if self._inbox:
            raise self._unexpected("no message", self._inbox[0])

    async def expect_down(
        self, ref: ActorRef[Any], reason: ExitReason | type[ExitReason] | None = None, *, timeout: float = TIMEOUT
    ) -> Down:
        """The next thing to come is the DOWN of this ref (after `monitor` or `watch`), for this reason if one is given.

        Raises:
            Unexpected: something else came, or nothing within `timeout` seconds. NotIdle: virtual time stood still.
        """
        return await self._signal(Down, "DOWN", ref, reason, timeout)

    async def expect_exit(
        self, ref: ActorRef[Any], reason: ExitReason | type[ExitReason] | None = None, *, timeout: float = TIMEOUT
    ) -> Exit:
        """The next thing to come is the EXIT of this ref (after `link`), for this reason if one is given.

        Raises:
            Unexpected: something else came, or nothing within `timeout` seconds. NotIdle: virtual time stood still.
        """
        return await self._signal(Exit, "EXIT", ref, reason, timeout)

    async def _signal(self, kind: type[S], word: str, ref: ActorRef[Any], reason: Any, timeout: float) -> S:
        name = f"{word} of {ref.path}" + ("" if reason is None else f" for {_reason_name(reason)}")
        heard = await self._next(name, timeout)
        if not isinstance(heard, kind) or heard.ref != ref or not _has_reason(heard, reason):
            raise self._unexpected(name, heard)
        return heard

    async def _next(self, name: str, timeout: float, shown: float | None = None) -> Heard:
        try:
            async with patience(max(timeout, 0.0), self._system.node):
                while not self._inbox:
                    self._wake.clear()
                    await self._wake.wait()
        except NotIdle:
            raise
        except TimeoutError:
            raise self._unexpected(name, None, timeout if shown is None else shown) from None
        heard = self._inbox.popleft()
        self._past.append(heard)
        return heard

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
            HoldfastError: nobody asked.
        """
        self._handle().reply(value)

    def refuse(self, no: Refusal) -> None:
        """Answer the message that was expected last with a Refusal. Raises HoldfastError: nobody asked."""
        self._handle().fail(no)

    def _handle(self) -> ReplyHandle[Any]:
        last = self._last
        if last is None or last.handle is None:
            what = "no message was expected yet" if last is None else f"{last} is no ask"
            raise HoldfastError(f"{self.path} cannot reply: {what}")
        return last.handle

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
        context = self._system.node.base_context.copy()
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
        self._system.node.topics.subscribe(topic, self.ref._cell)

    async def stop(self) -> None:
        """End the probe's life."""
        await self._system.stop(self.ref)

    def __repr__(self) -> str:
        return f"<Probe {self.path}, {len(self._inbox)} waiting>"


def probe(system: ActorSystem, name: str | None = None) -> Probe:
    """A probe in a running system.

    Raises:
        NameTaken: a child of the root has this name.
    """
    return Probe(system, name)


def _matches(message: Message[Any], what: Any) -> bool:
    return isinstance(message, what) if isinstance(what, type) else message == what


def _name(what: Any) -> str:
    return type_name(what) if isinstance(what, type) else repr(what)


def _reason_name(reason: Any) -> str:
    return reason.__name__ if isinstance(reason, type) else str(reason)


def _has_reason(heard: Any, reason: Any) -> bool:
    if reason is None:
        return True
    return isinstance(heard.reason, reason) if isinstance(reason, type) else bool(heard.reason == reason)
