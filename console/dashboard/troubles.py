"""What needs attention in a system: whom to ask why, and what the answers come to; pure functions."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import msgspec

from ...system.history.evidence import LONG_TURN, messages_text, seconds_text
from ...system.history.why import MANY, MUCH, NO_TROUBLE
from ..overview import ActorRow

NEWS: Final = 600.0
"""Seconds for which it is told what has happened to an actor that is well again."""
FRESH: Final = 30.0
"""Seconds for which an end is worth a look, even if the next life goes on."""
MOST: Final = 24
"""Actors that are asked why at a time."""
MOST_SUSPECTS: Final = 3
"""Suspects of diagnosis of whom it is told how they are now."""
TELLING: Final = (
    "ActorCrashed",
    "AutoShutdown",
    "BackgroundWorkLost",
    "ChildStartFailed",
    "JournalFull",
    "LifeAbandoned",
    "MessageQuarantined",
    "ProcessDied",
    "ProtectionLost",
    "RecoveryFailed",
    "ReplicaFaulty",
    "ReplicaLost",
    "StopOverdue",
    "SupervisorGaveUp",
    "TrustBreached",
)
"""Events whose actor is asked why: those that docs/events.md has somebody look at."""
ILL, ODD, NEWS_ONLY = "ill", "odd", "news"
"""How grave it is: somebody has to act; look; it is told only."""


class TroubleAdvice(msgspec.Struct, frozen=True):
    """What a cause calls for: how grave it is, what to do in a sentence, and which orders help."""

    grade: str
    text: str
    orders: tuple[str, ...] = ()


ADVICE: Final[dict[str, TroubleAdvice]] = {
    "a supervisor above has given up": TroubleAdvice(
        ILL, "Mend what failed, and start the supervisor again.", ("start",)
    ),
    "it has given up": TroubleAdvice(ILL, "Mend what failed, and start it again.", ("start",)),
    "its own faults": TroubleAdvice(ODD, "Mend the code that failed, or the message that it was handling."),
    "ended by others": TroubleAdvice(NEWS_ONLY, "Start it again, if it was not meant to end.", ("start",)),
    "the root was killed": TroubleAdvice(NEWS_ONLY, "What was recorded is there again."),
    "quarantine": TroubleAdvice(
        ILL,
        "Mend the cause, then have the message handled again; or drop it.",
        ("quarantine-retry", "quarantine-drop"),
    ),
    "recovery fails": TroubleAdvice(ILL, "Mend what it tells, then restart it.", ("restart",)),
    "suspended": TroubleAdvice(ODD, "Resume it, when you are done.", ("resume",)),
    "its start waits": TroubleAdvice(ODD, "Start the actor to whom it is bound, or mend the address in its spec."),
    "restarting": TroubleAdvice(ODD, "Wait; if it does not come back, its history says why."),
    "its process does not answer": TroubleAdvice(
        ILL, "Have the process go on, or end it: its supervisor restarts the actor.", ("kill",)
    ),
    "its turn waits": TroubleAdvice(
        ILL, "Put a time limit around this line. Until then, end the turn: whoever has asked hears of it.", ("kill",)
    ),
    "mailbox": TroubleAdvice(ODD, "Have it do less for each message, spread the work, or bound its mailbox."),
    "memory": TroubleAdvice(
        ODD, "See what its state holds, and have it hold less. Until then, begin anew.", ("state", "restart")
    ),
    "replicas": TroubleAdvice(NEWS_ONLY, "Nothing is to be done: the protection is whole."),
    "replicas that are away": TroubleAdvice(ILL, "See whether it comes back by itself; if not, its history says why."),
    "store": TroubleAdvice(ILL, "Make room beside the store; it tries again by itself. Do not touch its files."),
    "restarts of children": TroubleAdvice(ODD, "Ask the child why."),
    "children that are not there": TroubleAdvice(ODD, "Start it again, if it was not meant to end."),
    "children that start or stop": TroubleAdvice(ODD, "Wait; if it hangs, see at which line."),
    "children in trouble": TroubleAdvice(NEWS_ONLY, "Ask the child why."),
    "children that had to be killed": TroubleAdvice(NEWS_ONLY, "Mend what hangs in its end."),
    "children that wait": TroubleAdvice(ODD, "Ask the child why."),
    "trouble further below": TroubleAdvice(ODD, "Ask why of whom it names."),
    "events left out": TroubleAdvice(NEWS_ONLY, "Somebody tells very much: look at the events."),
}
"""Of each cause that `why` knows, what to do."""
OF_CHILDREN: Final = frozenset(
    {
        "restarts of children",
        "children that are not there",
        "children that start or stop",
        "children in trouble",
        "children that had to be killed",
        "children that wait",
        "trouble further below",
    }
)
OF_ALL: Final = frozenset({"store", "events left out"})
"""Causes of which every actor tells; they are told once, of the root."""
OF_ITS_OWN: Final = "Its journal"
"""How a sentence about the store begins that is about one actor."""
UNKNOWN: Final = TroubleAdvice(ODD, "Look closer.")
"""Of a cause that only the system knows, which is of another version."""
NOT_THERE: Final = TroubleAdvice(ILL, "Mend the cause, and start it again.", ("start",))
SILENT: Final = TroubleAdvice(
    ILL, "Its process does not answer: see whether it is stopped or busy; kill it if it stays so.", ("kill",)
)
SETTLED: Final = TroubleAdvice(NEWS_ONLY, "It was settled: nothing is to be done.")
MENDED: Final = TroubleAdvice(
    NEWS_ONLY, "It goes on in a new life. Mend the code that failed, or the message that it was handling."
)


class Trouble(msgspec.Struct, frozen=True, omit_defaults=True):
    """One actor that needs attention, or of which there is news.

    Attributes:
        address: whose.
        grade: "ill": somebody has to act; "odd": look; "news".
        sentences: what is wrong, as `why` says it, what weighs most first.
        advice: what to do, in sentences.
        orders: the orders that help.
        leads: addresses of other troubles that the sentences name: their cause may be there.
        case: the number of the case of repair whose plan waits for a yes; 0: none does.
        view: the view that shows more, "diagnosis"; "": the page of the actor.
    """

    address: str
    grade: str
    sentences: tuple[str, ...]
    advice: tuple[str, ...] = ()
    orders: tuple[str, ...] = ()
    leads: tuple[str, ...] = ()
    case: int = 0
    view: str = ""


class SeenSystem(msgspec.Struct, frozen=True):
    """What is known before anybody is asked: the rows, who has messages in quarantine, and when something was told.

    Of `rows`, `turn_seconds` is the moment at which the turn began, in Unix time, as a `Picture` has it.
    """

    now: float
    root: str
    rows: Mapping[str, ActorRow]
    memory: Mapping[int, int]
    quarantined: frozenset[str]
    told: Mapping[str, float]


def suspects(seen: SeenSystem) -> list[str]:
    """The addresses that are asked why, those that look worst first; the root is always among them."""
    weights: dict[str, float] = {seen.root: 9.0}
    for path, at in seen.told.items():
        if seen.now - at < NEWS:
            weights[path] = 1.0 + (seen.now - at < FRESH)
    for path, row in seen.rows.items():
        weight = _weight(seen, row)
        if weight:
            weights[path] = max(weight, weights.get(path, 0.0))
    for path in seen.quarantined:
        weights[path] = 5.0
    return sorted(weights, key=lambda path: -weights[path])[:MOST]


def _weight(seen: SeenSystem, row: ActorRow) -> float:
    if row.state == "silent":
        return 6.0
    if row.turn and not row.rests and seen.now - row.turn_seconds >= LONG_TURN:
        return 4.0
    if row.state != "running":
        return 3.0
    if row.queued >= MANY:
        return 2.5
    is_full = row.allowed_bytes and seen.memory.get(row.pid, 0) >= MUCH * row.allowed_bytes
    return 2.5 if is_full else 0.0


def troubles(seen: SeenSystem, answers: Mapping[str, Sequence[tuple[str, str]]]) -> list[Trouble]:
    """What needs attention, the gravest first; whoever is well is left out.

    Args:
        seen: what is known of all.
        answers: of each address that was asked the causes and their sentences.
    """
    found: list[Trouble] = []
    told = {path for path, said in answers.items() if path != seen.root and any(_is_own(one) for one in said)}
    for path, said in answers.items():
        kept = [one for one in said if _is_told(seen, path, one, told)]
        trouble = _trouble(seen, path, kept)
        if trouble is not None:
            found.append(trouble)
    silent = [_silent(row) for path, row in seen.rows.items() if row.state == "silent" and path in answers]
    by_path = {one.address: one for one in [*found, *silent]}
    linked = [msgspec.structs.replace(one, leads=_leads(one, by_path)) for one in by_path.values()]
    return sorted(linked, key=lambda one: (grade_of(one), len(one.leads), -seen.told.get(one.address, 0.0)))


def grade_of(one: Trouble) -> int:
    """How grave it is, as a number to be sorted by: the gravest first."""
    return GRADES.index(one.grade)


def seen_causes(seen: SeenSystem, path: str) -> list[tuple[str, str]]:
    """What is wrong with an actor as far as its row shows it, for a system that keeps no history and cannot say why."""
    row = seen.rows.get(path)
    if row is None or row.state == "silent":
        return []
    seconds = seen.now - row.turn_seconds
    if row.state == "suspended":
        waits = messages_text(row.queued) if row.queued else "what comes waits"
        return [("suspended", f"{path} is suspended: it handles nothing, and {waits} for `resume`.")]
    if row.turn and not row.rests and seconds >= LONG_TURN:
        return [("its turn waits", f"{path} has been in the turn of {row.turn} for {seconds_text(seconds)}.")]
    if row.state == "stopped":
        return [("ended by others", f"{path} is stopped.")]
    if row.state != "running":
        return [("restarting", f"{path} is {row.state}.")]
    return [("mailbox", f"{row.queued} messages wait in its mailbox.")] if row.queued >= MANY else []


GRADES: Final = (ILL, ODD, NEWS_ONLY)


def _is_own(one: tuple[str, str]) -> bool:
    cause, sentence = one
    return cause not in OF_CHILDREN | NO_TROUBLE and (cause not in OF_ALL or sentence.startswith(OF_ITS_OWN))


def _is_told(seen: SeenSystem, path: str, one: tuple[str, str], told: set[str]) -> bool:
    """Whether a sentence stays: what concerns all is told of the root, and children that are asked speak themselves."""
    cause, sentence = one
    if cause in NO_TROUBLE:
        return False
    if cause == "trouble further below":
        return False  # Whoever it names is among those who are asked, or is silent: each stands in the list.
    if cause in OF_CHILDREN:
        names = {child.rpartition("/")[2] for child in told if child.rpartition("/")[0] == path}
        return not any(_names(sentence, name) for name in names)
    return path == seen.root or _is_own(one)


def _names(sentence: str, name: str) -> bool:
    return re.search(rf"(?<![\w/-]){re.escape(name)}(?![\w-])", sentence) is not None


def _trouble(seen: SeenSystem, path: str, said: list[tuple[str, str]]) -> Trouble | None:
    if not said:
        return None
    given = [_advice(seen, path, cause) for cause, _ in said]
    grade = GRADES[min(GRADES.index(one.grade) for one in given)]
    weighty = [one for one in given if one.grade == grade]
    orders = tuple(dict.fromkeys(order for one in weighty for order in one.orders if _is_of_use(seen, path, order)))
    return Trouble(path, grade, tuple(sentence for _, sentence in said), _texts(weighty), orders)


def _texts(given: Iterable[TroubleAdvice]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(one.text for one in given))


def _is_of_use(seen: SeenSystem, path: str, order: str) -> bool:
    """Whether an order can do anything for an actor as it is now."""
    row = seen.rows.get(path)
    if order == "start":
        return row is not None and row.state == "stopped"
    return row is not None or order.startswith("quarantine")


def _advice(seen: SeenSystem, path: str, cause: str) -> TroubleAdvice:
    """What the table says of a cause, or less or more of it, by how the actor is now."""
    row, usual = seen.rows.get(path), ADVICE.get(cause, UNKNOWN)
    is_there = row is not None and row.state not in ("stopped", "silent")
    match cause:
        case "its own faults" if not is_there:
            return NOT_THERE
        case "its own faults" if seen.now - seen.told.get(path, 0.0) >= FRESH:
            return MENDED
        case "quarantine" if path not in seen.quarantined:
            return SETTLED
        case "ended by others" if row is not None and row.state == "stopped":
            return msgspec.structs.replace(usual, grade=ODD)
        case "ended by others" if is_there:
            return SETTLED
        case _:
            return usual


def _silent(row: ActorRow) -> Trouble:
    sentence = f"The process {row.pid} of {row.path} does not answer."
    return Trouble(row.path, ILL, (sentence,), (SILENT.text,), SILENT.orders)


def diagnosed_troubles(found: Sequence[Mapping[str, Any]]) -> list[Trouble]:
    """What diagnosis suspects, and which plans of repair wait for a yes.

    Args:
        found: what each diagnoser has answered, as `AskDiagnosis` gives it.
    """
    said: list[Trouble] = []
    for one in found:
        repair = one["repair"]
        if repair and repair["waiting"]:
            case = int(repair["waiting"])
            stories = [story for story in repair["stories"] if story["case"] == case]
            texts = tuple(str(entry["text"]) for story in stories for entry in story["entries"][-3:])
            advice = ("Approve the plan, or deny it: repair waits for one of both.",)
            said.append(
                Trouble(str(repair["repairer"]), ILL, texts, advice, ("repair-approve",), case=case, view="diagnosis")
            )
        elif one["suspects"]:
            now = [str(suspect["now"]).replace("`", "") for suspect in one["suspects"] if suspect["now"]]
            sentences = (f"Diagnosis says: {one['text']}.", *now[:MOST_SUSPECTS])
            said.append(
                Trouble(
                    str(one["diagnoser"]), ODD, sentences, ("See why, and what repair would do.",), view="diagnosis"
                )
            )
    return said


def _leads(one: Trouble, by_path: Mapping[str, Trouble]) -> tuple[str, ...]:
    """The other troubles that its sentences name, but for those below it."""
    said = " ".join(one.sentences)
    return tuple(
        path
        for path, other in by_path.items()
        if path != one.address
        and other.grade != NEWS_ONLY
        and not path.startswith(f"{one.address}/")
        and re.search(rf"(?<![\w/]){re.escape(path)}(?![\w/-])", said)
    )
