"""The certificate of one that takes part is revoked: it counts as lost at once, and the others serve."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.mechanisms.sec import SEC
from holdfast.ftm.mechanisms.tmr import TMR
from holdfast.ftm.sec.authority import CertificationAuthority, GetCertificate, Revoke
from holdfast.ftm.sec.certificates import public_of
from tests.ftm.accounts import Add, Counter, Tags

CA = "/app/ca"
STACKS: dict[str, Callable[[], tuple[Any, ...]]] = {
    "SEC over PBR": lambda: (SEC(CA), hf.ftm.PBR()),
    "SEC over LFR": lambda: (SEC(CA), hf.ftm.LFR()),
    "SEC over TMR": lambda: (SEC(CA), TMR()),
    "SEC over PBR over TR": lambda: (SEC(CA), hf.ftm.PBR(), hf.ftm.TR()),
}


async def until(holds: Callable[[], Any]) -> None:
    async with asyncio.timeout(30.0):
        while not await holds():
            await asyncio.sleep(0.01)


async def whole(system: hf.ActorSystem, ref: hf.ActorRef[Counter]) -> None:
    async def is_whole() -> bool:
        return (await system.protection(ref)).is_whole

    await until(is_whole)


async def key_of(system: hf.ActorSystem, name: str) -> bytes:
    authority = system.ref(CA, CertificationAuthority)
    return public_of(await authority.ask(GetCertificate(name), timeout=20.0))


async def revoke(system: hf.ActorSystem, name: str) -> None:
    assert await system.ref(CA, CertificationAuthority).ask(Revoke(name), timeout=20.0) == 1


@pytest.mark.parametrize("role", ["leads", "follows"])
@pytest.mark.parametrize("stack", STACKS)
async def test_a_replica_that_is_revoked_counts_as_lost_and_the_others_serve(
    secured: hf.ActorSystem, stack: str, role: str
) -> None:
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(STACKS[stack]())))
    assert await ref.ask(Add(0), timeout=20.0) == 1
    await whole(secured, ref)
    before = await secured.protection(ref)
    gone = next(name for name, state in before.replicas.items() if state == role)
    path = f"{ref.path}/ftm/{gone}"
    key, pid = await key_of(secured, path), secured._workers.processes()[path]
    with secured.events() as events:
        asked = [ref.ask(Add(n), timeout=20.0) for n in range(1, 50)]
        await revoke(secured, path)
        asked += [ref.ask(Add(n), timeout=20.0) for n in range(50, 100)]
        lost = await asyncio.wait_for(events.until(hf.events.ReplicaLost), 10.0)
        assert (lost.address, lost.replica) == (ref.path, gone)
        assert "revoked" in lost.why
        assert not (await secured.protection(ref)).is_whole
        assert await asyncio.gather(*asked) == list(range(2, 101))
        assert await ref.ask(Tags(), timeout=20.0) == list(range(100))
    await whole(secured, ref)
    now = await secured.protection(ref)
    assert (now.leader == before.leader) == (role == "follows")
    assert secured._workers.processes()[path] != pid
    assert await key_of(secured, path) != key, "what is started in its place has a key of its own"
    assert await ref.ask(Add(100), timeout=20.0) == 101


async def test_a_leader_that_is_all_there_is_begins_again_from_the_journal(secured: hf.ActorSystem) -> None:
    child = hf.child("c", hf.start(Counter), recovery=hf.replay_only(), mechanism=hf.ftm.compose(SEC(CA)))
    ref = await secured.start(child)
    assert await ref.ask(Add(0), timeout=20.0) == 1
    await whole(secured, ref)
    key = await key_of(secured, f"{ref.path}/ftm/r1")
    await revoke(secured, f"{ref.path}/ftm/r1")
    assert await ref.ask(Add(1), timeout=5.0) == 2
    assert await ref.ask(Tags(), timeout=20.0) == [0, 1]
    assert await key_of(secured, f"{ref.path}/ftm/r1") != key


async def test_all_that_take_part_are_revoked_at_once(secured: hf.ActorSystem) -> None:
    stack = hf.ftm.compose(SEC(CA), hf.ftm.PBR())
    ref = await secured.start(hf.child("c", hf.start(Counter), recovery=hf.hybrid(), mechanism=stack))
    assert await ref.ask(Add(0), timeout=20.0) == 1
    await whole(secured, ref)
    for part in ("r1", "r2", "proxy"):
        await revoke(secured, f"{ref.path}/ftm/{part}")
    assert await ref.ask(Add(1), timeout=20.0) == 2
    await whole(secured, ref)
    assert await ref.ask(Tags(), timeout=20.0) == [0, 1]


async def test_the_root_takes_another_key_and_loses_no_replica(secured: hf.ActorSystem) -> None:
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(SEC(CA), hf.ftm.PBR())))
    assert await ref.ask(Add(0), timeout=20.0) == 1
    await whole(secured, ref)
    proxy = f"{ref.path}/ftm/proxy"
    key = await key_of(secured, proxy)
    with secured.events() as events:
        await revoke(secured, proxy)
        assert [await ref.ask(Add(n), timeout=20.0) for n in range(1, 20)] == list(range(2, 21))
        assert not [one for one in events.take() if isinstance(one, hf.events.ReplicaLost)]
    assert await key_of(secured, proxy) != key
    assert await ref.ask(Tags(), timeout=20.0) == list(range(20))
