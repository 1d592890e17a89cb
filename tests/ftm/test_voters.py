"""Voters: what runs have in common, and the typed result when it is nothing (T43, T44)."""

import datetime as dt
import decimal
import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import holdfast as hf
from holdfast.actors.kernel.codec import encode_special
from holdfast.checkpoint.protocol import CRASH, OK, REFUSAL, REPLY, Answer, Out, TurnEnd
from holdfast.ftm.votes.canonical import ABSENT, answer_form, canonical, end_form
from holdfast.ftm.votes.voters import (
    Agreed,
    AnyVoter,
    Custom,
    Exact,
    Made,
    Majority,
    Median,
    NoMajority,
    Tolerance,
    Undecided,
    Voter,
    custom,
    decide,
    decide_by,
)

NAN = math.nan
VOTERS: list[Voter] = [Exact(), Majority(), Tolerance(abs=0.5), Median()]


class Colour(enum.Enum):
    RED = 1


class Kind(enum.IntEnum):
    ONE = 1


class Word(str):
    __slots__ = ()


@dataclass
class Pose:
    x: float
    y: float


class Point(msgspec.Struct):
    x: float


def won(decided: object) -> tuple[int, ...]:
    assert isinstance(decided, Agreed), decided
    return decided.agreeing


def lost(decided: object) -> Undecided:
    assert isinstance(decided, Undecided), decided
    return decided


def reply(value: Any) -> Answer:
    return Answer(REPLY, "", msgspec.msgpack.encode(value))


def end(value: Any, *outs: Out, state: int = 0, status: str = OK) -> TurnEnd:
    return TurnEnd(3, 7, status, list(outs), reply(value), state)


# -- canonical forms ------------------------------------------------------------------------------------------------

NOON = dt.datetime(2026, 3, 1, 12, tzinfo=dt.UTC)
SAME = [
    (NAN, float("-nan")),
    (0.0, -0.0),
    (3, 3.0),
    ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
    ({1: "x", 2.0: "y"}, {2: "y", 1.0: "x"}),
    ((1, 2), [1, 2]),
    ({"b", "a"}, {"a", "b"}),
    ([{"t": NAN}], [{"t": NAN}]),
    (NOON, dt.datetime(2026, 3, 1, 14, tzinfo=dt.timezone(dt.timedelta(hours=2)))),
    (dt.timedelta(minutes=1), dt.timedelta(seconds=60)),
    (decimal.Decimal("1.10"), decimal.Decimal("1.1")),
    (b"x", bytearray(b"x")),
    (np.array([[1.0, NAN]]), np.array([[1.0, NAN]])),
    (np.float64(2.0), 2),
    (np.int64(2), 2),
    (np.bool_(True), True),
    (Word("x"), "x"),
    (Pose(1, 2), Pose(1.0, 2.0)),
    (ValueError("x"), ValueError("x")),
]
DIFFERENT = [
    (1, True),
    (0, False),
    (1, "1"),
    ("x", b"x"),
    ({"a": 1}, {"a": 2}),
    ({"a": 1}, {"b": 1}),
    ({"a": None}, {}),
    ([1, 2], [2, 1]),
    ([1], {1}),
    ([[1], 2], [1, [2]]),
    (NAN, 0.0),
    (NAN, None),
    (NOON, NOON.replace(tzinfo=None)),
    (NOON, NOON + dt.timedelta(microseconds=1)),
    (NOON.date(), NOON.isoformat()),
    (Colour.RED, 1),
    (Kind.ONE, 1),
    (Pose(1, 2), Point(1)),
    (np.zeros(4), np.zeros((2, 2))),
    (ValueError("x"), KeyError("x")),
    (2**53, float(2**53) + 2),
]


@pytest.mark.parametrize(("one", "other"), SAME)
def test_what_means_the_same_has_one_form(one: Any, other: Any) -> None:
    assert canonical(one) == canonical(other)
    assert hash(canonical(one)) == hash(canonical(other))


@pytest.mark.parametrize(("one", "other"), DIFFERENT)
def test_what_differs_has_two_forms(one: Any, other: Any) -> None:
    assert canonical(one) != canonical(other)


@pytest.mark.parametrize("value", [["nan"], ["list", 1], ["dict", [1, 2]], ["bool", True], ["instant", 0]])
def test_no_value_looks_like_the_form_of_another(value: list[Any]) -> None:
    for other in (NAN, [1], {1: 2}, True, dt.datetime(1970, 1, 1, tzinfo=dt.UTC)):
        assert canonical(value) != canonical(other)


# -- exact and majority ---------------------------------------------------------------------------------------------


def test_exact_wants_all() -> None:
    assert won(decide(Exact(), [{"x": 1}, {"x": 1.0}])) == (0, 1)
    assert lost(decide(Exact(), [1, 1, 2])).groups == ((0, 1), (2,))
    assert lost(decide(Exact(), [1, ABSENT])).why == "2 ballots in groups of 1, 1 absent, and all must agree"


def test_the_majority_wins_whatever_came_first() -> None:
    decided = decide(Majority(), [9, 4, 4])
    assert decided == Agreed(4, 1, (1, 2), (0,))


@pytest.mark.parametrize(
    "ballots", [[1, 2], [1, 2, 3], [1, 1, 2, 2], [1, 1, 2, 3], [1, ABSENT], [1, 1, ABSENT, ABSENT], [ABSENT] * 3]
)
def test_without_a_majority_there_is_no_answer(ballots: list[Any]) -> None:
    for voter in (Majority(), Tolerance(abs=0.1), Exact()):
        assert isinstance(decide(voter, ballots), Undecided)


def test_none_is_a_value_and_no_absence() -> None:
    assert decide(Majority(), [None, None, 1]) == Agreed(None, 0, (0, 1), (2,))


def test_a_small_need_with_two_groups_is_no_answer() -> None:
    assert won(decide(Majority(need=2), [1, 1, 2, 3])) == (0, 1)
    assert lost(decide(Majority(need=2), [1, 1, 2, 2])).groups == ((0, 1), (2, 3))


@pytest.mark.parametrize("voter", VOTERS)
def test_no_ballots_and_too_many_are_no_answer(voter: Voter) -> None:
    assert isinstance(decide(voter, []), Undecided)
    assert "16 ballots" in lost(decide(voter, [1] * 16)).why


@given(st.lists(st.sampled_from([1, 2, 3, ABSENT]), min_size=1, max_size=7))
def test_a_majority_is_found_exactly_when_there_is_one(ballots: list[Any]) -> None:
    decided = decide(Majority(), ballots)
    strict = [value for value in (1, 2, 3) if ballots.count(value) * 2 > len(ballots)]
    assert strict == ([decided.value] if isinstance(decided, Agreed) else [])


# -- tolerance ------------------------------------------------------------------------------------------------------


def test_floats_may_differ_a_little_wherever_they_stand() -> None:
    ballots = [{"pose": [1.0, 2.0], "n": 3}, {"n": 3, "pose": [1.04, 1.97]}, {"pose": [1.0, 2.5], "n": 3}]
    assert won(decide(Tolerance(abs=0.05), ballots)) == (0, 1)
    assert isinstance(decide(Majority(), ballots), Undecided)


def test_a_relative_tolerance() -> None:
    assert won(decide(Tolerance(rel=0.01), [1000.0, 1009.0])) == (0, 1)
    assert isinstance(decide(Tolerance(rel=0.01), [1000.0, 1011.0]), Undecided)


def test_integers_and_text_have_no_tolerance_unless_told() -> None:
    assert isinstance(decide(Tolerance(abs=5), [100, 101]), Undecided)
    assert isinstance(decide(Tolerance(abs=5), [True, False]), Undecided)
    assert won(decide(Tolerance(abs=5, integers=True), [100, 101])) == (0, 1)
    assert won(decide(Tolerance(abs=5), [100, 101.0])) == (0, 1)


def test_times_have_a_tolerance_of_their_own() -> None:
    later = NOON + dt.timedelta(milliseconds=20)
    assert won(decide(Tolerance(seconds=0.1), [{"at": NOON}, {"at": later}])) == (0, 1)
    assert isinstance(decide(Tolerance(abs=100, seconds=0.01), [NOON, later]), Undecided)
    assert isinstance(decide(Tolerance(seconds=1e9), [NOON, NOON.replace(tzinfo=None)]), Undecided)


def test_nearness_is_not_handed_on() -> None:
    chain = [0.0, 1.0, 2.0]  # each near its neighbour, but not all near each other
    decided = decide(Tolerance(abs=1.0), chain)
    assert isinstance(decided, Agreed)
    assert decided.value == 1.0  # the one that both majorities have
    assert len(decided.agreeing) == 2
    assert isinstance(decide(Tolerance(abs=1.0), [0.0, 1.0, 2.0, 3.0]), Undecided)


def test_what_is_no_number_is_near_itself_only() -> None:
    tolerance = Tolerance(abs=math.pi)
    assert won(decide(tolerance, [NAN, NAN, 0.0])) == (0, 1)
    assert won(decide(tolerance, [math.inf, math.inf, -math.inf])) == (0, 1)
    assert isinstance(decide(tolerance, [math.inf, 1e308, -math.inf]), Undecided)
    assert won(decide(Tolerance(rel=0.1), [10**400, 10**400, 1.0])) == (0, 1)


def test_complex_numbers_and_decimals_have_it() -> None:
    assert won(decide(Tolerance(abs=0.1), [1 + 1j, 1.05 + 1j])) == (0, 1)
    assert won(decide(Tolerance(abs=0.1), [decimal.Decimal("1.0"), 1.05])) == (0, 1)


@pytest.mark.parametrize("wrong", [{"abs": -1}, {"rel": NAN}, {"seconds": math.inf}])
def test_a_tolerance_that_is_none_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="tolerance"):
        Tolerance(**wrong)  # type: ignore[arg-type]


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=6), st.floats(0, 20))
def test_those_that_agree_are_all_near_each_other(ballots: list[float], width: float) -> None:
    decided = decide(Tolerance(abs=width), ballots)
    if isinstance(decided, Agreed):
        assert len(decided.agreeing) * 2 > len(ballots)
        near = [ballots[at] for at in decided.agreeing]
        assert all(math.isclose(a, b, rel_tol=0, abs_tol=width) for a in near for b in near)
        assert decided.value in near


# -- median ---------------------------------------------------------------------------------------------------------


def test_the_median_is_a_ballot_that_was_given() -> None:
    assert decide(Median(), [5.0, 1.0, 900.0]) == Agreed(5.0, 0, (0, 1, 2))


def test_the_median_of_structures_goes_place_by_place() -> None:
    decided = decide(Median(), [{"x": 1, "y": 9}, {"y": 5, "x": 2}, {"x": 3, "y": 1}])
    assert decided == Agreed({"x": 2, "y": 5}, 1, (0, 1, 2))
    made = decide(Median(), [[1, 5, True], [2, 9, True], [3, 1, True]])
    assert made == Agreed([2, 5, True], None, (0, 1, 2))


def test_two_middle_ones_that_differ_are_no_answer() -> None:
    assert isinstance(decide(Median(), [1, 2]), Undecided)
    assert isinstance(decide(Median(), [1, 2, ABSENT]), Undecided)
    assert decide(Median(), [2, 2, ABSENT]) == Agreed(2, 0, (0, 1), (2,))
    assert decide(Median(), [1, 2, 2, 9]) == Agreed(2, 1, (0, 1, 2, 3))


def test_ballots_of_another_shape_are_absent() -> None:
    assert decide(Median(), [1, "broken", 3, 2]) == Agreed(2, 3, (0, 2, 3), (1,))
    assert decide(Median(), [NAN, 2, 2, 1]) == Agreed(2, 1, (1, 2, 3), (0,))
    assert isinstance(decide(Median(), ["a", "a", "a"]), Undecided)
    assert isinstance(decide(Median(), [{1: 5}, {2: 5}, {3: 5}]), Undecided)  # the keys of a dict are no numbers


def test_a_median_with_a_width_needs_a_majority_near_it() -> None:
    assert won(decide(Median(abs=1), [5.0, 5.5, 900.0])) == (0, 1)
    assert isinstance(decide(Median(abs=1), [0.0, 50.0, 900.0]), Undecided)


def test_objects_are_not_made_of_several() -> None:
    poses = [Pose(1, 9), Pose(2, 1), Pose(3, 5)]
    assert "Pose cannot be made of several" in lost(decide(Median(), poses)).why
    assert decide(Median(), [Pose(1, 1), Pose(3, 3), Pose(2, 2)]) == Agreed(Pose(2, 2), 2, (0, 1, 2))


@given(st.lists(st.integers(-5, 5), min_size=3, max_size=3), st.integers(0, 2), st.integers() | st.floats())
def test_one_wrong_value_of_three_never_leaves_the_range_of_the_right_ones(
    right: list[int], at: int, wrong: float
) -> None:
    ballots: list[Any] = [*right[:at], wrong, *right[at + 1 :]]
    rest = [value for index, value in enumerate(right) if index != at]
    decided = decide(Median(), ballots)
    if isinstance(decided, Agreed):
        assert min(rest) <= decided.value <= max(rest)


# -- a user's own ---------------------------------------------------------------------------------------------------


def smallest(ballots: Sequence[Any]) -> tuple[int, ...] | Made | Undecided:
    present = [at for at, ballot in enumerate(ballots) if ballot is not ABSENT]
    return (min(present, key=lambda at: ballots[at]),) if len(present) > 1 else Undecided("too few")


def out_of_range(ballots: Sequence[Any]) -> tuple[int, ...]:
    return (len(ballots),)


def absent_one(ballots: Sequence[Any]) -> tuple[int, ...]:
    return (list(ballots).index(ABSENT),)


def broken(ballots: Sequence[Any]) -> tuple[int, ...]:
    raise KeyError("oops")


def nothing(ballots: Sequence[Any]) -> None: ...


def test_a_users_voter_is_found_by_name_and_decides() -> None:
    voter = custom(smallest)
    assert voter.function.endswith("test_voters:smallest")
    assert decide(voter, [3, 1, 2]) == Agreed(1, 1, (1,), (0, 2))
    assert decide(voter, [3, ABSENT]) == Undecided("too few")


@pytest.mark.parametrize(
    ("function", "why"),
    [(out_of_range, "no ballots"), (absent_one, "no ballots"), (nothing, "no ballots"), (broken, "oops")],
)
def test_a_users_voter_that_is_wrong_decides_nothing(function: Any, why: str) -> None:
    assert why in lost(decide(custom(function), [1, 1, ABSENT])).why
    assert isinstance(decide(Custom("no.such.module:f"), [1, 1]), Undecided)


def test_a_function_without_a_name_is_refused() -> None:
    with pytest.raises(ValueError, match="no name"):
        custom(lambda ballots: (0,))


def test_an_object_with_a_vote_is_a_voter() -> None:
    class Last:
        def vote(self, ballots: Sequence[object]) -> tuple[int, ...]:
            return (len(ballots) - 1,)

    assert isinstance(Last(), Voter)
    assert decide(Last(), [1, 2]) == Agreed(2, 1, (1,), (0,))


@pytest.mark.parametrize(
    "voter", [Exact(), Majority(need=2), Tolerance(abs=0.1, seconds=2), Median(abs=1), Custom("m:f")]
)
def test_voters_travel_as_settings(voter: AnyVoter) -> None:
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(voter), type=AnyVoter) == voter


# -- what is encoded ------------------------------------------------------------------------------------------------


def vote_answers(voter: AnyVoter, answers: Sequence[Answer | None], kind: Any = None) -> Any:
    return decide_by(voter, answers, lambda answer: answer_form(answer, kind))


def vote_ends(voter: AnyVoter, ends: list[TurnEnd], *, with_state: bool = True) -> Any:
    return decide_by(voter, ends, lambda one: end_form(one, with_state=with_state))


def test_encoded_answers_are_compared_by_what_they_mean() -> None:
    answers = [reply({"a": 1, "b": [2.0]}), reply({"b": [2], "a": 1}), reply({"a": 2})]
    decided = vote_answers(Majority(), answers)
    assert won(decided) == (0, 1)
    assert isinstance(decided, Agreed)
    assert decided.value is answers[0]


def test_encoded_times_and_arrays_have_tolerance() -> None:
    codec = msgspec.msgpack.Encoder(enc_hook=encode_special)
    arrays = [Answer(REPLY, "", codec.encode(np.array([1.0, 2.0 + by]))) for by in (0, 0.01, 5)]
    assert won(vote_answers(Tolerance(abs=0.1), arrays)) == (0, 1)
    times = [reply({"at": NOON + dt.timedelta(seconds=by)}) for by in (0, 1, 90)]
    assert won(vote_answers(Tolerance(seconds=2), times)) == (0, 1)


def test_refusals_and_crashes_are_answers() -> None:
    refusal = Answer(REFUSAL, "app:Overdrawn", msgspec.msgpack.encode([5]))
    assert won(vote_answers(Majority(), [refusal, reply(5), refusal])) == (0, 2)
    crashes = [Answer(CRASH, "", msgspec.msgpack.encode(["ValueError", "x", trace])) for trace in ("at 1", "at 2")]
    assert won(vote_answers(Exact(), crashes)) == (0, 1)
    other = Answer(CRASH, "", msgspec.msgpack.encode(["ValueError", "y", "at 1"]))
    assert isinstance(vote_answers(Exact(), [crashes[0], other]), Undecided)


def test_absent_answers_have_to_be_won_over() -> None:
    assert won(vote_answers(Majority(), [None, reply(1), reply(1)])) == (1, 2)
    assert isinstance(vote_answers(Majority(), [None, reply(1)]), Undecided)
    assert isinstance(vote_answers(Majority(), [None, None, None]), Undecided)


def test_sets_are_compared_as_such_if_their_type_is_told() -> None:
    answers = [reply(["a", "b"]), reply(["b", "a"])]
    assert isinstance(vote_answers(Exact(), answers), Undecided)
    assert won(vote_answers(Exact(), answers, set[str])) == (0, 1)


def test_bytes_that_are_no_payload_are_compared_as_bytes() -> None:
    wrong = [Answer(REPLY, "", b"\xc1"), Answer(REPLY, "", b"\xc1"), reply(1)]
    assert won(vote_answers(Majority(), wrong)) == (0, 1)


def test_ends_differ_by_outputs_status_answer_and_state() -> None:
    out = Out(1, "tell", "/app/b", "app:Add", msgspec.msgpack.encode([1.0]))
    other = Out(1, "tell", "/app/b", "app:Add", msgspec.msgpack.encode([2.0]))
    good = end(1, out, state=5)
    for wrong in (
        end(1, other, state=5),
        end(1, state=5),
        end(1, out, out, state=5),
        end(2, out, state=5),
        end(1, out, state=6),
        end(1, out, state=5, status="failed"),
    ):
        assert isinstance(vote_ends(Exact(), [good, wrong]), Undecided)
        assert won(vote_ends(Majority(), [wrong, good, good])) == (1, 2)
    assert won(vote_ends(Exact(), [good, end(1.0, out, state=6)], with_state=False)) == (0, 1)
    assert won(vote_ends(Tolerance(abs=1), [good, end(1, other, state=5)])) == (0, 1)


def test_a_tolerance_is_none_for_counts_of_turns_and_outputs() -> None:
    one, other = Out(1, "tell", "/app/b"), Out(2, "tell", "/app/b")
    wide = Tolerance(abs=100, integers=True)
    assert isinstance(vote_ends(wide, [end(1, one), end(1, other)]), Undecided)
    assert isinstance(vote_ends(wide, [end(1, state=1), end(1, state=2)]), Undecided)
    assert won(vote_ends(wide, [end(1, one), end(50, one)])) == (0, 1)


def test_no_majority_is_an_error_with_a_class_that_crosses_processes() -> None:
    error = lost(decide(Majority(), [1, 2])).error("/app/a")
    assert isinstance(error, NoMajority)
    assert isinstance(error, hf.HoldfastError)
    assert type(error)(*error.args).args == error.args
    assert "/app/a do not agree" in str(error)
