"""The certification authority, as an actor in a system (A68-A70)."""

import time
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.ftm.sec.authority import (
    CertificationAuthority,
    Enrol,
    GetCertificate,
    GetRevocations,
    GetRoot,
    Revoke,
)
from holdfast.ftm.sec.certificates import Trust, about, make_request
from holdfast.ftm.sec.handshake import Participant
from holdfast.ftm.sec.keys import SigningKey
from holdfast.ftm.sec.sec_errors import EnrolmentRefused, NoCertificate, Rejected
from tests.ftm.sec.parties import meet

Authority = hf.ActorRef[CertificationAuthority]


async def enrol(authority: Authority, name: str, key: SigningKey | None = None, incarnation: int = 1) -> Participant:
    mine = key or SigningKey.per_start()
    certificate = await authority.ask(Enrol(make_request(mine, name)))
    return Participant(mine, certificate, Trust(await authority.ask(GetRoot())), incarnation=incarnation)


async def test_participants_that_it_has_enrolled_can_meet() -> None:
    """A69."""
    async with hf.ActorSystem("app", log=False) as system:
        authority = system.spawn(hf.start(CertificationAuthority), name="ca")
        one, other = await enrol(authority, "a"), await enrol(authority, "b")
        mine, theirs = meet(one, other)
        assert theirs.open(mine.seal(b"x")) == b"x"
        assert await authority.ask(GetCertificate("a")) == one.certificate
        with pytest.raises(NoCertificate, match="no valid certificate of 'c'"):
            await authority.ask(GetCertificate("c"))


async def test_a_name_belongs_to_one_key_until_it_is_revoked() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        authority = system.spawn(hf.start(CertificationAuthority), name="ca")
        key = SigningKey.per_start()
        one = await enrol(authority, "a", key)
        again = await enrol(authority, "a", key)  # a new certificate for the same key
        assert one.certificate != again.certificate
        with pytest.raises(EnrolmentRefused, match="belongs to another key"):
            await enrol(authority, "a")
        assert await authority.ask(Revoke("a")) == 2
        with pytest.raises(NoCertificate):
            await authority.ask(GetCertificate("a"))
        assert (await enrol(authority, "a")).name == "a"


async def test_only_those_are_revoked_that_were_issued_between_two() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        authority = system.spawn(hf.start(CertificationAuthority), name="ca")
        key = SigningKey.per_start()
        issued = [(await enrol(authority, "a", key)).certificate for _ in range(5)]
        serials = [about(one)[0] for one in issued]
        assert await authority.ask(Revoke("a", after=serials[3])) == 1
        assert await authority.ask(GetCertificate("a")) == issued[3]
        assert await authority.ask(Revoke("a", until=serials[0])) == 1
        assert await authority.ask(Revoke("a", after=serials[0], until=serials[1])) == 1
        assert await authority.ask(Revoke("a", until=1)) == 0, "of one that it does not know"
        assert await authority.ask(GetCertificate("a")) == issued[3]
        assert await authority.ask(Revoke("a")) == 2


async def test_what_was_revoked_is_on_its_list() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        authority = system.spawn(hf.start(CertificationAuthority), name="ca")
        one, other = await enrol(authority, "a"), await enrol(authority, "b")
        mine, theirs = meet(one, other)
        empty = await authority.ask(GetRevocations())
        assert other.take_list(empty)
        await authority.ask(Revoke("a"))
        assert other.take_list(await authority.ask(GetRevocations()))
        with pytest.raises(Rejected, match="revoked"):
            theirs.open(mine.seal(b"x"))
        assert not other.take_list(empty)


async def test_it_issues_for_its_names_only_and_for_whom_has_the_key() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        authority = system.spawn(hf.start(CertificationAuthority, names=("a",)), name="ca")
        await enrol(authority, "a")
        with pytest.raises(EnrolmentRefused, match="not among the names"):
            await enrol(authority, "b")
        for rubbish in (b"", b"x" * 50):
            with pytest.raises(EnrolmentRefused, match="malformed"):
                await authority.ask(Enrol(rubbish))


async def test_with_a_key_file_it_is_the_same_authority_in_the_next_life(tmp_path: Path) -> None:
    file, store = tmp_path / "ca.pem", f"sqlite:{tmp_path / 'store.db'}"
    start = hf.start(CertificationAuthority, str(file))
    spec = hf.child("ca", start, recovery=hf.checkpoint_only(interval=3600))
    async with hf.ActorSystem("app", log=False, store=store) as system:
        authority = await system.start(spec)
        one = await enrol(authority, "a")
        root = await authority.ask(GetRoot())
        await authority.ask(Revoke("a"))
        other = await enrol(authority, "b")
        await system.checkpoint(authority)
    async with hf.ActorSystem("app", log=False, store=store) as system:
        authority = await system.start(spec)
        assert await authority.ask(GetRoot()) == root
        assert await authority.ask(GetCertificate("b")) == other.certificate
        trust = Trust(root)
        trust.take_list(await authority.ask(GetRevocations()), time.time())
        with pytest.raises(Rejected, match="revoked"):
            trust.verify(one.certificate, time.time())
    stored = b"".join(path.read_bytes() for path in tmp_path.glob("store*/**/*") if path.is_file())
    stored += b"".join(path.read_bytes() for path in tmp_path.glob("store*") if path.is_file())
    assert other.certificate in stored
    assert file.read_bytes().splitlines()[1] not in stored


async def test_with_a_key_of_its_start_it_forgets_what_nobody_would_believe(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'store.db'}"
    roots: list[bytes] = []
    for start in range(2):
        async with hf.ActorSystem("app", log=False, store=store) as system:
            spec = hf.child("ca", hf.start(CertificationAuthority), recovery=hf.checkpoint_only(interval=3600))
            authority = await system.start(spec)
            roots.append(await authority.ask(GetRoot()))
            if start == 0:
                await enrol(authority, "a")
                await system.checkpoint(authority)
            else:
                with pytest.raises(NoCertificate):
                    await authority.ask(GetCertificate("a"))
                assert (await enrol(authority, "a")).name == "a"
    assert roots[0] != roots[1]


async def test_keys_are_in_no_event_and_no_state() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        authority = system.spawn(hf.start(CertificationAuthority), name="ca")
        with await system.trace(authority) as events:
            await enrol(authority, "a")
            shown = repr(events.take()) + repr(await system.get_state(authority))
        assert "PRIVATE" not in shown
        assert "_key" not in shown
        assert "SigningKey" not in shown
