"""Certificates: whom to believe, and for how long (A68-A70)."""

import datetime as dt
from collections.abc import Callable

import pytest

from holdfast.ftm.sec.certificates import Trust, issue, make_list, make_request, make_root, read_request
from holdfast.ftm.sec.keys import SigningKey, raw_public
from holdfast.ftm.sec.sec_errors import Rejected
from tests.ftm.sec.parties import NOW, Office

DAY = 86_400.0


@pytest.fixture
def office() -> Office:
    return Office()


@pytest.fixture
def key() -> SigningKey:
    return SigningKey.per_start()


def reason(work: Callable[[], object]) -> str:
    with pytest.raises(Rejected) as caught:
        work()
    return caught.value.reason


def test_a_certificate_says_whose_key_it_is(office: Office, key: SigningKey) -> None:
    peer = Trust(office.root).verify(office.certificate(key, "alice"), NOW, "alice")
    assert (peer.name, peer.public) == ("alice", raw_public(key.public))
    assert peer.until == NOW + 30 * DAY


def test_another_authority_of_the_same_name_is_not_believed(office: Office, key: SigningKey) -> None:
    other = Office()
    assert other.root != office.root
    assert reason(lambda: Trust(office.root).verify(other.certificate(key, "alice"), NOW)) == "untrusted"


def test_a_participant_cannot_issue(office: Office, key: SigningKey) -> None:
    mine = office.certificate(key, "mallory")
    forged = issue(key, mine, "alice", raw_public(key.public), NOW)
    assert reason(lambda: Trust(office.root).verify(forged, NOW)) == "untrusted"
    by_name = issue(key, office.root, "alice", raw_public(key.public), NOW)  # the right issuer, the wrong key
    assert reason(lambda: Trust(office.root).verify(by_name, NOW)) == "untrusted"
    with pytest.raises(Rejected):
        Trust(mine)


def test_the_authority_speaks_for_nobody(office: Office) -> None:
    assert reason(lambda: Trust(office.root).verify(office.root, NOW)) == "untrusted"


def test_a_certificate_has_a_time(office: Office, key: SigningKey) -> None:
    certificate, trust = office.certificate(key, "alice", lifetime=dt.timedelta(days=1)), Trust(office.root)
    trust.verify(certificate, NOW - 200)  # clocks may differ a little
    trust.verify(certificate, NOW + DAY - 1)
    assert reason(lambda: trust.verify(certificate, NOW - 400)) == "not_yet_valid"
    assert reason(lambda: trust.verify(certificate, NOW + DAY + 1)) == "expired"
    short = make_root(office.key, "office", NOW, dt.timedelta(hours=1))
    late = issue(office.key, short, "alice", raw_public(key.public), NOW)
    assert reason(lambda: Trust(short).verify(late, NOW + DAY)) == "expired"  # as the authority is


def test_a_certificate_of_somebody_else_is_refused(office: Office, key: SigningKey) -> None:
    certificate = office.certificate(key, "bob")
    assert reason(lambda: Trust(office.root).verify(certificate, NOW, "alice")) == "wrong_peer"


@pytest.mark.parametrize("what", ["certificate", "list", "request"])
def test_no_changed_bit_is_believed(office: Office, key: SigningKey, what: str) -> None:
    trust = Trust(office.root)
    kinds: dict[str, tuple[bytes, Callable[[bytes], object]]] = {
        "certificate": (office.certificate(key, "alice"), lambda data: trust.verify(data, NOW)),
        "list": (office.revocations(4711), lambda data: trust.take_list(data, NOW)),
        "request": (make_request(key, "alice"), read_request),
    }
    good, read = kinds[what]
    for bit in range(len(good) * 8):
        changed = bytearray(good)
        changed[bit // 8] ^= 1 << bit % 8
        with pytest.raises(Rejected) as caught:
            read(bytes(changed))
        assert caught.value.reason in ("untrusted", "malformed")
    for length in range(len(good)):
        with pytest.raises(Rejected) as caught:
            read(good[:length])
        assert caught.value.reason == "malformed"
    assert not trust.is_revoked(4711)
    assert read(good)


def test_rubbish_is_malformed(office: Office) -> None:
    trust = Trust(office.root)
    for rubbish in (b"", b"\x30", b"x" * 100, b"x" * 100_000):
        assert reason(lambda data=rubbish: trust.verify(data, NOW)) == "malformed"  # type: ignore[misc]
        assert reason(lambda data=rubbish: read_request(data)) == "malformed"  # type: ignore[misc]
        assert reason(lambda data=rubbish: trust.take_list(data, NOW)) == "malformed"  # type: ignore[misc]


def test_a_request_shows_that_its_maker_has_the_key(key: SigningKey) -> None:
    request = make_request(key, "alice")
    assert read_request(request) == ("alice", raw_public(key.public))
    swapped = request.replace(raw_public(key.public), raw_public(SigningKey.per_start().public))
    assert reason(lambda: read_request(swapped)) in ("untrusted", "malformed")


@pytest.mark.parametrize("name", ["", "x" * 65])
def test_a_name_has_a_length(key: SigningKey, name: str) -> None:
    with pytest.raises(ValueError, match="1 to 64 characters"):
        make_request(key, name)


def test_a_revoked_certificate_is_refused_and_others_are_not(office: Office, key: SigningKey) -> None:
    trust = Trust(office.root)
    certificate, other = office.certificate(key, "alice"), office.certificate(key, "bob")
    serial = trust.verify(certificate, NOW).serial
    assert trust.take_list(office.revocations(serial), NOW)
    assert reason(lambda: trust.verify(certificate, NOW)) == "revoked"
    assert trust.verify(other, NOW).name == "bob"


def test_an_older_list_does_not_make_it_good_again(office: Office, key: SigningKey) -> None:
    trust = Trust(office.root)
    certificate = office.certificate(key, "alice")
    before = office.revocations()
    assert trust.take_list(office.revocations(trust.verify(certificate, NOW).serial), NOW)
    assert not trust.take_list(before, NOW)
    assert reason(lambda: trust.verify(certificate, NOW)) == "revoked"


def test_a_list_is_only_believed_from_the_authority_and_in_its_time(office: Office) -> None:
    trust, other = Trust(office.root), Office()
    assert reason(lambda: trust.take_list(other.revocations(), NOW)) == "untrusted"
    forged = make_list(other.key, office.root, {}, 99, NOW)
    assert reason(lambda: trust.take_list(forged, NOW)) == "untrusted"
    old = office.revocations()
    assert reason(lambda: trust.take_list(old, NOW + 2 * DAY)) == "stale_list"
    assert trust.list_number == -1


def test_who_needs_a_list_believes_nobody_without_a_fresh_one(office: Office, key: SigningKey) -> None:
    trust = Trust(office.root, needs_list=True)
    certificate = office.certificate(key, "alice")
    assert reason(lambda: trust.verify(certificate, NOW)) == "stale_list"
    trust.take_list(office.revocations(), NOW)
    assert trust.verify(certificate, NOW).name == "alice"
    assert reason(lambda: trust.verify(certificate, NOW + DAY)) == "stale_list"
