"""A bank, and programs that use it over NATS: their refs stay good when its leader is killed and another one leads.

`python connect.py` starts a server and two programs of the bank, each in a process of its own, and kills the one that
leads. The server is that of `standby.py`.
"""

import asyncio
import sys

from standby import nats_server  # type: ignore[import-not-found]  # it lies beside this file

import holdfast as hf


class Deposit(hf.Message[int]):
    amount: int


class Deposited(hf.Message[None]):
    amount: int


class Watch(hf.Message[None]):
    account: hf.ActorRef[hf.Actor]


class Report(hf.Message[str]): ...


class Account(hf.Actor):
    """An account of the bank: recorded, so that each deposit is made once."""

    def __init__(self) -> None:
        self.balance = 0

    @hf.on(Deposit)
    async def deposit(self, message: Deposit) -> int:
        self.balance += message.amount
        await self.ctx.publish("/deposits", Deposited(message.amount))
        return self.balance


class Audit(hf.Actor):
    """An actor of another system: it hears of all deposits, and whether the bank can be reached."""

    def __init__(self) -> None:
        self.deposits = 0
        self.lost = ""

    @hf.on(Watch)
    def watch(self, message: Watch) -> None:
        self.ctx.monitor(message.account)

    @hf.on(Deposited)
    def hear(self, message: Deposited) -> None:
        self.deposits += 1

    def on_down(self, source: hf.ActorRef[hf.Actor], reason: hf.ExitReason, recovering: bool) -> None:
        if isinstance(reason, hf.NoConnection):  # It may well live on: nobody here can say.
            self.lost = reason.node

    @hf.on(Report)
    def report(self, message: Report) -> str:
        return f"{self.deposits} deposit, {self.lost or 'nothing'} lost"


async def lead(store: str) -> None:
    """A program of the bank: it leads, or stands by until it does."""
    async with hf.ActorSystem("bank", store=store, standby="warm", log=False) as system:
        await system.start(hf.child("account", hf.start(Account), recovery=hf.hybrid()))
        await asyncio.Event().wait()


async def use(store: str, programs: list[asyncio.subprocess.Process]) -> None:
    """A program without a system of its own: the leader is killed while its asks are out."""
    programs.append(await start_program(store))
    async with hf.connect(store, timeout=30.0) as bank:
        programs.append(await start_program(store))  # It stands by.
        account = bank.ref("/bank/account", Account)
        print(await account.ask(Deposit(10)))  # 10
        asks = [asyncio.ensure_future(account.ask(Deposit(1), 60.0)) for _ in range(100)]
        await asks[0]
        programs[0].kill()
        balances = await asyncio.gather(*asks)
        print(sorted(balances) == list(range(11, 111)))  # True
        print(await account.ask(Deposit(0)))  # 110


async def listen(store: str) -> None:
    """A system of its own: its actors use the refs, and are reached from the bank."""
    async with hf.ActorSystem("office", log=False) as office:
        audit = await office.start(hf.child("audit", hf.start(Audit)))
        async with hf.connect(store, within=office) as bank:
            account = bank.ref("/bank/account", Account)
            bank.subscribe("/deposits", audit)
            await audit.ask(Watch(account))
            print(await account.ask(Deposit(5)))  # 115
            print(await audit.ask(Report()))  # 1 deposit, nothing lost
        print(await audit.ask(Report()))  # 1 deposit, bank lost
        print(await balance(bank))  # None


async def balance(bank: hf.system.SystemConnection) -> int | None:
    """What is in the account, if the bank can be reached."""
    try:
        return await bank.ref("/bank/account", Account).ask(Deposit(0))
    except hf.Unreachable:  # Nothing was sent.
        return None
    except hf.errors.ConnectionLost:  # It may have been done, by an actor without recovery.
        return None


async def main() -> None:
    with nats_server() as address:
        store = f"nats://{address}/bank"
        programs: list[asyncio.subprocess.Process] = []
        try:
            await use(store, programs)
            await listen(store)
        finally:
            for program in programs:
                if program.returncode is None:
                    program.kill()
                await program.wait()


async def start_program(store: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(sys.executable, __file__, store)


if __name__ == "__main__":
    asyncio.run(lead(sys.argv[1]) if len(sys.argv) > 1 else main())
