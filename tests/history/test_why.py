"""The causes that `why` knows, each from evidence alone: it is a pure function."""

from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.group.protected import ProtectionStatus
from holdfast.supervision.supervisor import IN_VAIN
from holdfast.system.history.evidence import (
    Allowance,
    Below,
    ChildNow,
    Evidence,
    Outstanding,
    OwnProcess,
    ProcessMemory,
    PutAside,
    Silence,
    Waiting,
)
from holdfast.system.history.why import RULES, causes, why

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

PastLife = hf.system.PastLife
ROOT_KILLED = life(1, 990.0, "the process of the root was killed", "RootKilled", by="the program")

SHORTLY = str(hf.errors.ReplayDiverged(f"{AT}/a", 1, 2, what="effect luck")).partition("; ")[0]
WENT_ASTRAY = f"{hf.errors.ReplayDiverged(f'{AT}/a', 1, 2, what='effect luck')}; {IN_VAIN}"

NO_WORD = f"The process of {AT} (pid 7) has not answered within 5.0 s"

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
    "its process is stopped": (
        {
            "is_there": True,
            "lives": [life(1)],
            "process": OwnProcess(silence=Silence(7, 5.0, is_stopped=True)),
        },
        f"The process of {AT} (pid 7) is stopped, as by SIGSTOP: SIGCONT lets it go on.",
    ),
    "its process is silent": (
        {
            "is_there": True,
            "lives": [life(1)],
            "process": OwnProcess(silence=Silence(7, 5.0, is_stopped=False)),
        },
        f"{NO_WORD}: its event loop does not run, or the machine is very busy.",
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
            f"{AT} ended 2 times and was restarted 1 times in the last 9 s; the last time handling shop.Pay; "
            "its process was ended by SIGSEGV (the last time)."
        ),
    ),
    "what was in hand once is not blamed for later ends": (
        {
            "lives": [
                *(life(n, 990.0 + n, "hung for 1 s", "Hung", handling="shop.Pay", restarts=n, pid=n) for n in (1, 2)),
                life(3, 998.0, "out of memory: 2 GB", "OutOfMemory", restarts=3, pid=3),
                life(4),
            ]
        },
        (
            f"{AT} restarted 3 times in the last 9 s; 2 times handling shop.Pay, but not the last time; "
            "its process was out of memory: 2 GB (the last time)."
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
        f"{AT} ended 2.0 s ago: it was killed, by a time limit or over a link.",
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
    "ended by `auto_shutdown`": (
        {
            "lives": [life(1, 990.1, "shutdown", "Shutdown", by=AT, because="it has ended with shutdown")],
            "events": [told("AutoShutdown", child="b", reason="normal")],
        },
        f"{AT} ended 10 s ago, by its `auto_shutdown`: its child b ended (normal).",
    ),
    "gave up, and runs again": (
        {
            "is_there": True,
            "lives": [life(1, 990.1, "shutdown: x", "Shutdown", by=AT, because="x"), PastLife(2, started=995.0)],
            "events": [told("SupervisorGaveUp", child="b", reason="KeyError: 7")],
        },
        f"{AT} gave up 10 s ago, and was started again 5.0 s ago: its child b had failed too often (KeyError: 7).",
    ),
    "root killed": (
        {"lives": [ROOT_KILLED]},
        f"{AT} ended 10 s ago because the process of the root was killed; what it had in hand was cut off.",
    ),
    "root killed, and it runs again": (
        {"is_there": True, "lives": [ROOT_KILLED, PastLife(1, started=998.0)]},
        (
            f"{AT} runs; it was started 2.0 s ago, for its life before had ended 10 s ago because the process of "
            "the root was killed."
        ),
    ),
    "root killed, and the root itself runs again": (
        {"is_there": True, "lives": [ROOT_KILLED], "events": [told("SystemStarted", at=997.0)]},
        (
            f"{AT} runs; it was started 3.0 s ago, for its life before had ended 10 s ago because the process of "
            "the root was killed."
        ),
    ),
    "root killed long ago": (
        {"now": 9_000.0, "is_there": True, "lives": [ROOT_KILLED, PastLife(1, started=998.0)], "status": status()},
        f"{AT} is running, in life 2, and nothing is wrong as far as is known.",
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
        f"{AT} is suspended: it handles nothing, and 7 messages wait for `resume`.",
    ),
    "suspended, by whom is known": (
        {
            "status": status("suspended", queued=1),
            "lives": [life(1)],
            "events": [
                told("ActorSuspended", at=900.0, number=1, by="the program"),
                told("ActorResumed", at=950.0, number=2, by="the program"),
                told("ActorSuspended", at=990.0, number=3, by="an operator"),
                told("ActorSuspended", at=995.0, number=4, by="/app/desk"),
            ],
        },
        f"{AT} was suspended 10 s ago by an operator: it handles nothing, and 1 message waits for `resume`.",
    ),
    "suspended in another life, and again": (
        {
            "status": status("suspended"),
            "lives": [PastLife(2, started=995.0)],
            "events": [told("ActorSuspended", at=990.0, by="an operator")],
        },
        f"{AT} is suspended: it handles nothing, and what comes waits for `resume`.",
    ),
    "its start waits": (
        {"awaited": "/app/desk"},
        f"{AT} is to start as soon as somebody lives at /app/desk: its spec binds it to that.",
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
    "rests as it has said": (
        {"status": status(turn="shop.Pay", turn_seconds=1.5, turn_rests="has slept for 1.5 s")},
        f"{AT} has been in the turn of shop.Pay for 1.5 s; it has slept for 1.5 s.",
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
        {"events": [told("FailedOver", replica="b", epoch=2, why="SIGKILL")]},
        "Replica b took over 10 s ago, in epoch 2: SIGKILL.",
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
    "a child restarted": (
        {
            "below": Below(
                events=[
                    told("ChildRestarted", f"{AT}/a", 985.0, reason="KeyError: 7", allowed=3),
                    told("ChildRestarted", f"{AT}/b", 990.0, reason="SIGKILL", allowed=3),
                    told("ChildRestarted", f"{AT}/a", 995.0, reason="KeyError: 8", allowed=3),
                    told("ChildRestarted", f"{AT}/old", 100.0, reason="long ago", allowed=3),
                ]
            ),
            "own_allowance": Allowance(3, 5.0, 3),
        },
        (
            "Within the last 15 s it restarted a 2 times (KeyError: 8), b once (SIGKILL); it allows 3 in 5 s, "
            "and gives up at the next."
        ),
    ),
    "a child that does not come up again": (
        {
            "below": Below(
                events=[
                    told("ChildRestarted", f"{AT}/b", 990.0, reason="SIGKILL", allowed=3),
                    *(
                        told(kind, f"{AT}/a", at, reason=WENT_ASTRAY, allowed=3)
                        for at in (970.0, 985.0)
                        for kind in ("ChildRestarted", "ChildStartFailed")
                    ),
                ],
                now=[ChildNow("b", "running")],
            ),
        },
        (
            f"Within the last 30 s it restarted b once (SIGKILL), and could not start a 2 times ({SHORTLY}); "
            "it allows 3 within its period."
        ),
    ),
    "restarts of a child that is up again": (
        {
            "is_there": True,
            "status": status(),
            "below": Below(
                events=[
                    told("ChildRestarted", f"{AT}/a", at, reason="KeyError: 7", allowed=3) for at in (942.0, 950.0)
                ],
                now=[ChildNow("a", "running")],
            ),
        },
        "Within the last 58 s it restarted a 2 times (KeyError: 7); that is over.",
    ),
    "restarts of one further below that is up again": (
        {
            "deeper": Below(
                [told("ChildRestarted", f"{AT}/a/b", at, reason="KeyError: 7") for at in (942.0, 950.0)],
            ),
            "is_there": True,
            "status": status(),
        },
        f"Below it, {AT}/a/b was restarted 2 times within the last 58 s (KeyError: 7); that is over.",
    ),
    "one further below that does not come up": (
        {
            "deeper": Below(
                events=[
                    *(
                        told(kind, f"{AT}/a/b", at, reason=WENT_ASTRAY)
                        for at in (960.0, 970.0)
                        for kind in ("ChildRestarted", "ChildStartFailed")
                    ),
                    told("ChildRestarted", f"{AT}/a/b", 990.0, reason=WENT_ASTRAY),
                ],
                ended={f"{AT}/a/b": life(1, 970.0, WENT_ASTRAY, "StartFailed")},
            ),
        },
        f"Below it, {AT}/a/b could not be started 2 times within the last 40 s ({SHORTLY}): ask why of {AT}/a/b.",
    ),
    "a long reason": (
        {"below": Below(ended={f"{AT}/a": life(1, 998.0, "because " * 100, "StartFailed")})},
        f"Its child a could not be started 2.0 s ago: {'because ' * 37}[...].",
    ),
    "a child restarted, and the supervisor is silent": (
        {"below": Below(events=[told("ChildRestarted", f"{AT}/a", reason="KeyError: 7", allowed=3)])},
        "Within the last 10 s it restarted a once (KeyError: 7); it allows 3 within its period.",
    ),
    "a child that has ended": (
        {
            "below": Below(
                ended={
                    f"{AT}/a": life(
                        1, 998.0, "shutdown", "Shutdown", by="an operator", because="it was stopped by order"
                    )
                }
            )
        },
        "Its child a ended 2.0 s ago and is not there: shutdown, by an operator (it was stopped by order).",
    ),
    "a child that could not be started": (
        {"below": Below(ended={f"{AT}/a": life(1, 998.0, "no file", "StartFailed")})},
        "Its child a could not be started 2.0 s ago: no file.",
    ),
    "a child that is stopped": (
        {"below": Below(now=[ChildNow("a", "stopping", "shop.Pay", 12.0, "shop.py:41, await answer")])},
        "Its child a is being stopped: it has been in the turn of shop.Pay for 12 s at shop.py:41, await answer.",
    ),
    "a child that starts": (
        {"below": Below(now=[ChildNow("a", "starting", awaited="/app/b"), ChildNow("c", "running")])},
        "Its child a is starting, and waits for /app/b to be there.",
    ),
    "a child in trouble": (
        {"below": Below(events=[told("ReplicaLost", f"{AT}/a"), told("ReplicaLost", f"{AT}/a", 100.0)])},
        f"Of its child a, a replica was lost 10 s ago: ask why of {AT}/a.",
    ),
    "a child that was killed": (
        {
            "below": Below(
                events=[
                    told("StopOverdue", f"{AT}/a", seconds=5.0, stacks=f"{AT}/a (ending) has been in the turn of Pay:")
                ]
            )
        },
        (
            "Its child a had not ended within 5.0 s when it was told to, and was killed 10 s ago: "
            f"{AT}/a (ending) has been in the turn of Pay."
        ),
    ),
    "a child that waits": (
        {"below": Below(now=[ChildNow("a", "running", "shop.Pay", 3.0), ChildNow("b", "running", "shop.Pay", 0.5)])},
        "Its child a does not get on: it has been in the turn of shop.Pay for 3.0 s.",
    ),
    "trouble further below": (
        {
            "deeper": Below(
                events=[
                    told("ChildRestarted", f"{AT}/a/b", 960.0, reason="KeyError: 7"),
                    told("ChildRestarted", f"{AT}/a/b", 980.0, reason="KeyError: 8"),
                ]
            ),
        },
        f"Below it, {AT}/a/b was restarted 2 times within the last 40 s (KeyError: 8): ask why of {AT}/a/b.",
    ),
    "a child that rests": (
        {
            "is_there": True,
            "status": status(),
            "below": Below(
                now=[ChildNow("a", "running", "shop.Pay", 3.0, waited=2.0, queued=1, rests="has slept for 3.0 s")]
            ),
        },
        "Its child a is in the turn of shop.Pay: it has slept for 3.0 s.",
    ),
    "a child that is suspended": ({"below": Below(now=[ChildNow("a", "suspended")])}, "Its child a is suspended."),
    "little memory is left": (
        {"process": OwnProcess(ProcessMemory(250_000_000, 300_000_000))},
        (
            "Its process has 250 MB of memory, and is ended at 300 MB: if that goes on growing, look at what its "
            "state holds (`holdfast inspect --state`)."
        ),
    ),
    "much memory is left": (
        {
            "process": OwnProcess(ProcessMemory(100_000_000, 300_000_000)),
            "is_there": True,
            "lives": [life(1)],
            "status": status(),
        },
        f"{AT} is running, in life 2, and nothing is wrong as far as is known.",
    ),
    "what waits": (
        {"status": status(queued=150), "waiting": Waiting("shop.Pay", 140, "/app/till")},
        "150 messages wait in its mailbox; most of them are shop.Pay from /app/till.",
    ),
    "asks that wait for long": (
        {
            "status": status(queued=33),
            "waiting": Waiting("shop.Pay", 30, "/app/till", waited=8.0, late=24, mean_turn=0.25),
        },
        (
            "33 messages wait in its mailbox; most of them are shop.Pay from /app/till; one has waited for 8.0 s or "
            "more; nobody waits for the answers of 24 any more; a turn takes 0.25 s in the mean."
        ),
    ),
    "asks that have just come": (
        {"is_there": True, "status": status(queued=33), "waiting": Waiting("shop.Pay", 33, waited=0.5)},
        f"{AT} is running, in life 2, and nothing is wrong as far as is known.",
    ),
    "a child whose asks wait": (
        {"below": Below(now=[ChildNow("a", "running", queued=1, waited=8.0)])},
        "Its child a does not get on; 1 message waits for it, one for 8.0 s or more.",
    ),
    "where it waits": (
        {"status": status(turn="shop.Pay", turn_seconds=1.5, turn_at="shop.py:41, await answer")},
        (
            f"{AT} has been in the turn of shop.Pay for 1.5 s, at shop.py:41, await answer; it waits for something "
            "that is no ask of this process."
        ),
    ),
    "killed by somebody": (
        {"lives": [life(1, 998.0, "killed", "Killed", by="/app/b", because="it was killed by `ref.kill()`"), life(2)]},
        f"{AT} was ended by /app/b 2.0 s ago: it was killed by `ref.kill()`.",
    ),
    "events left out": ({"suspects_gap": True}, "Events are left out at the moment, because there are too many."),
}


def test_that_somebody_rests_is_told_though_nothing_is_wrong() -> None:
    known, rests = CASES["a child that rests"]
    assert why(evidence(known)) == [f"{AT} is running, in life 2, and nothing is wrong as far as is known.", rests]


@pytest.mark.parametrize("name", CASES)
def test_each_cause_has_its_sentence(name: str) -> None:
    known, sentence = CASES[name]
    said = [one.sentence for one in causes(evidence(known))] or why(evidence(known))
    assert len(said) == 1
    assert said[0] == sentence or (sentence.endswith("1970-01-01") and said[0].startswith(sentence))


def test_each_rule_is_met() -> None:
    met: set[str] = set()
    for known, _ in CASES.values():
        met |= {name for name, rule in RULES.items() if rule(evidence(known))}
    assert met == set(RULES)


LOST = [
    told("ReplicaLost", number=1, replica="a", why="its process has ended (SIGKILL)"),
    told("FailedOver", number=2, replica="b", epoch=2, why="its process has ended (SIGKILL)"),
]
JOINED = told("ReplicaJoined", number=3, at=995.0, replica="a")


def protection(**replicas: str) -> ProtectionStatus:
    is_whole = "joining" not in replicas.values()
    return ProtectionStatus(AT, ("PBR",), replicas, "b", 2, 0, is_whole, 0.0, False, False)


def test_a_replica_that_was_lost_is_told_of_also_when_it_is_back() -> None:
    said = why(Evidence(AT, NOW, events=LOST, protection=protection(a="joining", b="leads")))
    assert said == [
        "Replica a was lost 10 s ago and is not back: its process has ended (SIGKILL).",
        "Replica b took over 10 s ago, in epoch 2: its process has ended (SIGKILL).",
        "It is not whole: a joining, b leads, epoch 2.",
    ]
    said = why(Evidence(AT, NOW, events=[*LOST, JOINED], protection=protection(a="follows", b="leads")))
    assert said[0] == "Replica a was lost 10 s ago: its process has ended (SIGKILL)."
    assert said[2] == "It is whole again, for a came back 5.0 s ago: a follows, b leads, epoch 2."


def test_the_worst_trouble_further_below_is_told_first_and_the_rest_is_counted() -> None:
    deeper = [
        *(told("ChildRestarted", f"{AT}/a/b", 980.0, reason="KeyError: 8") for _ in range(2)),
        told("RecoveryFailed", f"{AT}/a/c/d", reason="no file"),
        told("RecoveryFailed", f"{AT}/a/old", 100.0, reason="no file"),
    ]
    now = [ChildNow(f"{AT}/a/e", "suspended"), ChildNow(f"{AT}/a/f", "running", "shop.Pay", 3.0)]
    ended = {f"{AT}/a/g": life(1, 998.0, "no file", "StartFailed")}
    assert why(Evidence(AT, NOW, deeper=Below(deeper, now, ended))) == [
        f"Below it, {AT}/a/b was restarted 2 times within the last 20 s (KeyError: 8): ask why of {AT}/a/b.",
        f"Below it, {AT}/a/g could not be started, 2.0 s ago (no file): ask why of {AT}/a/g.",
        f"Below it, {AT}/a/c/d has something to tell: a recovery failed 10 s ago: ask why of {AT}/a/c/d.",
        "2 more are in trouble below it.",
    ]


def test_of_many_children_some_are_named() -> None:
    said = why(Evidence(AT, NOW, below=Below(now=[ChildNow(f"c{n}", "suspended") for n in range(9)])))
    assert said == [*(f"Its child c{n} is suspended." for n in range(3)), "The same is true of 6 more."]
    ended = {f"{AT}/c{n}": life(1, 900.0 + n, "killed", "Killed") for n in range(5)}
    assert why(Evidence(AT, NOW, below=Below(ended=ended)))[-1] == "2 more of its children are not there."
    below = [told("ChildRestarted", f"{AT}/c{n}", reason="SIGKILL", allowed=9) for n in range(5)]
    assert "c2 once (SIGKILL), 2 others; it allows 9" in why(Evidence(AT, NOW, below=Below(below)))[0]


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
