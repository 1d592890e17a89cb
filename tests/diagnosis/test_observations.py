"""What counts as known: the newest word of each source, until its time to live is over."""

import msgspec
import pytest

from holdfast.diagnosis.literals import BadLiteral, Literal, Vocabulary, const, dec, inc, ok, running
from holdfast.diagnosis.observations import Observation, ObservationSet, Observed

ODOM, HM, RISES, FALLS, STAYS = ok("/odom"), running("hm"), inc("v"), dec("v"), const("v")


@pytest.fixture
def seen() -> ObservationSet:
    return ObservationSet(Vocabulary([ODOM, HM, RISES, FALLS, STAYS]), trust={"guess": 0.1})


def saw(literal: Literal, time: float, source: str = "a", time_to_live: float = 5.0) -> Observation:
    return Observation(literal, time, source, time_to_live)


def test_a_newer_word_takes_the_place_of_the_last(seen: ObservationSet) -> None:
    """D28."""
    assert seen.add(saw(ODOM, 1.0))
    assert seen.add(saw(~ODOM, 2.0))
    assert seen.current(2.0).negative == {ODOM}
    assert seen.add(saw(ODOM, 3.0))
    assert seen.current(3.0).positive == {ODOM}
    assert not seen.current(3.0).negative


def test_an_older_word_that_comes_late_is_left_out(seen: ObservationSet) -> None:
    seen.add(saw(ODOM, 2.0))
    assert not seen.add(saw(~ODOM, 1.0))
    assert seen.current(2.0).positive == {ODOM}


def test_the_same_word_again_changes_nothing_but_its_age(seen: ObservationSet) -> None:
    assert seen.add(saw(ODOM, 0.0))
    assert not seen.add(saw(ODOM, 4.0))
    assert seen.current(8.0).positive == {ODOM}
    assert seen.add(saw(ODOM, 20.0))  # it had been forgotten


def test_what_is_not_renewed_becomes_unknown_and_not_false(seen: ObservationSet) -> None:
    """T50."""
    seen.add(saw(ODOM, 0.0, time_to_live=5.0))
    seen.add(saw(HM, 1.0, time_to_live=9.0))
    assert seen.next_expiry() == 5.0
    assert seen.current(5.0).positive == {ODOM, HM}
    later = seen.current(5.1)
    assert later.positive == {HM}
    assert not later.negative
    assert seen.expire(5.1) == (saw(ODOM, 0.0, time_to_live=5.0),)
    assert seen.next_expiry() == 10.0


def test_without_any_current_word_the_set_is_blind(seen: ObservationSet) -> None:
    """T50."""
    assert seen.current(0.0).is_blind
    seen.add(saw(ODOM, 0.0))
    assert not seen.current(1.0).is_blind
    assert seen.current(6.0).is_blind


def test_sources_that_differ_are_reported_and_neither_is_believed(seen: ObservationSet) -> None:
    """T49, O5."""
    seen.add(saw(HM, 1.0, "node"))
    seen.add(saw(~HM, 2.0, "process"))
    now = seen.current(2.0)
    (torn,) = now.contradictions
    assert torn.observations == (saw(HM, 1.0, "node"), saw(~HM, 2.0, "process"))
    assert str(torn) == "node says running(hm) (at 1 s), but process says not running(hm) (at 2 s)"
    assert not now.positive | now.negative
    assert not now.is_blind


def test_a_contradiction_ends_with_the_life_of_one_side(seen: ObservationSet) -> None:
    seen.add(saw(HM, 1.0, "node"))
    seen.add(saw(~HM, 6.0, "process"))
    assert not seen.current(6.1).contradictions
    assert seen.current(6.1).negative == {HM}


def test_of_equals_the_older_word_is_dropped(seen: ObservationSet) -> None:
    """T49."""
    seen.add(saw(HM, 1.0, "node"))
    seen.add(saw(~HM, 2.0, "process"))
    (torn,) = seen.current(2.0).contradictions
    assert seen.settle(torn) == (saw(HM, 1.0, "node"),)
    assert seen.current(2.0).negative == {HM}
    assert seen.settle(torn) == ()


def test_the_source_with_less_trust_is_dropped_though_it_spoke_last(seen: ObservationSet) -> None:
    """T49."""
    seen.add(saw(HM, 1.0, "node"))
    seen.add(saw(~HM, 2.0, "guess"))
    (torn,) = seen.current(2.0).contradictions
    assert seen.settle(torn) == (saw(~HM, 2.0, "guess"),)
    assert seen.current(2.0).positive == {HM}


def test_a_source_that_has_spoken_again_meanwhile_is_not_dropped(seen: ObservationSet) -> None:
    seen.add(saw(HM, 1.0, "node"))
    seen.add(saw(~HM, 2.0, "process"))
    (torn,) = seen.current(2.0).contradictions
    seen.add(saw(~HM, 3.0, "node"))
    assert seen.settle(torn) == ()
    assert seen.current(3.0).negative == {HM}


def test_a_trend_takes_the_place_of_the_last_one(seen: ObservationSet) -> None:
    """D22: a value does not rise and fall at once."""
    seen.add(saw(RISES, 1.0))
    seen.add(saw(FALLS, 2.0))
    assert seen.current(2.0).positive == {FALLS}
    seen.add(saw(~STAYS, 2.5))
    assert seen.current(2.5).positive == {FALLS}


def test_two_sources_with_different_trends_contradict_each_other(seen: ObservationSet) -> None:
    seen.add(saw(RISES, 1.0, "a"))
    seen.add(saw(STAYS, 2.0, "b"))
    now = seen.current(2.0)
    (torn,) = now.contradictions
    assert set(torn.literals) == {RISES, STAYS}
    assert not now.positive
    assert seen.settle(torn) == (saw(RISES, 1.0, "a"),)
    assert seen.current(2.0).positive == {STAYS}


def test_a_source_that_has_ended_is_forgotten(seen: ObservationSet) -> None:
    seen.add(saw(ODOM, 1.0, "a"))
    seen.add(saw(HM, 1.0, "b"))
    seen.forget("a")
    assert seen.current(1.0).positive == {HM}


def test_unknown_names_and_times_that_do_not_count_are_refused(seen: ObservationSet) -> None:
    """T53."""
    with pytest.raises(BadLiteral):
        seen.add(saw(ok("/odm"), 1.0))
    for observation in (
        saw(ODOM, float("nan")),
        saw(ODOM, 1.0, time_to_live=-1.0),
        saw(ODOM, 1.0, time_to_live=float("nan")),
    ):
        with pytest.raises(ValueError, match="time"):
            seen.add(observation)
    assert seen.current(1.0).is_blind


def test_bare_literals_with_both_signs_are_a_contradiction() -> None:
    now = Observed.of([HM, ~HM, ODOM])
    assert now.positive == {ODOM}
    assert [torn.literals for torn in now.contradictions] == [(~HM, HM)]


def test_an_observation_crosses_a_wire() -> None:
    sent = saw(~ODOM, 1.5)
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(sent), type=Observation) == sent


def test_who_alone_contradicts_several_others_is_set_aside_also_where_nobody_contradicts_it(
    seen: ObservationSet,
) -> None:
    seen.add(saw(HM, 1.0, "node"))
    seen.add(saw(ODOM, 1.0, "rate"))
    seen.add(saw(~HM, 1.0, "liar"))
    seen.add(saw(~ODOM, 1.0, "liar"))
    seen.add(saw(RISES, 1.0, "liar"))
    now = seen.current(1.0)
    assert now.set_aside == ("liar",)
    assert now.positive == {HM, ODOM}
    assert not now.negative
    assert not now.contradictions
    seen.add(saw(HM, 2.0, "liar"))  # It agrees again, but for one: nobody can say who of the two is wrong.
    now = seen.current(2.0)
    assert not now.set_aside
    assert now.positive == {HM, RISES}


def test_of_two_disputes_that_have_nothing_to_do_with_each_other_each_is_settled_by_itself(
    seen: ObservationSet,
) -> None:
    for source in ("a", "b"):
        seen.add(saw(HM, 1.0, source))
    seen.add(saw(~HM, 1.0, "c"))
    seen.add(saw(ODOM, 1.0, "d"))
    seen.add(saw(~ODOM, 1.0, "e"))
    now = seen.current(1.0)
    assert now.set_aside == ("c",)
    assert [torn.literals for torn in now.contradictions] == [(~ODOM, ODOM)]
