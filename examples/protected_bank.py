"""A bank under a fault-tolerance mechanism: its primary is killed while transfers flow, then the mechanism changes."""

import asyncio
import os
import signal

import holdfast as hf


class Transfer(hf.Message[int]):  # its reply: how many transfers there were
    source: str
    target: str
    euros: int


class Balances(hf.Message[dict[str, int]]): ...


class Bank(hf.Actor):  # an ordinary actor: nothing in it knows of mechanisms
    def __init__(self) -> None:
        self.accounts = {"alice": 1000, "bob": 1000}
        self.transfers = 0

    @hf.on(Transfer)
    def transfer(self, message: Transfer) -> int:
        self.accounts[message.source] -= message.euros
        self.accounts[message.target] += message.euros
        self.transfers += 1
        return self.transfers

    @hf.on(Balances, readonly=True)
    def balances(self, message: Balances) -> dict[str, int]:
        return self.accounts


async def customer(bank: hf.ActorRef[Bank], closing: asyncio.Event) -> int:
    """Asks for one transfer after the other; how many."""
    done = 0
    while not closing.is_set():
        await bank.ask(Transfer("alice", "bob", 1), timeout=20.0)
        done += 1
    return done


async def main() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        events = system.events()
        bank = await system.start(hf.child("bank", hf.start(Bank), mechanism=hf.ftm.PBR()))
        closing = asyncio.Event()
        customers = [asyncio.create_task(customer(bank, closing)) for _ in range(4)]

        primary = system.ref("/app/bank/ftm/r1", hf.Actor)
        os.kill(system.pid_of(primary), signal.SIGKILL)
        async for event in events:
            if isinstance(event, hf.events.FailedOver):
                print(event.replica, event.epoch)  # r2 2
                break

        async with system.transaction() as change:
            change.protect(bank, hf.ftm.LFR())  # two compute instead of one
        async with system.transaction() as change:
            change.protect(bank, (hf.ftm.PBR(), hf.ftm.TR()))  # each request twice, against transient faults
        async with system.transaction() as change:
            change.protect(bank, None)  # a plain task again; it never stopped

        closing.set()
        asked = sum(await asyncio.gather(*customers))
        found = await bank.ask(Balances())
        print(sum(found.values()))  # 2000
        print(asked > 0, found["bob"] == 1000 + asked)  # True True


if __name__ == "__main__":
    hf.run(main())
