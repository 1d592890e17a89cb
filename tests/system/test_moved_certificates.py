"""Actors whose links are secured are moved: certified there before they go, and under their old address no more."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.bricks.sealed_frames import Greet, Refused, Sealed
from holdfast.ftm.mechanisms.sec import SEC
from holdfast.ftm.sec.authority import CertificationAuthority, Enrol, GetCertificate, GetRevocations, GetRoot, Revoke
from holdfast.ftm.sec.certificates import Trust, about, make_request
from holdfast.ftm.sec.handshake import Participant
from holdfast.ftm.sec.keys import SigningKey
from holdfast.ftm.sec.participants import key_file
from holdfast.ftm.sec.sec_errors import NoCertificate
from tests.system.test_moved_replicas import (
    HERE,
    IN_TIME,
    THERE,
    TROUBLE,
    Add,
    Me,
    Refuse,
    Resident,
    Stream,
    Strike,
    Told,
    changes,
    fail_over,
    group_of,
    kill_replicas,
    moved,
    program,
    resident,
    whole,
)

CA = "/app/ca"
PARTS = ("proxy", "r1", "r2")


def authority(system: hf.ActorSystem) -> hf.ActorRef[CertificationAuthority]:
    return system.ref(CA, CertificationAuthority)


async def certificates(system: hf.ActorSystem, address: str) -> dict[str, bytes]:
    """Those that are valid, of whoever takes part at an address."""
    found = dict[str, bytes]()
    for part in PARTS:
        with suppress(NoCertificate):
            found[part] = await authority(system).ask(GetCertificate(f"{address}/ftm/{part}"), IN_TIME)
    return found


async def party(system: hf.ActorSystem, path: str, certificate: bytes) -> Participant:
    """Somebody with the key and the certificate of a participant, who has heard of no revocation."""
    key = SigningKey.from_file(key_file(SEC(CA).folder, path))
    trust = Trust(await authority(system).ask(GetRoot(), IN_TIME))
    return Participant(key, certificate, trust, incarnation=2**62, epoch=2**30)


async def greeted(system: hf.ActorSystem, of: Participant, at: str) -> str:
    """Why a greeting is refused; "" if it is not."""
    ref = system._node.cell_at(f"{at}/protocol").ref
    try:
        await ref.ask(Greet(of.begin(at).hello), IN_TIME)
    except Refused as no:
        return no.reason
    return ""


async def test_it_is_certified_at_its_new_address_before_and_at_its_old_one_no_more_behind() -> None:
    async with program("SEC+PBR", "recorded") as system:
        one = resident(system)
        await whole(one)
        assert await one.ask(Add(), IN_TIME) == 1
        before, sessions = await certificates(system, HERE), set(group_of(one).replicas.link._sessions)
        assert set(before) == set(PARTS)
        seen = list[dict[str, bytes]]()

        async def look() -> None:
            seen.extend([await certificates(system, HERE), await certificates(system, THERE)])

        class Look(Strike):
            async def prepare(self, system: hf.ActorSystem) -> None:
                await look()

        await moved(system, then=Look("", None))
        here, there = seen
        assert here == before, "until it has gone it is certified where it is"
        assert set(there) == set(PARTS)
        assert await certificates(system, HERE) == {}
        assert await certificates(system, THERE) == there
        assert await one.ask(Add(), IN_TIME) == 2
        now = group_of(one).replicas.link._sessions
        assert now
        assert not sessions & set(now)
        assert {session.peer.name for session in now.values()} <= {f"{THERE}/ftm/{part}" for part in PARTS}


@pytest.mark.parametrize("part", ["proxy", "r2"])
async def test_an_old_certificate_opens_nothing_any_more(part: str) -> None:
    """Neither where the actor is now, nor where it was: not even when others live there, who have the same names."""
    async with program("SEC+PBR", "plain") as system:
        one = resident(system)
        await whole(one)
        old = (await certificates(system, HERE))[part]
        mallory = await party(system, f"{HERE}/ftm/{part}", old)
        assert await greeted(system, mallory, f"{HERE}/ftm/r1") == ""  # It was worth something.
        await moved(system)
        assert await one.ask(Add(), IN_TIME) == 1
        assert await greeted(system, mallory, f"{THERE}/ftm/r1") == "revoked"
        child = hf.child("one", hf.start(Resident), mechanism=(SEC(CA), hf.ftm.PBR()))
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app/here", child)
        other = system.ref("/app/here/one", Resident)
        await whole(other)
        assert await other.ask(Add(10), IN_TIME) == 10
        assert await greeted(system, mallory, f"{HERE}/ftm/r1") == "revoked"
        assert await one.ask(Add(), IN_TIME) == 2


async def test_a_certificate_for_the_old_address_that_nobody_has_revoked_opens_nothing_elsewhere() -> None:
    """The root was killed before it could say so, and the authority lives on."""
    async with program("SEC+PBR", "plain") as system:
        one = resident(system)
        await whole(one)
        await moved(system)
        for part in PARTS:
            path = f"{HERE}/ftm/{part}"
            key = SigningKey.renewed(
                key_file(SEC(CA).folder, path)
            )  # That of before was revoked, and is not certified.
            left = await authority(system).ask(Enrol(make_request(key, path)), IN_TIME)
            assert await greeted(system, await party(system, path, left), f"{THERE}/ftm/r1") == "wrong_peer"
        assert await one.ask(Add(), IN_TIME) == 1


async def test_what_was_sealed_before_the_move_is_refused_behind_it(monkeypatch: pytest.MonkeyPatch) -> None:
    async with program("SEC+PBR", "plain") as system:
        one = resident(system)
        await whole(one)
        frames = list[bytes]()
        link = group_of(one).replicas.link
        real = type(link)._call

        async def call(self: Any, partner: Any, name: str, parts: Any, reach: Any, *more: Any) -> Any:
            async def tapped(message: Any, seconds: float) -> Any:
                if isinstance(message, Sealed):
                    frames.append(message.frame)
                return await reach(message, seconds)

            return await real(self, partner, name, parts, tapped, *more)

        monkeypatch.setattr(type(link), "_call", call)
        assert await one.ask(Add(), IN_TIME) == 1
        recorded = list(frames)
        assert recorded
        await moved(system)
        assert await one.ask(Add(), IN_TIME) == 2
        for path in (f"{THERE}/ftm/r1", f"{THERE}/ftm/r2"):
            for frame in recorded:
                with pytest.raises(Refused, match=r"wrong_session|stale|plain"):
                    await system._node.cell_at(f"{path}/protocol").ref.ask(Sealed(frame), IN_TIME)
        assert (await one.ask(Told(), IN_TIME))["count"] == 2


async def test_what_was_certified_for_a_move_that_is_given_up_is_revoked() -> None:
    async with program("SEC+PBR", "plain") as system:
        one = resident(system)
        await whole(one)
        before, stream = await certificates(system, HERE), Stream(one)
        for _ in range(2):
            with pytest.raises(hf.TransactionFailed, match="on purpose"):
                await moved(system, then=Refuse())
            assert await certificates(system, THERE) == {}
            assert await certificates(system, HERE) == before
            await stream.goes_on()
        await fail_over(one)
        await stream.goes_on()
        await moved(system)
        await stream.goes_on()
        await stream.stop()


async def test_two_that_exchange_their_addresses_are_certified_anew() -> None:
    async with program("SEC+PBR", "plain") as system:
        child = hf.child("one", hf.start(Resident), mechanism=(SEC(CA), hf.ftm.PBR()))
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app/there", child)
        one, other = resident(system), resident(system, THERE)
        for ref in (one, other):
            await whole(ref)
        before = [await certificates(system, HERE), await certificates(system, THERE)]

        async def exchanged(then: Any = None) -> None:
            async with system.transaction(timeout=IN_TIME) as change:
                change.move(one, "/app")
                change.move(other, "/app/here")
                change.move("/app/one", "/app/there")
                if then is not None:
                    change.step(then)

        with pytest.raises(hf.TransactionFailed, match="on purpose"):
            await exchanged(Refuse())
        assert [await certificates(system, HERE), await certificates(system, THERE)] == before
        assert [await ref.ask(Me(), IN_TIME) for ref in (one, other)] == [HERE, THERE]
        await exchanged()
        trust = Trust(await authority(system).ask(GetRoot(), IN_TIME))
        trust.take_list(await authority(system).ask(GetRevocations(), IN_TIME), system._node.loop.time())
        for certified in before:
            assert all(trust.is_revoked(about(one)[0]) for one in certified.values())
        for address in (HERE, THERE):
            now = await certificates(system, address)
            assert set(now) == set(PARTS)
            assert not any(trust.is_revoked(about(certificate)[0]) for certificate in now.values())
        for ref, address in ((one, THERE), (other, HERE)):
            await fail_over(ref)
            assert await ref.ask(Me(), IN_TIME) == address


@pytest.mark.parametrize("taken", ["one name", "all"])
async def test_a_name_that_belongs_to_another_key_keeps_it_where_it_is(taken: str, tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    keys.mkdir(mode=0o700)
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        stack = (SEC(CA, keys=str(keys)), hf.ftm.PBR())
        await system.start(hf.supervisor("here", children=[hf.child("one", hf.start(Resident), mechanism=stack)]))
        await system.start(hf.supervisor("there"))
        one = resident(system)
        await whole(one)
        for part in PARTS if taken == "all" else ("r2",):
            request = make_request(SigningKey.per_start(), f"{THERE}/ftm/{part}")
            await authority(system).ask(Enrol(request), IN_TIME)
        before = await certificates(system, THERE)
        with pytest.raises(hf.TransactionFailed, match="belongs to another key; revoke that one first"):
            await moved(system)
        assert await certificates(system, THERE) == before
        assert await one.ask(Add(), IN_TIME) == 1
        for part in before:
            await authority(system).ask(Revoke(f"{THERE}/ftm/{part}"), IN_TIME)
        await moved(system)
        assert await one.ask(Add(), IN_TIME) == 2


async def test_keys_of_an_earlier_start_are_no_obstacle() -> None:
    async with program("SEC+PBR", "plain") as system:
        one = resident(system)
        await whole(one)
        for part in PARTS:
            await authority(system).ask(Enrol(make_request(SigningKey.per_start(), f"{THERE}/ftm/{part}")), IN_TIME)
        await moved(system)
        assert await one.ask(Add(), IN_TIME) == 1


async def test_who_was_revoked_is_certified_nowhere_else() -> None:
    async with program("SEC+PBR", "plain") as system:
        one = resident(system)
        await whole(one)
        await authority(system).ask(Revoke(f"{HERE}/ftm/r2"), IN_TIME)
        await group_of(one).replicas.link.moved_certificates(THERE).prepare()
        assert set(await certificates(system, THERE)) == {"proxy", "r1"}


async def test_an_authority_that_is_gone_keeps_it_where_it_is() -> None:
    async with program("SEC+PBR", "plain") as system:
        one = resident(system)
        await whole(one)
        await system.stop(authority(system))
        with pytest.raises(hf.TransactionFailed, match=f"no authority lives at {CA}"):
            await moved(system)
        assert await one.ask(Add(), IN_TIME) == 1


async def test_an_authority_that_dies_at_the_commit_revokes_in_its_next_life(tmp_path: Path) -> None:
    start = hf.start(CertificationAuthority, str(tmp_path / "ca.key"))
    ca = hf.child("ca", start, recovery=hf.checkpoint_only(every=1))
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        await system.start(ca)
        stack = (SEC(CA), hf.ftm.PBR())
        await system.start(hf.supervisor("here", children=[hf.child("one", hf.start(Resident), mechanism=stack)]))
        await system.start(hf.supervisor("there"))
        one = resident(system)
        await whole(one)
        stream = Stream(one)
        await stream.goes_on()
        await moved(system, then=Strike("commit", authority(system).kill))
        await stream.goes_on()
        await stream.stop()
        assert await certificates(system, HERE) == {}
        assert set(await certificates(system, THERE)) == set(PARTS)
        await fail_over(one)
        assert await one.ask(Me(), IN_TIME) == THERE


@pytest.mark.pairs
@pytest.mark.parametrize("whom", ["leader", "follower", "all"])
@pytest.mark.parametrize("when", ["prepare", "commit", "finish"])
@pytest.mark.parametrize("there", ["task", "process"])
async def test_replicas_that_are_killed_at_a_step_of_the_move(there: str, when: str, whom: str) -> None:
    async with program("SEC+PBR", "recorded", there=there) as system:
        one = resident(system)
        await whole(one)
        for count in (1, 2, 3):
            assert await one.ask(Add(), IN_TIME) == count

        await moved(system, then=Strike(when, lambda: kill_replicas(one, whom)))
        assert one.path == THERE
        assert await one.ask(Add(), IN_TIME) == 4
        await fail_over(one)
        assert (await one.ask(Told(), IN_TIME))["at"] == [HERE] * 3 + [THERE]
        assert await certificates(system, HERE) == {}
        assert set(await certificates(system, THERE)) == set(PARTS)


async def test_it_goes_far_and_comes_back_under_load_and_nothing_is_told_as_trouble() -> None:
    async with program("SEC+PBR", "plain", there="process") as system:
        one = resident(system)
        await whole(one)
        stream = Stream(one)
        with system.events() as events:
            for above, of in (("/app/there", HERE), ("/app/here", THERE), ("/app/there", HERE)):
                await moved(system, above, of)
                await stream.goes_on()
            assert not [event for event in events.take() if isinstance(event, TROUBLE)]
        count = await stream.stop()
        told = await one.ask(Told(), IN_TIME)
        assert (told["count"], changes(told["at"])) == (count, [HERE, THERE, HERE, THERE])
