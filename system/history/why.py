"""Why an actor is as it is, in a few plain sentences: pure functions of the evidence, one for each cause."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from ...ftm.group.protected import ProtectionStatus
from .evidence import GAVE_UP_KINDS, LONG_TURN, MOST_TEXT, Evidence, PutAside, brief, cut, messages_text, seconds_text
from .lives import CLEAN, PastLife, is_fault
from .past_event import PastEvent
from .raised import raised_at
from .why_children import (
    NEWS,
    deeper_trouble,
    ended_children,
    moving_children,
    overdue_children,
    past_restarts,
    rest_below,
    restarts_of_children,
    troubled_children,
    waiting_children,
)

LATELY = 60.0
"""Seconds within which ends belong to one crash loop, if the supervisor's period is not known to be longer."""
MANY = 100
"""Messages in a mailbox that are worth a sentence."""
MUCH = 0.6
"""The part of the memory that a process may have from which on it is worth a sentence."""

ROUNDED = 1.0
"""Seconds by which the end of a supervisor may be told of later than its reason for it."""

AT_REST = "its turn rests"
REST_BELOW = "turns that rest below"
PAST_RESTARTS = "restarts that are over"
NO_TROUBLE = frozenset({AT_REST, REST_BELOW, PAST_RESTARTS})
"""Causes of which there is something to tell, while nothing is wrong."""

Rule = Callable[[Evidence], list[str]]


class Cause(NamedTuple):
    """One sentence of `why`, with the name of the cause in the table `RULES` that it tells of."""

    cause: str
    sentence: str


def causes(evidence: Evidence) -> list[Cause]:
    """Say what is wrong at the address, a sentence for each thing, what weighs most first, and who rests last."""
    return [Cause(name, sentence) for name, rule in RULES.items() for sentence in rule(evidence)]


def why(evidence: Evidence) -> list[str]:
    """Say in sentences why the actor restarts, has ended, or does not get on: what weighs most comes first.

    >>> why(Evidence("/app/till", 0.0))
    ['Nobody lives at /app/till, and the history knows of no life there.']
    """
    found = causes(evidence)
    is_well = all(one.cause in (REST_BELOW, PAST_RESTARTS) for one in found)
    return [*([_well(evidence)] if is_well else []), *(one.sentence for one in found)]


def _well(evidence: Evidence) -> str:
    status = evidence.status
    if status is None and not evidence.lives:
        return f"Nobody lives at {evidence.address}, and the history knows of no life there."
    if not evidence.is_there:
        return f"Nobody lives at {evidence.address} any more, and how its last life ended is not known."
    if status is None:
        return f"{evidence.address} does not say how it is, and the history knows of nothing that is wrong."
    return f"{evidence.address} is {status.state}, in life {status.life}, and nothing is wrong as far as is known."


# -- ends -------------------------------------------------------------------------------------------------------------


def _ends(evidence: Evidence) -> list[PastLife]:
    """The lives that ended by a fault, oldest first; only those behind the last good start of the root."""
    return [life for life in evidence.lives if life.is_over and is_fault(life)]


def _crash_loop(evidence: Evidence) -> list[str]:
    """Restarted again and again, or once, because of its own faults."""
    ends = _ends(evidence)
    if not ends or (evidence.lives[-1] is not ends[-1] and _last_ended(evidence) is not ends[-1]):
        return []
    last = ends[-1]
    allowance = evidence.allowance
    span = max(LATELY, allowance.period if allowance is not None else 0.0)
    loop = [life for life in ends if (last.ended or 0.0) - (life.ended or 0.0) <= span]
    if last.reason_kind == "StartFailed":
        return [_start_fails(evidence, loop)]
    if len(loop) == 1:
        return [_one_end(evidence, last)]
    said = f"{evidence.address} {_restarted(loop)} {_within(evidence, loop)}"
    said += _in_hand([life.handling for life in loop])
    said += f"; {_fault(last)}" + ("" if len({life.reason for life in loop}) == 1 else " (the last time)")
    limit = _limit(evidence, last)
    return [f"{said}; {limit}." if limit else f"{said}."]


def _within(evidence: Evidence, loop: list[PastLife]) -> str:
    first, last = loop[0].ended or evidence.now, loop[-1].ended or evidence.now
    if evidence.now - last < LATELY:
        return f"in the last {max(1, math.ceil(evidence.now - first))} s"
    return f"within {max(1, math.ceil(last - first))} s, the last time {evidence.ago(last)}"


def _last_ended(evidence: Evidence) -> PastLife | None:
    return next((life for life in reversed(evidence.lives) if life.is_over), None)


def _restarted(loop: list[PastLife]) -> str:
    ends, restarts = len(loop), sum(life.restarts is not None for life in loop)
    if restarts == ends:
        return f"restarted {restarts} times"
    return f"ended {ends} times and was restarted {restarts} times" if restarts else f"ended {ends} times"


def _in_hand(messages: list[str]) -> str:
    """What the lives had in hand when they ended, oldest first: each end is put down to its own message only.

    >>> _in_hand(["shop.Pay", "shop.Pay"]), _in_hand(["shop.Pay", "shop.Buy", "shop.Pay"])
    ('; each time handling shop.Pay', '; 2 times handling shop.Pay, once shop.Buy, the last time shop.Pay')
    >>> _in_hand(["shop.Pay", "", ""]), _in_hand(["", "shop.Pay"]), _in_hand(["", ""])
    ('; once handling shop.Pay, but not the last time', '; the last time handling shop.Pay', '')
    """
    known = Counter(message for message in messages if message)
    if not known:
        return ""
    last = messages[-1]
    if len(known) == 1 and last and known[last] in (1, len(messages)):
        return f"; {'the last' if known[last] < len(messages) else 'each'} time handling {last}"
    times = [f"{'once' if count == 1 else f'{count} times'} {message}" for message, count in known.most_common()]
    first, said = times[0].rpartition(" ")[::2]
    end = f"the last time {last}" if last else "but not the last time"
    return f"; {', '.join([f'{first} handling {said}', *times[1:], end])}"


def _one_end(evidence: Evidence, life: PastLife) -> str:
    handling = f" handling {life.handling}" if life.handling else ""
    then = ", and was restarted" if life.restarts is not None else ""
    said = f"{evidence.address} ended {_ago(evidence, life)}{handling}{then}: {_fault(life)}"
    limit = _limit(evidence, life)
    return f"{said}; {limit}." if limit else f"{said}."


def _fault(life: PastLife) -> str:
    """What has ended a life, in words."""
    reason = cut(life.reason)
    match life.reason_kind:
        case "Crash":
            place = raised_at(life.traceback)
            return f"{reason} at {place}" if place else reason
        case "Signal":
            who = (
                ", which nobody can catch: the kernel, an administrator or a program sent it"
                if reason == "SIGKILL"
                else ""
            )
            return f"its process was ended by {reason}{who}"
        case "ForkServerDied":
            return f"{reason}, as all others did: no fault of its own, and one restart for all of them"
        case "OutOfMemory":
            return f"its process was {reason}" if life.pid else reason
        case "Hung":
            return f"its process {reason}: a loop without await, a blocking call or a lock"
        case "Killed":
            return "it was killed, by a time limit or over a link"
        case "TrustBreach":
            return f"its process was ended for a {reason}"
        case _:
            return reason or "nobody knows why"


def _limit(evidence: Evidence, life: PastLife) -> str:
    """What the supervisor will do at the next end."""
    allowance = evidence.allowance
    if allowance is None:
        return "" if life.allowed is None else f"its supervisor allows {life.allowed} restarts"
    left = allowance.intensity - allowance.restarts
    said = f"its supervisor allows {allowance.intensity} in {allowance.period:g} s"
    return f"{said} and gives up at the next" if left <= 0 else f"{said}, of which it has counted {allowance.restarts}"


def _start_fails(evidence: Evidence, loop: list[PastLife]) -> str:
    last = loop[-1]
    failures = [life for life in loop if life.reason_kind == "StartFailed"]
    times = "" if len(failures) == 1 else f" {len(failures)} times, the last time"
    return f"{evidence.address} could not be started{times} {_ago(evidence, last)}: {cut(last.reason, 2 * MOST_TEXT)}."


# -- ends that others have called for ---------------------------------------------------------------------------------


def _ended_by_others(evidence: Evidence) -> list[str]:
    """Stopped by its supervisor, a sibling's end, an operator, the program, a transaction, or a link."""
    life = _last_ended(evidence)
    if life is None or not life.by or life.reason_kind in ("FailedOver", "RootKilled", "SystemStopped"):
        return []
    if life.by == evidence.address:
        event = _own_end(evidence)
        if event is not None and (life.started or 0.0) <= event.at <= (life.ended or evidence.now) + ROUNDED:
            return []  # It is told why: `_gave_up`.
        return [f"{evidence.address} ended by itself {_ago(evidence, life)}: {life.because}."]
    because = f": {life.because}" if life.because else ""
    fault = "" if life.reason_kind in CLEAN or life.reason_kind == "Killed" else f" ({_fault(life)})"
    return [f"{evidence.address} was ended by {life.by} {_ago(evidence, life)}{because}{fault}."]


def _given_up_above(evidence: Evidence) -> list[str]:
    """A supervisor above it has given up, or has ended because its significant children had."""
    said: list[str] = []
    for event in evidence.above[-3:]:
        child, reason = event.fields.get("child"), event.fields.get("reason")
        if event.kind == "SupervisorGaveUp":
            said.append(
                f"{event.address} gave up {evidence.ago(event.at)}, and all below it ended: "
                f"{event.address}/{child} had failed too often, the last time with {brief(str(reason))}."
            )
        else:
            said.append(
                f"{event.address} ended {evidence.ago(event.at)}: its significant child {child} did ({reason})."
            )
    return said


def _gave_up(evidence: Evidence) -> list[str]:
    """It is a supervisor, and has given up itself, or ended because its significant children had."""
    event = _own_end(evidence)
    if event is None:
        return []
    child, reason = event.fields.get("child"), brief(str(event.fields.get("reason")))
    ago, since = evidence.ago(event.at), _runs_since(evidence)
    then = "" if since is None or since < event.at else f", and was started again {evidence.ago(since)}"
    if event.kind == "AutoShutdown":
        return [f"{evidence.address} ended {ago}{then}, by its `auto_shutdown`: its child {child} ended ({reason})."]
    return [f"{evidence.address} gave up {ago}{then}: its child {child} had failed too often ({reason})."]


def _own_end(evidence: Evidence) -> PastEvent | None:
    """The newest event of a supervisor that has ended itself with all below it."""
    return next((event for event in reversed(evidence.events) if event.kind in GAVE_UP_KINDS), None)


def _runs_since(evidence: Evidence) -> float | None:
    """When the life at the address began, if one goes on. (The root's own is as old as its program.)"""
    if not evidence.is_there:
        return None
    if evidence.lives and not evidence.lives[-1].is_over:
        return evidence.lives[-1].started
    begun, life = _newest(evidence, "SystemStarted"), _last_ended(evidence)
    return None if begun is None or (life is not None and begun.at < (life.ended or 0.0)) else begun.at


def _root_ended(evidence: Evidence) -> list[str]:
    life = _last_ended(evidence)
    if life is None or life.reason_kind != "RootKilled":
        return []
    since, ended = _runs_since(evidence), f"{_ago(evidence, life)} because {life.reason}"
    if since is None:
        return [f"{evidence.address} ended {ended}; what it had in hand was cut off."]
    if evidence.now - since > NEWS:
        return []
    return [f"{evidence.address} runs; it was started {evidence.ago(since)}, for its life before had ended {ended}."]


# -- recovery ---------------------------------------------------------------------------------------------------------


def _quarantine(evidence: Evidence) -> list[str]:
    """Messages that are put aside because they have ended the process again and again."""
    if evidence.quarantined:
        return [_is_put_aside(evidence, one) for one in evidence.quarantined[-3:]]
    event = _newest(evidence, "MessageQuarantined")
    if event is None:
        return []
    put = f"The message {event.fields.get('message')} was put into quarantine {evidence.ago(event.at)}"
    return [f"{put}, after {event.fields.get('deliveries')} deaths of the process, and is not there any more."]


def _is_put_aside(evidence: Evidence, one: PutAside) -> str:
    put = f"The message {one.message} was put into quarantine {evidence.ago(one.since)}"
    deaths = f"it had ended the process {one.attempts} times in a row"
    return f"{put}: {deaths}. The actor goes on without it; retry or drop it once the cause is mended."


def _recovery_fails(evidence: Evidence) -> list[str]:
    """It cannot be brought back: its replay leads elsewhere, or what is recorded cannot be used."""
    event = _newest(evidence, "RecoveryFailed")
    back = _newest(evidence, "Recovered")
    if event is None or (back is not None and back.number > event.number):
        return []
    reason = cut(str(event.fields.get("reason", "")), 2 * MOST_TEXT)
    if "diverged" in reason:
        return [f"{evidence.address} cannot be recovered, for its turns do not go as they went before: {reason}."]
    return [f"{evidence.address} could not be recovered {evidence.ago(event.at)}: {reason}."]


# -- how it is now ----------------------------------------------------------------------------------------------------


def _suspended(evidence: Evidence) -> list[str]:
    status = evidence.status
    if status is None or status.state != "suspended":
        return []
    by = _suspended_by(evidence)
    since = "is suspended" if by is None else f"was suspended {evidence.ago(by.at)} by {by.fields.get('by')}"
    waits = messages_text(status.queued) if status.queued else "what comes waits"
    return [f"{evidence.address} {since}: it handles nothing, and {waits} for `resume`."]


def _suspended_by(evidence: Evidence) -> PastEvent | None:
    """The order that has suspended it, which later ones only repeat; None if that is not known."""
    since, found = _newest(evidence, "ActorResumed"), None
    begun = evidence.lives[-1].started if evidence.lives else None
    for event in evidence.events:
        is_later = (since is None or event.number > since.number) and event.at >= (begun or 0.0)
        if event.kind == "ActorSuspended" and is_later:
            found = found or event
    return found


def _restarting(evidence: Evidence) -> list[str]:
    status = evidence.status
    if status is None or status.state != "restarting":
        return []
    return [f"{evidence.address} has no life at the moment: it waits for its next start, or is being recovered."]


def _start_waits(evidence: Evidence) -> list[str]:
    """Its start waits for somebody to whom its spec binds it."""
    if not evidence.awaited:
        return []
    return [
        f"{evidence.address} is to start as soon as somebody lives at {evidence.awaited}: its spec binds it to that."
    ]


def _waits(evidence: Evidence) -> list[str]:
    """Its turn waits for an answer, or for something else."""
    return [] if evidence.rests else _long_turn(evidence)


def _rests(evidence: Evidence) -> list[str]:
    """Its turn rests, as it has said, and so do the messages that wait for it."""
    return [*_long_turn(evidence), *_waiting_messages(evidence)] if evidence.rests else []


def _long_turn(evidence: Evidence) -> list[str]:
    status = evidence.status
    if status is None or status.turn is None or status.turn_seconds < LONG_TURN:
        return []
    said = f"{evidence.address} has been in the turn of {status.turn} for {seconds_text(status.turn_seconds)}"
    at = f", at {status.turn_at}" if status.turn_at else ""
    if not evidence.asks and status.turn_rests:
        return [f"{said}{at}; it {status.turn_rests}."]
    if not evidence.asks:
        return [f"{said}{at}; it waits for something that is no ask of this process."]
    first = evidence.asks[0]
    more = f", and {len(evidence.asks) - 1} more asks" if len(evidence.asks) > 1 else ""
    asked = f"it waits for {first.to} to answer {first.message}, asked {seconds_text(first.seconds)} ago"
    return [f"{said}{at}: {asked}{more}."]


def _silent(evidence: Evidence) -> list[str]:
    """Its process does not answer what every loop that runs answers at once."""
    silence = evidence.process.silence
    if silence is None:
        return []
    process = f"The process of {evidence.address} (pid {silence.pid})"
    if silence.is_stopped:
        return [f"{process} is stopped, as by SIGSTOP: SIGCONT lets it go on."]
    waited = seconds_text(silence.seconds)
    return [f"{process} has not answered within {waited}: its event loop does not run, or the machine is very busy."]


def _mailbox(evidence: Evidence) -> list[str]:
    """Many messages wait for it, or one has waited for long."""
    return [] if evidence.rests else _waiting_messages(evidence)


def _waiting_messages(evidence: Evidence) -> list[str]:
    status, before, waiting = evidence.status, evidence.queued_before, evidence.waiting
    if status is None or not status.queued or status.state == "suspended":
        return []
    if status.queued < MANY and (waiting is None or (waiting.waited < LONG_TURN and not waiting.late)):
        return []
    said = f"{messages_text(status.queued)} in its mailbox"
    if before is not None and before != status.queued:
        said += ", and they become more" if status.queued > before else ", and they become fewer"
    if waiting is not None:
        sender = f" from {waiting.sender}" if waiting.sender else ""
        said += f"; most of them are {waiting.message}{sender}"
        said += f"; one has waited for {seconds_text(waiting.waited)} or more" if waiting.waited >= LONG_TURN else ""
        said += f"; nobody waits for the answers of {waiting.late} any more" if waiting.late else ""
        said += f"; a turn takes {waiting.mean_turn:.2g} s in the mean" if waiting.mean_turn else ""
    return [f"{said}."]


def _memory(evidence: Evidence) -> list[str]:
    """Its process has nearly as much memory as it may."""
    memory = evidence.process.memory
    if memory is None or memory.resident_bytes < MUCH * memory.allowed_bytes:
        return []
    has, may = memory.resident_bytes / 1e6, memory.allowed_bytes / 1e6
    said = f"Its process has {has:.0f} MB of memory, and is ended at {may:.0f} MB"
    return [f"{said}: if that goes on growing, look at what its state holds (`holdfast inspect --state`)."]


def _replicas(evidence: Evidence) -> list[str]:
    """Which replica was lost, when and by what; who leads since, and whether all of them are there again."""
    lost, over = _newest(evidence, "ReplicaLost"), _newest(evidence, "FailedOver")
    back = _newest(evidence, "ReplicaJoined")
    is_back = lost is not None and back is not None and back.number > lost.number
    said: list[str] = []
    if lost is not None:
        still = "" if is_back else " and is not back"
        ago = evidence.ago(lost.at)
        said.append(f"Replica {lost.fields.get('replica')} was lost {ago}{still}: {lost.fields.get('why')}.")
    if over is not None:
        took = f"Replica {over.fields.get('replica')} took over {evidence.ago(over.at)}"
        said.append(f"{took}, in epoch {over.fields.get('epoch')}: {over.fields.get('why')}.")
    protection = evidence.protection
    if said and protection is not None and protection.replicas and protection.is_whole:
        came = f", for {back.fields.get('replica')} came back {evidence.ago(back.at)}" if back and is_back else ""
        said.append(f"It is whole again{came}: {_replica_states(protection)}.")
    return said


def _replicas_away(evidence: Evidence) -> list[str]:
    """Which replicas are there, if one has to come back; whether any may die meanwhile."""
    lost, over = _newest(evidence, "ReplicaLost"), _newest(evidence, "FailedOver")
    gone, back = _newest(evidence, "ProtectionLost"), _newest(evidence, "ReplicaJoined")
    protection = evidence.protection
    said: list[str] = []
    if (lost or over) and protection is not None and protection.replicas and not protection.is_whole:
        said.append(f"It is not whole: {_replica_states(protection)}.")
    if gone is not None and (back is None or back.number < gone.number):
        said.append("It is not protected at the moment: no replica may die.")
    return said


def _replica_states(protection: ProtectionStatus) -> str:
    states = ", ".join(f"{name} {state}" for name, state in protection.replicas.items())
    return f"{states}, epoch {protection.epoch}"


def _store(evidence: Evidence) -> list[str]:
    """The store fails, or is full."""
    said: dict[str, str] = {}
    for event in evidence.store:
        reason = brief(str(event.fields.get("reason", "")))
        match event.kind:
            case "JournalGoesOn":
                said.pop("JournalBlocked", None)
            case "JournalBlocked":
                said[event.kind] = f"The store stopped taking anything {evidence.ago(event.at)}: {reason}."
            case "JournalStopped":
                said[event.kind] = f"The store failed {evidence.ago(event.at)}, and nothing is accepted: {reason}."
            case "ServersAnswer" | "LeadershipTaken":
                said.pop("ServersSilent", None)
            case "ServersSilent":
                first = said.get(
                    event.kind, f"The servers of the store have not answered (told {evidence.ago(event.at)})"
                )
                said[event.kind] = f"{first.partition(', and')[0]}, and nothing is accepted: {reason}."
            case "JournalFull" if event.address == evidence.address:
                said[event.kind] = (
                    f"Its journal became full {evidence.ago(event.at)}, and it accepts nothing: "
                    f"{event.fields.get('way_out')}."
                )
            case _:
                pass
    return list(said.values())


def _gap(evidence: Evidence) -> list[str]:
    return ["Events are left out at the moment, because there are too many."] if evidence.suspects_gap else []


RULES: dict[str, Rule] = {
    "a supervisor above has given up": _given_up_above,
    "it has given up": _gave_up,
    "its own faults": _crash_loop,
    "ended by others": _ended_by_others,
    "the root was killed": _root_ended,
    "quarantine": _quarantine,
    "recovery fails": _recovery_fails,
    "its start waits": _start_waits,
    "suspended": _suspended,
    "restarting": _restarting,
    "its process does not answer": _silent,
    "its turn waits": _waits,
    "mailbox": _mailbox,
    "memory": _memory,
    "replicas": _replicas,
    "replicas that are away": _replicas_away,
    "store": _store,
    "restarts of children": restarts_of_children,
    "children that are not there": ended_children,
    "children that start or stop": moving_children,
    "children in trouble": troubled_children,
    "children that had to be killed": overdue_children,
    "children that wait": waiting_children,
    "trouble further below": deeper_trouble,
    AT_REST: _rests,
    REST_BELOW: rest_below,
    PAST_RESTARTS: past_restarts,
    "events left out": _gap,
}
"""The causes, in the order in which they are told."""


# -- words ------------------------------------------------------------------------------------------------------------


def _newest(evidence: Evidence, kind: str) -> PastEvent | None:
    return next((event for event in reversed(evidence.events) if event.kind == kind), None)


def _ago(evidence: Evidence, life: PastLife) -> str:
    return evidence.ago(life.ended or evidence.now)
