"""Validated settings of recovery methods: safe state, held messages and hooks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, get_args

import msgspec

from ..actors.errors import SpecError, type_name
from ..actors.kernel.codec import encode_special, unencodable
from ..actors.kernel.message import Message, message_name
from ..actors.overflow import Overflow, check
from ..actors.seconds import check_seconds

Phase = Literal["safe_state", "isolate", "restart", "restore", "replay", "release"]
PHASES: tuple[Phase, ...] = get_args(Phase)

SAFE_STATE_TIMEOUT = 30.0
HOOK_TIMEOUT = 2.0


@dataclasses.dataclass(frozen=True, slots=True)
class SafeState:
    """The actors that are to be safe while another is recovered, and how they are told; made by `safe_state`.

    Attributes:
        to: addresses ("/app/wheels"), and names of bindings of the recovered actor ("wheels").
        enter, leave: name and body of the messages; without `enter`, the receivers' `on_safe_state` is called.
        ports: what the bindings lead to, as far as only another process knows.
    """

    to: tuple[str, ...]
    enter: tuple[str, bytes] | None = None
    leave: tuple[str, bytes] | None = None
    ports: tuple[tuple[str, str], ...] = ()


def safe_state(*to: str, enter: Message[Any] | None = None, leave: Message[Any] | None = None) -> SafeState:
    """Name the actors that are to be safe while another actor is recovered.

    Args:
        to: addresses such as "/app/wheels", or names of bindings of the recovered actor's class.
        enter: a message for when it begins; left out, `on_safe_state(True)` of the receivers is called.
        leave: a message for when it is over.

    Raises:
        SpecError: there is nobody to tell, or a message cannot be encoded.
    """
    if not to or not all(isinstance(one, str) and one and one != "/" for one in to):
        raise SpecError("safe_state", f"takes addresses such as '/app/wheels' or names of bindings, not {to!r}")
    if leave is not None and enter is None:
        raise SpecError("safe_state", "leave goes with enter: nobody can leave what was never entered")
    return SafeState(tuple(dict.fromkeys(to)), _encoded("enter", enter), _encoded("leave", leave))


def _encoded(which: str, message: Message[Any] | None) -> tuple[str, bytes] | None:
    if message is None:
        return None
    if not isinstance(message, Message):
        raise SpecError("safe_state", f"{which} must be a message, not {message!r}")
    try:
        body = msgspec.msgpack.encode(message, enc_hook=encode_special)
    except Exception as error:
        problem = unencodable(message, error)
        raise SpecError("safe_state", f"{which}: {type_name(type(message))} cannot be sent: {problem}") from error
    return message_name(type(message)), body


def as_safe_state(where: str, given: str | Sequence[str] | SafeState | None) -> SafeState | None:
    """What a method was given, as data. Raises SpecError."""
    match given:
        case None | SafeState():
            return given
        case str():
            return safe_state(given)
        case list() | tuple():
            return safe_state(*given)
        case _:
            raise SpecError(where, f"safe_state must be an address, a list of them, or safe_state(...), not {given!r}")


@dataclasses.dataclass(frozen=True, slots=True)
class Held:
    """A limit for messages that are held while an actor is recovered, and what becomes of more; made by `held`."""

    capacity: int
    overflow: Overflow = "block"


def held(capacity: int, *, overflow: Overflow = "block") -> Held:
    """At most `capacity` messages are held while an actor is recovered.

    Args:
        capacity: messages, >= 1. Those that waited before the crash do not count.
        overflow: "block" (a tell raises MailboxFull, a send waits, an ask waits to its deadline), "latest" (only the
            newest is kept), "drop_oldest", "drop_newest", "reject" (all raise MailboxFull). What is dropped is a
            dead letter.
    """
    check("held", capacity, overflow)
    return Held(capacity, overflow)


def as_held(where: str, given: Held | Mapping[str, Held] | None) -> tuple[Held | None, tuple[tuple[str, Held], ...]]:
    """What a method was given: for all messages ("*"), and by topic. Raises SpecError."""
    if given is None:
        return None, ()
    if isinstance(given, Held):
        return given, ()
    if not isinstance(given, Mapping):
        raise SpecError(where, f"held must be held(...) or a mapping of topics to held(...), not {given!r}")
    for topic, one in given.items():
        if not isinstance(topic, str) or not (topic.startswith("/") or topic == "*"):
            raise SpecError(where, f"held must name topics such as '/scan', or '*' for all else, not {topic!r}")
        if not isinstance(one, Held):
            raise SpecError(where, f"held[{topic!r}] must be held(...), not {one!r}")
    return given.get("*"), tuple((topic, one) for topic, one in given.items() if topic != "*")


@dataclasses.dataclass(frozen=True, slots=True)
class RecoveryStep:
    """One step of a recovery, as a hook is told of it: before or after a phase, and whose recovery it is.

    Attributes:
        address: the actor that is recovered.
        when: "before" or "after".
        phase: the phase.
        attempt: 1, and one more each time the actor ended again before it was back.
        since_noticed: seconds since its end was noticed.
    """

    address: str
    when: str
    phase: str
    attempt: int
    since_noticed: float


Hook = Callable[[RecoveryStep], Any]


class RecoveryHooks:
    """Functions that are called before and after phases of recoveries; made by `recovery_hooks`.

    Functions are no data, so they stay in this process.
    """

    def __init__(self, before: Mapping[Phase, Hook], after: Mapping[Phase, Hook], timeout: float) -> None:
        self._hooks: dict[tuple[str, str], Hook] = {
            **{("before", phase): hook for phase, hook in before.items()},
            **{("after", phase): hook for phase, hook in after.items()},
        }
        self.timeout = timeout

    def of(self, when: str, phase: str) -> Hook | None:
        """Return the hook of one point of a recovery."""
        return self._hooks.get((when, phase))

    def __repr__(self) -> str:
        points = ", ".join(f"{when} {phase}" for when, phase in self._hooks)
        return f"<recovery hooks {points}>"


def recovery_hooks(
    *,
    before: Mapping[Phase, Hook] | None = None,
    after: Mapping[Phase, Hook] | None = None,
    timeout: float = HOOK_TIMEOUT,
) -> RecoveryHooks:
    """Functions that are called before and after phases of a recovery, in the root process.

    Args:
        before, after: phase ("safe_state", "isolate", "restart", "restore", "replay", "release") to a function, or
            coroutine function, of one `RecoveryStep`. The recovery waits for it.
        timeout: seconds each may take. Then, or if it raises, the recovery goes on (RecoveryHookFailed tells of it).

    Raises:
        SpecError: naming the phase or the hook.
    """
    for which, hooks in (("before", before), ("after", after)):
        for phase, hook in (hooks or {}).items():
            if phase not in PHASES:
                known = ", ".join(map(repr, PHASES))
                raise SpecError("recovery_hooks", f"{which} must name phases ({known}), not {phase!r}")
            if not callable(hook):
                raise SpecError("recovery_hooks", f"{which}[{phase!r}] must be a function, not {hook!r}")
    return RecoveryHooks(before or {}, after or {}, check_seconds("recovery_hooks", "timeout", timeout))


@dataclasses.dataclass(frozen=True, slots=True)
class Meanwhile:
    """What is done while an actor is recovered.

    Attributes:
        safe_state: who is to be safe.
        safe_state_timeout: seconds after which a receiver that has not heard of the end raises the alarm.
        held: how many messages are held.
        held_topics: the same by topic.
        hooks: what is called before and after the phases.
    """

    safe_state: SafeState | None = None
    safe_state_timeout: float = SAFE_STATE_TIMEOUT
    held: Held | None = None
    held_topics: tuple[tuple[str, Held], ...] = ()
    hooks: RecoveryHooks | None = None


NOTHING_MEANWHILE = Meanwhile()


def meanwhile(
    where: str,
    safe_state: str | Sequence[str] | SafeState | None,
    safe_state_timeout: float,
    held: Held | Mapping[str, Held] | None,
    hooks: RecoveryHooks | None,
) -> Meanwhile:
    """Check what a method was given. Raises SpecError."""
    if hooks is not None and not isinstance(hooks, RecoveryHooks):
        raise SpecError(where, f"hooks must come from recovery_hooks(...), not be {hooks!r}")
    for_all, by_topic = as_held(where, held)
    timeout = check_seconds(where, "safe_state_timeout", safe_state_timeout)
    return Meanwhile(as_safe_state(where, safe_state), timeout, for_all, by_topic, hooks)
