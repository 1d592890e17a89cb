"""Exit reasons: why a life at an address ended. Values, never exceptions.

Clean reasons are `NORMAL`, `SHUTDOWN` and `Shutdown(detail)`; every other one is abnormal (Erlang/OTP).
That decides about restarts. A link ends the other side for every reason but `NORMAL`, clean or not.
"""

from __future__ import annotations

import signal

import msgspec

from .errors import DamagedValue, RemoteCrash, SpecError, StartFailed, error_text, format_error, shown, type_name

START_FAILED = type_name(StartFailed)
LONGEST_REASON = 1024 * 1024
"""Bytes that an exit reason of a user's may take: more than what is kept of the text and traceback of an error."""


class ExitReason(msgspec.Struct, frozen=True):
    """Base of the exit reasons."""

    @property
    def is_clean(self) -> bool:
        """True for NORMAL and every Shutdown: a transient child is not restarted after it."""
        return False

    @property
    def common_cause(self) -> str:
        """Name what outside of the actor has ended it and others: one fault, however many it strikes. "": nothing."""
        return ""

    @property
    def blames_nobody(self) -> bool:
        """Say whether the turn that was in hand has no part in the end, which was ordered or has a common cause."""
        return bool(self.common_cause)


class Normal(ExitReason, frozen=True):
    """The actor ended by itself, its work done."""

    @property
    def is_clean(self) -> bool:
        return True

    def __str__(self) -> str:
        return "normal"


class Shutdown(ExitReason, frozen=True):
    """The actor was told to stop, or ended in good order; `detail` is the user's own."""

    detail: str = ""
    because_of: str = ""
    """The common cause of the ends that a supervisor has given up for."""

    @property
    def is_clean(self) -> bool:
        return True

    @property
    def common_cause(self) -> str:
        return self.because_of

    def __str__(self) -> str:
        return f"shutdown ({self.detail})" if self.detail else "shutdown"


class Killed(ExitReason, frozen=True):
    """The actor was killed: no hook ran."""

    @property
    def blames_nobody(self) -> bool:
        return True

    def __str__(self) -> str:
        return "killed"


class NoProc(ExitReason, frozen=True):
    """Nobody lives at the address."""

    def __str__(self) -> str:
        return "no such actor"


class Crash(ExitReason, frozen=True, eq=False):
    """A handler or hook raised.

    The exception stays as it is: text and traceback are made when somebody looks, or when it leaves the process.
    """

    type_name: str
    text: str
    formatted: str = ""
    error: BaseException | None = None

    @property
    def traceback(self) -> str:
        """The traceback of the exception, formatted when it is asked for."""
        return self.formatted if self.error is None else format_error(self.error)

    @property
    def common_cause(self) -> str:
        return self.error.struck_by if isinstance(self.error, StartFailed) else ""

    def __str__(self) -> str:
        if self.type_name == START_FAILED and self.text:
            return self.text  # It says who could not be started, and why: once for each level is enough.
        return f"{self.type_name}: {self.text}" if self.text else self.type_name

    def portable(self) -> Crash:
        """Return the same reason without the exception object: what crosses a process border."""
        return self if self.error is None else Crash(self.type_name, self.text, self.traceback)


class Signal(ExitReason, frozen=True):
    """The OS process was ended by this signal."""

    number: int

    def __str__(self) -> str:
        try:
            return signal.Signals(self.number).name
        except ValueError:
            return f"signal {self.number}"


class ForkServerDied(ExitReason, frozen=True):
    """The OS process was ended because the fork server has died, whose child it was; `how` says what has ended that."""

    pid: int
    how: str = "cause unknown"

    @property
    def common_cause(self) -> str:
        return f"fork server {self.pid}"

    def __str__(self) -> str:
        return f"its process ended with the fork server (pid {self.pid}: {self.how})"


class Exited(ExitReason, frozen=True):
    """The OS process ended with this exit code without being asked to."""

    code: int

    def __str__(self) -> str:
        return f"process exited with code {self.code}"


class OutOfMemory(ExitReason, frozen=True):
    """MemoryError, our watch's limit, or the kernel's out-of-memory killer."""

    text: str = ""

    def __str__(self) -> str:
        return f"out of memory: {self.text}" if self.text else "out of memory"


class Hung(ExitReason, frozen=True):
    """The process gave no sign of life for this many seconds: its loop stopped beating, or a program was silent."""

    seconds: float
    text: str = ""

    def __str__(self) -> str:
        return f"hung for {self.seconds:g} s: {self.text}" if self.text else f"hung for {self.seconds:g} s"


class NoConnection(ExitReason, frozen=True):
    """The program that the actor lives in does not answer any more: a suspicion, the actor may well live on."""

    node: str

    def __str__(self) -> str:
        return f"no connection to {self.node}"


class TrustBreach(ExitReason, frozen=True):
    """The OS process was ended because it said what it may not, or what cannot be."""

    problem: str

    def __str__(self) -> str:
        return f"breach of trust: {self.problem}"


NORMAL = Normal()
SHUTDOWN = Shutdown()
KILLED = Killed()
NOPROC = NoProc()


def crash(error: BaseException) -> ExitReason:
    """The exit reason for an exception that left a handler or hook."""
    if isinstance(error, MemoryError):
        return OutOfMemory(error_text(error))
    return Crash(type_name(type(error)), error_text(error), "", error)


def raised_in(reason: ExitReason) -> BaseException | None:
    """What was raised in a life that has ended so, as a RemoteCrash from another process; None if nothing was."""
    if not isinstance(reason, Crash):
        return None
    return reason.error if reason.error is not None else RemoteCrash(reason.type_name, reason.text, reason.formatted)


def start_failed(actor: str, reason: ExitReason) -> StartFailed:
    """The error of a start that ended for `reason`; its cause is what was raised, if that was in this process."""
    failed = StartFailed(actor, str(reason))
    failed.__cause__ = reason.error if isinstance(reason, Crash) else None
    failed.struck_by = reason.common_cause
    return failed


UNREAD = "the reason is told as a crash instead, and whoever hears of it decides what follows"
"""What becomes of a recorded exit reason that cannot be read."""


class _Wire(msgspec.Struct, frozen=True):
    """What crosses the border: all fields of all reasons."""

    exit: str
    detail: str = ""
    type_name: str = ""
    text: str = ""
    formatted: str = ""
    number: int = 0
    seconds: float = 0.0


def pack_exit(reason: ExitReason) -> dict[str, object]:
    """`reason` as plain data for a frame."""
    match reason:
        case Shutdown(detail=detail, because_of=because_of):
            return {"exit": "Shutdown", "detail": detail, "text": because_of}
        case Crash():
            return {"exit": "Crash", "type_name": reason.type_name, "text": reason.text, "formatted": reason.traceback}
        case Signal(number=number):
            return {"exit": "Signal", "number": number}
        case ForkServerDied(pid=pid, how=how):
            return {"exit": "ForkServerDied", "number": pid, "text": how}
        case Exited(code=code):
            return {"exit": "Exited", "number": code}
        case OutOfMemory(text=text):
            return {"exit": "OutOfMemory", "text": text}
        case Hung(seconds=seconds, text=text):
            return {"exit": "Hung", "seconds": seconds, "text": text}
        case TrustBreach(problem=problem):
            return {"exit": "TrustBreach", "text": problem}
        case NoConnection(node=node):
            return {"exit": "NoConnection", "text": node}
        case _:
            return {"exit": type(reason).__name__}


def check_reason(where: str, reason: object) -> ExitReason:
    """Return `reason`, if it is one of the exit reasons here, and can be told elsewhere and read back from a journal.

    Args:
        where: the call that it was given to.
        reason: what was given.

    Raises:
        SpecError: it is none, and what to write instead.
    """
    try:
        body = msgspec.msgpack.encode(pack_exit(reason))  # type: ignore[arg-type]  # that is the question
        read = unpack_exit(msgspec.msgpack.decode(body))
    except Exception:  # Whatever a field holds that is none of ours may raise what it likes.
        body, read = b"", None
    if not isinstance(reason, ExitReason) or type(read) is not type(reason) or len(body) > LONGEST_REASON:
        raise SpecError(where, f"takes an exit reason, not {shown(reason)}: {_hint(reason)}")
    return reason


def check_farewell(given: ExitReason, reason: ExitReason) -> None:
    """Whether `on_stop` may end a life for this reason, where it was `given` another one.

    What something else than the life itself has done to it, such as a kill, can only be passed on: a supervisor that
    heard of a kill would bring the life back, to end again.

    Raises:
        SpecError: it may not, and what to return instead.
    """
    check_reason("on_stop", reason)
    if reason != given and not reason.is_clean and not isinstance(reason, Crash):
        raise SpecError(
            "on_stop", f"returns {reason}, which did not end it: return hf.Shutdown('TEXT'), or raise to end by a crash"
        )


def _hint(reason: object) -> str:
    match reason:
        case ExitReason() if type(reason).__module__ != __name__:
            return "nobody else can read a class of your own; say what you have to say in hf.Shutdown('TEXT')"
        case Shutdown():
            return f"the detail of hf.Shutdown is text that can be written, in {LONGEST_REASON} bytes at most"
        case Crash():
            return "the fields of hf.Crash are text, and its error is an exception; raise the error itself instead"
        case ExitReason():
            return "its fields do not have the types that its class says"
        case type() if issubclass(reason, ExitReason):
            return f"this is the class; give an instance, hf.{reason.__name__}(...)"
        case BaseException():
            return "raise the exception, or give hf.Shutdown('TEXT')"
        case str():
            return f"write hf.Shutdown({shown(reason)}) for an end in good order, or raise an exception for a crash"
        case _:
            return "hf.NORMAL, or hf.Shutdown('TEXT'); raise an exception for a crash"


def unpack_exit(data: object) -> ExitReason:
    """The exit reason a frame carries.

    Raises:
        msgspec.ValidationError: the data is no exit reason.
    """
    wire = msgspec.convert(data, _Wire)
    match wire.exit:
        case "Normal":
            return NORMAL
        case "Shutdown":
            return Shutdown(wire.detail, wire.text)
        case "Killed":
            return KILLED
        case "NoProc":
            return NOPROC
        case "Crash":
            return Crash(wire.type_name, wire.text, wire.formatted)
        case "Signal":
            return Signal(wire.number)
        case "ForkServerDied":
            return ForkServerDied(wire.number, wire.text)
        case "Exited":
            return Exited(wire.number)
        case "OutOfMemory":
            return OutOfMemory(wire.text)
        case "Hung":
            return Hung(wire.seconds, wire.text)
        case "NoConnection":
            return NoConnection(wire.text)
        case "TrustBreach":
            return TrustBreach(wire.text)
        case other:
            raise msgspec.ValidationError(f"unknown exit reason {other!r}")


def recorded_exit(data: object) -> ExitReason:
    """The exit reason that a journal has; a crash in its place, if nobody can read it.

    >>> recorded_exit({"exit": "Shutdown", "detail": "at night"}), recorded_exit({"exit": "str"}).is_clean
    (Shutdown(detail='at night', because_of=''), False)
    """
    try:
        return unpack_exit(data)
    except msgspec.ValidationError as error:
        return crash(DamagedValue(f"an exit reason, {shown(data)}: {error}", UNREAD))
