"""Hand-shakes: only with whom one means, in this life and this epoch (A71-A75, T47)."""

from collections.abc import Callable

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.ftm.sec.certificates import Trust
from holdfast.ftm.sec.handshake import AnswerBody, Hello, Participant, Signed
from holdfast.ftm.sec.keys import SigningKey
from holdfast.ftm.sec.sec_errors import Rejected
from holdfast.ftm.sec.session import SessionLimits
from tests.ftm.sec.parties import Office, meet


@pytest.fixture
def office() -> Office:
    return Office()


def reason(work: Callable[[], object]) -> str:
    with pytest.raises(Rejected) as caught:
        work()
    return caught.value.reason


def test_both_know_with_whom_they_speak(office: Office) -> None:
    one, other = office.party("client", 3), office.party("/app/alice", 5, epoch=0)
    mine, theirs = meet(one, other)
    assert (mine.peer.name, theirs.peer.name) == ("/app/alice", "client")
    assert (mine.incarnation, theirs.incarnation) == (5, 3)
    assert mine.number == theirs.number
    assert theirs.open(mine.seal(b"x")) == b"x"


def test_each_hand_shake_has_keys_of_its_own(office: Office) -> None:
    one, other = office.party("a"), office.party("b")
    first, _ = meet(one, other)
    number = first.number
    second, _ = meet(one, other)
    assert second.number != number
    assert not first.is_open  # the new one stands in its place
    assert one.sessions == (second,)


def test_both_may_begin_at_once(office: Office) -> None:
    one, other = office.party("a"), office.party("b")
    out, out_there = meet(one, other)
    back, back_here = meet(other, one)
    assert out_there.open(out.seal(b"1")) == b"1"
    assert back_here.open(back.seal(b"2")) == b"2"
    assert len(one.sessions) == len(other.sessions) == 2


def test_somebody_else_cannot_answer(office: Office) -> None:
    one, mallory = office.party("a"), office.party("mallory")
    begun = one.begin("b")
    assert reason(lambda: mallory.answer(begun.hello)) == "wrong_peer"
    hello = msgspec.msgpack.decode(begun.hello, type=Hello)
    hello.to = "mallory"
    answer = mallory.answer(msgspec.msgpack.encode(hello)).answer
    assert reason(lambda: begun.finish(answer)) == "wrong_peer"
    assert (one.rejected, mallory.rejected) == ({"wrong_peer": 1}, {"wrong_peer": 1})


def test_who_has_a_certificate_and_not_the_key_cannot_answer(office: Office) -> None:
    one, other, mallory = office.party("a"), office.party("b"), office.party("mallory")
    begun = one.begin("b")
    signed = msgspec.msgpack.decode(other.answer(begun.hello).answer, type=Signed)
    body = msgspec.msgpack.decode(signed.body, type=AnswerBody)
    body.key = X25519PrivateKey.generate().public_key().public_bytes_raw()
    changed = msgspec.msgpack.encode(body)
    for signature in (signed.signature, mallory.sign(b"responder", b"x"), b""):
        answer = msgspec.msgpack.encode(Signed(changed, signature))
        assert reason(lambda answer=answer: begun.finish(answer)) == "forged"  # type: ignore[misc]


def test_who_stands_in_between_gets_no_session(office: Office) -> None:
    one, other = office.party("a"), office.party("b")
    begun = one.begin("b")
    hello = msgspec.msgpack.decode(begun.hello, type=Hello)
    hello.key = X25519PrivateKey.generate().public_key().public_bytes_raw()
    response = other.answer(msgspec.msgpack.encode(hello))
    assert reason(lambda: begun.finish(response.answer)) == "forged"
    assert other.sessions == ()


def test_an_old_hello_leads_to_nothing(office: Office) -> None:
    one, other = office.party("a"), office.party("b")
    begun = one.begin("b")
    response = other.answer(begun.hello)
    _, finish = begun.finish(response.answer)
    response.complete(finish)
    again = other.answer(begun.hello)  # replayed
    assert again.answer != response.answer
    assert reason(lambda: again.complete(finish)) == "forged"
    assert reason(lambda: begun.finish(response.answer)) == "closed"
    assert reason(lambda: response.complete(finish)) == "closed"
    assert len(other.sessions) == 1


def test_an_answer_to_another_hello_is_forged(office: Office) -> None:
    one, other = office.party("a"), office.party("b")
    first, second = one.begin("b"), one.begin("b")
    answer = other.answer(first.hello).answer
    assert reason(lambda: second.finish(answer)) == "forged"


def test_a_signature_of_one_role_is_none_of_the_other(office: Office) -> None:
    one, other = office.party("a"), office.party("b")
    begun = one.begin("b")
    response = other.answer(begun.hello)
    reflected = msgspec.msgpack.encode(Signed(b"", msgspec.msgpack.decode(response.answer, type=Signed).signature))
    assert reason(lambda: response.complete(reflected)) == "forged"


@settings(max_examples=40)
@given(st.data(), st.sampled_from(["hello", "answer", "finish"]))
def test_no_changed_bit_leads_to_a_session(data: st.DataObject, part: str) -> None:
    office = Office()
    one, other = office.party("a"), office.party("b")

    def flipped(name: str, good: bytes) -> bytes:
        if name != part:
            return good
        at = data.draw(st.integers(0, 1 << 20)) % (len(good) * 8)  # How long it is differs: a number in it is random.
        changed = bytearray(good)
        changed[at // 8] ^= 1 << at % 8
        return bytes(changed)

    def shake() -> None:
        begun = one.begin("b")
        response = other.answer(flipped("hello", begun.hello))
        _, finish = begun.finish(flipped("answer", response.answer))
        response.complete(flipped("finish", finish))

    assert reason(shake) in (
        "forged", "malformed", "untrusted", "wrong_peer", "version", "stale_epoch", "expired", "not_yet_valid",
    )  # fmt: skip
    assert other.sessions == ()


@settings(max_examples=40)
@given(st.binary(max_size=300))
def test_rubbish_is_malformed(rubbish: bytes) -> None:
    office = Office()
    one, other = office.party("a"), office.party("b")
    begun = one.begin("b")
    response = other.answer(begun.hello)
    assert reason(lambda: other.answer(rubbish)) in ("malformed", "version")
    assert reason(lambda: begun.finish(rubbish)) in ("malformed", "version")
    assert reason(lambda: response.complete(rubbish)) in ("malformed", "forged")
    assert reason(lambda: other.answer(b"\x00" * 40_000)) == "malformed"


def test_a_key_of_small_order_is_refused(office: Office) -> None:
    one, other = office.party("a"), office.party("b")
    hello = msgspec.msgpack.decode(one.begin("b").hello, type=Hello)
    for key in (b"\0" * 32, b"\1" + b"\0" * 31, b"short"):
        hello.key = key
        assert reason(lambda: other.answer(msgspec.msgpack.encode(hello))) == "malformed"


# -- lives and epochs -----------------------------------------------------------------------------------------------


def test_a_new_life_needs_a_new_session_and_the_old_one_is_fenced(office: Office) -> None:
    """T7: who was restarted cannot be taken for whom it was."""
    key = SigningKey.per_start()
    certificate = office.certificate(key, "a")

    def life(number: int) -> Participant:
        return Participant(
            key, certificate, Trust(office.root), incarnation=number, wall=office.clock, clock=office.clock
        )

    other = office.party("b")
    before, theirs = meet(life(1), other)
    frame = before.seal(b"late")
    after, here = meet(life(2), other)
    assert reason(lambda: theirs.open(frame)) == "closed"
    assert here.open(after.seal(b"x")) == b"x"
    assert reason(lambda: here.open(frame)) == "wrong_session"
    assert reason(lambda: meet(life(1), other)) == "stale_life"


def test_a_hello_of_a_new_life_ends_nothing_before_it_has_proved_itself(office: Office) -> None:
    one, other = office.party("a", 1), office.party("b")
    mine, theirs = meet(one, other)
    hello = msgspec.msgpack.decode(one.begin("b").hello, type=Hello)
    hello.incarnation, hello.epoch = 99, 99
    other.answer(msgspec.msgpack.encode(hello))  # anybody can say that
    assert theirs.open(mine.seal(b"x")) == b"x"
    assert meet(one, other)[0].is_open


def test_a_higher_epoch_ends_what_was_agreed_before(office: Office) -> None:
    one, other = office.party("a", epoch=4), office.party("b", epoch=4)
    mine, theirs = meet(one, other)
    frame = mine.seal(b"old primary")
    other.raise_epoch(5)
    assert reason(lambda: theirs.open(frame)) == "stale_epoch"
    assert reason(lambda: meet(one, other)) == "stale_epoch"
    other.raise_epoch(3)
    assert other.epoch == 5
    one.raise_epoch(5)
    mine, theirs = meet(one, other)
    assert (mine.epoch, theirs.epoch) == (5, 5)
    assert other.rejected == {"stale_epoch": 2}


def test_an_epoch_that_rises_in_the_middle_of_a_hand_shake_ends_it(office: Office) -> None:
    one, other = office.party("a"), office.party("b")
    begun = one.begin("b")
    response = other.answer(begun.hello)
    _, finish = begun.finish(response.answer)
    other.raise_epoch(1)
    assert reason(lambda: response.complete(finish)) == "stale_epoch"
    begun = other.begin("a")
    response = one.answer(begun.hello)
    other.raise_epoch(2)
    assert reason(lambda: begun.finish(response.answer)) == "stale_epoch"


def test_who_has_proved_a_higher_epoch_is_not_heard_in_a_lower_one(office: Office) -> None:
    one, other = office.party("a", epoch=7), office.party("b", epoch=1)
    meet(one, other)
    one.epoch = 6  # a primary that was stopped and does not know
    assert reason(lambda: meet(one, other)) == "stale_epoch"


# -- certificates ---------------------------------------------------------------------------------------------------


def test_a_revoked_participant_gets_no_session(office: Office) -> None:
    one, other = office.party("a"), office.party("b")
    begun = one.begin("b")
    response = other.answer(begun.hello)
    _, finish = begun.finish(response.answer)
    assert other.take_list(office.revocations(response.peer.serial))
    assert reason(lambda: response.complete(finish)) == "revoked"  # in the middle of it
    assert reason(lambda: meet(one, other)) == "revoked"
    assert reason(lambda: meet(other, one)) == "revoked"  # whoever begins
    assert other.rejected == {"revoked": 3}


def test_an_expired_participant_gets_no_session(office: Office) -> None:
    old = office.party("old")
    office.clock.now += 29 * 86_400
    new = office.party("new")
    assert meet(old, new)[0].is_open
    office.clock.now += 2 * 86_400
    assert reason(lambda: meet(old, new)) == "expired"
    assert reason(lambda: meet(new, old)) == "expired"


def test_revoking_ends_the_sessions_there_are(office: Office) -> None:
    one, other, third = office.party("a"), office.party("b"), office.party("c")
    mine, theirs = meet(one, other)
    good, good_there = meet(third, other)
    frame = mine.seal(b"x")
    other.take_list(office.revocations(theirs.peer.serial))
    assert reason(lambda: theirs.open(frame)) == "revoked"
    assert good_there.open(good.seal(b"y")) == b"y"
    assert other.rejected == {"revoked": 1}


def test_a_participant_of_another_authority_is_untrusted(office: Office) -> None:
    one, stranger = office.party("a"), Office().party("b")
    assert reason(lambda: stranger.answer(one.begin("b").hello)) == "untrusted"
    with pytest.raises(Rejected):
        Participant(SigningKey.per_start(), stranger.certificate, Trust(office.root), incarnation=1, wall=office.clock)


# -- ciphers --------------------------------------------------------------------------------------------------------


def test_they_agree_on_the_best_cipher_that_both_have(office: Office) -> None:
    both = ("aes-256-gcm", "chacha20-poly1305")
    one, other = office.party("a", suites=both), office.party("b", suites=both[::-1])
    assert meet(one, other)[0]._suite == both[1]
    narrow = office.party("c", suites=both[:1])
    assert meet(narrow, other)[0]._suite == both[0]
    assert reason(lambda: meet(narrow, office.party("d", suites=both[1:]))) == "version"
    with pytest.raises(ValueError, match="unknown suites"):
        office.party("e", suites=("rot13",))


def test_all_sessions_can_be_closed(office: Office) -> None:
    one, other = office.party("a", limits=SessionLimits(window=5)), office.party("b")
    mine, _ = meet(one, other)
    one.close()
    assert reason(lambda: mine.seal(b"x")) == "closed"
    assert one.sessions == ()
