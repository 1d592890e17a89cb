"""Why a supervisor's children are as they are, in sentences: whom it restarts, who has ended, who hangs."""

from __future__ import annotations

from collections import Counter

from .evidence import LONG_TURN, MOST_TEXT, ChildNow, Evidence, messages_text, seconds_text
from .past_event import PastEvent

LATELY = 60.0
"""Seconds within which restarts are told, if the supervisor's period is not longer."""
MOST_NAMED = 3
"""Children that are named in one sentence, or have a sentence each."""
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


def restarts_of_children(evidence: Evidence) -> list[str]:
    """Which children it has restarted lately, how often, and what it allows."""
    own = evidence.own_allowance
    since = evidence.now - max(LATELY, own.period if own is not None else 0.0)
    lately = [event for event in evidence.below.events if event.kind == "ChildRestarted" and event.at >= since]
    if not lately:
        return []
    counted = Counter(event.address for event in lately).most_common(MOST_NAMED)
    others = len({event.address for event in lately}) - len(counted)
    named = [f"{_name(path)} {_times(count)} ({_last_reason(lately, path)})" for path, count in counted]
    named += [f"{others} others"] if others else []
    took = max(1, round(evidence.now - lately[0].at))
    said = f"Within the last {took} s it restarted {', '.join(named)}"
    if own is None:
        return [f"{said}; it allows {lately[-1].fields.get('allowed')} within its period."]
    left = "and gives up at the next" if own.restarts >= own.intensity else f"of which it has counted {own.restarts}"
    return [f"{said}; it allows {own.intensity} in {own.period:g} s, {left}."]


def ended_children(evidence: Evidence) -> list[str]:
    """Which children have ended, or could not be started, and are not there now."""
    ended = sorted(evidence.below.ended.items(), key=lambda one: one[1].ended or 0.0)
    said: list[str] = []
    for path, life in ended[-MOST_NAMED:]:
        ago = evidence.ago(life.ended or evidence.now)
        if life.reason_kind == "StartFailed":
            said.append(f"Its child {_name(path)} could not be started {ago}: {life.reason[:MOST_TEXT]}.")
        else:
            by = f", by {life.by} ({life.because})" if life.by else ""
            said.append(f"Its child {_name(path)} ended {ago} and is not there: {life.reason[:MOST_TEXT]}{by}.")
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
        elif event.kind != "ChildRestarted":
            add(event.address, 5.0, f"gave up {ago}" if event.kind == "SupervisorGaveUp" else f"ended {ago}")
    for path, life in evidence.deeper.ended.items():
        if life.ended is not None and evidence.now - life.ended <= NEWS:
            ended = "could not be started" if life.reason_kind == "StartFailed" else "ended and is not there"
            add(path, 4.0, f"{ended}, {evidence.ago(life.ended)} ({life.reason[:MOST_TEXT]})")
    restarts = [
        one for one in evidence.deeper.events if one.kind == "ChildRestarted" and evidence.now - one.at <= LATELY
    ]
    for path, count in Counter(event.address for event in restarts).items():
        first = next(event for event in restarts if event.address == path)
        within = max(1, round(evidence.now - first.at))
        words = f"was restarted {_times(count)} within the last {within} s ({_last_reason(restarts, path)})"
        add(path, 6.0 + count, words)
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


def _last_reason(events: list[PastEvent], path: str) -> str:
    last = next(event for event in reversed(events) if event.address == path)
    return str(last.fields.get("reason"))[:MOST_TEXT]


def _name(path: str) -> str:
    return path.rpartition("/")[2]


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
