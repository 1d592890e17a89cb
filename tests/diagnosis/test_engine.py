"""Limits, rank, memory between calls, and what the engine does when there is no diagnosis."""

import asyncio
import math
import threading

import pytest

from holdfast.diagnosis.engine import Diagnoser, Diagnosis, State, minimal_diagnoses
from holdfast.diagnosis.engine.cone import Index, RulePart, cone_of
from holdfast.diagnosis.engine.solve import SearchBudget, Solved, solve
from holdfast.diagnosis.literals import BadLiteral, Vocabulary, ok, parse, running
from holdfast.diagnosis.model import History, Model, Put, System, lint
from holdfast.diagnosis.observations import Observation, ObservationSet
from tests.diagnosis.robot import paper_robot


def pairs(count: int) -> tuple[System, list[str]]:
    """So many silent pairs of driver and device: twice as many diagnoses with each."""
    system = System()
    for i in range(count):
        system.hardware(f"h{i}")
        system.driver(f"d{i}", on=[f"h{i}"], out=[f"/{i}"])
    return system, [f"not ok(/{i})" for i in range(count)]


def ladder(count: int) -> tuple[System, list[str]]:
    """Components of which no two neighbours can both work: one part that can neither be divided nor reduced."""
    system = System()
    for i in range(count):
        system.hardware(f"h{i}")
    for i in range(count - 1):
        system.proposition(f"ok({i})")
        system.clause(f"NAB(h{i}), NAB(h{i + 1}) -> ok({i})")
    return system, [f"not ok({i})" for i in range(count - 1)]


def minimal_covers(count: int) -> int:
    """How many minimal diagnoses a ladder has: the minimal vertex covers of a path (Padovan's sequence)."""
    return [1, 2, 2][count - 1] if count <= 3 else minimal_covers(count - 2) + minimal_covers(count - 3)


def test_of_too_many_diagnoses_the_best_are_listed_and_the_rest_counted() -> None:
    """T55, O7: 2^14 diagnoses."""
    system, symptoms = pairs(14)
    said = Diagnoser(system, limit=100, seconds=60.0).diagnose_now(symptoms)
    assert (len(said.candidates), said.found, said.truncated) == (100, 2**14, ("count",))
    assert not said.is_complete
    hardware = [sum(name.startswith("h") for name in one.bad) for one in said.candidates]
    assert hardware == [0] + [1] * 14 + [2] * 85  # as if all had been made, and then sorted
    assert said.certain == ()


def test_all_are_found_below_the_limit() -> None:
    system, symptoms = pairs(6)
    said = Diagnoser(system, seconds=60.0).diagnose_now(symptoms)
    assert said.is_complete
    assert len({one.bad for one in said.candidates}) == said.found == 64


def test_components_that_are_exchangeable_cost_no_search() -> None:
    """O7: a thousand silent nodes in a row, before each of which another could be to blame."""
    system = System()
    system.driver("n0", out=["/0"])
    for i in range(1, 1000):
        system.node(f"n{i}", out={f"/{i}": [f"/{i - 1}"]})
    said = Diagnoser(system, seconds=60.0).diagnose_now(["not ok(/999)", "ok(/9)"])
    assert said.is_complete
    assert [one.bad for one in said.candidates] == [(f"n{i}",) for i in range(10, 1000)]


def test_the_smallest_diagnosis_is_among_those_of_a_part_with_too_many() -> None:
    """T55: of eleven in a row, every second one is the only diagnosis with five."""
    system, symptoms = ladder(11)
    assert minimal_covers(11) == 21
    said = Diagnoser(system, limit=4, seconds=60.0).diagnose_now(symptoms)
    assert said.truncated == ("count",)
    assert len(said.candidates) == 4
    assert said.candidates[0].bad == ("h1", "h3", "h5", "h7", "h9")


def test_a_long_search_finds_all() -> None:
    """It passes what a search without a timer may take."""
    system, symptoms = ladder(34)
    said = Diagnoser(system, limit=100_000, seconds=60.0).diagnose_now(symptoms)
    assert said.is_complete
    assert said.found == minimal_covers(34) > 10_000


def test_the_search_ends_with_its_time() -> None:
    """T55."""
    system, symptoms = ladder(90)
    said = Diagnoser(system, limit=10**9, seconds=0.3).diagnose_now(symptoms)
    assert said.truncated == ("time",)
    assert said.found > 0
    assert said.state is State.FAULTY


def test_without_time_nothing_is_found_and_nothing_is_claimed() -> None:
    system, symptoms = ladder(5)
    said = Diagnoser(system, seconds=1e-9).diagnose_now(symptoms)
    assert (said.state, said.candidates, said.truncated) == (State.FAULTY, (), ("time",))
    assert said.certain == ()


async def test_the_loop_goes_on_while_a_diagnosis_is_made() -> None:
    """T58."""
    system, symptoms = ladder(90)
    work = asyncio.create_task(Diagnoser(system, limit=10**9, seconds=0.3).diagnose(symptoms))
    turns = 0
    while not work.done():
        await asyncio.sleep(0)
        turns += 1
    assert (await work).truncated == ("time",)
    assert turns > 100


async def test_a_cancelled_diagnosis_ends_its_search() -> None:
    system, symptoms = ladder(90)
    engine = Diagnoser(system, limit=10**9, seconds=600.0)
    before = set(threading.enumerate())  # Some of them may end meanwhile.
    async with asyncio.timeout(60):
        work = asyncio.create_task(engine.diagnose(symptoms))
        while set(threading.enumerate()) <= before:
            await asyncio.sleep(0)
        work.cancel()
        with pytest.raises(asyncio.CancelledError):
            await work
        said = await engine.diagnose(["not on(h7)"])  # it waits for no lock
    assert [one.bad for one in said.candidates] == [("h7",)]


def test_what_interrupts_before_a_search_begins_is_not_lost() -> None:
    system, symptoms = ladder(90)
    index = Index(Model(system))
    (part,) = cone_of(index, frozenset(), index.numbers([*map(parse, symptoms_of(symptoms))])).parts
    budget = SearchBudget(600.0)
    budget.cancel()
    (solved,) = solve(part, 10**9, budget)
    assert (solved.sets, solved.by_time) == ([], True)


def symptoms_of(texts: list[str]) -> list[str]:
    """The atoms that do not hold."""
    return [text.removeprefix("not ") for text in texts]


def test_only_parts_that_changed_are_solved_again(monkeypatch: pytest.MonkeyPatch) -> None:
    solved: list[RulePart] = []

    def spy(part: RulePart, limit: int, budget: SearchBudget) -> list[Solved]:
        solved.append(part)
        return solve(part, limit, budget)

    monkeypatch.setattr(minimal_diagnoses, "solve", spy)
    engine = Diagnoser(paper_robot())
    engine.diagnose_now(["not ok(/odom)"])
    engine.diagnose_now(["not ok(/odom)", "running(rviz)"])
    assert len(solved) == 1
    said = engine.diagnose_now(["not ok(/odom)", "not ok(/map)"])
    assert len(solved) == 2
    assert said.found == 6
    said = engine.diagnose_now(["not ok(/odom)", "not ok(/map)", "ok(/scan)"])
    assert said.found == 2  # the map's own fault, which needs no search
    assert len(solved) == 2
    said = engine.diagnose_now(["not ok(/map)", "ok(/odom)"])
    assert said.found == 3
    assert len(solved) == 2


def test_what_was_truncated_is_not_remembered() -> None:
    system, symptoms = ladder(9)
    engine = Diagnoser(system)
    assert engine.diagnose_now(symptoms, seconds=1e-9).truncated
    assert engine.diagnose_now(symptoms, seconds=60.0).found == minimal_covers(9)


def test_another_version_of_the_model_counts_at_once() -> None:
    """D31."""
    system = System()
    system.node("a", out=["/a"])
    history = History(system)
    engine = Diagnoser(history.model)
    assert engine.diagnose_now(["not ok(/a)"]).found == 1
    lamp = System()
    lamp.hardware("lamp")
    lamp.driver("a", on=["lamp"], out=["/a"])
    engine.use(history.change([Put(component) for component in lamp.declaration().components]))
    said = engine.diagnose_now(["not ok(/a)"])
    assert {one.bad for one in said.candidates} == {("a",), ("lamp",)}
    assert said.version == 2


def test_the_likelier_fault_comes_first_among_equals_and_probabilities_add_up() -> None:
    """T54."""
    system = System()
    system.hardware("cable", prior=0.2)
    system.driver("driver", on=["cable"], out=["/x"], prior=0.001)
    said = Diagnoser(system).diagnose_now(["not ok(/x)"])
    assert [one.bad for one in said.candidates] == [("cable",), ("driver",)]
    odds = 0.2 / 0.8 / (0.001 / 0.999)
    assert said.candidates[0].probability == pytest.approx(odds / (1 + odds))
    assert math.fsum(one.probability for one in said.candidates) == pytest.approx(1.0)
    again = Diagnoser(system).diagnose_now(["not ok(/x)"], repaired=["cable"])
    assert [one.bad for one in again.candidates] == [("driver",), ("cable",)]


def test_fewer_faults_come_before_likelier_ones() -> None:
    declared = System()
    declared.hardware("supply", prior=1e-6)
    for i in range(2):
        declared.driver(f"d{i}", on=["supply"], out=[f"/{i}"], prior=0.4)
    said = Diagnoser(declared).diagnose_now(["not ok(/0)", "not ok(/1)"])
    assert [one.bad for one in said.candidates] == [("supply",), ("d0", "d1")]


def test_sources_that_contradict_each_other_cost_only_what_they_contradict_each_other_on() -> None:
    """O5, T49."""
    seen = ObservationSet(Vocabulary(Model(paper_robot()).vocabulary))
    seen.add(Observation(running("hm"), 1.0, "node"))
    seen.add(Observation(~running("hm"), 1.5, "process"))
    seen.add(Observation(~ok("/odom"), 1.5, "rate"))
    said = Diagnoser(paper_robot()).diagnose_now(seen.current(2.0))
    assert [one.bad for one in said.candidates] == [("jn",), ("ja",)]
    assert said.state is State.FAULTY
    assert running("hm") not in {symptom.atom for symptom in said.symptoms}
    assert "node says running(hm)" in str(said.contradictions[0])


def test_observations_that_the_model_excludes_are_reported_with_their_sources() -> None:
    """T49: no component could be faulty in a way that makes this possible."""
    system = System()
    system.node("a")
    system.proposition("ok(x)", "ok(y)", "ok(z)")
    system.clause("ok(x) -> ok(y)")
    model = Model(system)
    seen = ObservationSet(model.vocabulary)
    for literal in (ok("x"), ~ok("y"), ok("z")):
        seen.add(Observation(literal, 1.0, f"from {literal.args[0]}"))
    said = Diagnoser(model).diagnose_now(seen.current(1.0))
    assert said.state is State.CONTRADICTORY
    (torn,) = said.contradictions
    assert set(torn.literals) == {ok("x"), ~ok("y")}
    assert {one.source for one in torn.observations} == {"from x", "from y"}


def test_who_sees_nothing_diagnoses_nothing() -> None:
    """T50."""
    said = Diagnoser(paper_robot()).diagnose_now([])
    assert (said.state, said.candidates) == (State.BLIND, ())
    assert not said.is_complete


def test_names_the_model_does_not_know_are_refused() -> None:
    """T53."""
    with pytest.raises(BadLiteral, match="did you mean"):
        Diagnoser(paper_robot()).diagnose_now(["not ok(/odm)"])


async def test_names_the_model_does_not_know_are_refused_across_the_thread() -> None:
    with pytest.raises(BadLiteral):
        await Diagnoser(paper_robot()).diagnose([ok("/odm")])


@pytest.mark.parametrize(("limit", "seconds"), [(0, 1.0), (1, 0.0), (1, float("nan"))])
def test_limits_that_allow_nothing_are_refused(limit: int, seconds: float) -> None:
    with pytest.raises(ValueError, match="greater than 0"):
        Diagnoser(paper_robot(), limit=limit, seconds=seconds)


def test_nobody_is_blamed_by_a_guess_where_sources_contradict_each_other_on_a_suspect() -> None:
    said = Diagnoser(paper_robot()).diagnose_now(["on(ja)", "not on(ja)", "not ok(/odom)", "not running(hm)"])
    assert [one.bad for one in said.candidates] == [("hm",)]
    assert said.truncated == ("contested",)
    said = Diagnoser(paper_robot()).diagnose_now(["on(ja)", "not on(ja)", "not ok(/odom)"])
    assert (said.state, said.candidates) == (State.CONTRADICTORY, ())


def test_what_is_certain_is_known_though_another_part_runs_out_of_time() -> None:
    system, symptoms = ladder(5)
    system.node("dead")
    said = Diagnoser(system, seconds=1e-9).diagnose_now([*symptoms, "not running(dead)"])
    assert said.truncated == ("time",)
    assert [one.bad for one in said.candidates] == [("dead",)]
    assert said.certain == said.convicted == ("dead",)


def test_ten_thousand_components_with_fifty_faults_name_what_is_certain_at_once() -> None:
    system = System()
    for number in range(10_000):
        system.node(f"n{number}", out={f"/t{number}": [f"/t{number - 1}"] if number % 100 else []})
    engine = Diagnoser(system)
    faulty = range(0, 10_000, 200)
    seen = [f"not running(n{number})" for number in faulty] + [f"not ok(/t{number + 50})" for number in faulty]
    said = engine.diagnose_now(seen, seconds=0.05)
    assert set(said.certain) == {f"n{number}" for number in faulty}


def test_an_explanation_ends_with_its_time_and_says_how_much_is_left() -> None:
    system, symptoms = ladder(5)
    engine = Diagnoser(system)
    assert engine.explain(symptoms).left_out == 0
    why = engine.explain(symptoms, seconds=-1.0)
    assert why.left_out > 0
    assert f"{why.left_out} more symptoms were not explained in time" in str(why)


def test_a_component_of_whose_work_nothing_is_seen_is_unknown() -> None:
    """Healthy is a claim that needs evidence."""
    system = System()
    system.node("feed", out=["/prices"])
    system.node("watcher")
    said = Diagnoser(system).diagnose_now(["running(feed)", "running(watcher)"])
    assert (said.state, said.unknown) == (State.HEALTHY, ("feed",))
    assert str(said) == "healthy, as far as is known: 1 unknown (feed never seen)"
    many = Diagnosis(State.HEALTHY, unknown=tuple("abcdefg"))
    assert str(many).endswith(
        "7 unknown (a never seen, b never seen, c never seen, d never seen, e never seen, and 2 more)"
    )
    assert Diagnoser(system).diagnose_now(["ok(/prices)", "running(watcher)"]).unknown == ()


def test_clingo_writes_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    system, symptoms = ladder(12)
    Diagnoser(system, seconds=0.01).diagnose_now(symptoms)
    assert capfd.readouterr() == ("", "")


def test_literals_are_taken_as_text_wherever_they_are_taken() -> None:
    shop = System()
    shop.node("ledger", out=["/bookings"])
    shop.expect(ok("disk"), of=["ledger"], given=[ok("/bookings")])
    engine = Diagnoser(shop)
    found = engine.diagnose_now(["not ok(disk)"])
    assert found.suspects == ("ledger",)
    assert engine.unseen(["ok(/bookings)"]) == (ok("disk"),)
    assert engine.unseen(["not ok(/bookings)"]) == ()
    engine.next_observations(["not ok(disk)"], found, can_be_seen=["ok(/bookings)"], costs={"ok(/bookings)": 2.0})
    assert lint(Model(shop), ["ok(disk)"]) == lint(Model(shop), [ok("disk")])
    with pytest.raises(BadLiteral, match="did you mean"):
        lint(Model(shop), ["ok(disc)"])
