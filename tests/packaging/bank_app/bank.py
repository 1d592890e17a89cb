"""A user's program, as type checkers see it: messages, actors, a tree, mechanisms, asks."""

from __future__ import annotations

import holdfast as hf


class Deposit(hf.Message[int]):
    """Pay in; the reply is the balance."""

    amount: int
    note: str = ""


class Owner(hf.Message[str]):
    """Ask whose account it is."""


class Close(hf.Message):
    """Close the account; there is no reply."""


class Transfer(hf.Message[tuple[int, int]]):
    """Move money; the reply is both balances."""

    amount: int


class Overdrawn(hf.Refusal):
    missing: int


class Account(hf.Actor):
    def __init__(self, owner: str, balance: int = 0) -> None:
        self.owner = owner
        self.balance = balance

    @hf.on(Deposit)
    def deposit(self, message: Deposit) -> int:
        if self.balance + message.amount < 0:
            raise Overdrawn(missing=-(self.balance + message.amount))
        self.balance += message.amount
        return self.balance

    @hf.on(Owner, readonly=True)
    async def tell_owner(self, message: Owner) -> str:
        return self.owner

    @hf.on(Close)
    def close(self, message: Close) -> None:
        self.ctx.stop()


class Teller(hf.Actor):
    source: hf.Binding[Account]
    target: hf.Binding[Account]

    @hf.on(Transfer)
    async def transfer(self, message: Transfer) -> tuple[int, int]:
        paid = await self.source.ask(Deposit(-message.amount))
        return paid, await self.target.ask(Deposit(message.amount))


class Clerk(hf.Actor):
    """Answers later."""

    def __init__(self) -> None:
        self.waiting: list[hf.ReplyHandle[int]] = []

    @hf.on(Deposit)
    def deposit(self, message: Deposit) -> hf.ReplyHandle[int]:
        handle: hf.ReplyHandle[int] = self.ctx.reply_handle()
        self.waiting.append(handle)
        return handle


alice = hf.child("alice", hf.start(Account, "Alice", 100), isolation="process", recovery=hf.hybrid(interval=2.0))
bob = hf.child("bob", hf.start(Account, "Bob", balance=5), restart="transient", mailbox=hf.bounded(100))
vault = hf.child("vault", hf.start(Account, "the bank"), mechanism=(hf.ftm.PBR(), hf.ftm.TR()))
teller = hf.child(
    "teller", hf.start(Teller), bindings={"source": "/app/bank/alice", "target": "/app/bank/bob"}, backoff=hf.Backoff()
)
bank = hf.supervisor(
    "bank",
    strategy="rest_for_one",
    intensity=3,
    period=5.0,
    children=[alice, bob, vault, teller],
    rules=[hf.rule(hf.Killed, "restart")],
)
branches = hf.dynamic("branches", max_children=10)


async def main() -> None:
    async with hf.ActorSystem("app", store="sqlite:bank.db") as system:
        supervisor: hf.ActorRef[hf.Supervisor] = await system.start(bank)
        account: hf.ActorRef[Account] = await system.start(hf.child("carol", hf.start(Account, "Carol")))
        balance: int = await account.ask(Deposit(5), timeout=2.0)
        owner: str = await system.ref("/app/bank/alice", Account).ask(Owner())
        anyone = system.ref("/app/bank/bob")
        both: tuple[int, int] = await system.ref("/app/bank/teller", Teller).ask(Transfer(balance))
        await anyone.send(Close())
        anyone.tell(Deposit(1, note=owner))
        clerk = system.spawn(hf.start(Clerk), "clerk")
        async with system.transaction() as change:
            change.protect(account, hf.ftm.compose(hf.ftm.PBR(), hf.ftm.TR()))
            change.add(supervisor, hf.child("dave", hf.start(Account, "Dave", both[0])))
        await system.stop(clerk)


if __name__ == "__main__":
    hf.run(main())
