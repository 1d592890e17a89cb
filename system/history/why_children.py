"""Why a supervisor's children are as they are, in sentences: whom it restarts, who has ended, who hangs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from itertools import pairwise

from .evidence import LONG_TURN, START_KINDS, ChildNow, Evidence, brief, messages_text, seconds_text
from .past_event import PastEvent

LATELY = 60.0
"""Seconds within which restarts are told, if the supervisor's period is not longer."""
MOST_NAMED = 3
"""Children that are named in one sentence, or have a sentence each."""
QUIET = 30.0
"""Seconds for which one has to be up until its restarts are over."""
NEWS = 600.0
"""Seconds for which a supervisor tells what has happened to one of its children."""
TROUBLE = {
    "JournalFull": "the journal became full",
    "MessageQuarantined": "a message was put into quarantine",
    "RecoveryFailed": "a recovery failed",
    "ReplicaLost": "a replica was lost",
}
"""What may happen to a child without its end, in words."""
MOVING = {
    "starting": "is starting",
    "stopping": "is being stopped",
    "restarting": "waits for its next start",
    "recovering": "is being recovered",
}
"""What a child is in that is neither up nor stopped, in words."""


@dataclasses.dataclass(frozen=True, eq=False)
class Starts:
    """How often one was started again of late: by event, oldest first."""

    path: str
    restarts: list[PastEvent]
    failed: list[PastEvent]
    """Those starts of which it has not come up."""
    is_up: bool

    @property
    def count(self) -> int:
        """How often it was restarted, or could not be started."""
        return len(self.failed if self.is_in_vain else self.restarts)

    @property
    def is_in_vain(self) -> bool:
        """Whether it has not come up: of the last start nobody may know yet."""
        return bool(self.failed) and len(self.failed) >= len(self.restarts) - 1

    def is_over(self, now: float) -> bool:
        """Whether it is up, and has been for longer than between two restarts."""
        times = [event.at for event in self.restarts]
        longest = max((after - before for before, after in pairwise(times)), default=0.0)
        return self.is_up and now - times[-1] > max(QUIET, longest)

    @property
    def reason(self) -> str:
        """Why it was, or could not be, the last time."""
        return brief(str((self.failed if self.is_in_vain else self.restarts)[-1].fields.get("reason")))

    def told(self, now: float) -> str:
        """How often it was, or could not be, and why."""
        did = "could not be started" if self.is_in_vain else "was restarted"
        return f"{did} {_times(self.count)} within the last {max(1, round(now - self.first))} s ({self.reason})"

    @property
    def first(self) -> float:
        """When the first of these starts was, or failed."""
        return min(event.at for event in (*self.restarts, *self.failed))


def _starts(events: list[PastEvent], since: float, is_up: Callable[[str], bool]) -> list[Starts]:
    """Of each that was restarted, those who were most often first."""
    lately = [event for event in events if event.kind in START_KINDS and event.at >= since]
    found = [
        Starts(
            path,
            [event for event in lately if (event.kind, event.address) == ("ChildRestarted", path)],
            [event for event in lately if (event.kind, event.address) == ("ChildStartFailed", path)],
            is_up(path),
        )
        for path in dict.fromkeys(event.address for event in lately if event.kind == "ChildRestarted")
    ]
    return sorted(found, key=lambda one: -one.count)


def _restarted(evidence: Evidence, *, is_over: bool) -> list[Starts]:
    own, up = evidence.own_allowance, {one.name for one in _in(evidence, "running")}
    since = evidence.now - max(LATELY, own.period if own is not None else 0.0)
    starts = _starts(evidence.below.events, since, lambda path: _name(path) in up)
    return [one for one in starts if one.is_over(evidence.now) == is_over]


def restarts_of_children(evidence: Evidence) -> list[str]:
    """Which children it has restarted lately, or has tried to, how often, and what it allows."""
    starts, own = _restarted(evidence, is_over=False), evidence.own_allowance
    if not starts:
        return []
    said = _said_of(evidence, starts)
    if own is None:
        allowed = max((event for one in starts for event in one.restarts), key=lambda event: event.at)
        return [f"{said}; it allows {allowed.fields.get('allowed')} within its period."]
    left = "and gives up at the next" if own.restarts >= own.intensity else f"of which it has counted {own.restarts}"
    return [f"{said}; it allows {own.intensity} in {own.period:g} s, {left}."]


def _restarted_deeper(evidence: Evidence, *, is_over: bool) -> list[Starts]:
    ended = evidence.deeper.ended
    starts = _starts(evidence.deeper.events, evidence.now - LATELY, lambda path: path not in ended)
    return [one for one in starts if one.is_over(evidence.now) == is_over]


def past_restarts(evidence: Evidence) -> list[str]:
    """Who was restarted lately, of its children and further below, and has been up for a while."""
    starts = _restarted(evidence, is_over=True)
    said = [f"{_said_of(evidence, starts)}; that is over."] if starts else []
    deeper = [
        f"Below it, {one.path} {one.told(evidence.now)}; that is over."
        for one in _restarted_deeper(evidence, is_over=True)
    ]
    return [*said, *_first(deeper)]


def _said_of(evidence: Evidence, starts: list[Starts]) -> str:
    named, others = starts[:MOST_NAMED], len(starts) - MOST_NAMED
    told = {one: f"{_name(one.path)} {_times(one.count)} ({one.reason})" for one in named}
    in_vain = [words for one, words in told.items() if one.is_in_vain]
    came = [words for one, words in told.items() if not one.is_in_vain]
    came += [f"{others} others"] if others > 0 else []
    did = [f"restarted {', '.join(came)}"] if came else []
    did += [f"could not start {', '.join(in_vain)}"] if in_vain else []
    took = max(1, round(evidence.now - min(one.first for one in starts)))
    return f"Within the last {took} s it {', and '.join(did)}"


def ended_children(evidence: Evidence) -> list[str]:
    """Which children have ended, or could not be started, and are not there now."""
    ended = sorted(evidence.below.ended.items(), key=lambda one: one[1].ended or 0.0)
    said: list[str] = []
    for path, life in ended[-MOST_NAMED:]:
        ago = evidence.ago(life.ended or evidence.now)
        if life.reason_kind == "StartFailed":
            said.append(f"Its child {_name(path)} could not be started {ago}: {brief(life.reason)}.")
        else:
            by = f", by {life.author}" if life.by else ""
            said.append(f"Its child {_name(path)} ended {ago} and is not there: {brief(life.reason)}{by}.")
    more = len(ended) - MOST_NAMED
    return [*said, f"{more} more of its children are not there."] if more > 0 else said


def moving_children(evidence: Evidence) -> list[str]:
    """Which children are starting or being stopped, and where that hangs."""
    return _first([f"Its child {one.name} {MOVING[one.state]}{_hangs(one)}." for one in _in(evidence, *MOVING)])


def waiting_children(evidence: Evidence) -> list[str]:
    """Which children are up and do not get on: suspended, in a turn that waits for long, or behind with their work."""
    slow = [one for one in _in(evidence, "running") if one.is_slow]
    slow.sort(key=lambda one: -max(one.turn_seconds, one.waited))
    held = [f"Its child {one.name} is suspended." for one in _in(evidence, "suspended")]
    return _first([f"Its child {one.name} does not get on{_hangs(one)}." for one in slow] + held)


def rest_below(evidence: Evidence) -> list[str]:
    """Which children, and who further below, are in a turn that rests as it has said: that is no trouble."""
    said = [f"Its child {one.name} {_at_rest(one)}." for one in _in(evidence, "running") if _rests(one)]
    said += [f"Below it, {one.name} {_at_rest(one)}." for one in evidence.deeper.now if _rests(one)]
    return _first(said)


def troubled_children(evidence: Evidence) -> list[str]:
    """Which children have something to tell that is no end: whoever asks about them hears more."""
    said = [
        f"Of its child {_name(event.address)}, {TROUBLE[event.kind]} {evidence.ago(event.at)}: ask why of "
        f"{event.address}."
        for event in evidence.below.events
        if event.kind in TROUBLE and evidence.now - event.at <= NEWS
    ]
    return _first(said[::-1])


def overdue_children(evidence: Evidence) -> list[str]:
    """Which children had not ended in time when they were told to, and were killed."""
    events = [event for event in evidence.below.events if event.kind == "StopOverdue"]
    return _first(
        [
            f"Its child {_name(event.address)} had not ended within {event.fields.get('seconds')} s when it was told "
            f"to, and was killed {evidence.ago(event.at)}: {_stacks(event)}."
            for event in events
        ]
    )


def deeper_trouble(evidence: Evidence) -> list[str]:
    """Who is in trouble further below, at any depth: the worst few, and how many more."""
    worst = sorted(_deeper_trouble(evidence).items(), key=lambda one: (-one[1][0], one[0]))
    said = [f"Below it, {path} {words}: ask why of {path}." for path, (_, words) in worst[:MOST_NAMED]]
    more = len(worst) - MOST_NAMED
    return [*said, f"{more} more are in trouble below it."] if more > 0 else said


def _deeper_trouble(evidence: Evidence) -> dict[str, tuple[float, str]]:
    """What is wrong with each further below, and how much that weighs; of each only what weighs most."""
    found: dict[str, tuple[float, str]] = {}

    def add(path: str, weight: float, words: str) -> None:
        if weight > found.get(path, (0.0, ""))[0]:
            found[path] = weight, words

    for one in evidence.deeper.now:
        if _rests(one):
            continue
        held = one.state == "suspended"
        add(one.name, 1.0 if held else 2.0, "is suspended" if held else f"does not get on{_hangs(one)}")
    for event in evidence.deeper.events:
        ago = evidence.ago(event.at)
        if evidence.now - event.at > NEWS:
            continue
        if event.kind in TROUBLE:
            add(event.address, 3.0, f"has something to tell: {TROUBLE[event.kind]} {ago}")
        elif event.kind not in START_KINDS:
            add(event.address, 5.0, f"gave up {ago}" if event.kind == "SupervisorGaveUp" else f"ended {ago}")
    for path, life in evidence.deeper.ended.items():
        if life.ended is not None and evidence.now - life.ended <= NEWS:
            ended = "could not be started" if life.reason_kind == "StartFailed" else "ended and is not there"
            add(path, 4.0, f"{ended}, {evidence.ago(life.ended)} ({brief(life.reason)})")
    for tried in _restarted_deeper(evidence, is_over=False):
        add(tried.path, 6.0 + tried.count, tried.told(evidence.now))
    return found


def _stacks(event: PastEvent) -> str:
    lines = str(event.fields.get("stacks") or "").splitlines()
    return lines[0].rstrip(":") if lines else "what it waited for is not known"


def _in(evidence: Evidence, *states: str) -> list[ChildNow]:
    return [one for one in evidence.below.now if one.state in states]


def _hangs(one: ChildNow) -> str:
    """Where a child's turn waits, whom its start waits for, and who waits for it."""
    said = f", and waits for {one.awaited} to be there" if one.awaited else ""
    if one.turn and one.turn_seconds >= LONG_TURN:
        at = f" at {one.turn_at}" if one.turn_at else ""
        said += f": it has been in the turn of {one.turn} for {seconds_text(one.turn_seconds)}{at}"
    if one.waited >= LONG_TURN:
        said += f"; {messages_text(one.queued)} for it, one for {seconds_text(one.waited)} or more"
    return said


def _rests(one: ChildNow) -> bool:
    return one.state == "running" and one.is_long and bool(one.rests)


def _at_rest(one: ChildNow) -> str:
    """What a child's turn rests in, in the words of its own."""
    turn = f"is in the turn of {one.turn}: it " if one.turn else ""
    return f"{turn}{one.rests}"


def _first(said: list[str]) -> list[str]:
    more = len(said) - MOST_NAMED
    return [*said[:MOST_NAMED], f"The same is true of {more} more."] if more > 0 else said


def _name(path: str) -> str:
    return path.rpartition("/")[2]


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
