"""The change model (F, A, R): which mechanisms are right, cheapest first, or none with the reasons (A15, T46)."""

import itertools
import math
from typing import Any, ClassVar

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

import holdfast as hf
from holdfast.ftm.model.application import Application
from holdfast.ftm.model.change_model import (
    Choice,
    FaultClasses,
    Resources,
    check,
    choice_of,
    label,
    nesting_problems,
    recovery_price,
    response_price,
    select,
)
from holdfast.ftm.model.coverage import coverage, selection_table, selection_text
from holdfast.ftm.model.mechanism_declaration import FAULTS, LAYERS, BadDeclaration, Cost, Entry, MechanismDeclaration
from tests.ftm.declarations import AD, EIGHT, LFR, NVP, PBR, RB, SEC, TMR, TR

GOOD = Application("Account")
PLENTY = Resources(units=6, certificates=True)


def best(*faults: str, application: Application = GOOD, resources: Resources = PLENTY, **options: Any) -> str:
    chosen = select(FaultClasses.of(*faults), application, resources, EIGHT, **options).best
    return "none" if chosen is None else str(chosen)


# -- selection: F, then A, then R -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("faults", "chosen"),
    [
        ((), "unprotected"),
        (("crash",), "pbr"),
        (("transient_value",), "tr"),
        (("crash", "transient_value"), "pbr+tr"),
        (("crash", "permanent_value"), "tmr"),
        (("eavesdropping", "crash"), "sec+pbr"),
        (("replay", "crash", "transient_value"), "sec+pbr+tr"),
    ],
)
def test_the_fault_model_decides_first(faults: tuple[str, ...], chosen: str) -> None:
    assert best(*faults) == chosen


def test_an_application_without_state_access_leads_from_pbr_to_lfr() -> None:
    """A22."""
    assert best("crash") == "pbr"
    assert best("crash", application=Application("Account", has_state_access=False)) == "lfr"


def test_an_application_without_determinism_stays_with_pbr() -> None:
    """A28."""
    random = Application("Account", is_deterministic=False)
    assert best("crash", application=random, price=recovery_price) == "pbr"  # though LFR would be back sooner
    two = Resources(units=2)
    assert best("crash", price=recovery_price, resources=two) == "lfr"


def test_a_drop_in_bandwidth_leads_from_pbr_to_lfr_and_back() -> None:
    """A21, A22."""
    app = Application("Account", state_bytes=100_000, request_bytes=100, rate=100)
    assert best("crash", application=app, resources=Resources(units=2, bandwidth=20e6)) == "pbr"
    assert best("crash", application=app, resources=Resources(units=2, bandwidth=1e6)) == "lfr"
    assert best("crash", application=app, resources=Resources(units=2, bandwidth=5e3)) == "none"


def test_deltas_need_less_bandwidth_than_states() -> None:
    app = Application("Account", state_bytes=1_000_000, delta_bytes=100, has_delta=True, request_bytes=100, rate=100)
    narrow = Resources(units=2, bandwidth=1e6)
    assert best("crash", application=app, resources=narrow) == "pbr"
    assert best("crash", application=msgspec.structs.replace(app, has_delta=False), resources=narrow) == "lfr"


def test_one_unit_is_not_enough_for_a_crash_but_for_a_transient_fault() -> None:
    assert best("crash", resources=Resources(units=1)) == "none"
    assert best("transient_value", resources=Resources(units=1)) == "tr"
    assert best("crash", "transient_value", resources=Resources(units=2)) == "pbr+tr"


def test_a_busy_unit_has_no_time_to_compute_twice() -> None:
    app = Application("Account", rate=100, turn_seconds=0.004)
    assert best("transient_value", application=app, resources=Resources(units=1)) == "tr"
    assert best("transient_value", application=app, resources=Resources(units=1, cpu=0.5)) == "none"
    assert best("transient_value", application=app, resources=Resources(units=3, cpu=0.5)) == "tmr"


def test_assertions_bring_permanent_faults_to_two_units() -> None:
    """A23, A32: determinism and state are those of the duplex below."""
    sure = Application("Account", assertions=1)
    two = Resources(units=2)
    assert best("crash", "permanent_value", application=sure, resources=two) == "a&d+pbr"
    closed = msgspec.structs.replace(sure, has_state_access=False)
    assert best("crash", "permanent_value", application=closed, resources=two) == "a&d+lfr"
    neither = msgspec.structs.replace(closed, is_deterministic=False)
    assert best("crash", "permanent_value", application=neither, resources=two) == "none"


def test_development_faults_need_versions() -> None:
    """A33."""
    assert best("development") == "none"
    versions = Application("Account", versions=3, assertions=1)
    assert best("development", application=versions, resources=Resources(units=1)) == "rb"
    wrong = ("development", "permanent_value")
    assert best(*wrong, application=versions, resources=Resources(units=3)) == "a&d+pbr+rb"  # two units suffice
    unsure = msgspec.structs.replace(versions, assertions=0)
    assert best(*wrong, application=unsure, resources=Resources(units=3)) == "nvp"


def test_a_low_battery_refuses_what_says_so() -> None:
    class Hungry(LFR):
        name = "hungry"
        least_energy = 0.3

    app = Application("Account", has_state_access=False)
    full = select(FaultClasses.of("crash"), app, Resources(units=2, energy=0.9), (Hungry,))
    low = select(FaultClasses.of("crash"), app, Resources(units=2, energy=0.1), (Hungry,))
    assert str(full.best) == "hungry"
    assert low.best is None
    assert "needs 30% of the battery, 10% is left" in low.explain()


def test_what_is_cheap_can_be_said() -> None:
    """A19."""
    assert best("crash", "transient_value") == "pbr+tr"
    assert best("crash", "transient_value", price=response_price) == "tmr"  # nothing is computed twice in a row
    assert best("crash", price=recovery_price) == "tmr"  # masked: no time without service at all
    assert best("crash", price=lambda cost, units, sent, load: -cost.states) == "pbr"


def test_choices_come_cheapest_first_and_none_has_a_layer_too_many() -> None:
    chosen = select(FaultClasses.of("crash"), GOOD, PLENTY, EIGHT)
    assert [str(one) for one in chosen.valid] == ["pbr", "lfr", "tmr"]
    assert [one.price for one in chosen.valid] == sorted(one.price for one in chosen.valid)


# -- none -----------------------------------------------------------------------------------------------------------


def test_when_nothing_is_valid_the_reasons_are_the_answer() -> None:
    closed = Application("Account", has_state_access=False, is_deterministic=False, why_no_state="it is a socket")
    selection = select(FaultClasses.of("crash"), closed, Resources(units=2), EIGHT)
    assert selection.best is None
    reasons = {refusal.layers: refusal for refusal in selection.refused}
    assert reasons["pbr",].stage == "A"
    assert reasons["pbr",].why == "pbr needs state access: it is a socket"
    assert reasons["lfr",].why == "lfr needs determinism: Account says deterministic = False"
    assert reasons["tr",].why == "does not tolerate crash"
    assert reasons["tr",].stage == "F"
    assert "nothing is valid" in selection.explain()


def test_what_could_still_be_covered_is_told_and_not_taken() -> None:
    selection = select(FaultClasses.of("crash", "transient_value"), GOOD, Resources(units=1), EIGHT)
    assert selection.best is None
    assert [(str(one), sorted(one.uncovered)) for one in selection.degraded] == [
        ("tr", ["crash"]),
        ("unprotected", ["crash", "transient_value"]),
    ]
    assert "degraded: tr, without crash" in selection.explain()
    assert select(FaultClasses.of("crash"), GOOD, PLENTY, EIGHT).degraded == ()


def test_without_mechanisms_only_no_fault_can_be_tolerated() -> None:
    assert select(FaultClasses(), GOOD, PLENTY, ()).best is not None
    assert select(FaultClasses.of("crash"), GOOD, PLENTY, ()).best is None


def test_check_tells_all_reasons_in_the_order_in_which_they_count() -> None:
    closed = Application("Account", is_deterministic=False)
    reasons = check((TR, PBR), FaultClasses.of("crash", "development"), closed, Resources(units=1))
    assert [reason.stage for reason in reasons] == ["nesting", "F", "A", "R"]
    assert check((PBR, TR), FaultClasses.of("crash"), GOOD, Resources(units=2)) == ()
    assert "certification authority" in str(check((SEC,), FaultClasses(), GOOD, Resources())[0])


fault_sets = st.frozensets(st.sampled_from(FAULTS))
applications = st.builds(
    Application,
    name=st.just("it"),
    is_deterministic=st.booleans(),
    has_state_access=st.booleans(),
    assertions=st.integers(0, 1),
    versions=st.integers(1, 3),
    state_bytes=st.integers(0, 10**6),
    request_bytes=st.integers(0, 10**3),
    rate=st.floats(0, 1000),
    turn_seconds=st.floats(0, 0.01),
)
resource_sets = st.builds(
    Resources,
    units=st.integers(1, 6),
    bandwidth=st.floats(0, 1e9),
    cpu=st.floats(0, 1),
    certificates=st.booleans(),
)


@given(fault_sets, applications, resource_sets)
def test_what_is_valid_is_right_and_what_is_not_has_a_reason(
    classes: frozenset[str], application: Application, resources: Resources
) -> None:
    faults = FaultClasses(classes)
    selection = select(faults, application, resources, EIGHT)
    by_name = {kind.name: kind for kind in EIGHT}
    for choice in selection.valid:
        layers = [by_name[name] for name in choice.layers]
        assert check(layers, faults, application, resources) == ()
        assert classes <= frozenset[str]().union(*(kind.tolerates for kind in layers))
        assert choice.units <= resources.units
    for refusal in selection.refused:
        assert refusal.why
        assert check([by_name[name] for name in refusal.layers], faults, application, resources)
    assert all(choice.uncovered for choice in selection.degraded)
    assert not (selection.valid and selection.degraded)


@given(fault_sets, applications, resource_sets, fault_sets)
def test_more_faults_never_make_it_cheaper(
    classes: frozenset[str], application: Application, resources: Resources, more: frozenset[str]
) -> None:
    few = select(FaultClasses(classes), application, resources, EIGHT).best
    many = select(FaultClasses(classes | more), application, resources, EIGHT).best
    assert many is None or (few is not None and few.price <= many.price)


@given(fault_sets, applications, resource_sets, resource_sets)
def test_more_resources_never_make_it_dearer(
    classes: frozenset[str], application: Application, some: Resources, other: Resources
) -> None:
    less = Resources(
        min(some.units, other.units),
        min(some.bandwidth, other.bandwidth),
        min(some.cpu, other.cpu),
        certificates=some.certificates and other.certificates,
    )
    before, after = (select(FaultClasses(classes), application, what, EIGHT).best for what in (less, some))
    assert before is None or (after is not None and after.price <= before.price)


# -- nesting --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layers", [(), (PBR,), (PBR, TR), (LFR, TR), (AD, PBR), (SEC, PBR, TR), (SEC, AD, LFR, RB)])
def test_these_are_nested_rightly(layers: tuple[type[MechanismDeclaration], ...]) -> None:
    """A64-A66."""
    assert nesting_problems(layers) == ()


@pytest.mark.parametrize(
    ("layers", "why"),
    [
        ((PBR, SEC), "sec must be outermost: outside of it, pbr would see ciphered data"),
        ((AD, SEC, PBR), "sec must be outermost: outside of it, a&d would see ciphered data"),
        ((TR, PBR), "tr must stand inside pbr"),
        ((PBR, AD), "a&d must stand outside pbr"),
        ((PBR, LFR), "pbr and lfr are both of replication"),
        ((TR, RB), "tr and rb are both of repetition"),
        ((SEC, SEC), "sec and sec are both of link"),
        ((AD,), "a&d stands over a mechanism of replication, and there is none inside"),
        ((AD, TR), "a&d stands over a mechanism of replication, and there is none inside"),
        ((AD, TMR), "a&d keeps 2 replicas, and tmr 3"),
    ],
)
def test_these_are_not(layers: tuple[type[MechanismDeclaration], ...], why: str) -> None:
    """T42."""
    assert any(why in problem for problem in nesting_problems(layers))


@given(st.lists(st.sampled_from(EIGHT), max_size=4))
def test_an_order_is_right_exactly_when_no_layer_stands_outside_an_outer_one(
    layers: list[type[MechanismDeclaration]],
) -> None:
    ranks = [LAYERS.index(Entry.of(layer).layer) for layer in layers]
    needs_duplex = [at for at, layer in enumerate(layers) if layer is AD]
    is_right = all(a < b for a, b in itertools.pairwise(ranks)) and all(
        any(inner in (PBR, LFR) for inner in layers[at + 1 :]) for at in needs_duplex
    )
    assert (nesting_problems(layers) == ()) == is_right


# -- costs ----------------------------------------------------------------------------------------------------------


def test_computations_multiply_and_what_is_sent_adds_up() -> None:
    app = Application("Account", state_bytes=1000, request_bytes=10, rate=10, turn_seconds=0.01)
    choice = choice_of((LFR, TR), FaultClasses.of("crash"), app)
    assert choice.cost == Cost(runs=2, latency=2, total=4, states=0, requests=1, recovery=0.01)
    assert choice.bytes_per_second == 100
    assert choice.load == pytest.approx(0.2)
    assert (choice.units, choice.bandwidth, choice.layers) == (2, "low", ("lfr", "tr"))
    assert choice_of((PBR,), FaultClasses(), app).bytes_per_second == 10 * (1000 + 10)
    assert choice_of((), FaultClasses.of("crash"), app).uncovered == {"crash"}


def test_layers_share_replicas_but_versions_want_their_own_units() -> None:
    assert choice_of((AD, PBR), FaultClasses(), GOOD).units == 2
    assert choice_of((PBR, NVP), FaultClasses(), GOOD).units == 6
    assert choice_of((), FaultClasses(), GOOD).units == 1


# -- declarations ---------------------------------------------------------------------------------------------------


def test_an_instance_declares_like_its_class() -> None:
    assert Entry.of(PBR()) == Entry.of(PBR)
    assert Entry.of(Entry.of(PBR)) == Entry.of(PBR)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"tolerates": frozenset({"rain"})}, "unknown faults rain"),
        ({"needs": frozenset({"luck"})}, "unknown needs luck"),
        ({"layer": "cellar"}, "unknown layers cellar"),
        ({"bandwidth": "much"}, "unknown levels of bandwidth much"),
        ({"cpu": "much"}, "unknown levels of CPU much"),
    ],
)
def test_a_declaration_of_what_there_is_not_is_refused(changes: dict[str, Any], why: str) -> None:
    kind = type("Wrong", (MechanismDeclaration,), {"name": "wrong", **changes})
    with pytest.raises(BadDeclaration, match=why):
        Entry.of(kind)


def test_faults_that_there_are_not_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown faults rain"):
        FaultClasses.of("rain")
    assert str(FaultClasses.of("replay", "crash") | FaultClasses.of("forgery")) == "crash, forgery, replay"


def test_choices_and_resources_can_be_sent() -> None:
    selection = select(FaultClasses.of("crash"), GOOD, Resources(units=2, bandwidth=1e9), EIGHT)
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(selection), type=type(selection)) == selection
    assert isinstance(selection.best, Choice)
    assert Resources(bandwidth=10, cpu=0.5).scaled(0.5) == Resources(bandwidth=5, cpu=0.25, energy=0.5)


# -- the application, from its class --------------------------------------------------------------------------------


class Plain(hf.Actor):
    def __init__(self) -> None:
        self.balance = 5
        self._scratch = object()


class Noisy(hf.Actor):
    deterministic = False
    schema_version = 3


class Sealed(hf.Actor):
    state_access: ClassVar[bool] = False


class Half(hf.Actor):
    def get_state(self) -> dict[str, int]:
        return {}


class Own(hf.Actor):
    assertions: ClassVar[tuple[str, ...]] = ("is_positive",)
    versions: ClassVar[tuple[str, ...]] = ("fast", "slow")

    def get_state(self) -> bytes:
        return b"x" * 1000

    def set_state(self, state: bytes) -> None: ...

    def get_delta(self) -> bytes:
        return b""

    def apply_delta(self, delta: bytes) -> None: ...


class Socket(hf.Actor):
    def __init__(self) -> None:
        self.socket = object()


def test_an_application_says_what_it_is_by_its_class() -> None:
    """A17."""
    plain = Application.of(Plain)
    assert (plain.is_deterministic, plain.has_state_access, plain.has_delta) == (True, True, False)
    assert Application.of(Noisy).lack("determinism").endswith("Noisy says deterministic = False")
    assert Application.of(Noisy).version == "3"
    assert "state_access = False" in Application.of(Sealed).lack("state_access")
    assert "get_state without its counterpart" in Application.of(Half).lack("state_access")
    own = Application.of(Own, rate=100.0)
    assert (own.assertions, own.versions, own.has_delta, own.rate) == (1, 2, True, 100.0)
    assert (own.lack("assertions"), own.lack("versions")) == ("", "")
    assert plain.lack("assertions")
    assert plain.lack("versions")
    with pytest.raises(ValueError, match="unknown need"):
        plain.lack("luck")


def test_a_sample_shows_whether_the_state_can_be_saved_and_how_large_it_is() -> None:
    assert 0 < Application.of(Plain, sample=Plain()).state_bytes < 100
    assert Application.of(Own, sample=Own()).state_bytes > 1000
    closed = Application.of(Socket, sample=Socket())
    assert not closed.has_state_access
    assert "object cannot be saved" in closed.lack("state_access")
    assert best("crash", application=closed) == "lfr"


def test_known_sizes_go_before_what_the_sample_shows() -> None:
    assert Application.of(Plain, sample=Plain(), state_bytes=7).saved_bytes == 7
    assert Application.of(Own, delta_bytes=3, state_bytes=10).saved_bytes == 3


# -- tables ---------------------------------------------------------------------------------------------------------


def test_the_table_has_all_mechanisms_and_what_they_assume() -> None:
    """A26, A27: Table I, extended."""
    table = coverage(EIGHT)
    rows = {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows()}
    assert list(rows) == ["pbr", "lfr", "tr", "a&d", "sec", "rb", "nvp", "tmr"]
    assert (rows["pbr"]["crash"], rows["pbr"]["state_access"], rows["pbr"]["determinism"]) == ("x", "needed", "")
    assert (rows["lfr"]["crash"], rows["lfr"]["state_access"], rows["lfr"]["determinism"]) == ("x", "", "needed")
    assert [rows[name]["bandwidth"] for name in ("pbr", "lfr", "tr")] == ["high", "low", "nil"]
    assert [rows[name]["units"] for name in ("pbr", "lfr", "tr", "a&d", "tmr")] == ["2", "2", "1", "2", "3"]
    assert [rows[name]["layer"] for name in rows] == [
        "replication", "replication", "repetition", "assertion", "link", "repetition", "repetition", "replication",
    ]  # fmt: skip


def test_the_table_as_text_lines_up() -> None:
    lines = str(coverage(EIGHT)).splitlines()
    assert len(lines) == 10
    assert len({len(line) for line in lines}) == 1
    assert lines[2].startswith("| pbr ")


def test_the_selection_table_says_none_where_nothing_is_valid() -> None:
    situations = selection_table(EIGHT, faults=("crash", "transient_value"))
    chosen = {
        (str(one.faults), one.application.is_deterministic, one.application.has_state_access): one for one in situations
    }
    assert len(chosen) == 12
    assert str(chosen["crash", False, True].best) == "pbr"
    nothing = chosen["crash", False, False]
    assert nothing.best is None
    assert "nothing is valid" in nothing.why
    text = selection_text(situations)
    assert "| crash                  | no            | no           | none" in text
    assert label(()) == "unprotected"


def test_the_built_in_mechanisms_are_the_default() -> None:
    pytest.importorskip("holdfast.ftm.model.mechanism")
    names = [entry.name for entry in coverage().entries]
    assert {"pbr", "lfr", "tr"} <= set(names)
    assert select(FaultClasses.of("crash"), GOOD, Resources(units=2)).best is not None


def test_infinite_bandwidth_is_enough_for_everything() -> None:
    app = Application("Account", is_deterministic=False, state_bytes=10**12, rate=1e6)
    assert best("crash", application=app, resources=Resources(units=2, bandwidth=1e17)) == "none"
    assert best("crash", application=app, resources=Resources(units=2, bandwidth=math.inf)) == "pbr"
