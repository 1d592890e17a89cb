"""Chapter 2 of the tutorial: a supervisor, and a teller that uses two accounts."""

from chapter_1 import Account, Balance, Deposit, Overdrawn, Withdraw

import holdfast as hf


class Transfer(hf.Message[int]):  # its reply: how many transfers this teller has made
    amount: int


class Teller(hf.Actor):
    source: hf.Binding[Account]
    target: hf.Binding[Account]

    def __init__(self) -> None:
        self.transfers = 0

    @hf.on(Transfer)
    async def transfer(self, message: Transfer) -> int:
        await self.source.ask(Withdraw(message.amount))
        await self.target.ask(Deposit(message.amount))
        self.transfers += 1
        return self.transfers


branch = hf.supervisor(
    "branch",
    strategy="one_for_one",
    intensity=3,
    period=5.0,
    children=[
        hf.child("alice", hf.start(Account, 100)),
        hf.child("bob", hf.start(Account)),
        hf.child(
            "teller",
            hf.start(Teller),
            bindings={"source": "/bank/branch/alice", "target": "/bank/branch/bob"},
        ),
    ],
)


async def main() -> None:
    async with hf.ActorSystem("bank", log=False) as system:
        await system.start(branch)
        alice = system.ref("/bank/branch/alice", Account)
        bob = system.ref("/bank/branch/bob", Account)
        teller = system.ref("/bank/branch/teller", Teller)

        print(await teller.ask(Transfer(30)))  # 1
        print(await alice.ask(Balance()), await bob.ask(Balance()))  # 70 30

        try:
            await teller.ask(Transfer(500))
        except Overdrawn as no:
            print("short of", no.missing)  # short of 430

        try:
            await alice.ask(Deposit("ten"))  # type: ignore[arg-type]  # a bug in the caller
        except hf.RemoteCrash as crash:
            print(crash.type_name)  # TypeError

        print(await alice.ask(Balance()), await bob.ask(Balance()))  # 100 30


if __name__ == "__main__":
    hf.run(main())
