"""The two ends of a secured link, in one process: what is between them is the test's."""

from __future__ import annotations

import asyncio
import datetime as dt
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.bricks.sealed_frames import TELLS, Agree, Back, Call, Greet, LinkLost, Part, Refused, Sealed
from holdfast.ftm.mechanisms.sec import SEC
from holdfast.ftm.sec.authority import CertificationAuthority, GetCertificate, GetRoot, Revoke
from holdfast.ftm.sec.certificates import make_list, public_of
from holdfast.ftm.sec.keys import SigningKey
from holdfast.ftm.sec.link import LONGEST_PAUSE, REFUSED_FOR
from holdfast.ftm.sec.participants import key_file
from holdfast.ftm.sec.sec_errors import Rejected

CA = "/app/ca"
PROXY, REPLICA = "/app/c/ftm/proxy", "/app/c/ftm/r1"


class Wire:
    """The way from the proxy to the replica; the epoch of each end is the test's, too."""

    def __init__(self, system: hf.ActorSystem) -> None:
        self.epochs = {PROXY: 1, REPLICA: 1}
        sec = SEC(CA)
        self.inner: Any = sec.open_link(system._node, "/app/c", REPLICA, lambda: self.epochs[REPLICA])
        self.distrusted: list[tuple[str, str]] = []
        self.outer: Any = sec.open_link(
            system._node, "/app/c", PROXY, lambda: self.epochs[PROXY], lambda: [REPLICA],
            lambda path, why: self.distrusted.append((path, why)),
        )  # fmt: skip
        self.done: list[bytes] = []
        self.refused: list[str] = []
        self.on_frame = lambda: None
        self.is_wanted = True

    async def _handle(self, call: Call) -> Back:
        self.done.extend(part.body for part in call.parts)
        return Back("reply", "", call.parts[0].body)

    async def _reach(self, message: Any, seconds: float) -> Any:
        try:
            if isinstance(message, Greet):
                return await self.inner.greet(message.hello)
            if isinstance(message, Agree):
                return await self.inner.agree(message.hello, message.finish)
            self.on_frame()
            return await self.inner.take(message.frame, self._handle)
        except Refused as no:
            self.refused.append(no.reason)
            raise

    async def ask(self, body: bytes) -> Back:
        return await self.outer.call(REPLICA, TELLS, Part("", body), self._reach, lambda: self.is_wanted)

    def close(self) -> None:
        self.inner.close()
        self.outer.close()


async def test_a_frame_of_an_epoch_that_has_ended_at_the_receiver_is_refused() -> None:
    # T48: the one who led before has a session, and has not heard yet that it leads no longer.
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        wire = Wire(system)
        await wire.outer.ready()
        assert (await wire.ask(b"in its epoch")).body == b"in its epoch"

        def on_frame() -> None:
            wire.epochs[REPLICA] = 2  # while the frame is on its way
            wire.on_frame = lambda: None
            wire.is_wanted = False

        wire.on_frame = on_frame
        with pytest.raises(LinkLost):
            await wire.ask(b"after its end")
        assert wire.refused == ["wrong_session"] or wire.refused == ["stale_epoch"]
        assert wire.done == [b"in its epoch"]
        wire.is_wanted, wire.epochs[PROXY] = True, 2
        assert (await wire.ask(b"in the next")).body == b"in the next"
        wire.close()


async def test_a_revocation_ends_the_sessions_there_are() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        authority = await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        wire = Wire(system)
        await wire.outer.ready()
        assert (await wire.ask(b"before")).body == b"before"
        with system.events() as events:
            assert await authority.ask(Revoke(REPLICA)) == 1
            await authority.ask(GetRoot())  # Whoever waited for a revocation has heard of it before this.
            asked = asyncio.ensure_future(wire.ask(b"after"))
            async with asyncio.timeout(20.0):
                while not (
                    {one.reason for one in events.take() if isinstance(one, hf.events.FrameRefused)} & {"revoked"}
                ):
                    await asyncio.sleep(0)
            wire.is_wanted = False
            with pytest.raises(LinkLost):
                await asked
        assert wire.done == [b"before"]
        assert wire.distrusted == [(REPLICA, "its certificate is not accepted (revoked)")]
        wire.close()


async def test_whoever_orders_certificates_gets_another_when_its_own_was_revoked() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        authority = await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        wire = Wire(system)
        await wire.outer.ready()
        assert (await wire.ask(b"before")).body == b"before"
        key = public_of(await authority.ask(GetCertificate(PROXY)))
        assert await authority.ask(Revoke(PROXY)) == 1
        assert (await wire.ask(b"after")).body == b"after"
        assert wire.done == [b"before", b"after"]
        assert wire.distrusted == []
        assert public_of(await authority.ask(GetCertificate(PROXY))) != key
        wire.close()


async def test_one_that_another_key_has_come_to_is_distrusted_and_nobody_is_while_no_authority_is_heard() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        authority = await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        wire = Wire(system)
        await wire.outer.ready()
        assert (await wire.ask(b"before")).body == b"before"
        SigningKey.renewed(key_file(SEC(CA).folder, REPLICA))
        wire.inner.close()
        wire.inner = SEC(CA).open_link(system._node, "/app/c", REPLICA, lambda: wire.epochs[REPLICA])
        asked = asyncio.ensure_future(wire.ask(b"after"))
        async with asyncio.timeout(4 * REFUSED_FOR):
            while not wire.distrusted:
                await asyncio.sleep(0.01)
        [(path, why)] = wire.distrusted
        assert path == REPLICA
        assert "no certificate" in why
        await system.stop(authority)
        wire.distrusted.clear()
        end = len(wire.refused) + int(1.5 * REFUSED_FOR / LONGEST_PAUSE)
        while len(wire.refused) < end:
            await asyncio.sleep(0.01)
        assert wire.distrusted == []
        wire.is_wanted = False
        with pytest.raises(LinkLost):
            await asked
        assert wire.done == [b"before"]
        wire.close()


async def test_an_end_that_is_closed_takes_nothing_and_begins_nothing() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        wire, other = Wire(system), Wire(system)
        await wire.outer.ready()
        assert (await wire.ask(b"before")).body == b"before"
        wire.inner.close()
        other.inner.close()
        for one in (wire, other):  # There is a session, or there is none yet.
            asked = asyncio.ensure_future(one.ask(b"after"))
            async with asyncio.timeout(20.0):
                while not one.refused:
                    await asyncio.sleep(0)
            one.is_wanted = False
            with pytest.raises(LinkLost):
                await asked
            assert set(one.refused) == {"closed"}
            one.close()
        assert wire.done == [b"before"]
        assert other.done == []


@pytest.mark.parametrize("first", ["outer", "inner"])
@pytest.mark.parametrize("at", range(6))
async def test_what_is_on_its_way_when_it_moves_is_done_once_in_order(at: int, first: str) -> None:
    """One end knows of it before the other one does; what was answered, and the answer lost, is not done again."""
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        wire = Wire(system)
        await wire.outer.ready()
        await wire.outer.moved_certificates("/app/other/c").prepare()
        ends = [wire.outer, wire.inner] if first == "outer" else [wire.inner, wire.outer]
        tried = 0

        async def reach(message: Any, seconds: float) -> Any:
            nonlocal tried
            tried += isinstance(message, Sealed)
            if tried > at and ends:
                ends.pop(0).readdress("/app/other/c")
            reply = await wire._reach(message, seconds)
            if isinstance(message, Sealed) and tried % 2:
                raise hf.AskTimeout(REPLICA, seconds)
            return reply

        asked = [wire.outer.call(REPLICA, TELLS, Part("", b"%d" % n), reach, lambda: True) for n in range(5)]
        async with asyncio.timeout(25.0):
            backs = await asyncio.gather(*asked)
        assert [back.body for back in backs] == [b"%d" % n for n in range(5)] == wire.done
        assert not ends
        assert {one.peer.name for one in wire.inner._sessions.values()} == {"/app/other/c/ftm/proxy"}
        wire.close()


@pytest.mark.parametrize("kind", [Greet, Agree])
async def test_a_hand_shake_that_a_move_comes_into_makes_no_session(kind: type[Any]) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        wire = Wire(system)
        await wire.outer.ready()
        await wire.outer.moved_certificates("/app/other/c").prepare()
        kept = list[str]()
        real = wire.outer._keep

        def keep(partner: Any, session: Any) -> None:
            kept.append(session.peer.name)
            real(partner, session)

        wire.outer._keep = keep

        async def reach(message: Any, seconds: float) -> Any:
            reply = await wire._reach(message, seconds)
            if isinstance(message, kind) and not kept:
                for end in (wire.outer, wire.inner):
                    if end.path.startswith("/app/c/"):
                        end.readdress("/app/other/c")
            return reply

        async with asyncio.timeout(25.0):
            asked = wire.outer.call(REPLICA, TELLS, Part("", b"x"), reach, lambda: True)
            assert (await asked).body == b"x"
        assert kept == ["/app/other/c/ftm/r1"]
        wire.close()


class Late(CertificationAuthority):
    """The time of its lists is over when they come."""

    def _list(self) -> bytes:
        self.list_number += 1
        over = dt.timedelta(seconds=-1)
        return make_list(self._key, self.root, self.revoked, self.list_number, self.ctx.now(), over)


async def test_who_cannot_know_whether_somebody_was_revoked_believes_nobody() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("ca", hf.start(Late)))
        wire = Wire(system)
        with pytest.raises(Rejected, match="stale_list"):
            await wire.outer.ready()
        wire.close()
