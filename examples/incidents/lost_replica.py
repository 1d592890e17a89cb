"""A lost replica: an account is protected by primary-backup replication, and somebody kills the primary's process."""

import asyncio

import holdfast as hf


class Deposit(hf.Message[int]):
    cents: int


class Account(hf.Actor):
    def __init__(self) -> None:
        self.cents = 0

    @hf.on(Deposit)
    def deposit(self, message: Deposit) -> int:
        self.cents += message.cents
        return self.cents


async def main(system: hf.ActorSystem) -> None:
    account = await system.start(hf.child("account", hf.start(Account), mechanism=hf.ftm.PBR()))
    while True:
        await account.ask(Deposit(1), timeout=30.0)
        await asyncio.sleep(0.05)
