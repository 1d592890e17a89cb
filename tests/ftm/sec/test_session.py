"""Sessions: each frame of the peer is opened once, and nothing else ever (T47)."""

import os
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.ftm.sec import session as sessions
from holdfast.ftm.sec.sec_errors import Rejected
from holdfast.ftm.sec.session import HEAD, LEAP, TAG_BYTES, Session, SessionLimits, Window
from tests.ftm.sec.parties import Office, meet

SUITES = ["aes-256-gcm", "chacha20-poly1305"]


def reason(work: Callable[[], object]) -> str:
    with pytest.raises(Rejected) as caught:
        work()
    return caught.value.reason


def pair(suite: str = SUITES[0], **limits: Any) -> tuple[Office, Session, Session]:
    office = Office()
    given_limits = SessionLimits(**limits)
    one = office.party("a", suites=(suite,), limits=given_limits)
    other = office.party("b", suites=(suite,), limits=given_limits)
    return office, *meet(one, other)


@pytest.mark.parametrize("suite", SUITES)
def test_what_is_sealed_is_opened_by_the_peer_in_both_directions(suite: str) -> None:
    _, one, other = pair(suite)
    for text in (b"", b"hello", os.urandom(100_000)):
        assert other.open(one.seal(text)) == text
        assert one.open(other.seal(text)) == text
    assert (one.sealed, one.opened, other.sealed, other.opened) == (3, 3, 3, 3)


def test_nobody_reads_it_and_equal_texts_look_different() -> None:
    _, one, _ = pair()
    first, second = one.seal(b"transfer 100 to bob"), one.seal(b"transfer 100 to bob")
    assert b"transfer" not in first
    assert first[HEAD.size :] != second[HEAD.size :]
    assert len(first) == HEAD.size + 19 + TAG_BYTES


@settings(max_examples=60)
@given(st.binary(max_size=40), st.data())
def test_no_flipped_bit_is_accepted(text: bytes, data: st.DataObject) -> None:
    _, one, other = pair()
    frame = bytearray(one.seal(text, b"7"))
    at = data.draw(st.integers(0, len(frame) * 8 - 1))
    frame[at // 8] ^= 1 << at % 8
    assert reason(lambda: other.open(bytes(frame), b"7")) in (
        "version", "wrong_session", "generation", "forged", "too_old",
    )  # fmt: skip
    frame[at // 8] ^= 1 << at % 8
    assert other.open(bytes(frame), b"7") == text  # what was rejected has changed nothing


@settings(max_examples=30)
@given(st.integers(0, 60))
def test_no_part_of_a_frame_is_accepted(length: int) -> None:
    _, one, other = pair()
    frame = one.seal(b"x" * 30)
    if length < len(frame):
        expected = "truncated" if length < HEAD.size + TAG_BYTES else "forged"
        assert reason(lambda: other.open(frame[:length])) == expected
    assert reason(lambda: other.open(frame + b"\0")) == "forged"


def test_a_frame_is_accepted_once() -> None:
    _, one, other = pair()
    frame = one.seal(b"pay")
    assert other.open(frame) == b"pay"
    assert reason(lambda: other.open(frame)) == "replayed"
    assert other.rejected == {"replayed": 1}


def test_frames_may_come_in_another_order_within_the_window_each_once() -> None:
    _, one, other = pair(window=8)
    frames = [one.seal(bytes([number])) for number in range(20)]
    order = [3, 0, 2, 1, 7, 5, 6, 4, 19, 12]
    assert [other.open(frames[at])[0] for at in order] == order
    assert [reason(lambda at=at: other.open(frames[at])) for at in order] == [  # type: ignore[misc]
        "too_old", "too_old", "too_old", "too_old", "too_old", "too_old", "too_old", "too_old", "replayed", "replayed",
    ]  # fmt: skip
    assert reason(lambda: other.open(frames[11])) == "too_old"  # never seen, and cannot be told from one that was
    assert other.open(frames[13]) == bytes([13])


@given(st.lists(st.integers(0, 40), max_size=60), st.integers(1, 16))
def test_the_window_is_a_set_that_forgets_only_what_is_too_old(numbers: list[int], size: int) -> None:
    window, seen = Window(size), set[int]()
    for number in numbers:
        newest = max(seen, default=-1)
        expected = "" if number > newest else "too_old" if newest - number >= size else "replayed" * (number in seen)
        assert window.refusal(number) == expected
        if not expected:
            window.put(number)
            seen.add(number)


def test_a_number_far_ahead_costs_no_memory() -> None:
    window = Window(64)
    window.put(1 << 47)
    window.put((1 << 48) - 1)
    assert window.refusal(1 << 47) == "too_old"
    assert window._bits == 1


def test_a_frame_that_is_sent_back_to_its_maker_is_forged() -> None:
    _, one, _ = pair()
    assert reason(lambda: one.open(one.seal(b"x"))) == "forged"


def test_what_both_know_besides_is_sealed_along() -> None:
    """A request's number, say: a reply to another request is refused (T47)."""
    _, one, other = pair()
    frame = one.seal(b"42", about=b"request 7")
    assert reason(lambda: other.open(frame, about=b"request 8")) == "forged"
    assert other.open(frame, about=b"request 7") == b"42"


def test_a_frame_of_another_session_is_refused_whatever_it_says() -> None:
    office = Office()
    one, other, third = office.party("a"), office.party("b"), office.party("c")
    _, here = meet(one, other)
    there, _ = meet(third, other)
    frame = there.seal(b"x")
    assert reason(lambda: here.open(frame)) == "wrong_session"
    assert reason(lambda: here.open(frame[:1] + here.number + frame[9:])) == "forged"


# -- rotation -------------------------------------------------------------------------------------------------------


def generation(frame: bytes) -> int:
    return int(HEAD.unpack(frame[: HEAD.size])[2])


def test_keys_are_exchanged_after_so_many_frames_and_numbers_go_on() -> None:
    _, one, other = pair(messages=3)
    frames = [one.seal(bytes([number])) for number in range(8)]
    assert [generation(frame) for frame in frames] == [0, 0, 0, 1, 1, 1, 2, 2]
    assert [HEAD.unpack(frame[: HEAD.size])[3] for frame in frames] == list(range(8))
    assert [other.open(frame)[0] for frame in frames] == list(range(8))


def test_keys_are_exchanged_after_so_long() -> None:
    office, one, other = pair(seconds=10)
    first = one.seal(b"1")
    office.clock.now += 9.9
    assert generation(one.seal(b"2")) == 0
    office.clock.now += 0.1
    second = one.seal(b"3")
    assert (generation(first), generation(second)) == (0, 1)
    assert other.open(second) == b"3"
    assert other.open(first) == b"1"  # it is late, and within its grace


def test_keys_before_are_forgotten_after_their_grace() -> None:
    office, one, other = pair(messages=1, grace=5)
    frames = [one.seal(bytes([number])) for number in range(3)]
    other.open(frames[1])
    office.clock.now += 6
    assert reason(lambda: other.open(frames[0])) == "generation"
    assert other._previous is None
    assert other.open(frames[2]) == bytes([2])
    assert reason(lambda: other.open(frames[0])) == "generation"  # two generations back


def test_lost_generations_are_skipped_up_to_a_bound() -> None:
    _, one, other = pair(messages=1)
    frames = [one.seal(b"x") for _ in range(LEAP + 3)]
    assert reason(lambda: other.open(frames[LEAP + 1])) == "generation"
    assert other.open(frames[LEAP]) == b"x"
    assert other.open(frames[LEAP + 1]) == b"x"


def test_a_forged_head_exchanges_no_keys() -> None:
    _, one, other = pair()
    frame = one.seal(b"x")
    forged = HEAD.pack(1, other.number, 5, 0) + frame[HEAD.size :]
    assert reason(lambda: other.open(forged)) == "forged"
    assert other.open(frame) == b"x"


@pytest.mark.parametrize("suite", SUITES)
def test_no_nonce_comes_twice_under_one_key(suite: str) -> None:
    _, one, other = pair(suite, messages=5)
    used = set[tuple[int, int, bytes]]()
    for side in (one, other):
        for _ in range(40):
            frame = side.seal(b"")
            _, _, number, sequence = HEAD.unpack(frame[: HEAD.size])
            used.add((id(side), number, side._sending.nonce(sequence)))
    assert len(used) == 80
    assert one._sending._iv != other._sending._iv


# -- ends -----------------------------------------------------------------------------------------------------------


def test_a_session_has_a_lifetime() -> None:
    office, one, other = pair(lifetime=100)
    frame = one.seal(b"x")
    office.clock.now += 100
    assert reason(lambda: one.seal(b"x")) == "expired"
    assert reason(lambda: other.open(frame)) == "expired"
    assert not one.is_open


def test_a_session_ends_with_the_certificate_of_the_peer() -> None:
    office, one, _ = pair(lifetime=1e9, seconds=1e9)
    office.clock.now += 30 * 86_400
    assert reason(lambda: one.seal(b"x")) == "expired"


def test_a_closed_session_has_no_keys() -> None:
    _, one, other = pair()
    frame = other.seal(b"x")
    one.close("revoked")
    one.close()  # the first reason stays
    assert reason(lambda: one.open(frame)) == "revoked"
    assert reason(lambda: one.seal(b"x")) == "revoked"
    assert not hasattr(one, "_sending")
    assert not hasattr(one, "_receiving")
    assert one.generation == -1
    assert repr(one) == "<Session with 'b' epoch 0 revoked>"


def test_a_session_is_exhausted_before_its_numbers_are(monkeypatch: pytest.MonkeyPatch) -> None:
    _, one, other = pair()
    monkeypatch.setattr(sessions, "MOST_FRAMES", 2)
    frames = [one.seal(b"x"), one.seal(b"x")]
    assert reason(lambda: one.seal(b"x")) == "exhausted"
    assert other.open(frames[1]) == b"x"


def test_a_forked_process_does_not_seal_with_its_parents_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    _, one, other = pair()
    frame = other.seal(b"x")
    monkeypatch.setattr(os, "getpid", lambda: -1)
    assert reason(lambda: one.seal(b"x")) == "forked"
    assert reason(lambda: one.open(frame)) == "forked"


@pytest.mark.parametrize("wrong", [{"messages": 0}, {"seconds": 0}, {"grace": -1}, {"lifetime": 0}, {"window": 0}])
def test_limits_that_are_none_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="must be"):
        SessionLimits(**wrong)


@settings(max_examples=40)
@given(st.binary(max_size=200))
def test_rubbish_is_rejected_and_counted(data: bytes) -> None:
    _, _, other = pair()
    assert reason(lambda: other.open(data)) in ("truncated", "version", "wrong_session")
    assert sum(other.rejected.values()) == 1
