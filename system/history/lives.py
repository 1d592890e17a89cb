"""Past lives: what each address went through, folded from past events; a pure function of them."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterator
from typing import TypeAlias

import msgspec

from ...supervision.children import WITH_SUPERVISOR
from .authors import PROGRAM
from .past_event import PastEvent, Plain
from .paths import is_part

MOST_LIVES = 16
"""Lives that are kept of one address, the newest."""
MOST_ADDRESSES = 10_000
"""Addresses whose lives are kept; beyond, whoever had nothing happen for longest is forgotten."""

WITH_THE_SYSTEM = "the system has ended"
"""Why a life has ended, in words, whose supervisor has ended with the whole system."""
KILLED_BY_REF = "it was killed by `ref.kill()`"
"""Why a life has ended that somebody has killed, in words."""


class PastLife(msgspec.Struct):
    """A life at an address, from its start to its end, as far as the history has seen it.

    Attributes:
        number: counts from 1 at each address, and from 1 again in the next root.
        started: Unix time; None if the start failed, or was not seen.
        ended: Unix time; None while the life goes on.
        reason: why it ended, in words; "" while it goes on.
        reason_kind: the class of the exit reason, such as "Crash" or "Signal"; "StartFailed" if it did not even begin.
        traceback: that of the error that has ended it, if one has.
        handling: the type of the message, or the hook, whose turn has ended it.
        by: who has ended it: the address of an actor, "the program", "an operator", "a transaction", "failover";
            "" if it ended by itself.
        because: why that one did, in words.
        restarts: restarts within the supervisor's period when this life was to be followed by another, that one
            included; None if none was.
        allowed: how many restarts the supervisor allows within its period.
        pid: the OS process that it had for itself; 0 if it had none.
        phases: seconds that each phase of its recovery took (detect, isolate, restart, restore, replay, release).
        replayed: turns that were handled again before it was there.
        turns: turns that it did, replayed ones not among them; None if nobody has counted them.
        turns_before: turns that were counted at the address before it; None if nobody has.
        longest_turn: seconds of the longest turn that was told by `watch_turns`, or measured while statistics are on.
        longest_message: the type of the message of that turn; "" if none is known.
    """

    number: int
    started: float | None = None
    ended: float | None = None
    reason: str = ""
    reason_kind: str = ""
    traceback: str = ""
    handling: str = ""
    by: str = ""
    because: str = ""
    restarts: int | None = None
    allowed: int | None = None
    pid: int = 0
    phases: dict[str, float] = {}
    replayed: int = 0
    turns: int | None = None
    turns_before: int | None = None
    longest_turn: float = 0.0
    longest_message: str = ""

    @property
    def is_over(self) -> bool:
        """Say whether the life has ended, or did not even begin."""
        return self.ended is not None

    @property
    def author(self) -> str:
        """The address or the person that has ended it, and the reason in brackets, as far as both are known."""
        return f"{self.by} ({self.because})" if self.because else self.by


CLEAN = frozenset({"", "Normal", "Shutdown", "SystemStopped", "RootKilled", "FailedOver"})
"""The kinds of ends that are no fault of whoever has ended."""


def is_fault(life: PastLife) -> bool:
    """Whether it has ended, or did not begin, because of something at its own address that went wrong."""
    return life.reason_kind not in CLEAN and not life.by


def is_deeper(path: str, address: str) -> bool:
    """Whether a path is below an address, and not directly.

    >>> is_deeper("/app/arm/motor", "/app"), is_deeper("/app/arm", "/app")
    (True, False)
    """
    return path.startswith(f"{address}/") and "/" in path[len(address) + 1 :]


Lives: TypeAlias = "deque[PastLife]"


class LivesByAddress:
    """The newest lives of each address, oldest first.

    Args:
        most: lives that are kept of one address.
        most_addresses: addresses of which any are kept.
    """

    def __init__(self, most: int = MOST_LIVES, most_addresses: int = MOST_ADDRESSES) -> None:
        self._most, self._most_addresses = most, most_addresses
        self._known: OrderedDict[str, Lives] = OrderedDict()

    def at(self, address: str) -> list[PastLife]:
        """The lives of an address, oldest first; copies."""
        self._end_with_above(address)
        return [msgspec.structs.replace(life) for life in self._known.get(address, ())]

    def last_below(self, address: str) -> Iterator[tuple[str, PastLife]]:
        """The newest life of each address directly below this one, with that address."""
        for path, known in self._known.items():
            if path.rpartition("/")[0] == address:
                self._end_with_above(path)
                yield path, known[-1]

    def last_deeper(self, address: str) -> Iterator[tuple[str, PastLife]]:
        """The newest life of each address below the ones directly below this one, with that address."""
        for path, known in self._known.items():
            if is_deeper(path, address):
                self._end_with_above(path)
                yield path, known[-1]

    def __len__(self) -> int:
        return len(self._known)

    def forget(self, top: str) -> None:
        """Forget the lives of an address, and of those below it."""
        for path in [path for path in self._known if path == top or path.startswith(f"{top}/")]:
            del self._known[path]

    def apply(self, event: PastEvent) -> None:
        """Learn what an event says of the lives at its address."""
        learn = LEARN.get(event.kind)
        if learn is None:
            return
        if event.kind in ROOT:
            for path in self._known:
                self._end_with_above(path)
            for known in self._known.values():
                _root_ended(known, event)
            return
        lives = self._known.get(event.address)
        if lives is None:
            lives = self._known[event.address] = deque(maxlen=self._most)
            if len(self._known) > self._most_addresses:
                self._known.popitem(last=False)
        else:
            self._known.move_to_end(event.address)
            if event.kind in BEHIND_AN_END:
                self._end_with_above(event.address)
        learn(lives, event)
        if not lives:
            del self._known[event.address]

    def _end_with_above(self, path: str) -> None:
        """End a life that has ended with the one above it: of those that are killed so, no event tells."""
        lives, above = self._known.get(path), path.rpartition("/")[0]
        if not lives or is_part(path) or not above:
            return
        self._end_with_above(above)
        life = lives[-1]
        is_killed = life.reason_kind == "Killed" and not life.by and life.allowed is None
        if life.started is None or (life.is_over and not is_killed):
            return
        for ended in self._known.get(above, ()):
            if ended.reason_kind != "FailedOver" and ended.ended is not None and ended.ended > life.started:
                if not life.is_over:
                    life.ended, life.reason, life.reason_kind = ended.ended, ended.reason, ended.reason_kind
                life.by, life.because = above, WITH_SUPERVISOR
                return


def _now(lives: Lives) -> PastLife:
    """The life that goes on; if none is known to, one that has begun unseen."""
    if not lives or lives[-1].is_over:
        lives.append(PastLife(lives[-1].number + 1 if lives else 1))
    return lives[-1]


def _last(lives: Lives) -> PastLife:
    """The newest life, over or not."""
    return lives[-1] if lives else _now(lives)


def _text(event: PastEvent, name: str) -> str:
    value = event.fields.get(name)
    return value if isinstance(value, str) else ""


def _number(event: PastEvent, name: str) -> int | None:
    value = event.fields.get(name)
    return value if isinstance(value, int) else None


def _end(life: PastLife, event: PastEvent) -> None:
    """The life is over; the first that is told of its end says the most."""
    if life.ended is None:
        life.ended = event.at
        done(life, event.fields)
    if not life.reason:
        life.reason, life.reason_kind = _text(event, "reason"), _text(event, "reason_kind")
        life.traceback = _text(event, "traceback")


def done(life: PastLife, fields: dict[str, Plain]) -> None:
    """What is counted at the address when something is told of the life; see `count_work`."""
    turns, seconds, message = fields.get("turns"), fields.get("longest_turn"), fields.get("longest_message")
    if isinstance(turns, int) and life.turns_before is not None and turns >= life.turns_before:
        life.turns = turns - life.turns_before
    if isinstance(seconds, float) and isinstance(message, str) and seconds > life.longest_turn:
        life.longest_turn, life.longest_message = seconds, message


def _slow(lives: Lives, event: PastEvent) -> None:
    """A turn that `watch_turns` has seen: told when it is over, which may be after the life."""
    seconds = event.fields.get("seconds")
    done(_last(lives), {"longest_turn": seconds, "longest_message": _text(event, "message")})


def _started(lives: Lives, event: PastEvent) -> None:
    number = _number(event, "life") or 1
    if lives and not lives[-1].is_over:
        life = lives[-1]
        if life.started is None:
            life.number, life.started, life.turns_before = number, event.at, _number(event, "turns")
            return
        if life.number == number:
            return  # A replica of the same life.
        life.ended, life.reason = event.at, life.reason or "its end was not recorded"
    lives.append(PastLife(number, event.at, turns_before=_number(event, "turns")))


def _process_started(lives: Lives, event: PastEvent) -> None:
    """The process is told of before the life that begins in it."""
    life = _now(lives)
    life.pid = _number(event, "pid") or 0


def _crashed(lives: Lives, event: PastEvent) -> None:
    life = _now(lives)
    number = _number(event, "life")
    if life.started is None and number:
        life.number = number
    life.handling = _text(event, "message") or life.handling
    _end(life, event)


def _process_died(lives: Lives, event: PastEvent) -> None:
    life = _last(lives)
    if life.pid not in (0, _number(event, "pid")):
        return
    life.pid = _number(event, "pid") or 0
    if life.started is None and not life.is_over and not life.by and _text(event, "reason_kind") == "Killed":
        lives.pop()  # It was not wanted before it began; if that was a failure, it is told.
    else:
        _end(life, event)


def _terminated(lives: Lives, event: PastEvent) -> None:
    life = _last(lives)
    _end(life, event)
    life.allowed = _number(event, "allowed")
    _blame(life, event)


def _blame(life: PastLife, event: PastEvent) -> None:
    if not life.by:
        life.by, life.because = _text(event, "by"), _text(event, "because")


def _stopped(lives: Lives, event: PastEvent) -> None:
    life = _last(lives)
    number = _number(event, "life")
    if life.is_over and number is not None and number > life.number:
        lives.append(life := PastLife(number))
    _end(life, event)
    if _text(event, "because") == WITH_THE_SYSTEM and life.reason_kind == "Shutdown":
        life.reason_kind, life.by = "SystemStopped", PROGRAM
    _blame(life, event)
    life.by = life.by or PROGRAM  # No actor has called for it.


def _linked_end(lives: Lives, event: PastEvent) -> None:
    life = _now(lives)
    life.by, life.because = _text(event, "peer"), "it is linked to it"
    _end(life, event)


def _killed(lives: Lives, event: PastEvent) -> None:
    """Its end is told by another event, which comes when it has ended."""
    life = _now(lives)
    life.by, life.because = _text(event, "by"), KILLED_BY_REF


def _restarted(lives: Lives, event: PastEvent) -> None:
    life = _last(lives)
    _end(life, event)
    life.restarts, life.allowed = _number(event, "attempt"), _number(event, "allowed")


def _not_started(lives: Lives, event: PastEvent) -> None:
    life = _last(lives)
    has_crashed_in_its_start = life.reason_kind == "Crash" and life.allowed is None
    if life.started is not None and life.is_over and not has_crashed_in_its_start:
        life = _now(lives)
    life.ended = event.at
    life.reason, life.reason_kind = _text(event, "reason"), "StartFailed"


def _recovered(lives: Lives, event: PastEvent) -> None:
    life = _last(lives)
    phases = event.fields.get("phases")
    life.phases = phases if isinstance(phases, dict) else {}
    life.replayed = _number(event, "replayed") or 0


def _failed_over(lives: Lives, event: PastEvent) -> None:
    life = _now(lives)
    life.ended, life.reason, life.reason_kind = event.at, _text(event, "why"), "FailedOver"
    done(life, event.fields)
    life.by, life.because = "failover", f"{_text(event, 'replica')} leads now"
    lives.append(PastLife(life.number, event.at, turns_before=_number(event, "turns")))


def _quarantined(lives: Lives, event: PastEvent) -> None:
    """The processes that have died in a row had this message in hand."""
    left = _number(event, "deliveries") or 1
    for life in reversed(lives):
        is_dying = not life.is_over and life.started is not None  # Of replicas the end is told behind this.
        if left and (life.reason_kind in DEATHS or is_dying):
            life.handling = life.handling or _text(event, "message")
            left -= 1


def _root_ended(lives: Lives, event: PastEvent) -> None:
    """Whoever lived has ended with the process of the root."""
    if lives and not lives[-1].is_over:
        life = lives[-1]
        life.ended, life.reason = event.at, _text(event, "why") or "the system stopped"
        life.reason_kind = "SystemStopped" if event.kind == "SystemStopped" else "RootKilled"
        life.by = PROGRAM if event.kind == "SystemStopped" else ""


WITH_THE_ROOT = frozenset({"SystemStopped", "RootKilled"})
"""How lives end that end with the process of the root."""
ROOT = ("SystemStarted", "SystemStopped")
BEHIND_AN_END = ("ActorStarted", "ProcessStarted", "MessageQuarantined")
"""Events that come when the life before is over."""
DEATHS = frozenset({"Signal", "ForkServerDied", "Exited", "OutOfMemory", "Hung"})
"""Exit reasons of a process that says nothing itself of what it had in hand."""
LEARN = {
    "ActorStarted": _started,
    "ActorCrashed": _crashed,
    "ProcessStarted": _process_started,
    "ProcessDied": _process_died,
    "ChildTerminated": _terminated,
    "ChildStopped": _stopped,
    "EndedByLink": _linked_end,
    "ActorKilled": _killed,
    "ChildRestarted": _restarted,
    "ChildStartFailed": _not_started,
    "Recovered": _recovered,
    "FailedOver": _failed_over,
    "MessageQuarantined": _quarantined,
    "TurnSlow": _slow,
    "SystemStarted": _root_ended,
    "SystemStopped": _root_ended,
}
"""What each kind of event says of the lives at its address."""
