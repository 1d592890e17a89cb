"""What needs attention: whom to ask, what is left out, what comes first, and what is advised."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from holdfast.console.dashboard.orders import VERBS
from holdfast.console.dashboard.troubles import (
    ADVICE,
    FRESH,
    MOST,
    NEWS,
    NOT_THERE,
    OF_CHILDREN,
    TELLING,
    SeenSystem,
    diagnosed_troubles,
    seen_causes,
    suspects,
    troubles,
)
from holdfast.console.overview import ActorRow
from holdfast.events import __all__ as KINDS
from holdfast.system.history.why import AT_REST, NO_TROUBLE, REST_BELOW, RULES

NOW = 1_000_000.0


def row(path: str, **fields: Any) -> ActorRow:
    """A row of an actor that is well, but for these fields."""
    well = ActorRow(path, "m.C", "running", "task", 7, 0, 0, "", 0.0, "", (), (), "permanent", False)
    return msgspec.structs.replace(well, **fields)


def seen(
    *rows: ActorRow,
    memory: dict[int, int] | None = None,
    quarantined: frozenset[str] = frozenset(),
    told: dict[str, float] | None = None,
) -> SeenSystem:
    """What is known of a system with a root and these actors."""
    known = {one.path: one for one in (row("/app"), *rows)}
    return SeenSystem(NOW, "/app", known, memory or {}, quarantined, told or {})


def test_there_is_advice_for_each_cause_and_for_no_other() -> None:
    assert ADVICE.keys() == RULES.keys() - NO_TROUBLE
    assert ADVICE.keys() >= OF_CHILDREN
    assert set(TELLING) <= set(KINDS)
    orders = {order for one in [*ADVICE.values(), NOT_THERE] for order in one.orders}
    assert orders <= {*VERBS, "state"}


@pytest.mark.parametrize(
    "odd",
    [
        row("/app/x", state="suspended"),
        row("/app/x", state="silent"),
        row("/app/x", turn="m.Pay", turn_seconds=NOW - 1.5),
        row("/app/x", queued=100),
        row("/app/x", allowed_bytes=100, pid=9),
    ],
)
def test_who_looks_ill_is_asked(odd: ActorRow) -> None:
    well = [row("/app/y", turn="m.Pay", turn_seconds=NOW - 0.5), row("/app/z", queued=99, allowed_bytes=100)]
    assert suspects(seen(odd, *well, memory={9: 61, 7: 59})) == ["/app", "/app/x"]


def test_who_has_told_of_something_is_asked_for_a_while() -> None:
    told = {"/app/new": NOW - 1.0, "/app/old": NOW - NEWS - 1.0, "/app/gone": NOW - 100.0}
    assert suspects(seen(row("/app/new"), row("/app/old"), told=told)) == ["/app", "/app/new", "/app/gone"]
    assert suspects(seen(quarantined=frozenset({"/app/q"}))) == ["/app", "/app/q"]


def test_of_very_many_those_who_look_worst_are_asked() -> None:
    crowd = [row(f"/app/{number}", state="suspended") for number in range(2 * MOST)]
    asked = suspects(seen(*crowd, row("/app/worst", state="silent")))
    assert (len(asked), asked[:2]) == (MOST, ["/app", "/app/worst"])


def test_who_is_well_is_left_out() -> None:
    assert troubles(seen(row("/app/x")), {"/app": [], "/app/x": []}) == []


def test_who_rests_as_it_has_said_is_left_out() -> None:
    resting = row("/app/x", turn="m.Go", turn_seconds=NOW - 3600.0, rests=True)
    assert suspects(seen(resting)) == ["/app"]
    assert seen_causes(seen(resting), "/app/x") == []
    answers = {"/app": [(REST_BELOW, "Its child x has slept for 1 s.")], "/app/x": [(AT_REST, "/app/x has slept.")]}
    assert troubles(seen(resting), answers) == []


def test_who_waits_for_another_one_leads_there() -> None:
    answers = {
        "/app": [],
        "/app/till": [("its turn waits", "/app/till has been in a turn: it waits for /app/bank to answer m.Book.")],
        "/app/bank": [("its turn waits", "/app/bank has been in the turn of m.Book; it waits for something.")],
        "/app/bank-2": [("suspended", "/app/bank-2 is suspended.")],
    }
    bank, till, other = troubles(seen(row("/app/till"), row("/app/bank"), row("/app/bank-2")), answers)
    assert [one.address for one in (bank, till, other)] == ["/app/bank", "/app/till", "/app/bank-2"]
    assert (bank.leads, till.leads, other.leads) == ((), ("/app/bank",), ())
    assert (bank.orders, other.orders) == (("kill",), ("resume",))


def test_what_children_say_themselves_is_not_said_of_them() -> None:
    answers = {
        "/app": [
            ("restarts of children", "Within the last 4 s it restarted till 3 times (SIGSEGV); it allows 3 in 5 s."),
            ("children that wait", "Its child other is suspended."),
            ("children that wait", "Its child till does not get on."),
            (
                "trouble further below",
                "Below it, /app/shop/till was restarted once (SIGSEGV): ask why of /app/shop/till.",
            ),
        ],
        "/app/till": [("its own faults", "/app/till restarted 3 times.")],
    }
    found = troubles(seen(row("/app/till"), row("/app/other"), told={"/app/till": NOW}), answers)
    assert {one.address: one.sentences for one in found} == {
        "/app": ("Its child other is suspended.",),
        "/app/till": ("/app/till restarted 3 times.",),
    }


def test_what_concerns_all_is_said_once() -> None:
    store = ("store", "The store stopped taking anything 2.5 s ago: full.")
    own = ("store", "Its journal became full 2.5 s ago, and it accepts nothing: make room.")
    found = troubles(seen(row("/app/x")), {"/app": [store], "/app/x": [store, own]})
    assert [(one.address, one.sentences) for one in found] == [("/app", (store[1],)), ("/app/x", (own[1],))]


FAULT = ("its own faults", "/app/x ended 3 s ago: RuntimeError.")


@pytest.mark.parametrize(
    ("rows", "at", "grade", "orders"),
    [
        ([row("/app/x")], NOW - FRESH + 1, "odd", ()),
        ([row("/app/x")], NOW - FRESH, "news", ()),
        ([row("/app/x", state="stopped")], NOW - FRESH, "ill", ("start",)),
        ([], NOW - FRESH, "ill", ()),
    ],
)
def test_a_fault_is_graver_if_nobody_goes_on(
    rows: list[ActorRow], at: float, grade: str, orders: tuple[str, ...]
) -> None:
    [one] = troubles(seen(*rows, told={"/app/x": at}), {"/app/x": [FAULT]})
    assert (one.grade, one.orders) == (grade, orders)


def test_a_message_in_quarantine_can_be_settled_until_it_is() -> None:
    put = {"/app/x": [("quarantine", "The message m.Pay was put into quarantine.")]}
    [there] = troubles(seen(row("/app/x"), quarantined=frozenset({"/app/x"})), put)
    assert (there.grade, there.orders) == ("ill", ("quarantine-retry", "quarantine-drop"))
    [settled] = troubles(seen(row("/app/x")), put)
    assert (settled.grade, settled.orders) == ("news", ())


def test_who_was_stopped_by_order_can_be_started() -> None:
    ended = {"/app/x": [("ended by others", "/app/x was ended by an operator: it was stopped by order.")]}
    [stopped] = troubles(seen(row("/app/x", state="stopped")), ended)
    assert (stopped.grade, stopped.orders) == ("odd", ("start",))
    [lives] = troubles(seen(row("/app/x")), ended)
    assert (lives.grade, lives.orders) == ("news", ())


def test_a_cause_that_only_a_newer_system_knows_is_told() -> None:
    [one] = troubles(seen(row("/app/x")), {"/app/x": [("the moon", "/app/x is moonstruck.")]})
    assert (one.grade, one.sentences, one.advice) == ("odd", ("/app/x is moonstruck.",), ("Look closer.",))


def test_a_process_that_says_nothing_is_told() -> None:
    [one] = troubles(seen(row("/app/x", state="silent", pid=9)), {"/app/x": []})
    assert (one.grade, one.sentences, one.orders) == ("ill", ("The process 9 of /app/x does not answer.",), ("kill",))


def test_without_a_history_the_row_says_what_it_can() -> None:
    rows = [
        row("/app/a", state="suspended", queued=3),
        row("/app/b", turn="m.Pay", turn_seconds=NOW - 12.0),
        row("/app/c", state="stopped"),
        row("/app/d", state="restarting"),
        row("/app/e", queued=200),
        row("/app/f"),
    ]
    found = {one.path: seen_causes(seen(*rows), one.path) for one in rows}
    assert [cause for said in found.values() for cause, _ in said] == [
        "suspended",
        "its turn waits",
        "ended by others",
        "restarting",
        "mailbox",
    ]
    assert found["/app/b"][0][1] == "/app/b has been in the turn of m.Pay for 12 s."


def test_a_plan_that_waits_comes_before_what_is_suspected() -> None:
    suspect = {"component": "till", "address": "/app/till", "is_certain": True, "now": "`/app/till` is suspended"}
    story = {"case": 3, "entries": [{"text": f"sentence {number}"} for number in range(5)]}
    repair = {"repairer": "/app/diagnosis/repairer", "waiting": 3, "stories": [story]}
    said = {"diagnoser": "/app/diagnosis/diagnoser", "text": "faulty: till", "suspects": [suspect], "repair": repair}
    [waits] = diagnosed_troubles([said])
    assert (waits.case, waits.grade, waits.orders, waits.view) == (3, "ill", ("repair-approve",), "diagnosis")
    assert waits.sentences == ("sentence 2", "sentence 3", "sentence 4")
    [suspected] = diagnosed_troubles([{**said, "repair": {**repair, "waiting": 0}}])
    assert suspected.sentences == ("Diagnosis says: faulty: till.", "/app/till is suspended")
    assert diagnosed_troubles([{**said, "suspects": [], "repair": None}]) == []
