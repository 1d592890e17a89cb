"""Every error that holdfast raises, as one tree.

HoldfastError
├── SendError            not enqueued, or surely not run: safe to send again
│   ├── ActorStopped     nobody lives at the address, or its process died with the message still queued
│   ├── MailboxFull      the mailbox is at capacity
│   ├── UnknownMessage   the receiver has no handler for this type
│   ├── BadMessage       a field cannot be coded, or has the wrong type, or the frame is too large
│   ├── AskDeadlock      the receiver waits, directly or not, for this very asker
│   ├── ActorRestarting  the receiver is between two lives, and the asker did not want to wait
│   ├── WrongThread      called from another thread than the system's
│   └── WrongLoop        called from another event loop than the system's
├── AskTimeout           no reply before the deadline (`handled` says whether the turn may have run)
├── AskFailed            the receiver ended in the middle of the turn
├── RemoteCrash          the receiver's handler raised
├── Quarantined          the message ended its actor's process again and again
├── EffectFailed         what a turn does to the outside has failed, also at the last attempt
├── EffectInDoubt        a crash came while an effect that is performed at most once was out
├── WaitTimeout          the message that a turn waits for has not come in time
├── ReplayDiverged       a replayed turn released something else than before
├── StartFailed          an actor could not be started
│   └── StartIgnored     it did not want to be started, which is no failure
├── Ignore               raised by an actor that does not want to be started
├── ControlFailed        an order to a live actor could not be carried out; the actor is as before
│   └── NotSuspended     the order is for suspended actors only
├── CannotMove           an actor cannot be moved to another task or process; it goes on where it lives
├── NotGranted           an actor in a process gave an order to one that it has neither started nor is bound to
├── NameTaken            a living actor has this name already
├── NoSuchActor          nobody lives at this address
├── NoSuchEvent          the event that was waited for has not come
├── WrongActor           another class lives at this address
├── SpecError            a child specification is not valid
├── UnsavableValue       a value that no snapshot can hold
├── DamagedValue         saved bytes that cannot be read
├── StoreError           what must be kept could not be: StoreFailed, DamagedStore, StoreInUse, AccessRefused
├── ProcessUnavailable   no OS process could be had
├── TreeFailed           the root supervisor gave up
└── Refusal              a handler's typed "no" (`message.py`)

Arguments equal fields in each class, so the codec can rebuild an error in another process.
"""

from __future__ import annotations

import inspect
import reprlib
import string
from collections.abc import Iterator
from copy import copy
from typing import Any, ClassVar, Final

from typing_extensions import dataclass_transform

LONGEST_TEXT = 64 * 1024
"""Characters of an error's text or traceback that are kept."""


@dataclass_transform(eq_default=False)
class HoldfastError(Exception):
    """Base of every error holdfast raises.

    A subclass declares its fields as a dataclass does, and what it says as `text`, a format string of them (the format
    of a tuple is what joins it: `{names:, }`). The fields are its arguments (`args`), all of them, so that it can be
    made again in another process. A class without fields takes what an exception takes.

    >>> class TooHot(HoldfastError, text="{room} has {degrees:.0f} degrees"):
    ...     room: str
    ...     degrees: float = 40.0
    >>> str(TooHot("the kitchen")), TooHot(room="the bath", degrees=45.2).args
    ('the kitchen has 40 degrees', ('the bath', 45.2))
    """

    _text: ClassVar[str] = ""
    _fields: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, *, text: str = "", **options: Any) -> None:
        super().__init_subclass__(**options)
        cls._text = text or cls._text
        own = (name for name, kind in inspect.get_annotations(cls).items() if "ClassVar" not in str(kind))
        cls._fields = tuple(dict.fromkeys((*cls._fields, *own)))

    def __init__(self, *args: Any, **named: Any) -> None:
        names = self._fields
        if named or (names and len(args) != len(names)):
            args = self._bound(args, named)
        super().__init__(*args)
        self.__dict__.update(zip(names, args, strict=False))

    def _bound(self, args: tuple[Any, ...], named: dict[str, Any]) -> tuple[Any, ...]:
        """All values, in the order of the fields; TypeError as a function that takes them would raise it."""
        kind, names = type(self), self._fields
        given = dict(zip(names, args, strict=False))
        wrong = [f"{name!r} twice" for name in named if name in given]
        wrong += [f"an unknown {name!r}" for name in named if name not in names]
        given |= named
        wrong += [f"no {name!r}" for name in names if name not in given and not hasattr(kind, name)]
        if len(args) > len(names) or wrong:
            raise TypeError(f"{kind.__name__}({', '.join(names)}) got {'; '.join(wrong) or f'{len(args)} arguments'}")
        return tuple(given[name] if name in given else copy(getattr(kind, name)) for name in names)

    def __str__(self) -> str:
        return _ErrorText().vformat(self._text, (), vars(self)) if self._text else super().__str__()


class _ErrorText(string.Formatter):
    """Fills in the text of an error; a tuple is joined by what stands as its format: `{kept:, }`."""

    def format_field(self, value: object, format_spec: str) -> str:
        return (
            format_spec.join(map(str, value)) if isinstance(value, tuple) else super().format_field(value, format_spec)
        )


class SendError(HoldfastError):
    """The message was not enqueued, or surely not run: it is safe to send it again."""


class ActorStopped(SendError):
    """Nobody lives at the address: start the actor again, or send elsewhere.

    If its supervisor is being restarted, the actor may be back soon without your help.
    """

    actor: str
    reason: str = ""

    def __str__(self) -> str:
        why = f" ({self.reason})" if self.reason else ""
        return f"{self.actor} has stopped{why}; the message was not handled"


class MailboxFull(SendError):
    """The mailbox is at capacity: wait, shed load, or raise the capacity. The message was not handled.

    Attributes:
        actor: the address of the receiver.
        capacity: messages that its mailbox takes.
        displaced_by: the overflow policy by which the message was dropped after it had been taken, because newer ones
            came: "drop_oldest" or "latest". "" if it was never taken.
    """

    actor: str
    capacity: int
    displaced_by: str = ""

    def __str__(self) -> str:
        if not self.displaced_by:
            return f"mailbox of {self.actor} is full (capacity {self.capacity} messages)"
        return (
            f"{self.actor} had taken the message, and dropped it for a newer one "
            f"(capacity {self.capacity} messages, overflow={self.displaced_by!r}); ask again, or choose another policy"
        )


class UnknownMessage(SendError):
    """The receiver's class has no handler for this message type.

    Attributes:
        actor: the address of the receiver.
        message: the type of the message.
        is_anew: whether it handles another class of that name, from before its module or cell ran again.
    """

    actor: str
    message: str
    is_anew: bool = False

    def __str__(self) -> str:
        if self.is_anew:
            why = f"{self.message} was defined anew since that actor's class, as when a cell or a module runs again"
            return (
                f"{self.actor} handles the {self.message} of before: {why}; define its class anew, and start it again"
            )
        return f"{self.actor} has no handler for {self.message}; add one with @on({self.message.rpartition('.')[2]})"


class BadMessage(SendError, text="{message} to {actor}: {problem}"):
    """The message cannot be coded as its type says."""

    actor: str
    message: str
    problem: str


class BadReply(HoldfastError, text="{actor} has handled {message}, but its reply cannot be passed on: {problem}"):
    """The reply, or a field of a refusal, cannot be coded as its type says. The turn has run: do not just ask again.

    `actor` is who has replied, and `message` the type of what it was asked, or the key of an effect.
    """

    actor: str
    message: str
    problem: str


class AskDeadlock(SendError):
    """The receiver is itself waiting, directly or through others, for the asker."""

    actor: str
    chain: tuple[str, ...]

    def __str__(self) -> str:
        way = " -> ".join((*reversed(self.chain), self.actor))
        return f"ask to {self.actor} would wait for itself ({way}); use tell, or ask from outside the turn"


class ActorRestarting(SendError, text="{actor} is being restarted; the message was not sent, try again"):
    """The receiver is between two lives, or being recovered, and the asker said `restarting="fail"`."""

    actor: str


class WrongThread(
    SendError,
    text="{actor} was called from thread {thread!r}, but its system runs in another one, and nothing was "
    "sent: use a handle made by system.from_thread() in threads",
):
    """An actor was called from another thread than its system's: nothing was sent. Use `system.from_thread()` there."""

    actor: str
    thread: str


class WrongLoop(
    SendError,
    text="{actor} was called from another event loop than that of its system, and nothing was sent: have both in one "
    "loop (with pytest-asyncio, by the same loop_scope)",
):
    """An actor was called from an event loop in its thread that is not its system's, as tests may have several."""

    actor: str


class AskTimeout(HoldfastError):
    """No reply before the deadline.

    `handled` is False when the turn never started (safe to send again), None when that is unknown. `why` says why
    nobody waits any longer, if it is not the time; `turn`, of an operator's call, which turn is in its way.
    """

    actor: str
    seconds: float
    handled: bool | None = None
    why: str = ""
    turn: str = ""

    def __str__(self) -> str:
        known = "it was not handled" if self.handled is False else "it may have been handled"
        until = f" ({self.why})" if self.why else f" within {self.seconds:g} s"
        return f"{self.actor} did not reply{until}{f', for {self.turn}' if self.turn else ''}; {known}"


class StillEnding(AskTimeout):
    """A life that was told to end has not yet: it does when its turn is over, unless it is killed before."""

    def __str__(self) -> str:
        turn = f", for {self.turn}" if self.turn else ""
        return (
            f"{self.actor} has not ended within {self.seconds:g} s{turn}; it ends when its turn is over, or is killed"
        )


class AskFailed(HoldfastError, text="{actor} ended while it handled the message: {reason}"):
    """The receiver ended in the middle of the turn: whether it took effect is unknown."""

    actor: str
    reason: str


class ConnectionLost(AskFailed, text="nobody knows whether {actor} has handled the message: {reason}"):
    """Another program leads the receiver's system, or the connection to it has ended: the receiver may well live on."""


class Unreachable(SendError, text="{actor} cannot be reached: {problem}; nothing was sent"):
    """The program that the receiver lives in is known to be cut off, or to have ended."""

    actor: str
    problem: str


class ConnectionFull(SendError, text="{system} takes no more from {program} for now: {problem}; it was not handled"):
    """A program has as much outstanding in another system as it may: wait for what is out, or raise the limit there."""

    system: str
    program: str
    problem: str


class RemoteCrash(HoldfastError):
    """The receiver's handler raised; the actor crashed.

    The same class in one process and across processes, so that isolation changes nothing. Where it is printed, the
    receiver's traceback is printed with it: as its cause, or, from another process, as a note.
    """

    def __init__(self, type_name: str, text: str, traceback: str = "") -> None:
        super().__init__(type_name, text, traceback)
        self.type_name, self.text = type_name, text
        self._traceback = traceback
        if traceback:
            self.add_note(f"The actor's traceback, in its process:\n\n{traceback.rstrip()}")

    @property
    def traceback(self) -> str:
        """The receiver's formatted traceback (formatted on first use: most are never looked at)."""
        cause = self.__cause__
        if not self._traceback and cause is not None:
            self._traceback = format_error(cause)
        return self._traceback

    def __str__(self) -> str:
        return f"{self.type_name}: {self.text}" if self.text else self.type_name


class EffectFailed(HoldfastError, text="{effect} has failed at attempt {attempt}: {error}: {reason}"):
    """An effect of a turn has failed: what `ctx.effect` called has raised, or has taken too long, at the last attempt.

    It is an outcome like any other: it is journaled, and a replay gets it again. `effect` is the effect's key, `error`
    the name of the class of what was raised ("builtins.OSError" is "OSError"), and `reason` its text: what was raised
    need not be a value that a journal can keep.
    """

    effect: str
    attempt: int
    error: str
    reason: str


class EffectInDoubt(
    HoldfastError,
    text="{actor} has ended while its effect {effect} was out, and that is performed at most once: ask the other side "
    "whether it has happened",
):
    """The actor has ended between an effect that is performed at most once and the record of its outcome.

    It may have happened or not: only the other side can say. The effect is not performed again.
    """

    actor: str
    effect: str


class WaitTimeout(HoldfastError, text="{actor} has waited for {message}, and its time is over"):
    """`ctx.wait_for` has waited as long as it was told to, and no such message has come. It is journaled."""

    actor: str
    message: str


class TurnTimeout(
    HoldfastError, text="{actor} has been in the turn of {message} for {seconds:g} s, which is its turn_timeout"
):
    """A turn has waited for longer than its actor's class allows; the actor has crashed by this error.

    Its cause is the cancellation of the turn, whose traceback says where it has waited.
    """

    actor: str
    message: str
    seconds: float


class ReplayDiverged(HoldfastError):
    """A replayed turn went another way than before the crash: another output or reply, or no end at all.

    `cause` says what it did, where that is known; else its `output` differs, counted from 1, which is `what` now.
    """

    actor: str
    turn: int
    output: int
    cause: str = ""
    what: str = ""

    def __str__(self) -> str:
        where = f"replay of {self.actor} {DIVERGED} {self.turn}"
        if self.cause:
            return f"{where}: {self.cause}"
        now = f" ({self.what})" if self.what else ""
        return f"{where}, output {self.output}{now}: it is not what it was before the crash; {DIVERGES}"


RAISED_AGAIN = "handling it again raised"
"""In the text of a divergence that may pass."""
DIVERGED = "diverged at turn"
"""In the text of every divergence, and so in the reason of a start that has failed because of one."""
DIVERGES = (
    "the handler's code or an argument of the constructor was changed, or on_start(True) has changed the state, or the "
    "handler reads what no snapshot holds (an attribute with a leading underscore that a turn has set, a list or dict "
    "in the body of the class, which all its actors share, ctx.life, the world): use ctx.now(), ctx.random "
    "and ctx.uuid(), or set deterministic = False"
)
"""Why a replay goes another way."""


class Quarantined(
    HoldfastError, text="{actor}'s process died {deliveries} times in a row while it handled this message"
):
    """The message ended its actor's process again and again; it was put aside."""

    actor: str
    deliveries: int


class StartFailed(HoldfastError, text="{actor} could not be started: {reason}"):
    """An actor could not be started; `reason` is its exit reason in words."""

    actor: str
    reason: str

    struck_by = ""  # the common cause by which the life that was begun has ended, known in this process only

    def __init__(self, actor: str, reason: str = "") -> None:
        super().__init__(actor, reason.removeprefix(f"{actor} could not be started: "))  # Said once is enough.


class StartIgnored(StartFailed):
    """An actor did not want to be started (it raised `Ignore`): to a supervisor that is no failure."""

    actor: str
    reason: str = ""

    def __str__(self) -> str:
        return f"{self.actor} does not want to be started{f': {self.reason}' if self.reason else ''}"


class Ignore(HoldfastError):
    """Raised in an actor's `__init__` or `on_start`: do not start me, and that is no failure.

    Its supervisor keeps the spec of a permanent or transient child, without a life, and drops that of a temporary one.
    """

    why: str = ""

    def __str__(self) -> str:
        return self.why or "not to be started"


class ControlFailed(HoldfastError, text="{order} of {actor} failed: {problem}"):
    """An order to a live actor could not be carried out; the actor goes on as before."""

    actor: str
    order: str
    problem: str


class NotSuspended(ControlFailed):
    """The order is for suspended actors only."""

    problem: str = "the actor must be suspended first"


class CannotMove(HoldfastError, text="{actor} cannot be moved: {why}"):
    """An actor was not moved to where it was to live; it goes on where it was, as it was."""

    actor: str
    why: str


ONLY_MESSAGES: Final = (
    "only messages go over a connection; send one to an actor there that gives the order, or use the command line"
)
"""What to do in place of an order to an actor of another system."""


class NotGranted(
    HoldfastError,
    text="{by} may not order {actor} ({order}): {remedy}",
):
    """An order (stop, kill, start a child) was given by somebody who may not: by an actor in a process that has not
    started the other one, or by another program, which may only send messages over a connection.

    Attributes:
        remedy: what to do instead.
    """

    actor: str
    order: str
    by: str
    remedy: str = (
        "an actor in a process gives orders to what it has started, and to what the root has bound it to by "
        "child(..., bindings={'port': ADDRESS})"
    )


class NameTaken(HoldfastError, text="{actor} exists already; choose another name or stop it first"):
    """A living actor has this name already."""

    actor: str


class NoSuchActor(HoldfastError, text="there is no actor at {actor}"):
    """Nobody lives at this address, or has this name."""

    actor: str

    def __str__(self) -> str:
        # An address begins with a slash, a name never does.
        return super().__str__() if self.actor.startswith("/") else f"no actor has the name {self.actor!r}"


class NoSuchEvent(HoldfastError, text="no {event} has come {when}"):
    """`EventStream.until` has waited for an event of this class, and none has come."""

    event: str
    when: str


class WrongActor(HoldfastError, text="{actor} is a {found}, not a {expected}"):
    """An actor of another class lives at this address."""

    actor: str
    expected: str
    found: str


class SpecError(HoldfastError, text="{where}: {problem}"):
    """A child specification or an option is not valid."""

    where: str
    problem: str


class UnsavableValue(
    HoldfastError,
    text="{where}: {problem} cannot be saved; make it a key variable of a supported type, name it with a "
    "leading underscore, or define get_state/set_state",
):
    """A value that no snapshot can hold: `where` is the path to it, `problem` what sits there."""

    where: str
    problem: str


class DamagedValue(HoldfastError, text="a saved value cannot be read: {problem}; {remedy}"):
    """Saved bytes that cannot be read: cut short, altered, of another format, or of a class that is no longer there."""

    problem: str
    remedy: str = "use an older snapshot"


class StoreError(HoldfastError):
    """The store could not keep what must be kept, or not give it back; see `checkpoint/journal.py`."""


class ProcessUnavailable(HoldfastError, text="{problem}"):
    """No OS process could be had for an actor."""

    problem: str


class TreeFailed(HoldfastError, text="the tree of {system} gave up: {reason}"):
    """The root supervisor reached its restart intensity and gave up."""

    system: str
    reason: str


def format_error(error: BaseException) -> str:
    """The traceback of `error` as text, without the frames of holdfast's own run loop at its top."""
    import traceback

    return portable("".join(traceback.format_exception(error)))


def error_text(error: BaseException) -> str:
    """What an exception says; a user's `__str__` may itself raise, the report must not."""
    try:
        return portable(str(error))
    except BaseException as broken:
        return f"<its text cannot be shown: {type_name(type(broken))}>"


def shown(value: object) -> str:
    """A value that somebody gave, for the error that refuses it: short, and whatever its `__repr__` does.

    >>> shown("alice"), shown(list("abcdefghi")), shown("half a pair: \\ud800")
    ("'alice'", "['a', 'b', 'c', 'd', 'e', 'f', ...]", "'half a pair: \\\\ud800'")
    """
    try:
        return portable(reprlib.repr(value))
    except BaseException as broken:
        return f"<a {type_name(type(value))} that cannot be shown: {type_name(type(broken))}>"


def can_be_written(text: str) -> bool:
    """Whether a text can be recorded and sent: half of a surrogate pair cannot, as in file names that are not UTF-8.

    >>> can_be_written("żółw\\n"), can_be_written("a\\ud800b")
    (True, False)
    """
    return text.isascii() or text.encode(errors="ignore").decode() == text


def portable(text: str) -> str:
    """Text that can cross any border: not longer than `LONGEST_TEXT`, and without halves of surrogate pairs.

    >>> portable("half a pair: \\ud800")
    'half a pair: ?'
    """
    if len(text) > LONGEST_TEXT:
        half = LONGEST_TEXT // 2
        text = f"{text[:half]}\n[{len(text) - 2 * half} characters are left out]\n{text[-half:]}"
    return text if text.isascii() else text.encode("utf-8", "replace").decode()


def remote_crash(error: BaseException) -> RemoteCrash:
    """`error` as the asker sees it; the traceback is formatted only if somebody looks."""
    if isinstance(error, RemoteCrash):
        return error
    crash = RemoteCrash(type_name(type(error)), error_text(error))
    crash.__cause__ = error
    return crash


def type_name(kind: type) -> str:
    """`module.Class`, without the module for builtins.

    >>> type_name(ValueError)
    'ValueError'
    """
    if kind.__module__ == "builtins":
        return kind.__qualname__
    module = "__main__" if kind.__module__ == "__mp_main__" else kind.__module__  # as in `message_name`
    return f"{module}.{kind.__qualname__}"


def error_classes(base: type[HoldfastError] = HoldfastError) -> Iterator[type[HoldfastError]]:
    """`base` and all classes derived from it that are loaded here."""
    yield base
    for child in base.__subclasses__():
        yield from error_classes(child)


def rebuild_error(name: str, args: tuple[Any, ...]) -> HoldfastError | None:
    """The error that another process raised, or None if its class is not loaded here."""
    for kind in error_classes():
        if type_name(kind) == name:
            return kind(*args)
    return None
