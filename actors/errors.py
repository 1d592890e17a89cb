"""Every error that holdfast raises, as one tree.

HoldfastError
├── SendError            not enqueued, or surely not run: safe to send again
│   ├── ActorStopped     the address has ended for good, or its process died with the message still queued
│   ├── MailboxFull      the mailbox is at capacity
│   ├── UnknownMessage   the receiver has no handler for this type
│   ├── BadMessage       a field cannot be coded, or has the wrong type, or the frame is too large
│   ├── AskDeadlock      the receiver waits, directly or not, for this very asker
│   ├── ActorRestarting  the receiver is between two lives, and the asker did not want to wait
│   └── WrongThread      called from another thread than the system's
├── AskTimeout           no reply before the deadline (`handled` says whether the turn may have run)
├── AskFailed            the receiver ended in the middle of the turn
├── RemoteCrash          the receiver's handler raised
├── Quarantined          the message ended its actor's process again and again
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
├── WrongActor           another class lives at this address
├── SpecError            a child specification is not valid
├── UnsavableValue       a value that no snapshot can hold
├── DamagedValue         saved bytes that cannot be read
├── StoreError           what must be kept could not be: StoreFailed, DamagedStore, StoreInUse, StaleEpoch
├── ProcessUnavailable   no OS process could be had
├── TreeFailed           the root supervisor gave up
└── Refusal              a handler's typed "no" (`message.py`)

Arguments equal parameters in each class, so the codec can rebuild an error in another process.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

LONGEST_TEXT = 64 * 1024
"""Characters of an error's text or traceback that are kept."""


class HoldfastError(Exception):
    """Base of every error holdfast raises."""


class SendError(HoldfastError):
    """The message was not enqueued, or surely not run: it is safe to send it again."""


class ActorStopped(SendError):
    """The address has ended for good: start the actor again, or send elsewhere."""

    def __init__(self, actor: str, reason: str = "") -> None:
        super().__init__(actor, reason)
        self.actor, self.reason = actor, reason

    def __str__(self) -> str:
        why = f" ({self.reason})" if self.reason else ""
        return f"{self.actor} has stopped{why}; the message was not handled"


class MailboxFull(SendError):
    """The mailbox is at capacity: wait, shed load, or raise the capacity."""

    def __init__(self, actor: str, capacity: int) -> None:
        super().__init__(actor, capacity)
        self.actor, self.capacity = actor, capacity

    def __str__(self) -> str:
        return f"mailbox of {self.actor} is full (capacity {self.capacity} messages)"


class UnknownMessage(SendError):
    """The receiver's class has no handler for this message type."""

    def __init__(self, actor: str, message: str) -> None:
        super().__init__(actor, message)
        self.actor, self.message = actor, message

    def __str__(self) -> str:
        return f"{self.actor} has no handler for {self.message}; add one with @on({self.message.rpartition('.')[2]})"


class BadMessage(SendError):
    """The message cannot be coded as its type says."""

    def __init__(self, actor: str, message: str, problem: str) -> None:
        super().__init__(actor, message, problem)
        self.actor, self.message, self.problem = actor, message, problem

    def __str__(self) -> str:
        return f"{self.message} to {self.actor}: {self.problem}"


class AskDeadlock(SendError):
    """The receiver is itself waiting, directly or through others, for the asker."""

    def __init__(self, actor: str, chain: tuple[str, ...]) -> None:
        super().__init__(actor, tuple(chain))
        self.actor, self.chain = actor, tuple(chain)

    def __str__(self) -> str:
        way = " -> ".join((*reversed(self.chain), self.actor))
        return f"ask to {self.actor} would wait for itself ({way}); use tell, or ask from outside the turn"


class ActorRestarting(SendError):
    """The receiver is between two lives, or being recovered, and the asker said `restarting="fail"`."""

    def __init__(self, actor: str) -> None:
        super().__init__(actor)
        self.actor = actor

    def __str__(self) -> str:
        return f"{self.actor} is being restarted; the message was not sent, try again"


class WrongThread(SendError):
    """An actor was called from another thread than its system's: nothing was sent. Use `system.from_thread()` there."""

    def __init__(self, actor: str, thread: str) -> None:
        super().__init__(actor, thread)
        self.actor, self.thread = actor, thread

    def __str__(self) -> str:
        return (
            f"{self.actor} was called from thread {self.thread!r}, but its system runs in another one, and nothing was "
            "sent: use a handle made by system.from_thread() in threads"
        )


class AskTimeout(HoldfastError):
    """No reply before the deadline.

    `handled` is False when the turn never started (safe to send again), None when that is unknown.
    """

    def __init__(self, actor: str, seconds: float, handled: bool | None = None) -> None:
        super().__init__(actor, seconds, handled)
        self.actor, self.seconds, self.handled = actor, seconds, handled

    def __str__(self) -> str:
        known = "it was not handled" if self.handled is False else "it may have been handled"
        return f"{self.actor} did not reply within {self.seconds:g} s; {known}"


class AskFailed(HoldfastError):
    """The receiver ended in the middle of the turn: whether it took effect is unknown."""

    def __init__(self, actor: str, reason: str) -> None:
        super().__init__(actor, reason)
        self.actor, self.reason = actor, reason

    def __str__(self) -> str:
        return f"{self.actor} ended while it handled the message: {self.reason}"


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


class ReplayDiverged(HoldfastError):
    """A replayed turn went another way than before the crash: another output or reply, or no end at all.

    `cause` says what it did, where that is known; else its `output` differs, counted from 1.
    """

    def __init__(self, actor: str, turn: int, output: int, cause: str = "") -> None:
        super().__init__(actor, turn, output, cause)
        self.actor, self.turn, self.output, self.cause = actor, turn, output, cause

    def __str__(self) -> str:
        where = f"replay of {self.actor} diverged at turn {self.turn}"
        if self.cause:
            return f"{where}: {self.cause}"
        return f"{where}, output {self.output}: it is not what it was before the crash; {DIVERGES}"


DIVERGES = (
    "the handler's code was changed, or it reads what no snapshot holds (an attribute with a leading underscore that a "
    "turn has set, or the world): use ctx.now(), ctx.random and ctx.uuid(), or set deterministic = False"
)
"""Why a replay goes another way."""


class Quarantined(HoldfastError):
    """The message ended its actor's process again and again; it was put aside."""

    def __init__(self, actor: str, deliveries: int) -> None:
        super().__init__(actor, deliveries)
        self.actor, self.deliveries = actor, deliveries

    def __str__(self) -> str:
        return f"{self.actor}'s process died {self.deliveries} times in a row while it handled this message"


class StartFailed(HoldfastError):
    """An actor could not be started; `reason` is its exit reason in words."""

    def __init__(self, actor: str, reason: str) -> None:
        super().__init__(actor, reason)
        self.actor, self.reason = actor, reason

    def __str__(self) -> str:
        return f"{self.actor} could not be started: {self.reason}"


class StartIgnored(StartFailed):
    """An actor did not want to be started (it raised `Ignore`): to a supervisor that is no failure."""

    def __init__(self, actor: str, reason: str = "") -> None:
        super().__init__(actor, reason)

    def __str__(self) -> str:
        return f"{self.actor} does not want to be started{f': {self.reason}' if self.reason else ''}"


class Ignore(HoldfastError):
    """Raised in an actor's `__init__` or `on_start`: do not start me, and that is no failure.

    Its supervisor keeps the spec of a permanent or transient child, without a life, and drops that of a temporary one.
    """

    def __init__(self, why: str = "") -> None:
        super().__init__(why)
        self.why = why

    def __str__(self) -> str:
        return self.why or "not to be started"


class ControlFailed(HoldfastError):
    """An order to a live actor could not be carried out; the actor goes on as before."""

    def __init__(self, actor: str, order: str, problem: str) -> None:
        super().__init__(actor, order, problem)
        self.actor, self.order, self.problem = actor, order, problem

    def __str__(self) -> str:
        return f"{self.order} of {self.actor} failed: {self.problem}"


class NotSuspended(ControlFailed):
    """The order is for suspended actors only."""

    def __init__(self, actor: str, order: str) -> None:
        super().__init__(actor, order, "the actor must be suspended first")
        self.args = (actor, order)


class CannotMove(HoldfastError):
    """An actor was not moved to where it was to live; it goes on where it was, as it was."""

    def __init__(self, actor: str, why: str) -> None:
        super().__init__(actor, why)
        self.actor, self.why = actor, why

    def __str__(self) -> str:
        return f"{self.actor} cannot be moved: {self.why}"


class NotGranted(HoldfastError):
    """An actor in a process gave an order (stop, start a child) to one it has not started: bind it to that one."""

    def __init__(self, actor: str, order: str, by: str) -> None:
        super().__init__(actor, order, by)
        self.actor, self.order, self.by = actor, order, by

    def __str__(self) -> str:
        return (
            f"{self.by} lives in a process and may not order {self.actor} ({self.order}): orders go to what it has "
            f"started and to what it is bound to, child(..., bindings={{'port': {self.actor!r}}})"
        )


class NameTaken(HoldfastError):
    """A living actor has this name already."""

    def __init__(self, actor: str) -> None:
        super().__init__(actor)
        self.actor = actor

    def __str__(self) -> str:
        return f"{self.actor} exists already; choose another name or stop it first"


class NoSuchActor(HoldfastError):
    """Nobody lives at this address."""

    def __init__(self, actor: str) -> None:
        super().__init__(actor)
        self.actor = actor

    def __str__(self) -> str:
        return f"there is no actor at {self.actor}"


class WrongActor(HoldfastError):
    """An actor of another class lives at this address."""

    def __init__(self, actor: str, expected: str, found: str) -> None:
        super().__init__(actor, expected, found)
        self.actor, self.expected, self.found = actor, expected, found

    def __str__(self) -> str:
        return f"{self.actor} is a {self.found}, not a {self.expected}"


class SpecError(HoldfastError):
    """A child specification or an option is not valid."""

    def __init__(self, where: str, problem: str) -> None:
        super().__init__(where, problem)
        self.where, self.problem = where, problem

    def __str__(self) -> str:
        return f"{self.where}: {self.problem}"


class UnsavableValue(HoldfastError):
    """A value that no snapshot can hold: `where` is the path to it, `problem` what sits there."""

    def __init__(self, where: str, problem: str) -> None:
        super().__init__(where, problem)
        self.where, self.problem = where, problem

    def __str__(self) -> str:
        return (
            f"{self.where}: {self.problem} cannot be saved; make it a key variable of a supported type, "
            "name it with a leading underscore, or define get_state/set_state"
        )


class DamagedValue(HoldfastError):
    """Saved bytes that cannot be read: cut short, altered, of another format, or of a class that is no longer there."""

    def __init__(self, problem: str) -> None:
        super().__init__(problem)
        self.problem = problem

    def __str__(self) -> str:
        return f"a saved value cannot be read: {self.problem}; use an older one"


class StoreError(HoldfastError):
    """The store could not keep what must be kept, or not give it back; see `checkpoint/journal.py`."""


class ProcessUnavailable(HoldfastError):
    """No OS process could be had for an actor."""

    def __init__(self, problem: str) -> None:
        super().__init__(problem)
        self.problem = problem

    def __str__(self) -> str:
        return self.problem


class TreeFailed(HoldfastError):
    """The root supervisor reached its restart intensity and gave up."""

    def __init__(self, system: str, reason: str) -> None:
        super().__init__(system, reason)
        self.system, self.reason = system, reason

    def __str__(self) -> str:
        return f"the tree of {self.system} gave up: {self.reason}"


def format_error(error: BaseException) -> str:
    """The traceback of `error` as text, without the frames of holdfast's own run loop at its top."""
    import traceback

    return portable("".join(traceback.format_exception(error)))


def error_text(error: BaseException) -> str:
    """What an exception says; a user's `__str__` may itself raise, the report must not."""
    try:
        return portable(str(error))
    except Exception as broken:
        return f"<its text cannot be shown: {type_name(type(broken))}>"


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
