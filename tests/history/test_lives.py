"""Past lives are a pure function of past events; which addresses, kinds and numbers a page is about is another."""

import asyncio
import math
from typing import Any

import pytest

import holdfast as hf
from holdfast.system.history.lives import LivesByAddress
from holdfast.system.history.pages import question
from holdfast.system.history.past_event import PastEvent
from holdfast.system.history.paths import matcher
from tests.history.players import Do, Worker, failed, until

AT = "/app/one"


def lives_of(*told: tuple[str, dict[str, Any]]) -> list[hf.system.PastLife]:
    lives = LivesByAddress()
    for number, (kind, fields) in enumerate(told, 1):
        address = "/app" if kind.startswith("System") else AT
        lives.apply(PastEvent(number, float(number), kind, address, fields))
    return lives.at(AT)


SIGKILL = {"reason": "SIGKILL", "reason_kind": "Signal"}


def test_a_crash_is_told_by_several_events_and_is_one_end() -> None:
    reason = {"reason": "KeyError: 7", "reason_kind": "Crash"}
    first, second = lives_of(
        ("ActorStarted", {"life": 1}),
        ("ActorCrashed", {"life": 1, **reason, "traceback": "here", "message": "shop.Buy"}),
        ("ChildTerminated", {**reason, "restarts": 0, "allowed": 3}),
        ("ChildRestarted", {**reason, "attempt": 1, "allowed": 3}),
        ("ActorStarted", {"life": 2}),
    )
    assert (first.started, first.ended, first.reason, first.traceback) == (1.0, 2.0, "KeyError: 7", "here")
    assert (first.handling, first.restarts, first.allowed) == ("shop.Buy", 1, 3)
    assert (second.number, second.is_over) == (2, False)


def test_a_process_is_known_before_its_life_and_dies_for_a_reason() -> None:
    first, second = lives_of(
        ("ProcessStarted", {"pid": 71}),
        ("ActorStarted", {"life": 1}),
        ("ProcessDied", {"pid": 71, **SIGKILL}),
        ("ChildRestarted", {**SIGKILL, "attempt": 1, "allowed": 3}),
        ("ProcessStarted", {"pid": 72}),
        ("ActorStarted", {"life": 2}),
        ("Recovered", {"life": 2, "replayed": 5, "phases": {"restore": 0.5}}),
    )
    assert (first.pid, first.ended, first.reason_kind) == (71, 3.0, "Signal")
    assert (second.pid, second.number, second.replayed, second.phases) == (72, 2, 5, {"restore": 0.5})


def test_the_end_of_an_earlier_process_does_not_end_a_later_life() -> None:
    [only] = lives_of(
        ("ProcessStarted", {"pid": 72}), ("ActorStarted", {"life": 2}), ("ProcessDied", {"pid": 71, **SIGKILL})
    )
    assert not only.is_over


def test_a_message_in_quarantine_is_what_the_dead_had_in_hand() -> None:
    lives = lives_of(
        *[
            one
            for life in (1, 2, 3)
            for one in (("ActorStarted", {"life": life}), ("ProcessDied", {"pid": 70 + life, **SIGKILL}))
        ],
        ("MessageQuarantined", {"message": "shop.Buy", "deliveries": 2}),
    )
    assert [life.handling for life in lives] == ["", "shop.Buy", "shop.Buy"]
    first, second = lives_of(
        ("ActorStarted", {"life": 1}),
        ("ChildTerminated", SIGKILL),
        ("ActorStarted", {"life": 2}),
        ("MessageQuarantined", {"message": "shop.Buy", "deliveries": 2}),
        ("ChildTerminated", SIGKILL),  # of the last replica
    )
    assert (first.handling, second.handling, second.reason_kind) == ("shop.Buy", "shop.Buy", "Signal")


def test_a_start_that_fails_is_a_life_that_did_not_begin() -> None:
    first, second = lives_of(
        ("ActorStarted", {"life": 1}),
        ("ChildRestarted", {"reason": "killed", "reason_kind": "Killed", "attempt": 1, "allowed": 3}),
        ("ChildStartFailed", {"reason": "no file"}),
    )
    assert first.reason_kind == "Killed"
    assert (second.number, second.started, second.reason, second.reason_kind) == (2, None, "no file", "StartFailed")
    [only] = lives_of(("ChildStartFailed", {"reason": "no file"}))
    assert (only.number, only.started, only.reason_kind) == (1, None, "StartFailed")


def test_a_process_that_is_ended_before_its_actor_has_begun_is_no_life() -> None:
    killed = {"reason": "killed", "reason_kind": "Killed"}
    assert lives_of(("ProcessStarted", {"pid": 71}), ("ProcessDied", {"pid": 71, **killed})) == []
    [only] = lives_of(
        ("ProcessStarted", {"pid": 71}),
        ("ProcessDied", {"pid": 71, **killed}),
        ("ChildStartFailed", {"reason": "no class"}),
    )
    assert (only.number, only.reason, only.reason_kind) == (1, "no class", "StartFailed")
    [told] = lives_of(
        ("ProcessStarted", {"pid": 71}), ("ActorKilled", {"by": "/app"}), ("ProcessDied", {"pid": 71, **killed})
    )
    assert (told.by, told.reason_kind) == ("/app", "Killed")


def test_a_life_ends_with_the_one_above_it() -> None:
    lives = LivesByAddress()

    def tell(number: int, kind: str, address: str, **fields: Any) -> None:
        lives.apply(PastEvent(number, float(number), kind, address, fields))

    crash = {"reason": "KeyError: 7", "reason_kind": "Crash"}
    for number, address in enumerate(("/app", "/app/s", "/app/s/t", "/app/s/t/one"), 1):
        tell(number, "ActorStarted", address, life=1)
    assert not lives.at("/app/s/t/one")[0].is_over
    tell(5, "ChildTerminated", "/app/s", **crash, restarts=0, allowed=3)
    [one], [above] = lives.at("/app/s/t/one"), lives.at("/app/s/t")
    assert (one.ended, one.reason, one.by, one.because) == (5.0, "KeyError: 7", "/app/s/t", "its supervisor has ended")
    assert (above.ended, above.by) == (5.0, "/app/s")
    tell(6, "ActorStarted", "/app/s/t/one", life=1)  # Who is above it tells of its start when that is over.
    tell(7, "ActorStarted", "/app/s/t", life=1)
    tell(8, "ActorStarted", "/app/s", life=2)
    assert [[life.is_over for life in lives.at(path)] for path in ("/app/s", "/app/s/t", "/app/s/t/one")] == [
        [True, False]
    ] * 3
    assert not lives.at("/app")[0].is_over


def test_a_life_that_begins_anew_has_ended_with_the_one_above_it() -> None:
    lives = LivesByAddress()
    for number, (kind, address) in enumerate(
        [
            ("ActorStarted", "/app/s"),
            ("ActorStarted", "/app/s/one"),
            ("ChildStopped", "/app/s"),
            ("ActorStarted", "/app/s/one"),
            ("ActorStarted", "/app/s"),
        ]
    ):
        lives.apply(PastEvent(number, float(number), kind, address, {"life": 1, "by": "/app", "because": "order"}))
    first, second = lives.at("/app/s/one")
    assert (first.ended, first.by, second.started, second.is_over) == (2.0, "/app/s", 3.0, False)


def test_who_has_ended_a_life() -> None:
    by = {"reason": "shutdown", "reason_kind": "Shutdown", "by": "/app", "because": "order"}
    [stopped] = lives_of(("ActorStarted", {"life": 1}), ("ChildStopped", {"life": 1, **by}))
    assert (stopped.by, stopped.because, stopped.reason_kind) == ("/app", "order", "Shutdown")
    [linked] = lives_of(
        ("ActorStarted", {"life": 1}),
        ("EndedByLink", {"peer": "/app/two", "reason": "KeyError", "reason_kind": "Crash"}),
        ("ChildTerminated", {"reason": "KeyError", "reason_kind": "Crash", "restarts": 0, "allowed": 3}),
    )
    assert (linked.by, linked.reason_kind) == ("/app/two", "Crash")


def test_a_failover_ends_a_life_and_begins_another() -> None:
    first, second = lives_of(
        ("ActorStarted", {"life": 1}),
        ("ActorStarted", {"life": 1}),  # of the other replica
        ("FailedOver", {"replica": "b", "epoch": 2, "seconds": 0.1, "why": "SIGKILL"}),
    )
    assert (first.by, first.because, first.reason) == ("failover", "b leads now", "SIGKILL")
    assert not second.is_over


@pytest.mark.parametrize(("kind", "ended"), [("SystemStarted", "RootKilled"), ("SystemStopped", "SystemStopped")])
def test_all_lives_end_with_the_root(kind: str, ended: str) -> None:
    first, second = lives_of(
        ("ActorStarted", {"life": 1}), (kind, {"why": "it is over"}), ("ActorStarted", {"life": 1})
    )
    assert (first.reason_kind, first.reason, first.ended) == (ended, "it is over", 2.0)
    assert (second.number, second.is_over) == (1, False)


def test_lives_that_are_given_out_are_copies() -> None:
    lives = LivesByAddress()
    lives.apply(PastEvent(1, 1.0, "ActorStarted", AT, {"life": 1}))
    lives.at(AT)[0].reason = "changed"
    assert lives.at(AT)[0].reason == ""


# -- patterns and questions -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pattern", "path", "is_meant"),
    [
        ("/app/a", "/app/a", True),
        ("/app/a", "/app/a/b", False),
        ("/app/*", "/app/a", True),
        ("/app/*", "/app", False),
        ("/app/**", "/app", True),
        ("/app/**", "/app/a/b/c", True),
        ("/app/**/till", "/app/till", True),
        ("/app/**/till", "/app/a/b/till", True),
        ("/app/**/till", "/app/a/b/till/c", False),
        ("/app/**/a/**/b", "/app/x/a/y/z/b", True),
        ("**", "/app/a", True),
        ("/app/w-?", "/app/w-1", True),
        ("/app/w-[12]", "/app/w-3", False),
        ("/app/$1", "/app/$1", True),
    ],
)
def test_a_pattern(pattern: str, path: str, is_meant: bool) -> None:
    assert matcher(pattern)(path) is is_meant


def test_a_pattern_of_a_hostile_form_takes_no_time() -> None:
    assert not matcher("/" + "**/" * 300 + "b")("/" + "a/" * 300 + "a")
    assert not matcher("/" + "*a" * 400)("/" + "a" * 5_000 + "b")


@pytest.mark.parametrize(
    "wrong",
    [
        {"path": 7},
        {"path": "x" * 1_001},
        {"kinds": "ActorCrashed"},
        {"kinds": [7]},
        {"limit": 0},
        {"limit": 1_001},
        {"limit": True},
        {"after": "1"},
        {"since": math.nan},
        {"until": "now"},
    ],
)
def test_a_question_that_cannot_be_asked(wrong: dict[str, Any]) -> None:
    with pytest.raises(hf.SpecError, match="history"):
        question(**wrong)


async def test_pages_go_on_where_the_one_before_ended() -> None:
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        worker = await system.start(hf.child("worker", hf.start(Worker)))
        for _ in range(5):
            await failed(worker, "crash")
        await worker.ask(Do("well"))
        whole = system.history(worker).events
        read: list[hf.system.PastEvent] = []
        after = 0
        while (page := system.history(worker, after=after, limit=3)).events:
            assert len(page.events) <= 3
            read += page.events
            after = page.next
        assert read == whole
        assert system.history(worker, limit=3).events == whole[-3:]
        middle = whole[4]
        assert system.history(worker, until=middle.at).events[-1].number >= middle.number
        assert {one.kind for one in system.history(kinds=["ActorCrashed"]).events} == {"ActorCrashed"}
        assert system.history("/app/nobody").events == []


async def test_following_waits_until_there_is_more() -> None:
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        worker = await system.start(hf.child("worker", hf.start(Worker)))
        page = system.history(worker)
        assert (await system.follow_history(worker, after=page.next, timeout=0.05)).events == []
        following = asyncio.create_task(system.follow_history(worker, after=page.next, kinds=["ActorCrashed"]))
        await asyncio.sleep(0)
        await failed(worker, "crash")
        assert [one.kind for one in (await following).events] == ["ActorCrashed"]
        assert system._history is not None
        await until(lambda: not system._history.followers)  # type: ignore[union-attr]  # it is there, see above


async def test_a_system_without_a_history_says_so() -> None:
    async with hf.ActorSystem("app", log=False, history=False) as system:
        for ask in (system.history, lambda: system.lives("/app")):
            with pytest.raises(hf.SpecError, match="history=False"):
                ask()
        with pytest.raises(hf.SpecError, match="history=False"):
            await system.why("/app")
