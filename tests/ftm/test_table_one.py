"""`select` and `coverage` of the built-in mechanisms, against Table I and its extension (A26-A33)."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.model.application import Application
from holdfast.ftm.model.change_model import FaultClasses, Resources, choice_of, nesting_problems, select
from holdfast.ftm.model.composition import check_stack
from holdfast.ftm.model.coverage import coverage
from holdfast.ftm.model.mechanism import BUILT_IN, MechanismRefused, find
from holdfast.ftm.model.mechanism_declaration import FAULTS
from tests.ftm.accounts import Counter
from tests.ftm.versions import SETTINGS

# Table I as the paper has it (A26, A27), and below it the extension. A&D has the needs and the bandwidth of its duplex;
# this one takes the state of the replica that it asks, so that it needs access to it besides.
TOLERATES = {
    "pbr": {"crash"},
    "lfr": {"crash"},
    "tr": {"transient_value"},
    "ad": {"transient_value", "permanent_value"},  # and crash, by its duplex
    "rb": {"transient_value", "development"},
    "nvp": {"transient_value", "development"},
    "tmr": {"crash", "transient_value", "permanent_value"},
    "sec": {"eavesdropping", "forgery", "replay"},
}
NEEDS = {
    "pbr": {"state_access"},
    "lfr": {"determinism"},
    "tr": {"determinism", "state_access"},
    "ad": {"assertions", "state_access"},
    "rb": {"assertions", "versions", "state_access"},
    "nvp": {"determinism", "versions", "state_access"},
    "tmr": {"determinism", "state_access"},
    "sec": {"certificates"},
}
BANDWIDTH = {"pbr": "high", "lfr": "low", "tr": "nil"}
UNITS = {"pbr": 2, "lfr": 2, "tr": 1, "ad": 2, "rb": 1, "nvp": 1, "tmr": 3, "sec": 1}
SORTS = (("sec",), ("ad",), ("pbr", "lfr", "tmr"), ("tr", "rb", "nvp"))

ALL = Application("It", assertions=1, versions=3)
PLENTY = Resources(units=6, certificates=True)


def test_the_table_says_what_the_paper_says() -> None:
    """A26, A27."""
    table = coverage()
    rows = {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows()}
    assert set(rows) == set(BUILT_IN) == set(TOLERATES)
    for name, row in rows.items():
        assert {fault for fault in FAULTS if row[fault]} == TOLERATES[name], name
        assert {need for need in table.columns if row.get(need) == "needed"} == NEEDS[name], name
        assert row["units"] == str(UNITS[name]), name
    assert {name: rows[name]["bandwidth"] for name in BANDWIDTH} == BANDWIDTH


def stacks() -> list[tuple[str, ...]]:
    """What can stand in each other, outermost first: one of each sort; A&D over PBR or LFR (A32, A40, A66)."""
    chosen = itertools.product(*(("", *sort) for sort in SORTS))
    made = (tuple(name for name in one if name) for one in chosen)
    return [one for one in made if "ad" not in one or not {"pbr", "lfr"}.isdisjoint(one)]


def covered(names: tuple[str, ...]) -> set[str]:
    return set().union(*(TOLERATES[name] for name in names))


def is_needless(names: tuple[str, ...], faults: set[str]) -> bool:
    """Whether it would do without one of them."""
    without = [tuple(other for other in names if other != name) for name in names]
    return any(one in STACKS and faults <= covered(one) for one in without)


STACKS = stacks()
SITUATIONS = [
    (frozenset(faults), frozenset(lacks), units)
    for faults in itertools.chain.from_iterable(
        itertools.combinations(("crash", "transient_value", "permanent_value", "development", "forgery"), count)
        for count in range(1, 3)
    )
    for lacks in ((), ("determinism",), ("state_access",), ("assertions", "versions"), ("determinism", "state_access"))
    for units in (1, 2, 3)
]


def test_what_is_valid_is_what_the_table_says_first_by_faults_then_application_then_resources() -> None:
    """A16, A18, A19, A25: in all situations, against the rule read from the table."""
    assert len(SITUATIONS) == 225
    for faults, lacks, units in SITUATIONS:
        application = Application(
            "It",
            is_deterministic="determinism" not in lacks,
            has_state_access="state_access" not in lacks,
            assertions=0 if "assertions" in lacks else 1,
            versions=1 if "versions" in lacks else 3,
        )
        found = select(FaultClasses(faults), application, Resources(units=units, certificates=True))
        expected = {
            names
            for names in STACKS
            if faults <= covered(names)
            and not lacks & set().union(*(NEEDS[name] for name in names))
            and max((UNITS[name] for name in names), default=1) <= units
            and not is_needless(names, set(faults))
        }
        assert {choice.layers for choice in found.valid} == expected, (faults, lacks, units)
        if not expected:
            assert found.best is None
            assert "nothing is valid" in found.explain()


def test_a_duplex_costs_what_the_paper_says() -> None:
    """A28, A29, A31: PBR sends the state, LFR has both compute, TR takes time."""
    app = Application("It", state_bytes=10_000, request_bytes=100, rate=100, turn_seconds=0.001)
    pbr, lfr, tr = (choice_of((find(name),), FaultClasses(), app) for name in ("pbr", "lfr", "tr"))
    assert pbr.bytes_per_second >= 100 * 10_000 > lfr.bytes_per_second > tr.bytes_per_second == 0
    assert (pbr.cost.total, lfr.cost.total) == (1, 2)
    assert tr.cost.latency >= 2 > pbr.cost.latency
    assert tr.load == pytest.approx(2 * pbr.load)


def test_what_the_duplex_needs_is_what_assertions_over_it_need() -> None:
    """A26, A27, A32."""
    over = {name: choice_of((find("ad"), find(name)), FaultClasses.of("crash"), ALL) for name in ("pbr", "lfr")}
    assert {name: (one.bandwidth, one.units) for name, one in over.items()} == {"pbr": ("high", 2), "lfr": ("low", 2)}
    assert not over["pbr"].uncovered  # the crash is the duplex's
    two = Resources(units=2)
    wanted = FaultClasses.of("crash", "permanent_value")
    assert [one.layers for one in select(wanted, ALL, two).valid] == [("ad", "pbr"), ("ad", "lfr")]
    random = Application("It", is_deterministic=False, assertions=1)
    assert [one.layers for one in select(wanted, random, two).valid] == [("ad", "pbr")]
    unsure = Application("It")
    assert not select(wanted, unsure, two).valid
    alone = select(FaultClasses.of("permanent_value"), ALL, Resources(units=1))
    assert "ad stands over a mechanism of replication" not in alone.explain()
    assert alone.best is None


@pytest.mark.parametrize("name", ["rb", "nvp"])
def test_development_faults_take_blocks_of_the_user(name: str) -> None:
    """A33."""
    faults, units = FaultClasses.of("development"), Resources(units=1)
    assert (name,) in [one.layers for one in select(faults, ALL, units).valid]
    without = select(faults, Application("It", assertions=1), units)
    assert not without.valid
    reasons = {one.layers: one.why for one in without.refused}
    assert f"{name} needs versions" in reasons[name,]


def test_one_unit_is_no_answer_to_a_crash_and_a_duplex_none_to_a_value_fault() -> None:
    """A30: replicas are taken to be self-checking, which TR and A&D make true (A31, A32)."""
    assert not select(FaultClasses.of("crash"), ALL, Resources(units=1)).valid
    crash_only = {one.layers for one in select(FaultClasses.of("crash"), ALL, PLENTY).valid}
    both = {one.layers for one in select(FaultClasses.of("crash", "transient_value"), ALL, PLENTY).valid}
    assert {("pbr",), ("lfr",)} <= crash_only
    assert not {("pbr",), ("lfr",)} & both
    assert {("pbr", "tr"), ("lfr", "tr"), ("ad", "pbr"), ("ad", "lfr"), ("tmr",)} <= both


def test_the_engine_takes_what_the_model_calls_rightly_nested_and_nothing_else() -> None:
    """T42: in any order, of up to three layers."""
    layers = {name: find(name)(**SETTINGS.get(name, {})) for name in BUILT_IN}
    right = 0
    for count in (1, 2, 3):
        for names in itertools.permutations(BUILT_IN, count):
            several = tuple(layers[name] for name in names)
            try:
                check_stack(several, Counter, "/app/alice")
                refused = ""
            except MechanismRefused as error:
                refused = str(error)
            assert (nesting_problems(several) == ()) == (not refused), (names, refused)
            right += not refused
    assert right == len([one for one in STACKS if 1 <= len(one) <= 3])


async def test_a_spec_with_mechanisms_that_do_not_go_together_is_refused() -> None:
    """As a transaction would: it is not started at all."""
    async with hf.ActorSystem("app", log=False) as system:
        for layers, why in (
            ((hf.ftm.TR(), hf.ftm.PBR()), "must stand outside of tr"),
            ((hf.ftm.PBR(), hf.ftm.TMR()), "keeps replicas already"),
            ((layer_of("ad"), hf.ftm.TMR()), "it wants 3 replicas, and ad outside of it 2"),
            ((hf.ftm.PBR(), hf.ftm.TR(), layer_of("nvp")), "both of repetition"),
        ):
            with pytest.raises(hf.HoldfastError, match=why):
                await system.start(hf.child("alice", hf.start(Counter), mechanism=layers))
        assert "/app/alice" not in system.tree()


def layer_of(name: str) -> Any:
    return find(name)(**SETTINGS[name])
