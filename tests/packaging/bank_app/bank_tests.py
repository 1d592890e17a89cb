"""The tests of a user's program, with the fixtures of holdfast."""

from __future__ import annotations

import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, Probe, idle

from .bank import Account, Close, Deposit, Overdrawn, Teller, Transfer


@pytest.fixture
async def account(actor_system: GuardedSystem) -> hf.ActorRef[Account]:
    return await actor_system.start(hf.child("alice", hf.start(Account, "Alice", 100), restart="temporary"))


async def test_a_deposit_is_added(account: hf.ActorRef[Account]) -> None:
    balance: int = await account.ask(Deposit(5))
    assert balance == 105
    with pytest.raises(Overdrawn) as refused:
        await account.ask(Deposit(-500))
    assert refused.value.missing == 395


async def test_a_teller_asks_both(actor_system: GuardedSystem, account: hf.ActorRef[Account], probe: Probe) -> None:
    ports = {"source": account.path, "target": probe.path}
    teller = await actor_system.start(hf.child("teller", hf.start(Teller), bindings=ports))
    both = teller.ask(Transfer(1))
    asked: Deposit = await probe.expect(Deposit)
    probe.reply(asked.amount)
    assert await both == (99, 1)


async def test_it_ends(actor_system: GuardedSystem, account: hf.ActorRef[Account], probe: Probe) -> None:
    probe.watch(account)
    account.tell(Close())
    await probe.expect_down(account, hf.NORMAL)
    await idle(actor_system)
