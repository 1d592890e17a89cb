"""Chapter 1 of the tutorial: an account that is an actor."""

import holdfast as hf


class Deposit(hf.Message[int]):  # the asker gets an int: the new balance
    amount: int


class Withdraw(hf.Message[int]):
    amount: int


class Balance(hf.Message[int]): ...


class Overdrawn(hf.Refusal):
    missing: int


class Account(hf.Actor):
    def __init__(self, balance: int = 0) -> None:
        self.balance = balance

    @hf.on(Deposit)
    def deposit(self, message: Deposit) -> int:
        self.balance += message.amount
        return self.balance

    @hf.on(Withdraw)
    def withdraw(self, message: Withdraw) -> int:
        if message.amount > self.balance:
            raise Overdrawn(missing=message.amount - self.balance)
        self.balance -= message.amount
        return self.balance

    @hf.on(Balance, readonly=True)
    def read(self, message: Balance) -> int:
        return self.balance


async def main() -> None:
    async with hf.ActorSystem("bank", log=False) as system:
        alice = await system.start(hf.child("alice", hf.start(Account, 100)))
        print(alice.path)  # /bank/alice

        print(await alice.ask(Deposit(20)))  # 120
        alice.tell(Deposit(5))  # nobody waits for an answer
        print(await alice.ask(Balance()))  # 125

        try:
            await alice.ask(Withdraw(500))
        except Overdrawn as no:
            print("short of", no.missing)  # short of 375
        print(await alice.ask(Balance()))  # 125


if __name__ == "__main__":
    hf.run(main())
