"""The causes that `why` knows, each from evidence alone: it is a pure function."""

from typing import Any

import pytest

import holdfast as hf
from holdfast.system.history.evidence import Allowance, Evidence, Outstanding, PutAside
from holdfast.system.history.why import RULES, why

AT = "/app/shop/till"
NOW = 1_000.0
TRACE = '  File "/srv/shop.py", line 41, in pay\n    1 // 0\nZeroDivisionError: by zero'


def life(number: int, ended: float | None = None, reason: str = "", kind: str = "", **more: Any) -> hf.system.PastLife:
    return hf.system.PastLife(number, started=float(number), ended=ended, reason=reason, reason_kind=kind, **more)


def told(kind: str, address: str = AT, at: float = 990.0, number: int = 1, **fields: Any) -> hf.system.PastEvent:
    return hf.system.PastEvent(number, at, kind, address, fields)


def status(state: str = "running", **more: Any) -> hf.system.Status:
    known: dict[str, Any] = {"parent": "/app/shop", "life": 2, "queued": 0, "turn": None, "turn_seconds": 0.0, "pid": 7}
    return hf.system.Status(AT, "shop.Till", state, links=0, monitors=0, **{**known, **more})


def evidence(known: dict[str, Any]) -> Evidence:
    rest = {name: value for name, value in known.items() if name != "now"}
    return Evidence(AT, known.get("now", NOW), **rest)


CRASHES = [
    life(n, 990.0 + n, "ZeroDivisionError: by zero", "Crash", traceback=TRACE, restarts=n, allowed=3) for n in (1, 2, 3)
]

CASES: dict[str, tuple[dict[str, Any], str]] = {
    "nobody": ({}, f"Nobody lives at {AT}, and the history knows of no life there."),
    "all is well": (
        {"is_there": True, "lives": [life(1)], "status": status()},
        f"{AT} is running, in life 2, and nothing is wrong as far as is known.",
    ),
    "no word": (
        {"is_there": True, "lives": [life(1)]},
        f"{AT} does not say how it is, and the history knows of nothing that is wrong.",
    ),
    "gone": ({"lives": [life(1)]}, f"Nobody lives at {AT} any more, and how its last life ended is not known."),
    "crash loop": (
        {"lives": [*CRASHES, life(4)], "allowance": Allowance(3, 5.0, 3)},
        (
            f"{AT} restarted 3 times in the last 9 s; ZeroDivisionError: by zero at shop.py:41; "
            "its supervisor allows 3 in 5 s and gives up at the next."
        ),
    ),
    "crash loop long ago": (
        {"now": 9_000.0, "lives": CRASHES},
        f"{AT} restarted 3 times within 2 s, the last time at 1970-01-01",
    ),
    "one crash": (
        {"lives": [life(1, 998.0, "KeyError: 7", "Crash", handling="shop.Pay", restarts=1), life(2)]},
        f"{AT} ended 2.0 s ago handling shop.Pay, and was restarted: KeyError: 7.",
    ),
    "different faults": (
        {"lives": [CRASHES[0], life(2, 995.0, "SIGSEGV", "Signal", handling="shop.Pay", pid=5)]},
        (
            f"{AT} ended 2 times and was restarted 1 times in the last 9 s; handling shop.Pay; "
            "its process was ended by SIGSEGV (the last time)."
        ),
    ),
    "killed": (
        {"lives": [life(1, 998.0, "SIGKILL", "Signal", pid=5)]},
        (
            f"{AT} ended 2.0 s ago: its process was ended by SIGKILL, which nobody can catch: the kernel, an "
            "administrator or a program sent it."
        ),
    ),
    "no memory": (
        {"lives": [life(1, 998.0, "out of memory: 2 GB", "OutOfMemory", pid=5)]},
        f"{AT} ended 2.0 s ago: its process was out of memory: 2 GB.",
    ),
    "hung": (
        {"lives": [life(1, 998.0, "hung for 2 s", "Hung", pid=5)]},
        f"{AT} ended 2.0 s ago: its process hung for 2 s: a loop without await, a blocking call or a lock.",
    ),
    "killed by the program": (
        {"lives": [life(1, 998.0, "killed", "Killed")]},
        f"{AT} ended 2.0 s ago: it was killed, by `ref.kill()` or by a time limit.",
    ),
    "breach": (
        {"lives": [life(1, 998.0, "breach of trust: it lies", "TrustBreach")]},
        f"{AT} ended 2.0 s ago: its process was ended for a breach of trust: it lies.",
    ),
    "start fails": (
        {
            "lives": [
                hf.system.PastLife(n, ended=900.0 + n, reason="no file", reason_kind="StartFailed") for n in (98, 99)
            ]
        },
        f"{AT} could not be started 2 times, the last time 1.0 s ago: no file.",
    ),
    "sibling": (
        {"lives": [life(1, 999.0, "shutdown", "Shutdown", by="/app/shop", because="/app/shop/b has ended"), life(2)]},
        f"{AT} was ended by /app/shop 1.0 s ago: /app/shop/b has ended.",
    ),
    "link": (
        {"lives": [life(1, 999.0, "KeyError: 7", "Crash", by="/app/b", because="it is linked to it"), life(2)]},
        f"{AT} was ended by /app/b 1.0 s ago: it is linked to it (KeyError: 7).",
    ),
    "itself": (
        {"lives": [life(1, 999.0, "normal", "Normal", by=AT, because="its work is done")]},
        f"{AT} ended by itself 1.0 s ago: its work is done.",
    ),
    "given up above": (
        {"above": [told("SupervisorGaveUp", "/app/shop", child="b", reason="KeyError: 7", reason_kind="Crash")]},
        (
            "/app/shop gave up 10 s ago, and all below it ended: /app/shop/b had failed too often, "
            "the last time with KeyError: 7."
        ),
    ),
    "auto shutdown above": (
        {"above": [told("AutoShutdown", "/app/shop", child="b", reason="normal", reason_kind="Normal")]},
        "/app/shop ended 10 s ago: its significant child b did (normal).",
    ),
    "gave up itself": (
        {"events": [told("SupervisorGaveUp", child="b", reason="KeyError: 7")]},
        f"{AT} gave up 10 s ago: its child b had failed too often (KeyError: 7).",
    ),
    "root killed": (
        {"lives": [life(1, 990.0, "the process of the root was killed", "RootKilled", by="the program"), life(1)]},
        f"{AT} ended 10 s ago because the process of the root was killed; what it had in hand was cut off.",
    ),
    "quarantine": (
        {"quarantined": [PutAside(AT, "shop.Pay", 3, 990.0)]},
        (
            "The message shop.Pay was put into quarantine 10 s ago: it had ended the process 3 times in a row. "
            "The actor goes on without it; retry or drop it once the cause is mended."
        ),
    ),
    "replay diverges": (
        {"events": [told("RecoveryFailed", reason=f"replay of {AT} diverged at turn 1: the reply differs")]},
        (
            f"{AT} cannot be recovered, for its turns do not go as they went before: replay of {AT} diverged at "
            "turn 1: the reply differs."
        ),
    ),
    "recovery fails": (
        {"events": [told("RecoveryFailed", reason="the class is another one")]},
        f"{AT} could not be recovered 10 s ago: the class is another one.",
    ),
    "recovered since": (
        {
            "events": [told("RecoveryFailed", reason="no"), told("Recovered", number=2)],
            "is_there": True,
            "lives": [life(1)],
        },
        f"{AT} does not say how it is, and the history knows of nothing that is wrong.",
    ),
    "suspended": (
        {"status": status("suspended", queued=7)},
        f"{AT} is suspended: it handles nothing, and 7 messages wait, until `resume`.",
    ),
    "restarting": (
        {"status": status("restarting")},
        f"{AT} has no life at the moment: it waits for its next start, or is being recovered.",
    ),
    "waits": (
        {
            "status": status(turn="shop.Pay", turn_seconds=12.0),
            "asks": [Outstanding("/app/bank", "bank.Book", 11.0), Outstanding("/app/b", "b.C", 1.0)],
        },
        (
            f"{AT} has been in the turn of shop.Pay for 12 s: it waits for /app/bank to answer bank.Book, "
            "asked 11 s ago, and 1 more asks."
        ),
    ),
    "waits for something else": (
        {"status": status(turn="shop.Pay", turn_seconds=1.5)},
        f"{AT} has been in the turn of shop.Pay for 1.5 s; it waits for something that is no ask of this process.",
    ),
    "mailbox grows": (
        {"status": status(queued=150), "queued_before": 100},
        "150 messages wait in its mailbox, and they become more.",
    ),
    "mailbox shrinks": (
        {"status": status(queued=150), "queued_before": 200},
        "150 messages wait in its mailbox, and they become fewer.",
    ),
    "replica lost": (
        {"events": [told("ReplicaJoined"), told("ReplicaLost", number=2, replica="b", why="SIGKILL")]},
        "Replica b was lost 10 s ago and is not back: SIGKILL.",
    ),
    "failed over": (
        {"events": [told("FailedOver", replica="b", why="SIGKILL")]},
        "Replica b took over 10 s ago: SIGKILL.",
    ),
    "not protected": (
        {"events": [told("ProtectionLost", number=2)]},
        "It is not protected at the moment: no replica may die.",
    ),
    "store blocked": (
        {"store": [told("JournalBlocked", "/app", reason="no room")]},
        "The store stopped taking anything 10 s ago: no room.",
    ),
    "store goes on": (
        {"store": [told("JournalBlocked", "/app", reason="no room"), told("JournalGoesOn", "/app", number=2)]},
        f"Nobody lives at {AT}, and the history knows of no life there.",
    ),
    "store stopped": (
        {"store": [told("JournalStopped", "/app", reason="it fell")]},
        "The store failed 10 s ago, and nothing is accepted: it fell.",
    ),
    "journal full": (
        {"store": [told("JournalFull", way_out="take a snapshot"), told("JournalFull", "/app/other", way_out="no")]},
        "Its journal became full 10 s ago, and it accepts nothing: take a snapshot.",
    ),
    "events left out": ({"suspects_gap": True}, "Events are left out at the moment, because there are too many."),
}


@pytest.mark.parametrize("name", CASES)
def test_each_cause_has_its_sentence(name: str) -> None:
    known, sentence = CASES[name]
    said = why(evidence(known))
    assert len(said) == 1
    assert said[0] == sentence or (sentence.endswith("1970-01-01") and said[0].startswith(sentence))


def test_each_rule_is_met() -> None:
    met: set[str] = set()
    for known, _ in CASES.values():
        met |= {name for name, rule in RULES.items() if rule(evidence(known))}
    assert met == set(RULES)


def test_several_causes_are_told_together() -> None:
    said = why(
        Evidence(
            AT,
            NOW,
            lives=[*CRASHES, life(4)],
            quarantined=[PutAside(AT, "shop.Pay", 3, 990.0)],
            store=[told("JournalBlocked", "/app", reason="no room")],
        )
    )
    assert [sentence.split()[0] for sentence in said] == [AT, "The", "The"]


def test_an_error_of_any_length_is_quoted_in_part() -> None:
    [said] = why(Evidence(AT, NOW, lives=[life(1, 998.0, "KeyError: " + "x" * 100_000, "Crash")]))
    assert len(said) < 500
