"""Events: what happens in a system, as typed values on one stream; text is made only when somebody reads it."""

from __future__ import annotations

import asyncio
import functools
import math
import typing
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Any, Final, Literal, TypeVar

import msgspec

from .errors import NoSuchEvent, portable
from .exit_reasons import ExitReason, pack_exit, unpack_exit
from .kernel.envelope import Item, item_name
from .kernel.message import Message, MessageText, message_of
from .seconds import check_seconds

E = TypeVar("E", bound="Event")


class Event(msgspec.Struct, frozen=True, eq=False):
    """Base of all events; `address` is the actor's."""

    address: str


class ActorStarted(Event, frozen=True, eq=False):
    """A life began; `life` counts from 1 at each address."""

    life: int


class ActorCrashed(Event, frozen=True, eq=False):
    """User code raised; `item` is what was being handled (from another process: as text that knows its type)."""

    life: int
    reason: ExitReason
    item: Any


class HookFailed(Event, frozen=True, eq=False):
    """`on_stop` or another closing hook raised; the end went on."""

    hook: str
    reason: ExitReason


class LifeAbandoned(Event, frozen=True, eq=False):
    """A killed turn went on in spite of its cancellation; what it sends is refused."""

    life: int


class DeadLetter(Event, frozen=True, eq=False):
    """Nobody handles this message, for the reason that `why` gives; `sender` is an actor's address, if known."""

    message: Any
    why: str
    sender: str = ""


REFUSED: Final = "refused: "
"""How `why` begins if the handler has refused a message that was told: that one was handled, and is not counted."""


class ChildRestarted(Event, frozen=True, eq=False):
    """A supervisor starts a child again.

    `attempt` counts the restarts of all its children within its period, this one included; `allowed` is its intensity.
    """

    reason: ExitReason
    attempt: int
    allowed: int = 0


class ChildTerminated(Event, frozen=True, eq=False):
    """A child ended by itself: told of every end of a permanent child, and of abnormal ends of the others.

    `restarts` are those of its supervisor's children within the period so far, `allowed` is its intensity.
    """

    reason: ExitReason
    restarts: int = 0
    allowed: int = 0


class ChildStopped(Event, frozen=True, eq=False):
    """A child has ended because it was told to, or a transient one because its work is done.

    `by` is the address of the actor that has called for it: the child itself, its supervisor, or who has asked its
    supervisor; "" if that was no actor. `because` says why in words.
    """

    life: int
    reason: ExitReason
    by: str
    because: str


class EndedByLink(Event, frozen=True, eq=False):
    """An actor ends because one that it is linked to, `peer`, has ended, and not with `NORMAL`."""

    peer: str
    reason: ExitReason


class ActorKilled(Event, frozen=True, eq=False):
    """Somebody has called `ref.kill()`, and the life ends; `by` is the actor whose turn has, "" if no actor has."""

    by: str


class ChildStartFailed(Event, frozen=True, eq=False):
    """A supervisor could not start a child; `reason` is its exit reason in words."""

    reason: str


class ShutdownError(Event, frozen=True, eq=False):
    """A child that was told to stop ended for another reason than it was told; the shutdown went on."""

    reason: ExitReason


class ActorSuspended(Event, frozen=True, eq=False):
    """An actor handles no message from now on, by the order of somebody: `by` says who.

    That is the address of an actor, "the program", or "an operator".
    """

    by: str


class ActorResumed(Event, frozen=True, eq=False):
    """An actor handles messages again, by the order of somebody: `by` says who."""

    by: str


class StopOverdue(Event, frozen=True, eq=False):
    """An actor has not ended in the time that those below it have for it, and is killed with all of them.

    `stacks` tells where each turn below it waits, as far as it is in the same process.
    """

    seconds: float
    stacks: str


class OrderHeld(Event, frozen=True, eq=False):
    """A supervisor is suspended, and so an order to it waits: to "start" or to "stop" a child. Told once of each.

    `child` is the address of that child, and `seconds` how long the order has waited. `resume` lets it go on.
    """

    order: str
    child: str
    seconds: float


class BindingAwaited(Event, frozen=True, eq=False):
    """Children that come back with their dynamic supervisor wait for somebody to whom their specs bind them.

    Told once of each `target`, after five seconds: so many `children` wait, for so many `seconds`. They start when
    somebody lives at that address.
    """

    target: str
    children: int
    seconds: float


class AutoShutdown(Event, frozen=True, eq=False):
    """A supervisor ends because its significant children have."""

    child: str
    reason: ExitReason


class SupervisorGaveUp(Event, frozen=True, eq=False):
    """A supervisor reached its restart intensity."""

    child: str
    reason: ExitReason


class ProcessStarted(Event, frozen=True, eq=False):
    """An actor's OS process is up."""

    pid: int


class ProcessDied(Event, frozen=True, eq=False):
    """An actor's OS process is gone; `asked`: a program was asked to end, and did so before it had to be killed."""

    pid: int
    reason: ExitReason
    asked: bool = False


class HelperStuck(Event, frozen=True, eq=False):
    """A helper process of holdfast did not do its work: `found` says how it was found, and what was done.

    The `helper` is the "keeper" of the program at the address, or the "fork server" of the system.
    """

    helper: str
    pid: int
    found: str


class TrustBreached(Event, frozen=True, eq=False):
    """An actor process said what it may not, or what cannot be; it is ended, and nobody else."""

    pid: int
    problem: str


class Recovered(Event, frozen=True, eq=False):
    """An actor came back with state and messages. Phases: detect, isolate, restart, restore, replay, release."""

    life: int
    replayed: int
    phases: dict[str, float]


class RecoveryFailed(Event, frozen=True, eq=False):
    """One attempt to bring an actor back has failed; its supervisor decides whether there is another."""

    reason: str


class RecoveryPhase(Event, frozen=True, eq=False):
    """A phase of a recovery is over: detect, safe_state, isolate, restart, restore, replay, release.

    `recovery` numbers the recoveries of a system, `attempt` counts from 1 within one; `since_noticed` are the seconds
    from the notice of the crash to the end of the phase, `seconds` those it took.
    """

    recovery: int
    attempt: int
    phase: str
    since_noticed: float
    seconds: float


class RecoveryHookFailed(Event, frozen=True, eq=False):
    """A hook of a recovery ("before isolate") raised, took too long, or was not called; the recovery went on."""

    hook: str
    reason: str


class SafeStateEntered(Event, frozen=True, eq=False):
    """An actor was told to be safe, because of the recovery of another."""

    because: str


class SafeStateMissed(Event, frozen=True, eq=False):
    """Nobody was made safe for a recovery here, an address or the name of a binding; the recovery goes on."""

    because: str
    reason: str


class SafeStateLeft(Event, frozen=True, eq=False):
    """An actor was told that all recoveries are over because of which it was safe; `because` is the last one's."""

    because: str


class SafeStateKept(Event, frozen=True, eq=False):
    """A recovery has failed: `receivers` stay safe until the actor is back."""

    receivers: tuple[str, ...]
    reason: str


class SafeStateOverdue(Event, frozen=True, eq=False):
    """An actor has not heard within `seconds` that it need not be safe any more. It stays safe."""

    seconds: float
    because: str


class HeldMessages(Event, frozen=True, eq=False):
    """Messages came while an actor was recovered whose method has `held=`: how many wait, and what became of more."""

    held: int
    dropped: int
    refused: int


class RolledBack(Event, frozen=True, eq=False):
    """An actor comes back with an older state: what its turns after `to_turn` did to it, up to `from_turn`, is undone.

    `to_turn` is -1 if it begins afresh. What has left stays out; what was not handled stays queued.
    """

    from_turn: int
    to_turn: int
    reason: str


class TurnsLost(Event, frozen=True, eq=False):
    """An actor comes back with the state of its snapshot after `turn` (-1: it has none, and begins afresh).

    What it handled since, `count` messages, timers and signals, is lost from its state (`checkpoint_only`).
    """

    count: int
    turn: int


class EffectRepeated(Event, frozen=True, eq=False):
    """An actor has ended while an effect was out, and its next life performs the effect again.

    `effect` is its key, and `message` the type of the message whose handler wants it.
    """

    effect: str
    message: str


class EffectRetried(Event, frozen=True, eq=False):
    """An attempt of an effect has failed, and is followed by another one.

    Attempt `number` of at most `most` has raised `error`; the next one begins in `seconds`. `effect` is its key.
    """

    effect: str
    number: int
    most: int
    error: str
    seconds: float


class ReplayPaced(Event, frozen=True, eq=False):
    """A replay that waits between messages: `turns` are still to be fed, and the last is due in `seconds`.

    `held` messages have come meanwhile. Told when it begins, and now and then.
    """

    turns: int
    seconds: float
    held: int


class TurnsSkipped(Event, frozen=True, eq=False):
    """A replay left out `readonly` turns that changed nothing and `superseded` ones that are written over.

    `problem`: why a key could not be had; nothing was left out because of it.
    """

    readonly: int
    superseded: int
    problem: str = ""


class MessageQuarantined(Event, frozen=True, eq=False):
    """A message that ended the process `deliveries` times in a row was put aside."""

    message: str
    deliveries: int


class SnapshotTaken(Event, frozen=True, eq=False):
    """A snapshot is safe: state after `turn`, in bytes; `pause` is how long the actor stood still, in seconds.

    `written_bytes` of it were written anew: what had not changed since the last one was not.
    """

    turn: int
    size_bytes: int
    pause: float
    written_bytes: int = 0


class SnapshotDamaged(Event, frozen=True, eq=False):
    """The newest snapshot could not be used: the actor goes on from an older one, after `turn`, and what came since."""

    turn: int
    reason: str


class RecordsMapped(Event, frozen=True, eq=False):
    """Records of an earlier version of the program were mapped to the fields and variables of the present one."""

    changes: str


class RecoveryTableUnused(Event, frozen=True, eq=False):
    """Nobody has been started yet whom this table of the recovery file is for; `where` is its file and line."""

    table: str
    where: str


class SnapshotFailed(Event, frozen=True, eq=False):
    """A snapshot could not be made or kept; journal and older snapshot stay."""

    reason: str


class StoreRefused(Event, frozen=True, eq=False):
    """The store did not keep or erase something for a supervisor in another process."""

    reason: str


class JournalFull(Event, frozen=True, eq=False):
    """The journal reached its limit; `turn` is the last one a snapshot covers, `way_out` says what can help."""

    turn: int
    size_bytes: int
    way_out: str = ""


class JournalBlocked(Event, frozen=True, eq=False):
    """The store has no room, or is locked: nothing is admitted, and nothing leaves, until it writes again."""

    reason: str


class JournalGoesOn(Event, frozen=True, eq=False):
    """The store writes again; what has waited leaves."""


class JournalStopped(Event, frozen=True, eq=False):
    """The store failed: nothing is admitted, and nothing leaves any more. Start the root again, which verifies it."""

    reason: str


class StandingBy(Event, frozen=True, eq=False):
    """Another program, `leader`, leads the system, and this one waits. Told anew whenever the leader changes."""

    leader: str


class ServersSilent(Event, frozen=True, eq=False):
    """The servers of the store do not answer a program that waits to lead, or that leads, and why.

    A leader tells it after a few seconds, in which servers may elect one of them. It is told anew each 30 s.
    """

    reason: str


class ServersAnswer(Event, frozen=True, eq=False):
    """The servers of the store answer again, after so many `seconds`: told if `ServersSilent` was told before."""

    seconds: float


class LeadershipTaken(Event, frozen=True, eq=False):
    """From now on this program leads the system, in this `epoch`; its tree is started next."""

    epoch: int


class ConnectionLimited(Event, frozen=True, eq=False):
    """A program wants more of a system than its `ConnectionLimits` allow, and is refused.

    Both ends tell it, once for each kind and line; `address` is that of the other system. `what` is over its limit,
    such as asks or subscriptions, and `problem` says how many there are.
    """

    what: str
    problem: str


class KeptForSystem(Event, frozen=True, eq=False):
    """Much is kept for another system that does not take it: what recorded actors tell it. `address` is that system's.

    Told when half of the limit is reached, and when the limit is; `is_full`: what else it is told is a dead letter.
    """

    messages: int
    bytes: int
    is_full: bool


class TurnSlow(Event, frozen=True, eq=False):
    """A turn occupied the event loop for at least `seconds`: nothing else ran meanwhile; `message` is its type.

    It is looked at four times within `watch_turns` seconds: what it took before the first look that found it, and
    behind the last one, is not counted.
    """

    message: str
    seconds: float


class TurnWaits(Event, frozen=True, eq=False):
    """A turn has taken longer than `watch_waits`, with all that it waits for, and goes on: nothing was ended.

    It is told once more each time that it has taken twice as long.

    Attributes:
        message: the type of what it handles; "" if its process does not answer.
        seconds: that it has taken so far, at least.
        at: the line of the user's code at which it waits; "" if that is not known.
    """

    message: str
    seconds: float
    at: str


class StopWaits(Event, frozen=True, eq=False):
    """An actor has been stopping for longer than `watch_waits`, and nothing was cut off.

    Of supervisors that wait for each other the lowest one tells. It is told again as `TurnWaits` is.

    Attributes:
        waits_for: the address of the child that is to end first; "" if it is its own `on_stop` that takes so long.
        seconds: that it has taken so far, at least.
        at: the line of the user's code at which that waits; "" if that is not known.
    """

    waits_for: str
    seconds: float
    at: str


class LoopLagged(Event, frozen=True, eq=False):
    """The event loop of the root process came `seconds` late to what was due; `address` is the root's."""

    seconds: float


class LogLine(Event, frozen=True, eq=False):
    """A line that an actor's process wrote to its `stream`, stdout or stderr; `life` is the one that wrote it.

    `is_logged`: it becomes a log record, too; else the program was started with `log_lines=False`.
    """

    stream: str
    text: str
    life: int = 0
    is_logged: bool = True


class MessageIn(Event, frozen=True, eq=False):
    """Traced: a message was let into the actor's mailbox. (From another process messages come as text.)"""

    message: Any


class TurnBegan(Event, frozen=True, eq=False):
    """Traced: the actor begins to handle a message."""

    message: Any


class TurnEnded(Event, frozen=True, eq=False):
    """Traced: the turn is over, after `seconds`; `outcome` is "done", "refused" or "crashed: ..."."""

    message: Any
    seconds: float
    outcome: str


class MessageOut(Event, frozen=True, eq=False):
    """Traced: the actor has sent a message to an address, or published it on a topic."""

    to: str
    message: Any


class Moved(Event, frozen=True, eq=False):
    """An actor lives elsewhere now: "task" is this process, "process" one of its own.

    `pause_seconds` passed between its last turn there and when it could have its first one here.
    """

    origin: str
    to: str
    pause_seconds: float


TRACED = (MessageIn, TurnBegan, TurnEnded, MessageOut)
"""What is told to those who trace the actor, and to nobody else."""


Restful = Literal["letters", "starts", "others"]
"""Dead letters, the first lives at addresses, and all other events: what a recorder may rest from."""


class RepairGaveUp(Event, frozen=True, eq=False):
    """Repair has given components up: a person has to look at them, and `plan` says what to try."""

    components: tuple[str, ...]
    why: str
    plan: tuple[str, ...] = ()


class RepairTold(Event, frozen=True, eq=False):
    """Repair tells of a case, in one sentence; `what` is the kind of the notice, such as "Planned"."""

    case: int
    what: str
    text: str


class NotDelivered(Event, frozen=True, eq=False):
    """The other side could not be reached, or refuses: it is tried again, unless `is_given_up`."""

    url: str
    why: str
    is_given_up: bool = False


class EventStream:
    """One listener's view: an async iterator over events, with a bound on how far it may fall behind.

    Attributes:
        missed: how many events gave way to newer ones because nobody had read them in time.
    """

    def __init__(self, hub: EventHub, most: int) -> None:
        self._hub = hub
        self._events: deque[Event] = deque(maxlen=most)
        self._wake: asyncio.Future[None] | None = None
        self._closed = False
        self.missed = 0

    def put(self, event: Event) -> None:
        """Take in an event from the hub; the oldest one gives way if there are too many."""
        if len(self._events) == self._events.maxlen:
            self.missed += 1
        self._events.append(event)
        self._signal()

    def _signal(self) -> None:
        if self._wake is not None and not self._wake.done():
            self._wake.set_result(None)

    def __aiter__(self) -> AsyncIterator[Event]:
        return self

    async def __anext__(self) -> Event:
        while not self._events:
            if self._closed:
                raise StopAsyncIteration
            self._wake = asyncio.get_running_loop().create_future()
            await self._wake
        return self._events.popleft()

    async def until(self, kind: type[E], *, timeout: float = 30.0) -> E:
        """Wait for the next event of a class, and return it; those before it are passed over.

        Args:
            kind: the class.
            timeout: seconds, finite and > 0.

        Raises:
            NoSuchEvent: none has come in time, or before the stream was closed.
        """
        try:
            async with asyncio.timeout(check_seconds("until", "timeout", timeout)):
                async for event in self:
                    if isinstance(event, kind):
                        return event
        except TimeoutError:
            raise NoSuchEvent(kind.__name__, f"within {timeout:g} s") from None
        raise NoSuchEvent(kind.__name__, "before the stream was closed")

    def take(self) -> list[Event]:
        """Return all events that wait, without waiting for more."""
        events = list(self._events)
        self._events.clear()
        return events

    def close(self) -> None:
        """Stop listening; what waits can still be read."""
        self._closed = True
        self._hub.remove(self)
        self._signal()

    def __enter__(self) -> EventStream:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class EventHub:
    """Hands each event to the listeners there are."""

    def __init__(self, changed: Callable[[bool], None] = lambda anybody: None) -> None:
        self._changed = changed  # told whether there is anybody at all
        self.has_listeners = False  # else events are not even made
        self.hears_letters = False  # the same of dead letters,
        self.hears_starts = False  # and of the first lives at addresses,
        self.hears_lines = False  # and of lines that processes print,
        self.hears_unkept = False  # and of what a recorder does not keep
        self._streams: list[EventStream] = []
        self._sinks: list[Callable[[Event], None]] = []
        self._recorder: Callable[[Event], None] | None = None
        self._listening: tuple[Callable[[Event], None], ...] = ()  # the recorder, if there is one, and the sinks
        self._resting: set[Restful] = set()  # of what the recorder has had enough for now

    def emit(self, event: Event) -> None:
        """Give the event to every listener and sink."""
        for stream in self._streams:
            stream.put(event)
        for sink in self._listening:
            try:
                sink(event)
            except Exception as error:  # A user's log or tracer may be behind it, and a supervisor may be telling this.
                context = {"message": "what listens to events has failed", "exception": error}
                asyncio.get_running_loop().call_exception_handler(context)

    def add_sink(self, sink: Callable[[Event], None]) -> None:
        """Call `sink` with every event, at once."""
        self._sinks.append(sink)
        self._count()

    def record(self, recorder: Callable[[Event], None]) -> None:
        """Call `recorder` with every event. Unlike a sink it may rest while there are too many."""
        self._recorder = recorder
        self._count()

    def rest(self, of: Restful) -> None:
        """The recorder has had enough of these events: make none for it alone until `wake`."""
        self._resting.add(of)
        self._count()

    def wake(self) -> None:
        """The recorder takes all events again."""
        self._resting.clear()
        self._count()

    def remove_sink(self, sink: Callable[[Event], None]) -> None:
        """Call a sink no more that `add_sink` was given."""
        self._sinks.remove(sink)
        self._count()

    def listen(self, most: int = 10_000) -> EventStream:
        """A new stream; the oldest of more than `most` unread events are dropped and counted in `missed`."""
        stream = EventStream(self, most)
        self._streams.append(stream)
        self._count()
        return stream

    def remove(self, stream: EventStream) -> None:
        """Give a stream no more events."""
        if stream in self._streams:
            self._streams.remove(stream)
        self._count()

    def _count(self) -> None:
        self._listening = (*(() if self._recorder is None else (self._recorder,)), *self._sinks)
        anybody = bool(self._streams or self._sinks)
        records = self._recorder is not None
        self.has_listeners = anybody or (records and "others" not in self._resting)
        self.hears_letters = anybody or (records and "letters" not in self._resting)
        self.hears_starts = anybody or (records and not self._resting & {"starts", "others"})
        self.hears_lines = anybody or records
        self.hears_unkept = anybody
        self._changed(self.has_listeners)

    def close(self) -> None:
        """End every stream that is open."""
        for stream in list(self._streams):
            stream.close()


def event_from(kind: str, data: dict[str, Any]) -> Event | None:
    """The event another process told of; None if it is of no kind known here or its data does not fit."""
    for event in Event.__subclasses__():
        if event.__name__ == kind:
            try:
                fields = {name: _field_in(data[name]) for name in event.__struct_fields__}
                told = event(**fields)
            except (KeyError, msgspec.ValidationError):
                return None
            return told if _fits(told) else None
    return None


@functools.cache
def _kinds(event: type[Event]) -> dict[str, Any]:
    """What the fields of an event have to be; those that may be anything are left out."""
    hints = typing.get_type_hints(event)
    kinds = {name: typing.get_origin(hints[name]) or hints[name] for name in event.__struct_fields__}
    return {
        name: (int, float) if kind is float else kind
        for name, kind in kinds.items()
        if type(kind) is type or kind is ExitReason
    }


def _fits(event: Event) -> bool:
    """Whether the fields of an event that another process told are what they have to be, and numbers finite."""
    values = ((getattr(event, name), kind) for name, kind in _kinds(type(event)).items())
    return all(isinstance(value, kind) and not is_endless(value) for value, kind in values)


def is_endless(value: object) -> bool:
    """Whether this is a number that is infinite, or none (NaN)."""
    return isinstance(value, float) and not math.isfinite(value)


def event_data(event: Event) -> dict[str, Any]:
    """An event's fields as plain data for a frame; what has no plain form is sent as text."""
    return {name: _field_out(getattr(event, name)) for name in event.__struct_fields__}


def _field_out(value: Any) -> Any:
    if isinstance(value, ExitReason):
        return {"exit reason": pack_exit(value)}
    if isinstance(value, (int, float, dict)) or value is None:
        return value
    if isinstance(value, (Message, Item, MessageText)):
        message = message_of(value)
        return {"item": item_name(value), "text": portable(str(value if message is None else message))}
    return portable(str(value))


def _field_in(value: Any) -> Any:
    match value:
        case str():
            return value.translate(_UNPRINTED)
        case {"exit reason": reason}:
            return unpack_exit(reason)
        case {"item": str(name), "text": str(text)}:
            return MessageText(text.translate(_UNPRINTED), name.translate(_UNPRINTED))
        case _:
            return value


_UNPRINTED = {code: "?" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\t"}
"""Characters that make a terminal do something: another process may not send them to whoever looks."""
